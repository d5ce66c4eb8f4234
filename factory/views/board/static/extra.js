// What a report shows beyond the live page: what was left out, settings.

import { extra, h, section, table } from "./dom.js";

export function extraSections() {
  return extra ? [leftOut(), settings()] : [];
}

const listed = (name, rows, heads = ["what", "why"]) => table(name, heads, Object.entries(rows).map(([k, v]) => h("tr", null, h("th", { scope: "row" }, k), h("td", null, v))));

function leftOut() {
  const found = Object.entries(extra.left_out ?? {}).filter(([, rows]) => Object.keys(rows).length);
  return found.length ? section("What the reader left out", null, found.map(([title, rows]) => [h("h3", null, title), listed("left-out", rows)])) : null;
}

function settings() {
  return h("details", null, h("summary", null, "Settings of the newest run"), listed("settings", extra.settings));
}

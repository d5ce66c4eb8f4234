// What a report shows beyond the live page: how good the scenes are, what was left out, settings.

import { extra, h, section, table } from "./dom.js";

export function extraSections() {
  return extra ? [scenes(), leftOut(), settings()] : [];
}

const listed = (name, rows, heads = ["what", "why"]) => table(name, heads, Object.entries(rows).map(([k, v]) => h("tr", null, h("th", { scope: "row" }, k), h("td", null, v))));

function scenes() {
  const found = Object.entries(extra.scenes ?? {}).filter(([, rows]) => Object.keys(rows).length);
  return found.length ? section("How well scenes show photos they were not made of", "Means over each camera's photos that were held out.", found.map(([title, rows]) => [h("h3", null, title), listed("scenes", rows, ["camera", "held-out photos"])])) : null;
}

function leftOut() {
  const found = Object.entries(extra.left_out ?? {}).filter(([, rows]) => Object.keys(rows).length);
  return found.length ? section("What the reader left out", null, found.map(([title, rows]) => [h("h3", null, title), listed("left-out", rows)])) : null;
}

function settings() {
  return h("details", null, h("summary", null, "Settings of the newest run"), listed("settings", extra.settings));
}

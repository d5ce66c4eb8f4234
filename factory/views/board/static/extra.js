// What a report shows beyond the live page: rejected attempts, cameras beside the log's photos, how good the scenes are,
// what was left out, settings.

import { extra, h, jpeg, section, table } from "./dom.js";

const ROWS = { now: "", earlier: "up to now", photos: "photo and rendering of the same pose", aside: "the same instant from the side" };

export function extraSections() {
  return extra ? [rejected(), strips(), scenes(), leftOut(), settings()] : [];
}

function figure(one) {
  const shown = one.data ? h("img", { alt: one.caption, src: jpeg(one.data) }) : h("div", { class: "missing" }, "no picture");
  return h("figure", null, shown, h("figcaption", null, one.caption, one.detail ? h("small", null, one.detail) : null));
}

function rejected() {
  if (!extra.rejected?.length) return null;
  return section("What was turned down", "Rejected attempts at now, seen from above, 60 m from bottom to top; orange the perturbation, blue the expert.", h("div", { class: "cards" }, extra.rejected.map(figure)));
}

function strips() {
  if (!extra.strips?.length) return null;
  const one = (strip) => h("div", { class: "strip" }, h("h3", null, strip.title, " ", h("span", { class: "pill plain" }, strip.source)),
    Object.entries(ROWS).filter(([name]) => strip.rows[name].length).map(([name, title]) => [title ? h("p", { class: "note" }, title) : null, h("div", { class: name === "now" || name === "photos" ? "cams" : "cams small" }, strip.rows[name].map(figure))]));
  return section("Camera frames", "photo: the log's own image. render: drawn from the block's reconstruction at the simulated poses. map: lanes and boxes drawn.", extra.strips.map(one));
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

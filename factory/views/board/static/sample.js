// One sample: its cameras, its drive from above, its scores, where it comes from, and its siblings.

import { ends } from "./charts.js";
import { address, ask, fold, h, holds, legend, picture, plural, score, section, still, table } from "./dom.js";

const STEPS = 56;
const NOW = 15;
const SLOW_MS = 150; // a picture that takes longer is said to be loading
const SCORES = {
  nc: "no at-fault collision", dac: "drivable area compliance", ddc: "driving direction compliance", tlc: "traffic light compliance", ep: "ego progress",
  ttc: "time to collision", lk: "lane keeping", hc: "history comfort", ec: "extended comfort", score: "EPDMS, all together",
};

export async function samplePage(id) {
  const [w, o] = await Promise.all([ask(`/api/samples/${id}`), ask("/api/overview")]);
  return [head(w), h("div", { class: "two" }, player(w, o), scores(w)), cameras(w), siblings(w, o.coverage), lineage(w)];
}

function head(w) {
  const i = w.item;
  const link = (id, text, go) => h("a", { class: `button${id ? "" : " off"}`, href: id ? `#/sample/${id}` : null, "data-go": go }, text);
  const facts = Object.entries(w.facts).map(([k, v]) => h("div", null, h("dt", null, k), h("dd", null, v)));
  return h("header", null,
    h("div", null, h("h1", null, `${i.expert}, round ${i.round}`), h("span", { class: "pill plain" }, i.image_source), h("span", { class: "space" }), episode(i), link(w.newer, "← newer", "back"), link(w.older, "older →", "on")),
    h("p", { class: "path" }, `sample ${i.attempt_id}, log ${i.log_id}`), h("dl", null, facts));
}

function episode(i) {
  if (still) return null;
  return h("a", { class: "button", href: `/episode/${i.attempt_id}.mcap`, download: `sample_${i.attempt_id}.mcap`, title: "for Foxglove, Lichtblick or Rerun" }, "↓ MCAP");
}

function player(w, o) {
  const at = (step) => address(w.item, "bev.jpg", `&size=600&step=${step}`);
  const image = h("img", { alt: "the scene from above", class: "bev", width: 600, height: 600 });
  const time = h("output");
  const range = h("input", { type: "range", min: 0, max: STEPS - 1, value: NOW, "aria-label": "time" });
  const button = h("button", { type: "button", "data-go": "play" }, "▶ play");
  let timer = 0;
  const say = (doing) => {
    const t = (Number(range.value) - NOW) / 10;
    time.textContent = `${t > 0 ? "+" : ""}${t.toFixed(1)} s${doing || (t ? "" : ": now")}`;
  };
  const show = () => {
    image.src = at(range.value);
    say("");
    setTimeout(() => image.complete || say(": loading"), SLOW_MS);
  };
  image.addEventListener("load", () => say(""));
  image.addEventListener("error", () => say(": no picture"));
  const tick = () => {
    if (!range.isConnected) return clearInterval(timer);
    if (!image.complete) return undefined;
    range.value = (Number(range.value) + 1) % STEPS;
    return show();
  };
  range.addEventListener("input", show);
  button.addEventListener("click", () => {
    const plays = timer !== 0;
    clearInterval(timer);
    timer = plays ? 0 : setInterval(tick, 100);
    button.textContent = plays ? "▶ play" : "■ stop";
  });
  show();
  return section("From above", "60 m from bottom to top, the ego pointing up. Now is 0 s: what led here, perturbed, before it; the expert's drive, the label, after it.", image, legend(o), still ? null : h("div", { class: "player" }, button, range, time));
}

function scores(w) {
  const cell = (value, fails) => h("td", { class: `n${value !== null && value < 1 ? " low" : ""}` }, score(value), fails === null ? null : h("small", null, `fails at ${fails.toFixed(1)} s`));
  const rows = w.scores.map((one) => h("tr", { "data-score": one.name, class: one.name === "score" ? "sum" : null },
    h("th", { scope: "row" }, SCORES[one.name] ?? one.name, h("small", null, one.name)), cell(one.stage1, one.stage1_fails_s), cell(one.stage2, one.stage2_fails_s)));
  return section("Scores", "1 is best, what is below it is orange. The perturbation is the way to now, the drive is the label from now.", table("scores", ["", "perturbation", "drive"], rows));
}

function cameras(w) {
  if (!w.images.length) return section("Cameras", null, h("p", { class: "nothing" }, "This sample has no images."));
  const times = [...new Set(w.images.map((i) => i.time_s.toFixed(1)))].sort((a, b) => Number(a) - Number(b));
  const names = [...new Set(w.images.map((i) => i.camera))];
  const strips = names.map((name) => h("div", { class: "strip" }, h("h3", null, name),
    h("div", { class: "film" }, times.map((t) => {
      const found = w.images.find((i) => i.camera === name && i.time_s.toFixed(1) === t);
      if (!found) return h("figure", null, h("div", { class: "missing" }, "none"));
      const file = `${found.index}.jpg`;
      const link = h(still ? "span" : "a", { href: still ? null : address(w.item, file), target: "_blank", rel: "noopener" }, picture(w.item, file, `${name} at ${t} s`, "&small=1"));
      return h("figure", { class: Number(t) === 0 ? "now" : null }, link, h("figcaption", null, Number(t) === 0 ? "now" : `${t} s`));
    }))));
  requestAnimationFrame(() => strips.forEach((strip) => (strip.lastChild.scrollLeft = strip.lastChild.scrollWidth))); // to now
  return section("Cameras", still ? "At now, made smaller." : `${plural(w.images.length, "image")}; a click opens one as it is stored.`, strips);
}

function siblings(w, grid) {
  const all = w.siblings.map((one) => ({ ...one, here: one.attempt_id === w.item.attempt_id }));
  if (w.item.candidate_index < 0) return null;
  const fell = all.filter((one) => one.kind === "rejected").length;
  const rows = all.filter((one) => one.kind !== "untried").map((one) => h("tr", { class: one.here ? "here" : one.kind, "data-kind": one.kind },
    h("td", { class: "n" }, one.candidate_index),
    h("td", null, one.kind === "accepted" ? (one.here ? h("b", null, "this sample") : h(holds(one.attempt_id) ? "a" : "span", { href: `#/sample/${one.attempt_id}` }, `accepted, round ${one.round}`)) : one.kind),
    h("td", null, one.words || one.reason, one.words ? h("small", null, one.reason) : null),
    h("td", { class: "n" }, one.end_x_m === null ? "-" : `${one.end_x_m.toFixed(1)}, ${one.end_y_m.toFixed(2)}`),
    h("td", { class: "dim roomy" }, one.detail)));
  const lead = `The perturbations of this clip in the order in which ${w.item.expert} tried them: ${fell} were turned down. Each round goes on until one is accepted.`;
  const key = h("p", { class: "keys" }, [...new Set(all.map((one) => one.kind)), "this sample"].map((kind) => h("span", null, h("i", { class: `dot ${kind.replace("this sample", "here")}` }), kind)));
  return section("Siblings", lead, key, ends(all, grid.reach_along_m, grid.reach_aside_m), table("siblings", ["#", "became", "why", "ends at x, y [m]", "detail*"], rows));
}

function lineage(w) {
  const rows = Object.entries(w.lineage).map(([k, v]) => h("tr", null, h("th", { scope: "row" }, k), h("td", null, v)));
  return fold("Lineage", "what it was made from and by", table("settings", ["", ""], rows));
}

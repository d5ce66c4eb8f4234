// The two drawings of the overview: rows by time, and counts over a plane.

import { clock, count, h, s, span } from "./dom.js";

export function timeline(t) {
  const [width, height] = [1000, 150];
  const most = Math.max(1, ...t.attempts);
  const step = width / t.attempts.length;
  const tall = (n) => ((height - 6) * n) / most;
  const bars = t.attempts.flatMap((attempts, i) => {
    const samples = t.samples[i];
    const at = t.began_ms + 1000 * t.bucket_s * i;
    const tip = `${clock(at)}: ${count(samples)} samples of ${count(attempts)} attempts in ${span(t.bucket_s)}`;
    const rect = (n, kind) =>
      s("rect", { x: i * step + 1, width: Math.max(1, step - 2), y: height - tall(n), height: tall(n), class: kind });
    return [s("g", null, s("title", null, tip), rect(attempts, "tried"), rect(samples, "made"))];
  });
  const line = s("line", { x1: 0, x2: width, y1: height, y2: height, class: "axis-line" });
  const drawn = { viewBox: `0 0 ${width} ${height}`, preserveAspectRatio: "none", role: "img", "aria-label": "attempts and samples by time", class: "timeline" };
  return h("div", null, s("svg", drawn, bars, line), h("p", { class: "times" }, h("span", null, clock(t.began_ms)), h("span", null, clock(t.ended_ms))));
}

export function heat(title, cells, reachAlong, reachAside, kind) {
  const [ny, nx] = [cells.length, cells[0].length];
  const [left, top, width, height, foot] = [40, 16, 454, 208, 26];
  const [dx, dy] = [width / nx, height / ny];
  const most = Math.max(1, ...cells.flat());
  const marks = [s("rect", { x: left, y: top, width, height, class: "plane" })];
  cells.forEach((row, j) =>
    row.forEach((n, i) => {
      if (!n) return;
      const along = -reachAlong + (2 * reachAlong * (i + 0.5)) / nx;
      const aside = -reachAside + (2 * reachAside * (j + 0.5)) / ny;
      const tip = `${along.toFixed(1)} m along, ${aside.toFixed(2)} m aside: ${count(n)}`;
      const place = { x: left + i * dx, y: top + height - (j + 1) * dy, width: dx + 0.3, height: dy + 0.3 };
      marks.push(s("rect", { ...place, class: kind, "fill-opacity": 0.12 + 0.88 * Math.sqrt(n / most) }, s("title", null, tip)));
    }),
  );
  const across = { x1: left, x2: left + width, y1: top + height / 2, y2: top + height / 2, class: "zero" };
  const up = { x1: left + width / 2, x2: left + width / 2, y1: top, y2: top + height, class: "zero" };
  marks.push(s("line", across), s("line", up));
  for (const part of [-1, 0, 1]) {
    const [x, y] = [left + (width * (part + 1)) / 2, top + (height * (1 - part)) / 2];
    const sign = (v) => (v > 0 ? `+${v}` : v < 0 ? `${v}` : "0");
    const anchor = ["start", "middle", "end"][part + 1];
    marks.push(s("text", { x, y: top + height + 18, "text-anchor": anchor }, sign(part * reachAlong)));
    marks.push(s("text", { x: left - 5, y: y + 4, "text-anchor": "end" }, sign(part * reachAside)));
  }
  const total = cells.flat().reduce((a, b) => a + b, 0);
  const caption = h("figcaption", { class: "keys" }, h("i", { class: `key ${kind}` }), h("b", null, title), ` ${count(total)}, at most ${count(most)} in a cell`);
  return h("figure", { class: "heat" }, s("svg", { viewBox: `0 0 ${left + width + 8} ${top + height + foot}`, role: "img", "aria-label": title }, marks), caption);
}

export function ends(siblings, reachAlong, reachAside) {
  // Where the candidates of one clip end, by what became of them.
  const [left, top, width, height, foot] = [40, 16, 454, 192, 24];
  const known = siblings.filter((one) => one.end_x_m !== null);
  const x = (m) => left + (width * (m + reachAlong)) / (2 * reachAlong);
  const y = (m) => top + (height * (reachAside - m)) / (2 * reachAside);
  const marks = [
    s("rect", { x: left, y: top, width, height, class: "plane" }),
    s("line", { x1: x(0), x2: x(0), y1: top, y2: top + height, class: "zero" }),
    s("line", { x1: left, x2: left + width, y1: y(0), y2: y(0), class: "zero" }),
  ];
  for (const one of known) {
    const tip = s("title", null, `candidate ${one.candidate_index}: ${one.kind} ${one.reason}`);
    const [u, v] = [x(one.end_x_m), y(one.end_y_m)];
    const cross = `M${u - 4} ${v - 4}l8 8m0 -8l-8 8`;
    marks.push(
      one.kind === "rejected" || one.kind === "failed"
        ? s("path", { d: cross, class: `mark ${one.kind}` }, tip)
        : s("circle", { cx: u, cy: v, r: one.here ? 7 : 5, class: `mark ${one.kind}${one.here ? " here" : ""}` }, tip),
    );
  }
  marks.push(s("text", { x: left, y: top + height + 18 }, `-${reachAlong} m`));
  marks.push(s("text", { x: left + width, y: top + height + 18, "text-anchor": "end" }, `+${reachAlong} m`));
  marks.push(s("text", { x: left - 4, y: top + 10, "text-anchor": "end" }, `+${reachAside}`));
  marks.push(s("text", { x: left - 4, y: top + height, "text-anchor": "end" }, `-${reachAside}`));
  return s("svg", { viewBox: `0 0 ${left + width + 8} ${top + height + foot}`, role: "img", "aria-label": "where the candidates end", class: "ends" }, marks);
}

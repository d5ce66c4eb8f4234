// Elements, numbers and questions to the server. Text from data only ever becomes text nodes.

const SVG = "http://www.w3.org/2000/svg";

function built(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "style") Object.entries(value).forEach(([k, v]) => node.style.setProperty(k, v));
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat(2).filter((child) => child !== null && child !== undefined));
  return node;
}

export const h = (tag, attributes, ...children) => built(document.createElement(tag), attributes, children);
export const s = (tag, attributes, ...children) => built(document.createElementNS(SVG, tag), attributes, children);

export const count = (n) => n.toLocaleString("en-US");
export const percent = (share) => (share === null ? "-" : `${(100 * share).toFixed(1)}\u00a0%`);
export const score = (value) => (value === null ? "-" : value.toFixed(3));

const OLD_MS = 20 * 3600 * 1000; // then the day is told too
export function clock(ms) {
  const day = Date.now() - ms > OLD_MS ? { month: "short", day: "numeric" } : {};
  return new Date(ms).toLocaleString([], { ...day, hour: "2-digit", minute: "2-digit" });
}

export const plural = (n, word) => `${count(n)} ${word}${n === 1 ? "" : "s"}`;

export function span(seconds) {
  if (seconds < 90) return `${seconds.toFixed(seconds < 10 ? 1 : 0)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  if (seconds < 172800) return `${(seconds / 3600).toFixed(1)} h`;
  return `${(seconds / 86400).toFixed(1)} days`;
}

export function bytes(n) {
  const [unit, size] = n >= 1e9 ? ["GB", 1e9] : n >= 1e6 ? ["MB", 1e6] : ["kB", 1e3];
  return `${(n / size).toFixed(n / size < 10 ? 1 : 0)} ${unit}`;
}

// A report is this page with its answers and some pictures inside (factory/views/board/report.py); there is no server then.
const kept = JSON.parse(document.getElementById("kept")?.textContent ?? "null");
export const still = kept !== null;
export const extra = kept?.extra ?? null;
export const holds = (id) => !still || `/api/samples/${id}` in kept.answers;
const jpeg = (base64) => `data:image/jpeg;base64,${base64}`;

export function address(item, name, query = "") {
  if (!still) return `/picture/${item.attempt_id}/${name}?v=${item.file}${query}`;
  const data = kept.pictures[`${item.attempt_id}/${name}`];
  return data ? jpeg(data) : null;
}

export async function ask(path) {
  if (still) {
    const found = kept.answers[path.replace(/\?$/, "")];
    if (!found) throw new Error("this report holds some of the samples; the dashboard shows all of them");
    return found;
  }
  const answer = await fetch(path);
  const body = await answer.json();
  if (!answer.ok) throw new Error(body.error ?? answer.statusText);
  return body;
}

export const section = (title, lead, ...content) =>
  h("section", null, h("h2", null, title), lead ? h("p", { class: "lead" }, lead) : null, ...content);

export const fold = (title, fact, ...content) =>
  h("details", { "data-fold": title }, h("summary", null, title, h("span", { class: "dim" }, fact)), ...content);

// Everything that a picture from above draws, in the colours it is drawn in.
export const legend = (o) =>
  h("p", { class: "keys" }, Object.entries(o.legend).map(([name, background]) => h("span", null, h("i", { class: "key", style: { background } }), name)));

export const listed = (name, rows) => table(name, ["what", "why"], Object.entries(rows).map(([k, v]) => h("tr", null, h("th", { scope: "row" }, k), h("td", null, v))));

// A title that ends in * is of a column that a narrow screen leaves out; its cells have the class roomy.
export function table(name, head, rows) {
  const titled = (title) => h("th", { scope: "col", class: title.endsWith("*") ? "roomy" : null }, title.replace("*", ""));
  const top = head.some(Boolean) ? h("thead", null, h("tr", null, head.map(titled))) : null;
  return h("div", { class: "wide" }, h("table", { class: name }, top, h("tbody", null, rows)));
}

export function bar(share, text, mark) {
  const track = h("span", { class: "track" }, h("span", { style: { width: `${100 * (share ?? 0)}%` } }));
  if (mark !== null && mark !== undefined) {
    track.append(h("i", { style: { left: `${100 * mark}%` }, title: `paper ${Math.round(100 * mark)} %` }));
  }
  return h("span", { class: "bar" }, track, h("span", { class: "value" }, text));
}

export function picture(item, name, alt, query = "") {
  const image = h("img", still ? { alt } : { alt, loading: "lazy", decoding: "async" });
  image.addEventListener("load", () => image.setAttribute("data-loaded", image.naturalWidth));
  image.addEventListener("error", () => image.replaceWith(h("span", { class: "missing" }, "no picture")));
  const source = address(item, name, query);
  if (source === null) return h("span", { class: "missing" }, "no picture");
  image.src = source;
  return image;
}

export const EXPERT_WORDS = {
  human: "the logged drive itself",
  pdm_closed: "plans by rule and scores its own proposals",
  recovery: "steers back to the logged drive",
};

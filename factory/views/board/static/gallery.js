// Samples as cards, by page, with filters that stand in the address.

import { ask, count, h, legend, picture, plural, score, still } from "./dom.js";

const FILTERS = { expert: "expert", round: "round", image_source: "images", command: "command", log_id: "log" };
const ORDERS = { newest: "newest first", worst: "lowest score first", best: "highest score first" };

export function card(item) {
  const front = item.image_source === "none" ? null : picture(item, "front.jpg", "front camera");
  const bev = picture(item, "bev.jpg", "from above: logged grey, perturbed orange, expert blue");
  const words = [h("b", null, item.expert), ` round ${item.round}, ${item.command} `, h("span", { class: "score", title: "of the expert's drive" }, `EPDMS ${score(item.stage2_score)}`),
    h("small", null, `${item.log_id}`)];
  return h("a", { class: "card", href: `#/sample/${item.attempt_id}`, "data-id": item.attempt_id },
    h("span", { class: `views${front ? "" : " alone"}` }, front, bev), h("span", { class: "words" }, words));
}

export async function galleryPage(query) {
  const wanted = new URLSearchParams(query);
  const [page, overview] = await Promise.all([ask(`/api/samples?${wanted}`), ask("/api/overview")]);
  const address = (changes) => {
    const next = new URLSearchParams(query);
    Object.entries(changes).forEach(([k, v]) => (v ? next.set(k, v) : next.delete(k)));
    return `#/gallery?${next}`;
  };
  const go = (name) => (event) => (location.hash = address({ [name]: event.target.value, page: "" }));
  const choice = (name, title, values) => h("label", null, title, h("select", { onchange: go(name), name },
    values.map(([value, text]) => h("option", { value, selected: (wanted.get(name) ?? "") === value }, text))));
  const filters = Object.entries(FILTERS).filter(([name]) => overview.facets[name].length > 1).map(([name, title]) =>
    choice(name, title, [["", "all"], ...overview.facets[name].map((v) => [v, v])]));
  const order = choice("order", "order", Object.entries(ORDERS).map(([k, v]) => [k === "newest" ? "" : k, v]));
  const steps = h("div", { class: "pager" },
    h("a", { class: `button${page.page > 1 ? "" : " off"}`, href: page.page > 1 ? address({ page: String(page.page - 1) }) : null, "data-go": "back" }, "← back"),
    h("span", { id: "total" }, `${plural(page.total, "sample")}, page ${count(page.page)} of ${count(page.pages)}`),
    h("a", { class: `button${page.page < page.pages ? "" : " off"}`, href: page.page < page.pages ? address({ page: String(page.page + 1) }) : null, "data-go": "on" }, "on →"));
  const key = legend(overview);
  const cards = page.items.length ? h("div", { class: "cards" }, page.items.map(card)) : h("p", { class: "nothing" }, "No sample fits.");
  if (still) {
    const some = h("p", { class: "lead", id: "total" }, `${count(page.items.length)} of ${plural(page.total, "sample")}: the newest, and some as unlike each other as can be.`);
    return [h("section", null, h("h2", null, "Samples"), some, key, cards)];
  }
  return [h("section", null, h("h2", null, "Samples"), h("div", { class: "filters" }, filters, order), key, cards, steps)];
}

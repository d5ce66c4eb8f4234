// Failed attempts with their errors, and how to try them again.

import { ask, count, fold, h, plural, section, table } from "./dom.js";

const said = (error) => {
  const last = error.trim().split("\n").pop();
  return [last, last === error.trim() ? null : fold("traceback", "", h("pre", null, error))];
};

export async function failedPage(query) {
  const number = new URLSearchParams(query).get("page") ?? "1";
  const f = await ask(`/api/failed?page=${encodeURIComponent(number)}`);
  if (!f.total) return [section("Failed attempts", null, h("p", { class: "nothing" }, "No attempt failed."))];
  const rows = f.items.map((one) => h("tr", null,
    h("th", { scope: "row" }, one.log_id, h("small", null, `clip ${one.clip_id}`)),
    h("td", null, one.expert || "the clip as a whole", one.expert ? h("small", null, `candidate ${one.candidate_index}`) : null),
    h("td", null, one.kind, h("small", null, one.words)), h("td", { class: "n" }, plural(one.tries, "run")),
    h("td", null, said(one.error), h("small", null, `to retry: ${one.retry}`))));
  const go = (page, text, name) => h("a", { class: "button", href: `#/failed?page=${page}`, "data-go": name }, text);
  const pager = f.pages > 1 ? h("div", { class: "pager" }, f.page > 1 ? go(f.page - 1, "← back", "back") : null, h("span", null, `page ${f.page} of ${f.pages}`), f.page < f.pages ? go(f.page + 1, "on →", "on") : null) : null;
  const some = f.items.length < f.total && !pager ? h("p", { class: "note" }, `${count(f.items.length)} of them are shown.`) : null;
  return [section("Failed attempts", `${plural(f.total, "attempt")} broke instead of being judged. They do not count as turned down.`, table("failed", ["log", "attempt", "kind", "tried in", "error"], rows), some, pager)];
}

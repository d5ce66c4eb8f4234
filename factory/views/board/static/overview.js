// The first page: how much was accepted, why the rest was not, how long it takes still, what it looks like; then the rest.

import { heat, timeline } from "./charts.js";
import { EXPERT_WORDS, ask, bar, bytes, clock, count, extra, fold, h, legend, listed, percent, plural, section, span, table } from "./dom.js";
import { card } from "./gallery.js";

const FEW = 6; // reasons on the first screen; the others are folded

export async function overviewPage() {
  const [o, newest, driven] = await Promise.all([ask("/api/overview"), ask("/api/samples?size=6&simulated=1"), ask("/api/drives")]);
  return [header(o), h("div", { class: "two" }, accepted(o), fallen(o)), looks(o, newest), drives(driven),
    acceptance(o), reasons(o), throughput(o), times(o), coverage(o), gates(o), leftOut(), source(o)];
}

function header(o) {
  const c = o.counts;
  const s = o.state;
  const p = o.planned;
  const made = c.simulated_attempts ? `${count(c.simulated)} of ${plural(c.simulated_attempts, "perturbed drive")}` : "no perturbed drive was tried yet";
  const tiles = [
    ["samples", count(c.samples), `${count(c.simulated)} simulated, ${count(c.samples - c.simulated)} logged, ${bytes(c.sample_bytes)}`],
    ["accepted", percent(c.simulated_attempts ? c.simulated / c.simulated_attempts : null), made],
    s.left ? ["left", s.left, s.detail || (s.left === "?" ? "not known yet" : "at this rate")] : s.took && ["taken", s.took, "by the newest run"],
    ["clips", count(c.clips), plural(c.candidates, "candidate perturbation")],
    c.failed && ["failed", count(c.failed), "see the errors", "#/failed"],
  ].filter(Boolean).map(([name, value, note, link]) =>
    h(link ? "a" : "div", { class: "tile", "data-count": name, href: link }, h("b", null, value), h("span", null, name), h("small", null, note)));
  const ends = ["rejected", "failed", "pending"].filter((name) => p[name]).map((name) => `, ${count(p[name])} ${name}`).join("");
  const planned = `${plural(p.planned, "sample")} planned: ${count(p.accepted)} made${ends}`;
  const state = [h("span", { class: `pill ${s.tone}` }, s.word), s.last_commit_ms ? h("span", { class: "dim" }, `last commit ${clock(s.last_commit_ms)}`) : null];
  return h("header", null, h("div", null, h("h1", null, o.where.split("/").filter(Boolean).pop()), state), h("p", { class: "path" }, o.where),
    h("div", { class: "tiles" }, tiles),
    s.live && p.planned ? bar(1 - p.pending / p.planned, planned) : p.planned ? h("p", { class: "note" }, planned) : null,
    o.cameras_left_out ? h("p", { class: "note", "data-cameras-left-out": "" }, o.cameras_left_out) : null,
    o.repaired ? h("p", { class: "note", "data-repaired": "" }, `logs: ${o.repaired}`) : null,
    s.live && !s.left ? h("p", { class: "note" }, s.detail) : null, o.notes.map((note) => h("p", { class: "note" }, note)));
}

function accepted(o) {
  const by = Object.groupBy(o.acceptance.filter((a) => a.simulated && a.tried), (a) => a.expert);
  const rows = Object.entries(by).map(([expert, rounds]) => {
    const [made, tried] = ["accepted", "tried"].map((name) => rounds.reduce((sum, a) => sum + a[name], 0));
    return h("tr", { "data-expert": expert }, named(expert, EXPERT_WORDS[expert]), h("td", null, bar(made / tried, percent(made / tried))), h("td", { class: "n dim" }, `${count(made)} of ${count(tried)}`));
  });
  const most = o.steps[0].left;
  const steps = o.steps.filter((step, i) => i === 0 || step.dropped).map((step) =>
    h("tr", { "data-step": step.name }, named(step.what), h("td", null, bar(step.left / most, count(step.left))), h("td", { class: "n dim" }, step.dropped ? `-${count(step.dropped)}` : "")));
  if (!rows.length) return section("Accepted", null, h("p", { class: "nothing" }, "No perturbed drive was tried yet."));
  return section("Accepted", "Of the perturbed drives, by expert; and what each stage left.", table("accepted", ["", "", ""], [...rows, ...steps]));
}

const named = (title, note) => h("th", { scope: "row" }, title, note ? h("small", null, note) : null);
const reason = (r) => named(r.words || r.reason, r.reason);

function fallen(o) {
  const most = o.reasons[0]?.total;
  const rows = o.reasons.slice(0, FEW).map((r) => h("tr", { title: r.reason }, named(r.words || r.reason), h("td", null, bar(r.total / most, count(r.total)))));
  return section("Why the rest was not", "One reason each: the first sub-score too low, or what failed.",
    rows.length ? table("few", ["", ""], rows) : h("p", { class: "nothing" }, "No attempt was turned down."));
}

function looks(o, newest) {
  const lead = "The newest simulated samples: the ego was put off its logged path, and an expert drove on from there.";
  const cards = newest.items.map((item) => card(item));
  return section("What it looks like", lead, cards.length ? [h("div", { class: "cards looks" }, cards), legend(o), h("a", { href: "#/gallery" }, "All samples")] : h("p", { class: "nothing" }, "There is no simulated sample yet."));
}

function drives(d) {
  if (!d.total) return null;
  const lines = d.lines.map((l) =>
    h("tr", { "data-driver": [l.planner, l.pictures, l.start].join(" ") },
      named(l.planner, `${l.start}${l.pictures === "none" ? "" : `, ${l.pictures}`}`),
      h("td", { class: "n" }, count(l.drives)), h("td", null, bar(l.score, percent(l.score))),
      h("td", { class: "n" }, percent(l.collision_at_fault)), h("td", { class: "n" }, percent(l.offroad)), h("td", { class: "n roomy" }, percent(l.left_corridor)),
      h("td", { class: "n roomy" }, l.m_between_incidents === null ? `> ${count(Math.round(1000 * l.km))}` : count(Math.round(l.m_between_incidents)))));
  const each = d.drives.map((r) =>
    h("tr", { "data-drive": r.drive_id },
      named(r.planner, `${r.log_id}${r.start < 0 ? "" : `, start ${r.start}`}`),
      h("td", null, r.failure_reason.replaceAll("_", " ")),
      h("td", { class: "n" }, percent(r.score)), h("td", { class: "n roomy" }, span(r.duration_s)),
      h("td", null, r.film ? h("a", { href: `/film/${r.drive_id}.mp4` }, "film") : "")));
  return section("Planners in closed loop", "Each plans twice a second as long as the log goes on, scored as by AlpaSim. Intervals: summary.csv.",
    table("drivers", ["planner", "drives", "score", "collision at fault", "off road", "left corridor*", "m between incidents*"], lines),
    fold("The drives", "those that failed first", table("drives", ["drive", "failed by", "score", "time*", ""], each)));
}

function acceptance(o) {
  const rows = o.acceptance.filter((a) => a.tried || a.clips).map((a) =>
    h("tr", null, named(a.expert, a.simulated ? "" : EXPERT_WORDS[a.expert]),
      h("td", { class: "n" }, count(a.round)), h("td", { class: "n roomy" }, count(a.tried)), h("td", { class: "n roomy" }, count(a.accepted)),
      h("td", null, bar(a.attempt_rate, percent(a.attempt_rate))),
      h("td", { class: "roomy" }, bar(a.first_drive_rate, percent(a.first_drive_rate), a.paper)),
      h("td", null, bar(a.clip_rate, percent(a.clip_rate), a.paper))));
  const lead = "Round r holds the (r+1)-th accepted sample of each clip and expert. Of attempts: accepted of tried. Of first drives: clips whose first drive is accepted, as one random draw a round would be; where an expert has no plan there is none. Of clips: clips with a sample of this round, of those with one of the round before.";
  const ended = Object.entries(o.exhausted).map(([expert, n]) => h("p", { class: "note" }, `${expert}: ${plural(n, "walk")} came to the end of the candidates`));
  const key = h("p", { class: "keys" }, h("span", null, h("i", { class: "key paper" }), "the paper's share of clips"));
  return fold("Acceptance by round and expert", "beside the paper's", h("p", { class: "lead" }, lead), key, table("acceptance", ["expert", "round", "tried*", "accepted*", "of attempts", "of first drives*", "of clips"], rows), ended);
}

function reasons(o) {
  const experts = [...new Set(o.reasons.flatMap((r) => Object.keys(r.by_expert)))].sort();
  const most = o.reasons[0]?.total;
  const rows = o.reasons.map((r) =>
    h("tr", { "data-reason": r.reason }, reason(r), experts.map((e) => h("td", { class: "roomy" }, r.by_expert[e] ? bar(r.by_expert[e] / most, count(r.by_expert[e])) : "")),
      h("td", null, bar(r.total / most, count(r.total)))));
  const clips = o.clip_reasons.map((r) => h("tr", null, reason(r), h("td", { class: "n" }, count(r.total))));
  return rows.length || clips.length ? fold("All reasons by expert", `${plural(rows.length, "reason")} of attempts${clips.length ? `, ${count(clips.length)} of clips` : ""}`,
    rows.length ? table("reasons", ["reason", ...experts.map((e) => `${e}*`), "all"], rows) : null,
    clips.length ? [h("h3", null, "Clips that never came to a simulated attempt"), table("clips", ["reason", "clips"], clips)] : null) : null;
}

function throughput(o) {
  const t = o.throughput;
  const rate = t.samples_per_hour === null ? "-" : count(Math.round(t.samples_per_hour));
  const lead = h("p", { class: "lead" }, `Between ${clock(t.began_ms)} and ${clock(t.ended_ms)} (${span((t.ended_ms - t.began_ms) / 1000)}), by the time of their commit.`);
  const key = h("p", { class: "keys" }, h("span", null, h("i", { class: "key tried" }), "attempts"), h("span", null, h("i", { class: "key made" }), "accepted"));
  return fold("Throughput", `${rate} samples an hour`, lead, key, timeline(t));
}

function times(o) {
  const all = o.stage_times.reduce((sum, t) => sum + t.seconds, 0);
  const sorted = [...o.stage_times].filter((t) => t.seconds > 0.005 * all).sort((a, b) => b.seconds - a.seconds);
  const rows = sorted.map((t) =>
    h("tr", null, named(t.stage), h("td", null, bar(t.seconds / sorted[0].seconds, span(t.seconds))),
      h("td", { class: "n" }, t.cpu_seconds === undefined ? "-" : span(t.cpu_seconds)), h("td", { class: "n" }, count(t.tasks)),
      h("td", { class: "n" }, t.tasks ? `${(t.seconds / t.tasks).toFixed(3)} s` : "-")));
  return rows.length ? fold("Where the time goes", sorted.slice(0, 2).map((t) => `${t.stage} ${span(t.seconds)}`).join(", "),
    h("p", { class: "lead" }, `Worker time by stage from half a percent on, of ${o.stage_times_of}.`), table("seconds", ["stage", "time", "of CPU", "tasks", "each"], rows)) : null;
}

function coverage(o) {
  const c = o.coverage;
  const maps = [heat("candidates", c.candidates, c.reach_along_m, c.reach_aside_m, "untried-cell"), heat("accepted", c.accepted, c.reach_along_m, c.reach_aside_m, "accepted-cell")];
  return fold("Coverage of end points", "where perturbed drives end", h("p", { class: "lead" }, "After four seconds, relative to where the logged drive was: metres behind and ahead of it from left to right, to its right and left from bottom to top. Darker: more of them."),
    h("div", { class: "heats" }, maps), c.beyond ? h("p", { class: "note" }, `${count(c.beyond)} end outside.`) : null);
}

function gates(o) {
  const most = Math.max(1, ...o.gates.map((g) => g.total));
  const rows = o.gates.filter((g) => g.total).map((g) => h("tr", null, reason(g), h("td", null, bar(g.total / most, count(g.total)))));
  return rows.length ? fold("Perturbation gates", "what was dropped before any attempt",
    h("p", { class: "lead" }, `Vocabulary trajectories dropped, summed over ${count(o.counts.clips)} clips; ${count(o.counts.candidates)} became candidates. One trajectory may fall to several gates.`),
    table("gates", ["gate", "dropped"], rows)) : null;
}

function leftOut() {
  const found = Object.entries(extra?.left_out ?? {}).filter(([, rows]) => Object.keys(rows).length);
  return found.length ? fold("What the reader left out", found.map(([title, rows]) => `${title.toLowerCase()}: ${count(Object.keys(rows).length)}`).join(", "),
    found.map(([title, rows]) => [h("h3", null, title), listed("left-out", rows)])) : null;
}

function source(o) {
  const facts = Object.entries({ ...o.facts, ...extra?.facts }).map(([k, v]) => h("div", null, h("dt", null, k), h("dd", null, v)));
  return fold("Source and settings", o.facts["data set"], h("dl", null, facts), extra ? listed("settings", extra.settings) : null);
}

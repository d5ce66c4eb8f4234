// The first page: what was made, how much was accepted, why the rest was not, what it looks like.

import { heat, timeline } from "./charts.js";
import { EXPERT_WORDS, ask, bar, bytes, clock, count, extra, h, percent, plural, section, span, table } from "./dom.js";
import { extraSections } from "./extra.js";
import { card } from "./gallery.js";

export async function overviewPage() {
  const [o, newest, driven] = await Promise.all([ask("/api/overview"), ask("/api/samples?size=6&simulated=1"), ask("/api/drives")]);
  return [header(o), looks(newest), drives(driven), funnel(o), balance(o), acceptance(o), reasons(o), throughput(o), times(o), coverage(o), trouble(o), gates(o), ...extraSections()];
}

function header(o) {
  const c = o.counts;
  const rate = c.simulated_attempts ? c.simulated / c.simulated_attempts : null;
  const logged = c.samples - c.simulated;
  const why = o.reasons.slice(0, 3).map((r) => `${r.words || r.reason} (${count(r.total)})`);
  const told = [
    `${plural(c.samples, "sample")} from ${plural(c.clips, "clip")}: ${count(c.simulated)} simulated, ${count(logged)} logged. `,
    c.simulated_attempts ? `Of ${count(c.simulated_attempts)} perturbed drives that were tried, ${percent(rate)} were accepted` : "No perturbed drive was tried yet",
    why.length ? `; the others fell mostly to: ${why.join(", ")}.` : ".",
  ].join("");
  const tiles = [
    ["samples", c.samples, `${count(c.simulated)} simulated, ${bytes(c.sample_bytes)}`],
    ["attempts", c.attempts, `${count(c.rejected)} turned down`],
    ["accepted", percent(rate), "of the perturbed drives"],
    ["clips", c.clips, `${count(c.candidates)} candidate perturbations`],
    ["failed", c.failed, c.failed ? "see the errors" : "nothing broke", c.failed ? "#/failed" : null],
  ].map(([name, value, note, link]) => {
    const inner = [h("b", null, typeof value === "number" ? count(value) : value), h("span", null, name), h("small", null, note)];
    return h(link ? "a" : "div", { class: "tile", "data-count": name, href: link }, inner);
  });
  const s = o.state;
  const state = [h("span", { class: `pill ${s.tone}` }, s.word)];
  if (s.last_commit_ms) state.push(h("span", { class: "dim" }, `last commit ${clock(s.last_commit_ms)}`));
  return h("header", null, h("div", null, h("h1", null, o.where.split("/").filter(Boolean).pop()), ...state), h("p", { class: "path" }, o.where),
    h("p", { class: "story" }, told), s.detail ? h("p", { class: "note" }, s.detail) : null, progress(o.throughput), plan(o.planned),
    h("div", { class: "tiles" }, tiles),
    h("dl", null, Object.entries({ ...o.facts, ...extra?.facts }).map(([k, v]) => h("div", null, h("dt", null, k), h("dd", null, v)))),
    o.notes.map((note) => h("p", { class: "note" }, note)));
}

function progress(t) {
  if (t.walks === null) return null;
  const left = t.eta_s === null ? "time left: not known yet" : `about ${span(t.eta_s)} left`;
  return h("div", { class: "progress" }, bar(t.walks ? t.walks_done / t.walks : 0, `${count(t.walks_done)} of ${count(t.walks)}`),
    h("small", null, `walks ended (one clip with one expert) since ${clock(t.began_ms)}; ${left}`));
}

function plan(p) {
  if (!p.planned) return null;
  return h("p", { class: "note" }, `${plural(p.planned, "sample")} planned: ${count(p.accepted)} made, ${count(p.rejected)} rejected, ` +
    `${count(p.failed)} failed, ${count(p.pending)} pending`);
}

function looks(newest) {
  const lead = "The newest simulated samples. Each is a drive that no human drove: the ego was put off its logged path (orange), and an expert drove on from there (blue).";
  const cards = newest.items.map((item) => card(item));
  return section("What it looks like", lead, cards.length ? h("div", { class: "cards looks" }, cards) : h("p", { class: "nothing" }, "There is no simulated sample yet."),
    h("p", null, h("a", { href: "#/gallery" }, "All samples")));
}

function drives(d) {
  if (!d.total) return null;
  const lines = d.lines.map((l) =>
    h("tr", { "data-driver": [l.planner, l.pictures, l.start].join(" ") },
      h("th", { scope: "row" }, l.planner, h("small", null, `${l.start}${l.pictures === "none" ? "" : `, ${l.pictures}`}`)),
      h("td", { class: "n" }, count(l.drives)), h("td", null, bar(l.route_completed, percent(l.route_completed))),
      h("td", { class: "n" }, percent(l.at_fault_collision)), h("td", { class: "n" }, percent(l.off_road)), h("td", { class: "n roomy" }, percent(l.comfortable)),
      h("td", { class: "n roomy" }, l.m_between_failures === null ? `> ${count(Math.round(1000 * l.km))}` : count(Math.round(l.m_between_failures)))));
  const each = d.drives.map((r) =>
    h("tr", { "data-drive": r.drive_id },
      h("th", { scope: "row" }, r.planner, h("small", null, `${r.log_id}${r.start < 0 ? "" : `, start ${r.start}`}`)),
      h("td", null, r.at_fault_collision ? `hit a ${r.hit_kind.toLowerCase()}` : r.ended.replace("_", " ")),
      h("td", { class: "n" }, percent(r.route_completed)), h("td", { class: "n roomy" }, span(r.duration_s)),
      h("td", null, r.film ? h("a", { href: `/film/${r.drive_id}.mp4` }, "film") : "")));
  return section("Planners in closed loop", "Each plans twice a second and drives on among traffic that answers, until a collision, the end of the road or of the known scene, or its time is up. Intervals: summary.csv.",
    table("drivers", ["planner", "drives", "route completed", "at fault", "off road", "comfortable*", "m between failures*"], lines),
    h("details", null, h("summary", null, `The drives, those that failed first`), table("drives", ["drive", "ended", "route", "time*", ""], each)));
}

function funnel(o) {
  const most = o.steps[0]?.left ?? 0;
  const rows = o.steps.map((step) =>
    h("tr", { "data-step": step.name },
      h("th", { scope: "row" }, step.what, h("small", null, step.name)),
      h("td", null, bar(most ? step.left / most : 0, count(step.left))),
      h("td", { class: "n" }, step.dropped ? `-${count(step.dropped)}` : ""),
      h("td", { class: "n dim roomy" }, most ? percent(step.left / most) : "-")));
  return section("From perturbation to sample", "How many of the perturbed drives are left after each stage.", table("steps", ["after", "left", "fell", "of all*"], rows));
}

function balance(o) {
  if (!o.balance.length) return null;
  const counts = ["planned", "accepted", "rejected", "failed", "pending"];
  const rows = o.balance.map((b) => {
    const who = [b.expert, b.round < 0 ? "" : `round ${b.round}`].filter(Boolean).join(", ");
    return h("tr", { "data-balance": [b.stage, b.expert, b.round].join(" ") }, h("th", { scope: "row" }, b.stage, h("small", null, who)), counts.map((name) => h("td", { class: "n" }, count(b[name]))));
  });
  return section("What was planned", "Clips, then each expert's attempts from task to task, then samples by round: planned = accepted + rejected + failed + pending.", table("balance", ["stage", ...counts], rows));
}

function acceptance(o) {
  const rows = o.acceptance.map((a) =>
    h("tr", null,
      h("th", { scope: "row" }, a.expert, a.round === 0 ? h("small", null, EXPERT_WORDS[a.expert] ?? "") : null),
      h("td", { class: "n" }, count(a.round)), h("td", { class: "n roomy" }, count(a.tried)), h("td", { class: "n roomy" }, count(a.accepted)),
      h("td", null, bar(a.attempt_rate, percent(a.attempt_rate))),
      h("td", { class: "roomy" }, bar(a.first_try_rate, percent(a.first_try_rate), a.paper)),
      h("td", null, bar(a.clip_rate, percent(a.clip_rate), a.paper)),
      h("td", { class: "n dim roomy" }, a.paper === null ? "-" : `${Math.round(100 * a.paper)} %`)));
  const lead = "Round r holds the (r+1)-th accepted sample of each clip and expert. Of attempts: accepted of tried. Of first tries: clips accepted without a second try, as one random draw a round would be. Of clips: clips with a sample of this round, of those with one of the round before; the orange marks and the last column are the paper's.";
  const ended = Object.entries(o.exhausted).map(([expert, n]) => h("p", { class: "note" }, `${expert}: ${plural(n, "walk")} came to the end of the candidates`));
  return section("Acceptance by round and expert", lead, table("acceptance", ["expert", "round", "tried*", "accepted*", "of attempts", "of first tries*", "of clips", "paper*"], rows), ended);
}

function reasons(o) {
  const experts = [...new Set(o.reasons.flatMap((r) => Object.keys(r.by_expert)))].sort();
  const most = Math.max(1, ...o.reasons.map((r) => r.total));
  const rows = o.reasons.map((r) =>
    h("tr", { "data-reason": r.reason }, h("th", { scope: "row" }, r.words || r.reason, h("small", null, r.reason)),
      experts.map((e) => h("td", { class: "roomy" }, r.by_expert[e] ? bar(r.by_expert[e] / most, count(r.by_expert[e])) : h("span", { class: "dim" }, "-"))),
      h("td", null, bar(r.total / most, count(r.total)))));
  const clips = o.clip_reasons.map((r) => h("tr", null, h("th", { scope: "row" }, r.words || r.reason, h("small", null, r.reason)), h("td", { class: "n" }, count(r.total))));
  return section("Why the rest was not accepted", "Every attempt that is not a sample has one reason: the first sub-score below its threshold, or what failed.",
    rows.length ? table("reasons", ["reason", ...experts.map((e) => `${e}*`), "all"], rows) : h("p", { class: "nothing" }, "No attempt was turned down."),
    clips.length ? [h("h3", null, "Clips that never came to a simulated attempt"), table("clips", ["reason", "clips"], clips)] : null);
}

function throughput(o) {
  const t = o.throughput;
  const rate = t.samples_per_hour === null ? "-" : count(Math.round(t.samples_per_hour));
  const lead = `${rate} samples an hour between ${clock(t.began_ms)} and ${clock(t.ended_ms)} (${span((t.ended_ms - t.began_ms) / 1000)}), by the time of their commit.`;
  const key = h("p", { class: "keys" }, h("span", null, h("i", { class: "key tried" }), "attempts"), h("span", null, h("i", { class: "key made" }), "accepted"));
  return section("Throughput", lead, key, timeline(t));
}

function times(o) {
  const most = Math.max(0, ...o.stage_times.map((t) => t.seconds));
  const rows = [...o.stage_times].sort((a, b) => b.seconds - a.seconds).map((t) =>
    h("tr", null, h("th", { scope: "row" }, t.stage), h("td", null, bar(most ? t.seconds / most : 0, span(t.seconds))),
      h("td", { class: "n" }, count(t.tasks)), h("td", { class: "n" }, t.tasks ? `${(t.seconds / t.tasks).toFixed(3)} s` : "-")));
  return section("Where the time goes", `Worker time by stage, of ${o.stage_times_of}.`,
    rows.length ? table("seconds", ["stage", "time", "tasks", "each"], rows) : h("p", { class: "nothing" }, "Nothing was timed yet."));
}

function coverage(o) {
  const c = o.coverage;
  const maps = [heat("candidates", c.candidates, c.reach_along_m, c.reach_aside_m, "untried-cell"), heat("accepted", c.accepted, c.reach_along_m, c.reach_aside_m, "accepted-cell")];
  return section("Coverage of end points", "Where perturbed drives end after four seconds, relative to where the logged drive was: metres behind and ahead of it from left to right, to its right and left from bottom to top. Darker: more of them.",
    h("div", { class: "heats" }, maps), c.beyond ? h("p", { class: "note" }, `${count(c.beyond)} end outside.`) : null);
}

function trouble(o) {
  const kinds = Object.entries(o.failed_kinds).map(([kind, n]) => `${kind} ${count(n)}`).join(", ");
  return section("What failed", null, kinds ? h("p", null, h("a", { href: "#/failed" }, `${plural(o.counts.failed, "failed attempt")}: ${kinds}`)) : h("p", { class: "nothing" }, "No attempt failed."));
}

function gates(o) {
  const most = Math.max(1, ...o.gates.map((g) => g.total));
  const rows = o.gates.map((g) => h("tr", null, h("th", { scope: "row" }, g.words || g.reason, h("small", null, g.reason)), h("td", null, bar(g.total / most, count(g.total)))));
  return h("details", null, h("summary", null, "Perturbation gates: what was dropped before any attempt"),
    h("p", { class: "lead" }, `Vocabulary trajectories dropped, summed over ${count(o.counts.clips)} clips; ${count(o.counts.candidates)} became candidates. One trajectory may fall to several gates.`),
    table("gates", ["gate", "dropped"], rows));
}

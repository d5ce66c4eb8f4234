"""The text of report.html: one file with its style, its pictures and nothing fetched from anywhere.

What data brings in (log ids, messages, paths) passes through `el`, which escapes it.
"""

import base64
import html
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from factory.funnel import Funnel, FunnelRow
from factory.look.report_html import Html, bar, count_bar, el, nothing, number, table
from factory.look.report_plot import FATES, EndPoint, fate_mark, scatter
from factory.look.report_style import STYLE
from factory.look.report_words import GATE_WORDS, PAPER_CLIP_PERCENT, REASON_WORDS
from factory.work import LOGGED
from tasks.perturb import PerturbSettings

MAX_POINTS = 4000  # in the scatter; more would make the file heavy and show nothing new


@dataclass(frozen=True)
class Picture:
    """A JPEG with its caption; `data` None where there is none, and the caption says why."""

    data: bytes | None
    caption: str
    detail: str = ""
    tone: str = ""  # accepted | rejected | ""


@dataclass(frozen=True)
class Strip:
    """What the cameras of one sample saw."""

    title: str
    source: str
    now: tuple[Picture, ...]
    earlier: tuple[Picture, ...] = ()
    photos: tuple[Picture, ...] = ()  # the log's, each followed by the scene seen from its pose
    aside: tuple[Picture, ...] = ()  # the same instant from beside the ego


@dataclass(frozen=True)
class FailedRow:
    """A failed attempt, or a failed clip where `expert` is empty."""

    log_id: str
    clip_id: str
    expert: str
    kind: str
    tries: int
    error: str


@dataclass(frozen=True)
class Report:
    """Everything on the page."""

    where: str
    status: str
    status_tone: str  # good | warn | bad
    facts: Mapping[str, str]
    funnel: Funnel
    sources: Mapping[str, int]  # image_source -> samples
    stage_seconds: Mapping[str, tuple[int, float]]  # stage -> tasks, seconds of the newest run
    notes: Sequence[str] = ()
    examples: Sequence[Picture] = ()
    n_rejected: int = 0  # simulated attempts
    strips: Sequence[Strip] = ()
    end_points: Sequence[EndPoint] = ()
    grid: PerturbSettings = field(default_factory=PerturbSettings)
    failed: Sequence[FailedRow] = ()
    n_failed: int = 0
    filtered_windows: Mapping[str, int] = field(default_factory=dict)
    skipped_logs: Mapping[str, str] = field(default_factory=dict)
    broken_logs: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)


def page(report: Report) -> str:
    """The whole file."""
    body = [
        _header(report),
        _funnel(report.funnel),
        _reasons(report.funnel),
        _gates(report.funnel),
        _examples(report.examples, report.n_rejected),
        _frames(report),
        _coverage(report.end_points, report.grid),
        _seconds(report),
        _trouble(report),
        _settings(report.settings),
    ]
    head = el(
        "head",
        Html('<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'),
        Html('<meta name="color-scheme" content="light dark">'),
        el("title", f"Driving data factory: {report.where}"),
        el("style", Html(STYLE)),
    )
    document = el("html", head, el("body", el("main", *body)), lang="en")
    return f"<!doctype html>\n{document}\n"


def _section(title: str, lead: str, *content: Html) -> Html:
    return el("section", el("h2", title), el("p", lead, class_="lead"), *content)


def _header(report: Report) -> Html:
    rows = report.funnel.rows
    tried = sum(r.accepted + r.rejected + r.failed for r in rows)
    samples = sum(r.accepted for r in rows)
    simulated = [r for r in rows if r.expert not in LOGGED]
    n_simulated = sum(r.accepted for r in simulated)
    attempts = sum(r.accepted + r.rejected + r.failed for r in simulated)
    tiles = (
        ("samples", samples, f"{n_simulated} simulated, {samples - n_simulated} logged"),
        ("attempts", tried, f"{_percent(n_simulated, attempts)} of the simulated accepted"),
        ("clips prepared", report.funnel.clips_prepared, f"{report.funnel.candidates} candidates"),
        ("failed", report.n_failed, "see the list below" if report.n_failed else "nothing broke"),
    )
    return el(
        "header",
        el("div", el("h1", "Driving data factory"), el("span", report.status, class_=f"pill {report.status_tone}")),
        el("p", report.where, class_="path"),
        el(
            "div",
            *(
                el("div", el("b", f"{value:,}"), el("span", name), el("small", note), class_="tile", data_count=name)
                for name, value, note in tiles
            ),
            class_="tiles",
        ),
        el("dl", *(el("div", el("dt", k), el("dd", v)) for k, v in report.facts.items())),
        *(el("p", note, class_="note") for note in report.notes),
    )


def _funnel(funnel: Funnel) -> Html:
    head = (
        "expert",
        "round",
        "tried",
        "accepted",
        "of attempts",
        "of first tries",
        "clips",
        "of clips before",
        "paper",
    )
    rates = table(head, [_funnel_row(row) for row in funnel.rows], "funnel")
    lead = (
        "Round r holds the (r+1)-th accepted sample of each clip and expert. Of attempts: accepted of tried. Of first "
        "tries: clips accepted without a second try in this round, as one random draw would be. Of clips before: clips "
        "with a sample of this round, of those with one of the round before; the mark on the bar shows the paper's."
    )
    ended = [
        el("p", f"{expert}: {count} {'walk' if count == 1 else 'walks'} came to the end of the list", class_="note")
        for expert, count in funnel.exhausted.items()
    ]
    return _section("Acceptance funnel", lead, rates, *ended)


def _funnel_row(row: FunnelRow) -> list[Html]:
    published = PAPER_CLIP_PERCENT.get(row.expert, ())
    paper = published[row.round] if row.round < len(published) else None
    tried = row.accepted + row.rejected + row.failed
    return [
        el("th", row.expert, scope="row"),
        number(row.round),
        number(tried),
        number(row.accepted),
        el("td", bar(row.attempt_rate)),
        el("td", bar(row.first_try_rate, paper)),
        el("td", f"{row.clips} / {row.clips_before}", class_="n"),
        el("td", bar(row.clip_rate, paper)),
        el("td", f"{paper} %" if paper is not None else "-", class_="n dim"),
    ]


def _reasons(funnel: Funnel) -> Html:
    experts = list(dict.fromkeys(row.expert for row in funnel.rows if row.reasons))
    counts: dict[str, dict[str, int]] = {}
    for row in funnel.rows:
        for reason, count in row.reasons.items():
            per_expert = counts.setdefault(reason, dict.fromkeys(experts, 0))
            per_expert[row.expert] += count
    clip_reasons = Counter(funnel.clip_outcomes) + Counter(funnel.clips_without_candidates)
    most = max((max(per.values()) for per in counts.values()), default=1)
    order = sorted(counts, key=lambda reason: (-sum(counts[reason].values()), reason))
    rows = [
        [_reason_cell(reason)]
        + [el("td", count_bar(counts[reason][expert], most)) for expert in experts]
        + [number(sum(counts[reason].values()))]
        for reason in order
    ]
    head = ("stage and reason", *experts, "all")
    content = [table(head, rows, "reasons") if rows else nothing("No attempt was turned down.")]
    if clip_reasons:
        listed = [[_reason_cell(reason), number(count)] for reason, count in clip_reasons.most_common()]
        content.append(el("h3", "Clips that never came to a simulated attempt"))
        content.append(table(("stage and reason", "clips"), listed, "clips"))
    lead = "Every attempt that is not a sample has a reason: the first sub-score below its threshold, or what failed."
    return _section("Why attempts fell", lead, *content)


def _reason_cell(reason: str) -> Html:
    words = REASON_WORDS.get(reason.rpartition(".")[2], "")
    return el("th", reason, el("small", words), scope="row")


def _gates(funnel: Funnel) -> Html:
    most = max(funnel.gates.values(), default=1)
    rows = [
        [
            el("th", gate, scope="row"),
            el("td", GATE_WORDS.get(gate, ""), class_="dim"),
            el("td", count_bar(count, most)),
        ]
        for gate, count in funnel.gates.items()
    ]
    lead = (
        f"Vocabulary trajectories that perturb dropped, summed over {funnel.clips_prepared} clips; {funnel.candidates} "
        "became candidates. Gates count independently: one trajectory may fall to several."
    )
    content = table(("gate", "", "dropped"), rows, "gates") if rows else nothing("No clip was perturbed.")
    return _section("Perturbation gates", lead, content)


def _examples(examples: Sequence[Picture], n_rejected: int) -> Html:
    key = el(
        "p",
        *(
            el("span", el("i", class_=f"key {name}"), text)
            for name, text in (
                ("logged", "logged drive"),
                ("perturbed", "perturbation, T to T+H"),
                ("expert", "expert, T+H to T+2H"),
                ("ego", "ego at T+H"),
            )
        ),
        class_="keys",
    )
    lead = "Seen from above at T+H, the ego pointing up; 60 m from bottom to top."
    groups = []
    for tone in ("accepted", "rejected"):
        chosen = [picture for picture in examples if picture.tone == tone]
        groups.append(el("h3", tone.capitalize()))
        missing = f"No simulated attempt was {tone}."
        if tone == "rejected" and n_rejected:
            missing = f"None of the {n_rejected} can be drawn: other settings, or clips that are not in this run."
        groups.append(el("div", *(_figure(p) for p in chosen), class_="cards") if chosen else nothing(missing))
    return _section("Examples", lead, key, *groups)


def _frames(report: Report) -> Html:
    total = sum(report.sources.values())
    counts = ", ".join(f"{count} of {total} samples: {source}" for source, count in sorted(report.sources.items()))
    words = (
        "photo: the log's own image. render: drawn from the block's reconstruction at the simulated poses. "
        "map: lanes and boxes drawn. none: no images."
    )
    strips = [
        el(
            "div",
            el("h3", strip.title, " ", el("span", strip.source, class_="pill plain")),
            el("div", *(_figure(p) for p in strip.now), class_="cams"),
            *_row("", strip.earlier, "cams small"),
            *_row("Photo and rendering of the same pose", strip.photos, "cams"),
            *_row("The same instant from the side", strip.aside, "cams small"),
            class_="strip",
        )
        for strip in report.strips
    ]
    content = strips or [nothing("No sample of this store has images.")]
    return _section("Camera frames", words, el("p", f"image_source: {counts or 'no samples'}", class_="note"), *content)


def _row(title: str, pictures: Sequence[Picture], style: str) -> list[Html]:
    if not pictures:
        return []
    head = [el("p", title, class_="note")] if title else []
    return [*head, el("div", *(_figure(p) for p in pictures), class_=style)]


def _figure(picture: Picture) -> Html:
    if picture.data is None:
        shown = el("div", "no picture", class_="missing")
    else:
        data = base64.b64encode(picture.data).decode()
        shown = Html(f'<img alt="{html.escape(picture.caption)}" loading="lazy" src="data:image/jpeg;base64,{data}">')
    detail = [el("small", picture.detail)] if picture.detail else []
    return el("figure", shown, el("figcaption", picture.caption, *detail), class_=picture.tone or None)


def _coverage(points: Sequence[EndPoint], grid: PerturbSettings) -> Html:
    counts = {fate: sum(p.fate == fate for p in points) for fate in FATES}
    lead = (
        f"Candidates' end poses in the frame of the logged pose at T+H: {grid.max_longitudinal_m:g} m along and "
        f"{grid.max_lateral_m:g} m aside, in an interleaved grid of {grid.step_longitudinal_m:g} m x "
        f"{grid.step_lateral_m:g} m. Accepted: by any expert."
    )
    shown = [fate for fate in FATES if counts[fate] or fate != "failed"]
    keys = el("p", *(el("span", fate_mark(fate), f"{fate} {counts[fate]}") for fate in shown), class_="keys")
    if not points:
        return _section("Coverage of end points", lead, nothing("There are no candidates."))
    step = -(-len(points) // MAX_POINTS)
    plot = scatter(points, points[::step], grid)
    note = [el("p", f"Every {step}th of {len(points)} points is drawn.", class_="note")] if step > 1 else []
    return _section("Coverage of end points", lead, keys, plot, *note)


def _seconds(report: Report) -> Html:
    samples = sum(row.accepted for row in report.funnel.rows)
    most = max((seconds for _, seconds in report.stage_seconds.values()), default=0.0)
    rows = [
        [
            el("th", stage, scope="row"),
            number(tasks),
            el("td", count_bar(seconds, most, f"{seconds:.1f}")),
            el("td", f"{seconds / tasks:.3f}" if tasks else "-", class_="n"),
        ]
        for stage, (tasks, seconds) in report.stage_seconds.items()
    ]
    lead = f"Worker seconds of the newest run; the store holds {samples} samples."
    content = (
        table(("stage", "tasks", "seconds", "per task"), rows, "seconds")
        if rows
        else nothing("The newest run had nothing left to do.")
    )
    return _section("Seconds per stage", lead, content)


def _trouble(report: Report) -> Html:
    content: list[Html] = []
    if report.failed:
        rows = [
            [
                el("th", row.log_id, el("small", f"clip {row.clip_id}"), scope="row"),
                el("td", row.expert or "the clip as a whole"),
                el("td", row.kind, el("small", REASON_WORDS.get(row.kind, ""))),
                number(row.tries),
                el("td", el("pre", row.error)),
            ]
            for row in report.failed
        ]
        content.append(table(("log", "expert", "kind", "tries", "error"), rows, "failed"))
        if report.n_failed > len(report.failed):
            content.append(el("p", f"{len(report.failed)} of {report.n_failed} are shown.", class_="note"))
    else:
        content.append(nothing("No attempt failed."))
    for title, named in (
        ("Filtered windows", {k: f"{n} windows" for k, n in report.filtered_windows.items()}),
        ("Skipped logs", report.skipped_logs),
        ("Broken logs", report.broken_logs),
    ):
        rows = [[el("th", k, scope="row"), el("td", v)] for k, v in named.items()]
        if rows:
            content += [el("h3", f"{title} ({len(rows)})"), table(("what", "why"), rows, "left-out")]
        else:
            content.append(nothing(f"{title}: none."))
    return _section("What did not come through", "Failed attempts, and what the reader left out.", *content)


def _settings(settings: Mapping[str, str]) -> Html:
    rows = [[el("th", k, scope="row"), el("td", v)] for k, v in settings.items()]
    return el(
        "details",
        el("summary", f"Settings of the newest run ({len(rows)})"),
        table(("setting", "value"), rows, "settings"),
    )


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "-"

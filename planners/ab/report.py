"""What an experiment comes to, made of its rows alone: a verdict, tables by arm and by cluster, a picture.

`write_report` writes ab.md, differences.csv and ab.svg. Every arm and every bound is held against the reference, and
against the arm that is claimed, over the same clips and drives, pairs of seeds and planners; intervals are over the
largest clusters of which there are two (planners/evaluation/bootstrap.py). As there are many differences, each has
beside its p the one that Holm (1979) adjusts for all of them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from planners.ab.rows import AbRows, read_ab_rows
from planners.evaluation.aggregation import collect_scores, write_csv
from planners.evaluation.bootstrap import Interval, cluster_labels_by_level, paired_interval
from planners.evaluation.compare import difference_sentence
from tasks.world.arrays import Array

Row = Mapping[str, Any]
BASELINES = ("constant_velocity", "go_straight", "pdm_closed")  # labels without a training
M_PER_KM = 1000.0
LOGGED = -1  # number of the start that is the log's own
SCORES = {"two-stage EPDMS": ("final", "unfiltered"), "stage two": ("stage_two", "none")}
SCENES, PERTURBED, INCIDENTS = "scene score", "scene score from aside", "incidents per km"


@dataclass(frozen=True)
class Measured:
    """One measure of everybody on the same n clips or drives."""

    name: str
    level: str  # of the clusters: town, log or clip
    clusters: tuple[str, ...]  # (n)
    values: Mapping[str, Array]  # label -> (n,)
    weights: Mapping[str, Array]  # label -> (n,) what each counts in a mean
    scale: float = 100.0  # of what is told

    def of(self, labels: Sequence[str]) -> tuple[Array, Array]:
        """(S, n) values and weights."""
        return np.stack([self.values[one] for one in labels]), np.stack([self.weights[one] for one in labels])

    def difference(self, b: Sequence[str], a: Sequence[str], confidence: float) -> Interval:
        """Of b's from a's."""
        (of_a, weights_a), (of_b, weights_b) = self.of(a), self.of(b)
        return paired_interval(
            of_a, of_b, weights=(weights_a, weights_b), clusters=self.clusters, confidence=confidence
        )

    def by_cluster(self, b: Sequence[str], a: Sequence[str]) -> dict[str, float]:
        """The difference of the means in each cluster."""
        found = {}
        for cluster in dict.fromkeys(self.clusters):
            here = np.array([one == cluster for one in self.clusters])
            means = [(x[:, here] * w[:, here]).sum() / w[:, here].sum() for x, w in (self.of(b), self.of(a))]
            found[cluster] = float(means[0] - means[1])
        return found


@dataclass(frozen=True)
class Held:
    """An arm or a bound beside another arm, in one measure."""

    planner: str  # all: the mean of all planners
    who: str
    against: str  # the reference or the claimed arm
    measure: Measured
    apart: Interval
    clusters: Mapping[str, float]  # difference in each

    @property
    def row(self) -> dict[str, Any]:
        """Of differences.csv."""
        one, scale = self.apart, self.measure.scale
        spans = {"": (one.low, one.high), "_t": one.student, "_wild": one.wild}
        ends = {
            f"{end}{name}": scale * span[i] for name, span in spans.items() for i, end in enumerate(("low", "high"))
        }
        facts = {"planner": self.planner, "who": self.who, "against": self.against, "measure": self.measure.name}
        means = {"mean": scale * one.b, "reference": scale * one.a, "difference": scale * one.difference}
        return {**facts, **means, **ends, "p": one.p, "level": self.measure.level, "clusters": one.n}


def measures_of(rows: AbRows) -> list[Measured]:
    """All that was measured of everybody."""
    labels = [one.label for one in rows.trained]
    who = [*labels, *(name for name in BASELINES if name in rows.frames)]
    scores = collect_scores([rows.frames[label] for label in who], "score") if labels else {}
    found = []
    for name, stage in SCORES.items():
        if stage in scores:
            one = scores[stage]
            level, clusters = _coarsest(one.clips, one.logs)
            values, weights = (dict(zip(who, each)) for each in (one.scores, one.weights))
            found.append(Measured(name, level, clusters, values, weights))
    kinds: dict[str, Callable[[Row], bool]] = {
        SCENES: lambda row: row["start"] == LOGGED,
        PERTURBED: lambda row: row["start"] != LOGGED,
    }
    for name, wanted in kinds.items():
        drives = {
            label: {(row["clip_id"], row["start"]): row for row in of if wanted(row)}
            for label, of in rows.drives.items()
        }
        found += _driven(name, drives, labels)
    return found


def _driven(name: str, drives: Mapping[str, Mapping[Any, Row]], labels: Sequence[str]) -> Iterator[Measured]:
    """Over the starts that all have driven; of the log's own the incidents too."""
    who = [label for label in (*labels, *BASELINES) if drives.get(label)]
    starts = sorted(set.intersection(*(set(drives[label]) for label in who))) if set(labels) <= set(who) and who else []
    if not starts:
        return
    rows = {label: [drives[label][start] for start in starts] for label in who}
    first = next(iter(rows.values()))
    level, clusters = _coarsest([row["clip_id"] for row in first], [row["log_id"] for row in first])
    scores = {label: np.array([row["score"] for row in of]) for label, of in rows.items()}
    yield Measured(name, level, clusters, scores, {label: np.ones(len(starts)) for label in who})
    if name == SCENES:
        km = {
            label: np.array([max(row["dist_traveled_m"] / M_PER_KM, 1e-9) for row in of]) for label, of in rows.items()
        }
        failed = {
            label: np.array([row["offroad_or_collision_at_fault"] for row in of]) / km[label]
            for label, of in rows.items()
        }
        yield Measured(INCIDENTS, level, clusters, failed, km, scale=1.0)


def _coarsest(clips: Sequence[str], logs: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """The largest clusters of which there are two, else all that there are."""
    known = cluster_labels_by_level(clips, logs)
    several = [level for level, names in known.items() if len(set(names)) > 1] or list(known)
    return several[-1], known[several[-1]]


def all_held(rows: AbRows) -> list[Held]:
    """Every arm and every bound against the reference, then against the claimed arm; by planner and over all."""
    found = []
    planners = list(dict.fromkeys(one.planner for one in rows.trained))
    for measure in measures_of(rows):
        for planner in [*planners, *(["all"] if len(planners) > 1 else [])]:
            mine = [one for one in rows.trained if planner in (one.planner, "all")]
            sides = {arm: [one.label for one in mine if one.arm == arm] for arm in dict.fromkeys(o.arm for o in mine)}
            sides |= {f"({name})": [name] for name in BASELINES if name in measure.values}
            for against in (rows.asked["reference"], rows.asked["claim"]):
                other = sides[against]
                sides = {who: labels for who, labels in sides.items() if who != rows.asked["reference"]}
                for who, labels in sides.items():
                    if who != against:
                        apart = measure.difference(labels, other, rows.asked["confidence"])
                        found.append(Held(planner, who, against, measure, apart, measure.by_cluster(labels, other)))
    return found


def holm(p: Sequence[float]) -> list[float]:
    """p adjusted for all of them (Holm 1979); NaN stays and counts for none."""
    order = sorted((value, i) for i, value in enumerate(p) if np.isfinite(value))
    found, so_far = [np.nan] * len(p), 0.0
    for rank, (value, i) in enumerate(order):
        so_far = max(so_far, min(1.0, (len(order) - rank) * value))
        found[i] = so_far
    return found


def verdict(rows: AbRows, held: Sequence[Held]) -> str:
    """One sentence on the arm that is claimed: its score and its drives, with intervals, and of how many it is one."""
    claim, confidence = rows.asked["claim"], rows.asked["confidence"]
    planners = list(dict.fromkeys(one.planner for one in rows.trained))
    who = planners[0] if len(planners) == 1 else "all"
    adjusted = holm([one.apart.p for one in held])
    mine = [(one, p) for one, p in zip(held, adjusted) if one.who == claim and one.planner == who]  # of the reference
    told = [(one, p) for one, p in mine if one.measure.name in ("two-stage EPDMS", SCENES)]
    said = [difference_sentence(one.measure.name, one.apart, one.measure.level, confidence) for one, _ in told]
    many = " and ".join(f"{p:.2g}" for _, p in told)
    seeds = len({one.seed for one in rows.trained})
    who_learned = f"{', '.join(planners)}, {seeds} seed{'s' * (seeds > 1)}"
    return (
        f"{claim} against {rows.asked['reference']}, {who_learned}: {'; '.join(said)}; of {len(held)} differences told "
        f"here, for which Holm makes p {many}"
    )


def write_report(folder: Path) -> str:
    """Of a folder of `write_ab_rows`; its text. Raises FileNotFoundError, ValueError."""
    rows = read_ab_rows(folder)
    held = all_held(rows)
    adjusted = holm([one.apart.p for one in held])
    write_csv(folder / "differences.csv", [one.row | {"p_holm": p} for one, p in zip(held, adjusted)])
    said = verdict(rows, held)
    wrapped = [part for line in said.splitlines() for part in wrap(line, 120)]
    text = "\n".join([*wrapped, "", *_tables(rows, held), *_cluster_tables(rows, held)])
    (folder / "ab.md").write_text(text + "\n", encoding="utf-8")
    (folder / "ab.svg").write_text(picture(rows, held), encoding="utf-8")
    return f"{text}\nlook at {folder / 'ab.md'} and ab.svg\n{said}"


def _tables(rows: AbRows, held: Sequence[Held]) -> list[str]:
    """Of each planner, against the reference and against the claimed arm: an arm a line, a measure a column."""
    percent = f"{100 * rows.asked['confidence']:g} %"
    said = (
        f"{rows.asked['steps']} steps each. In brackets: the difference from the first line, its {percent} interval "
        "over whole clusters, the widest of Student's t, the bootstrap with seeds and, below 20 clusters, the wild "
        "cluster bootstrap, p of sign flips; bold where zero lies outside of each. Scores and routes in percent."
    )
    lines = [*wrap(said, 120), ""]
    samples = {one.arm: f"{one.real} + {one.simulated}" for one in rows.trained}
    for planner, against in dict.fromkeys((one.planner, one.against) for one in held):
        mine = [one for one in held if (one.planner, one.against) == (planner, against)]
        measures = list({one.measure.name: one.measure for one in mine}.values())
        at = {(one.who, one.measure.name): one for one in mine}
        of_it = {one.measure.name: f"{one.measure.scale * one.apart.a:.1f}" for one in mine}
        body = [[f"`{against}`", samples[against], *of_it.values()]]
        for who in dict.fromkeys(one.who for one in mine):
            cells = [_cell(at.get((who, measure.name))) for measure in measures]
            body.append([f"`{who}`", samples.get(who, ""), *cells])
        heads = [f"{m.name}, {len(set(m.clusters))} {m.level}s" for m in measures]
        lines += [f"## {planner}, against `{against}`", "", *markdown_table(["arm", "real + simulated", *heads], body)]
    return lines


def _cell(one: Held | None) -> str:
    if one is None:
        return ""
    scale, apart = one.measure.scale, one.apart
    bold = "**" if apart.is_clear else ""
    ends = f": {scale * apart.low:+.1f} .. {scale * apart.high:+.1f}; p {apart.p:.2g}" if np.isfinite(apart.low) else ""
    return f"{scale * apart.b:.1f} ({bold}{scale * apart.difference:+.1f}{bold}{ends})"


def _cluster_tables(rows: AbRows, held: Sequence[Held]) -> list[str]:
    """A cluster a line, an arm a column, of the score and of the routes, over all planners."""
    lines = []
    planner = held[-1].planner
    for name in ("two-stage EPDMS", SCENES):
        mine = [one for one in held if one.planner == planner and one.measure.name == name]
        mine = [one for one in mine if one.against == rows.asked["reference"]]
        if not mine:
            continue
        body = [
            [cluster, *(f"{one.measure.scale * one.clusters[cluster]:+.1f}" for one in mine)]
            for cluster in sorted(set(mine[0].measure.clusters))
        ]
        lines += [f"## {name} less `{rows.asked['reference']}`'s, by {mine[0].measure.level}", ""]
        lines += markdown_table([mine[0].measure.level, *(f"`{one.who}`" for one in mine)], body)
    return lines


def markdown_table(head: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    """Its lines, and an empty one behind."""
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *body)] + [""]


LINE, LEFT, WIDE = 24, 190, 420  # pixels of the picture


def picture(rows: AbRows, held: Sequence[Held]) -> str:
    """An SVG: of each arm the differences in clusters as dots, the mean as a bar across, its interval as a line."""
    planner = held[-1].planner
    of_reference = [one for one in held if one.against == rows.asked["reference"]]
    mine = [one for one in of_reference if one.planner == planner and one.measure.scale == 100.0]
    parts, y = [], LINE
    for name in dict.fromkeys(one.measure.name for one in mine):
        of = [one for one in mine if one.measure.name == name]
        ends = [value for one in of for value in (*one.clusters.values(), one.apart.low, one.apart.high)]
        reach = max(1e-6, *(abs(value) for value in ends if np.isfinite(value)))

        def x(value: float, reach: float = reach) -> float:
            return LEFT + WIDE / 2 * (1.0 + value / reach)

        title = f"{name}: difference from {rows.asked['reference']}, {100 * reach:.0f} points to either side"
        parts.append(f'<text x="8" y="{y}" font-weight="bold">{title}</text>')
        top = y
        for one in of:
            y += LINE
            parts.append(f'<text x="8" y="{y + 4}">{one.who}</text>')
            parts += [f'<circle cx="{x(v):.1f}" cy="{y}" r="3" fill="#888"/>' for v in one.clusters.values()]
            colour = "#1f6fb4" if one.apart.is_clear else "#444"
            if np.isfinite(one.apart.low):
                low, high = x(one.apart.low), x(one.apart.high)
                parts.append(f'<path d="M{low:.1f} {y}H{high:.1f}" stroke="{colour}" stroke-width="2"/>')
            parts.append(f'<path d="M{x(one.apart.difference):.1f} {y - 7}v14" stroke="{colour}" stroke-width="3"/>')
        parts.append(f'<path d="M{x(0.0):.1f} {top + 8}V{y + 8}" stroke="#d1561c"/>')
        y += 2 * LINE
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{LEFT + WIDE + 20}" height="{y}" font-family="sans-serif"'
    return "\n".join([f'{head} font-size="13"><rect width="100%" height="100%" fill="#fff"/>', *parts, "</svg>", ""])

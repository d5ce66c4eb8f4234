"""`python -m planners report folder=docs/study/published`: all tables and pictures again, from per-frame rows alone.

    python -m planners report folder=docs/study/published                            as the paper's tables
    python -m planners report folder=docs/study/published human_filter=filtered out=/tmp/today
    python -m planners report folder=docs/study/logs/nuscenes/stage_two              of `python -m planners scaling`

`folder` holds the frames.parquet that the study or a scaling sweep wrote; nothing else is read, nothing is trained or
planned. `comparisons.csv` (means over seeds, differences with intervals over clips, logs and towns), `trainings.csv`
(each training), `clips.csv` (its score on each clip), `bounds.csv`, `tables.md` (to be read), `differences.png`, and
where there are rounds enough `curves.csv` and pictures of it. Only the learning curves need the trainings' own folders.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from factory.config.arguments import parse
from planners.command import command
from planners.evaluation.aggregation import (
    BOUNDS,
    MEASURES,
    PAPER,
    HumanFilter,
    name_of,
    scores_of_clips,
    shown,
    title_of,
    words_of_stage,
    write_csv,
)
from planners.evaluation.clip_scores import write_clips
from planners.evaluation.compare import CompareSettings, compare, is_clear_row, row_of
from planners.evaluation.frames_file import FRAMES, Clips, read_frames, write_frames
from planners.evaluation.scaling_law import FEWEST, fit_scaling
from planners.evaluation.score_rows import FrameRow
from planners.evaluation.score_table import FILTERS_NOTE
from planners.study.figures import Curve, draw_curves, draw_differences
from planners.study.setups import SWEEP, Comparison, Setup, words_of

CURVES = {"final": "scaling.png", "stage_two": "scaling_stage_two.png"}
RULES = CompareSettings(a="", b="")  # draws, confidence and seed as `python -m planners compare` has them
CURVED = ("rounds", SWEEP)  # the parts that are scores over data
INTERVALS = (
    "In brackets: the difference from what the setup is held against, its 95 % interval over clips (paired bootstrap, "
    "with seeds) and, of stage two and the final score, over logs and towns (Student's t over these, or the bootstrap "
    "where it is wider); bold where zero lies outside of each and there are several logs."
)
CLAIMED = ("stage_two", "final")  # the stages whose intervals over logs and towns are shown too

Row = dict[str, Any]  # of comparisons.csv
Scores = Mapping[str, Mapping[str, float]]  # by label


@dataclass(frozen=True)
class ReportRequest:
    """The command's keys."""

    folder: str
    out: str | None = None  # None: the folder
    human_filter: HumanFilter = PAPER  # of tables.md and the pictures; the CSVs hold both

    def __post_init__(self) -> None:
        if self.human_filter not in ("unfiltered", "filtered"):
            raise ValueError(f"human_filter={self.human_filter}: unfiltered or filtered")


@dataclass(frozen=True)
class StudyFrames:
    """What a study's frames.parquet holds."""

    trainings: tuple[Mapping[str, Any], ...]  # facts of each, with its label under "training"
    comparisons: tuple[Comparison, ...]
    clips: Clips  # also of ensembles and bounds


def write_study(
    path: Path,
    rows: Iterator[tuple[str, Sequence[FrameRow]]],
    trainings: Sequence[Mapping[str, Any]],
    comparisons: Sequence[Comparison],
) -> None:
    """Write a StudyFrames of the rows of each planner, by its label. Whole or not at all."""
    meta = {"trainings": [dict(one) for one in trainings], "comparisons": [asdict(one) for one in comparisons]}
    write_frames(path, rows, meta)


def read_study(path: Path) -> StudyFrames:
    """What `write_study` wrote. Raises FileNotFoundError, or ValueError for a file that is none."""
    meta, clips = read_frames(path)
    return StudyFrames(tuple(meta["trainings"]), tuple(map(_comparison, meta["comparisons"])), clips)


def _comparison(told: Mapping[str, Any]) -> Comparison:
    setups = {side: told[side] and Setup(**told[side]) for side in ("setup", "reference")}
    return Comparison(**{**told, **setups})


def write_tables(folder: Path, out: Path, human_filter: HumanFilter) -> str:
    """The files of this module's docstring, of `folder`; returns the two-stage scores, to be printed."""
    frames, measures = read_study(folder / FRAMES), shown(human_filter)
    out.mkdir(parents=True, exist_ok=True)
    scores = {label: scores_of_clips(clips) for label, clips in frames.clips.items()}
    trainings = [{**facts, **scores[facts["training"]]} for facts in frames.trainings]
    bounds = [{"planner": name, **scores[name]} for name in BOUNDS if name in scores]
    rows = compared(frames)
    write_csv(out / "comparisons.csv", rows)
    if bounds:
        write_csv(out / "bounds.csv", bounds)
    write_csv(out / "trainings.csv", trainings)
    write_clips(out / "clips.csv", {label: clips for label, clips in frames.clips.items() if label not in BOUNDS})
    (out / "tables.md").write_text(markdown_of(rows, human_filter), encoding="utf-8")
    drawn = [row for row in rows if row["reference"] and row["human_filter"] == measures[row["stage"]]]
    if drawn:
        draw_differences(drawn, out / "differences.png")
    curves = {stage: curves_of(frames, scores, name_of(stage, measures[stage])) for stage in CURVES}
    if any(one.law for one in curves["final"]):
        heads = {stage: {"stage": stage, "human_filter": measures[stage]} for stage in curves}
        write_csv(out / "curves.csv", [heads[stage] | one.row() for stage, found in curves.items() for one in found])
        for stage, name in CURVES.items():
            draw_curves(curves[stage], title_of(stage, measures[stage]), out / name)
    return "\n".join([text_of(rows, bounds, measures["final"]), f"tables and pictures: {out}"])


def compared(frames: StudyFrames) -> list[Row]:
    """A row for each comparison and each of MEASURES, in percent: mean over seeds, difference, 95 % intervals."""
    rows = []
    for one in frames.comparisons:
        sides = [[frames.clips[setup.label_of(seed)] for seed in range(one.seeds)] for setup in one.setups]
        intervals = compare(sides[1], sides[0], RULES) if one.reference else {}
        scores = [scores_of_clips(clips) for clips in sides[0]]
        for stage, human_filter in MEASURES:
            each = [score[name_of(stage, human_filter)] for score in scores]
            row = {**one.facts, "stage": stage, "human_filter": human_filter, "epdms": float(np.mean(each))}
            row["each"] = " ".join(f"{score:.1f}" for score in each)
            row["reference"] = one.reference.label if one.reference else ""
            rows.append(row | row_of(intervals.get((stage, human_filter))))
    return rows


def curves_of(frames: StudyFrames, scores: Scores, score: str) -> list[Curve]:
    """Scores over the number of samples: a curve for each planner and kind of data, real samples alone in each."""
    samples = {facts["training"]: facts["real"] + facts["simulated"] for facts in frames.trainings}
    curves = []
    for (planner, name), labels in _series(frames).items():
        sizes, values = tuple(samples[label] for label in labels), tuple(scores[label][score] for label in labels)
        law = fit_scaling(sizes, values) if len(set(sizes)) >= FEWEST else None
        curves.append(Curve(planner, name, sizes, values, law))
    return curves


def _series(frames: StudyFrames) -> Mapping[tuple[str, str], list[str]]:
    """(panel, curve) -> trainings, of the parts that are CURVED."""
    found = defaultdict[tuple[str, str], dict[str, None]](dict)
    of_setup = defaultdict[str, list[str]](list)
    for facts in frames.trainings:
        of_setup[facts["training"].rpartition("-")[0]].append(facts["training"])
    for one in frames.comparisons:
        if one.part in CURVED and one.setup.rounds:
            labels = [label for setup in reversed(one.setups) for label in of_setup[setup.label]]
            curve = f"{one.setup.planner}, equal {one.budget}", words_of(one.facts, counted=False)
            found[curve] |= dict.fromkeys(labels)
    return {name: list(labels) for name, labels in found.items()}


def markdown_of(rows: Sequence[Row], human_filter: HumanFilter) -> str:
    """EPDMS in percent; in brackets the difference from the reference with its intervals, bold where clear.

    The first interval is over clips. rows: those of comparisons.csv, a comparison's measures one after the other; of
    those with and without the human filter one is shown. A row that is itself a reference stands in front of what is
    held against it.
    """
    mine = [row for row in rows if row["human_filter"] in (human_filter, "none")]
    stages = [stage for stage in shown(human_filter) if any(row["stage"] == stage for row in mine)]
    head = ("planner", "trained on", "equal", "seeds", *map(words_of_stage, stages), "final of each seed")
    lines = [*wrap(f"Scores are {human_filter}: {FILTERS_NOTE[0]}; {FILTERS_NOTE[1]}.", 120), ""]
    lines += [*wrap(INTERVALS, 120), ""]
    for part, of_part in groupby(mine, key=lambda row: row["part"]):
        rows = list(of_part)
        lines += [f"## {part}", "", _line(head), _line(["---"] * len(head))]
        lines += [_line(_cells(rows[i : i + len(stages)])) for i in range(0, len(rows), len(stages))]
        lines.append("")
    return "\n".join(lines)


def _cells(stages: Sequence[Row]) -> list[str]:
    """Of the rows of one comparison."""
    one = stages[-1]
    facts = [f"`{one['planner']}`", words_of(one), one["budget"], str(one["seeds"])]
    return [*facts, *map(_score, stages), one["each"]]


def _score(row: Row) -> str:
    text = f"{row['epdms']:.1f}"
    if not row["reference"]:
        return text
    bold = "**" if is_clear_row(row) else ""
    said = [f"{bold}{row['difference']:+.1f}{bold}: {row['low']:+.1f} .. {row['high']:+.1f}"]
    if row["stage"] in CLAIMED:
        known = [level for level in ("log", "town") if row.get(f"low_{level}", "") != ""]
        said += [f"{level}s {row[f'low_{level}']:+.1f} .. {row[f'high_{level}']:+.1f}" for level in known]
    return f"{text} ({'; '.join(said)})"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def text_of(found: Sequence[Row], bounds: Sequence[Row], human_filter: str) -> str:
    """The two-stage scores among the rows of comparisons.csv, to be printed."""
    lines = [f"{title_of('final', human_filter)}; {FILTERS_NOTE[0]}"]
    lines += [f"{'part':<12}{'trained':<46}{'equal':>8}{'seeds':>7}{'EPDMS':>8}{'difference':>12}   95 % over clips"]
    for row in found:
        if (row["stage"], row["human_filter"]) == ("final", human_filter):
            line = f"{row['part']:<12}{row['setup']:<46}{row['budget']:>8}{row['seeds']:7}{row['epdms']:8.2f}"
            if row["difference"] != "":
                line += f"{row['difference']:+12.2f}   {row['low']:+.2f} .. {row['high']:+.2f}"
            lines.append(line)
    for bound in bounds:
        score = bound[name_of("final", human_filter)]
        lines.append(f"{bound['planner']:<73}" + (f"{score:8.2f}" if np.isfinite(score) else "       -"))
    return "\n".join(lines)


@command
def main(argv: Sequence[str]) -> None:
    """The command."""
    request = parse(ReportRequest, argv)
    print(write_tables(Path(request.folder), Path(request.out or request.folder), request.human_filter))

"""`python -m planners study_report folder=docs/study/again`: a study's tables and pictures, from its per-frame rows.

    python -m planners study_report folder=docs/study/again                          as the paper's tables
    python -m planners study_report folder=docs/study/again human_filter=filtered out=/tmp/today

`folder` holds the frames.parquet that `python -m planners study` wrote; nothing else is read, nothing is trained or
planned. Made of it: `trainings.csv` (each training), `clips.csv` (its score on each clip), `comparisons.csv` (means
over seeds, differences with paired bootstrap intervals over seeds and clips, logs, towns), `tables.md` (to be read),
`bounds.csv`, `curves.csv`, and pictures. Only the learning curves need the trainings' own folders.
"""

import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factory.config.compose import ConfigError, fill
from planners.evaluation.aggregation import MEASURES, ClipResult, HumanFilter
from planners.evaluation.clip_scores import write_clips
from planners.evaluation.compare import ByLevel, CompareSettings, Measure, compare, row_of
from planners.evaluation.score_table import FILTERS_NOTE
from planners.evaluation.scores import BOUNDS, PAPER, name_of, scores_of_clips, shown, title_of, write_csv
from planners.study.figures import draw_differences
from planners.study.frames_file import FRAMES, Clips, StudyFrames, read_frames
from planners.study.plan import Comparison, Setup
from planners.study.scaling_figure import Curve, Point, draw_curves
from planners.study.scaling_law import FEWEST, fit_scaling
from planners.study.tables import markdown_of

BAD_CONFIG = 2
CURVES = {"final": "scaling.png", "stage_two": "scaling_stage_two.png"}
RULES = CompareSettings(a="", b="")  # draws, confidence and seed as `python -m planners compare` has them

Row = dict[str, Any]


@dataclass(frozen=True)
class ReportSettings:
    """The command's keys."""

    folder: str
    out: str | None = None  # None: the folder
    human_filter: HumanFilter = PAPER  # of tables.md and the pictures; the CSVs hold both


def write_tables(frames: StudyFrames, report: Path, human_filter: HumanFilter) -> str:
    """The files of this module's docstring; returns the two-stage scores, to be printed."""
    scores = {label: scores_of_clips(clips) for label, clips in frames.clips.items()}
    trainings = [{**facts, **scores[facts["training"]]} for facts in frames.trainings]
    bounds = [{"planner": name, **scores[name]} for name in BOUNDS]
    found = compared(frames.comparisons, frames.clips)
    measures = shown(human_filter)
    write_csv(report / "trainings.csv", trainings)
    write_csv(report / "bounds.csv", bounds)
    write_clips(report / "clips.csv", {label: clips for label, clips in frames.clips.items() if label not in BOUNDS})
    write_csv(report / "comparisons.csv", found)
    (report / "tables.md").write_text(markdown_of(found, human_filter))
    curves = {stage: curves_of(frames.comparisons, trainings, stage, measures[stage]) for stage in CURVES}
    if any(curves.values()):
        lines = [
            {"stage": stage, "human_filter": measures[stage], **curve.row()}
            for stage, drawn in curves.items()
            for curve in drawn
        ]
        write_csv(report / "curves.csv", lines)
        for stage, name in CURVES.items():
            draw_curves(curves[stage], title_of(stage, measures[stage]), report / name)
    differences = [row for row in found if row["reference"] and row["human_filter"] == measures[row["stage"]]]
    if differences:
        draw_differences(differences, report / "differences.png")
    return text_of(found, bounds, measures["final"])


def compared(wanted: Sequence[Comparison], clips: Clips) -> list[Row]:
    """A row for each comparison and each of MEASURES: mean over seeds in percent, difference, intervals."""
    rows = []
    for one in wanted:
        intervals: dict[Measure, ByLevel] = {}
        if one.reference is not None:
            a, b = (_runs(setup, one.seeds, clips) for setup in (one.reference, one.setup))
            intervals = compare(a, b, RULES)
        each = [scores_of_clips(run) for run in _runs(one.setup, one.seeds, clips)]
        for stage, human_filter in MEASURES:
            mine = [scores[name_of(stage, human_filter)] for scores in each]
            row: Row = {**one.facts, "stage": stage, "human_filter": human_filter, "epdms": float(np.mean(mine))}
            row |= {"each": " ".join(f"{score:.1f}" for score in mine)}
            row |= {"reference": "" if one.reference is None else one.reference.label}
            rows.append(row | row_of(intervals.get((stage, human_filter))))
    return rows


def _runs(setup: Setup, seeds: int, clips: Clips) -> list[Sequence[ClipResult]]:
    return [clips[setup.label_of(seed)] for seed in range(seeds)]


def curves_of(
    wanted: Sequence[Comparison], rows: Sequence[Mapping[str, Any]], stage: str, human_filter: str
) -> list[Curve]:
    """One of MEASURES over the number of samples: a curve for each planner, expert, imitation and budget."""
    score, points = name_of(stage, human_filter), defaultdict[str, list[Point]](list)
    for row in rows:
        points[row["training"].rpartition("-")[0]].append(Point(row["real"] + row["simulated"], row[score]))
    series = defaultdict[tuple[str, str], dict[Setup, None]](dict)
    for one in wanted:
        if one.part == "rounds" and one.reference is not None:
            name = f"{one.setup.data}, rewards only" if one.setup.imitation == "real" else one.setup.data
            series[f"{one.setup.planner}, equal {one.budget}", name] |= {one.reference: None, one.setup: None}
    curves = []
    for (planner, name), setups in series.items():
        found = tuple(point for setup in setups for point in points[setup.label])
        enough = len({point.samples for point in found}) >= FEWEST
        law = fit_scaling([p.samples for p in found], [p.score for p in found]) if enough else None
        curves.append(Curve(planner, name, found, law))
    return curves


def text_of(found: Sequence[Mapping[str, Any]], bounds: Sequence[Mapping[str, Any]], human_filter: str) -> str:
    """The two-stage scores among the rows of comparisons.csv, to be printed."""
    lines = [f"{title_of('final', human_filter)}; {FILTERS_NOTE[0]}"]
    lines += [f"{'part':<12}{'trained':<46}{'equal':>8}{'seeds':>7}{'EPDMS':>8}{'difference':>12}   95 % over clips"]
    for row in found:
        if (row["stage"], row["human_filter"]) == ("final", human_filter):
            line = f"{row['part']:<12}{row['setup']:<46}{row['budget']:>8}{row['seeds']:7}{row['epdms']:8.2f}"
            if row["reference"]:
                line += f"{row['difference']:+12.2f}   {row['low']:+.2f} .. {row['high']:+.2f}"
            lines.append(line)
    for bound in bounds:
        score = bound[name_of("final", human_filter)]
        lines.append(f"{bound['planner']:<73}" + (f"{score:8.2f}" if np.isfinite(score) else "       -"))
    return "\n".join(lines)


def main(argv: Sequence[str]) -> int:
    """The command; 2 with a message for what is no study's folder."""
    if not argv or {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    try:
        wrong = [word for word in argv if "=" not in word]
        if wrong:
            raise ConfigError(f"{wrong[0]}: give key=value: folder=, out=, human_filter=")
        settings = fill(ReportSettings, dict(word.split("=", 1) for word in argv), "study_report")
        frames = read_frames(Path(settings.folder) / FRAMES)
        out = Path(settings.out or settings.folder)
        out.mkdir(parents=True, exist_ok=True)
        print(write_tables(frames, out, settings.human_filter))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_CONFIG
    print(f"tables and pictures: {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

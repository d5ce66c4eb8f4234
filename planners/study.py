"""`python -m planners.study`: does simulated data make planners better? Trains, evaluates and compares; docs/study.md.

    python -m planners.study vocabulary=<K x 40 x 3>.npy           all of it
    python -m planners.study ... minutes=25                          a part of it: what is done stays done
    python -m planners.study ... parts=[main,rounds]                 some comparisons only

Every comparison is made twice: with equal passes over a planner's own data, as the paper does, and with equal optimiser
steps, since more data in equal passes is more training as well. Seeds of parts are trained and evaluated one after the
other, small ones together; when the minutes are out, the tables hold what is done, and say with how many seeds. They
hold every part that is evaluated in `out`, whichever were asked for now. Tables go to `report`:
`trainings.csv` (each training), `clips.csv` (its score on each clip), `comparisons.csv` (means over seeds, differences
with paired bootstrap intervals over clips and seeds), `tables.md` (to be read), `bounds.csv`, `curves.csv`, and
pictures. Exit codes: 0 complete, 2 bad settings, 3 a training failed, 4 not complete yet, resumable.
"""

import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from factory.config import ConfigError, compose, fill
from planners.aggregation import MEASURES, ClipResult, by_clip
from planners.checkpoint import read_record
from planners.clip_table import write_clips
from planners.compare import CompareSettings, compare
from planners.index import DataSettings, open_dataset
from planners.scaling_figure import Curve, Point, draw_curves
from planners.scaling_law import FEWEST, fit_scaling
from planners.score_rows import read_rows
from planners.score_table import FILTERS_NOTE
from planners.scores import BOUNDS, name_of, scores_of, shown, title_of, write_csv
from planners.study_figures import draw_differences, draw_learning
from planners.study_plan import (
    Comparison,
    Portion,
    Setup,
    Sizes,
    StudySettings,
    comparisons,
    legs,
    portions,
    so_far,
    with_all_parts,
)
from planners.study_tables import markdown_of
from planners.sweep import (
    EVALUATIONS,
    Means,
    SweepFailed,
    Training,
    evaluate_all,
    folder_of,
    is_done,
    is_evaluated,
    train_all,
)

BAD_CONFIG, FAILED, INTERRUPTED = 2, 3, 4
CURVES = {"final": "scaling.png", "stage_two": "scaling_stage_two.png"}


def run(settings: StudySettings) -> int:
    """Train, evaluate, compare, draw, one seed of one part after the other; the exit code."""
    out, means = Path(settings.out), Means(jobs=settings.jobs, minutes=settings.minutes)
    sizes, whole = sizes_of(settings), with_all_parts(settings)
    asked = portions(comparisons(settings), settings, sizes)
    for leg in legs(asked):
        print("; ".join(f"{portion.part}, seed {portion.seed}" for portion in leg), file=sys.stderr)
        trainings = [training for portion in leg for training in portion.trainings]
        others = {label: spec for portion in leg for label, spec in portion.ensembles.items()}
        if not train_all(trainings, out, means):
            break
        if not evaluate_all(trainings, out, settings.benchmark, others=others, means=means):
            break
    wanted = comparisons(whole)
    planned = portions(wanted, whole, sizes)
    done = evaluated(planned, out)
    if done:
        trained = [training for portion in planned for training in portion.trainings if training.label in done]
        write_report(so_far(wanted, done), trained, settings)
    labels = [label for portion in asked for label in portion.labels]
    if missing := set(labels) - done:
        n = len(labels)
        print(f"{n - len(missing)} of {n} planners are evaluated: the same command goes on", file=sys.stderr)
        return INTERRUPTED
    return 0


def evaluated(planned: Sequence[Portion], out: Path) -> set[str]:
    """Labels of all that is trained to its end and evaluated as it is now, by this command or one before it."""
    trainings = [training for portion in planned for training in portion.trainings if is_done(out, training)]
    trained = {training.label: str(folder_of(out, training)) for training in trainings}
    folders = set(trained.values())
    joined = [(label, spec) for portion in planned for label, spec in portion.ensembles.items()]
    whole = {label: spec for label, spec in joined if folders.issuperset(spec.split("+"))}
    return {label for label, spec in (trained | whole).items() if is_evaluated(out, label, spec)}


def write_report(standing: Sequence[Comparison], trained: Sequence[Training], settings: StudySettings) -> None:
    """The tables and pictures of what is evaluated."""
    out, report = Path(settings.out), Path(settings.report)
    evaluations = out / EVALUATIONS
    report.mkdir(parents=True, exist_ok=True)
    rows = [row_of(training, out, evaluations) for training in trained]
    write_csv(report / "trainings.csv", rows)
    write_csv(report / "bounds.csv", [{"planner": name, **scores_of(evaluations / name)} for name in BOUNDS])
    write_clips(report / "clips.csv", {training.label: _clips(evaluations / training.label) for training in trained})
    found = compared(standing, evaluations)
    write_csv(report / "comparisons.csv", found)
    measures = shown(settings.human_filter)
    (report / "tables.md").write_text(markdown_of(found, settings.human_filter))
    curves = {(stage, measures[stage]): curves_of(standing, rows, stage, measures[stage]) for stage in CURVES}
    if any(curves.values()):
        lines = [
            {"stage": stage, "human_filter": human_filter, **curve.row()}
            for (stage, human_filter), drawn in curves.items()
            for curve in drawn
        ]
        write_csv(report / "curves.csv", lines)
        for measure, drawn in curves.items():
            draw_curves(drawn, title_of(*measure), report / CURVES[measure[0]])
    differences = [row for row in found if row["reference"] and row["human_filter"] == measures[row["stage"]]]
    if differences:
        draw_differences(differences, report / "differences.png")
    draw_learning({t.label: folder_of(out, t) for t in trained if t.facts["seed"] == 0}, report / "learning.png")
    print(text_of(found, evaluations, measures["final"]))
    print(f"tables and pictures: {report}")


def sizes_of(settings: StudySettings) -> Sizes:
    """What the plan depends on. Raises ConfigError where one side of the PSNR bound has no samples and is asked for."""
    sim = DataSettings(sim=settings.data, experts=("pdm_closed",), max_round=settings.rounds - 1)
    high = open_dataset(replace(sim, psnr_min=settings.psnr_db))
    real = sum(len(open_dataset(DataSettings(real=table))) for table in (settings.data, settings.begin) if table)
    steps = settings.epochs * ((real + len(high)) // settings.batch_size)
    try:
        low = open_dataset(replace(sim, psnr_max=settings.psnr_db))
    except ValueError as error:
        if "psnr" not in settings.parts:
            return Sizes(steps)
        raise ConfigError(f"part psnr: {error}; leave it out of parts, or choose another psnr_db") from error
    return Sizes(steps, min(len(low), len(high)))


def row_of(training: Training, out: Path, evaluations: Path) -> dict[str, Any]:
    """One training and its scores."""
    record = read_record(folder_of(out, training))
    return {
        "training": training.label,
        **training.facts,
        "parameters": record["parameters"],
        "optimiser_steps": record["trained"]["steps"],
        "real": record["samples"]["real"],
        "simulated": record["samples"]["simulated"],
        **scores_of(evaluations / training.label),
    }


def compared(wanted: Sequence[Comparison], evaluations: Path) -> list[dict[str, Any]]:
    """A row for each comparison and each of MEASURES: mean over seeds in percent, difference, interval."""
    rows = []
    for one in wanted:
        intervals = {}
        if one.reference is not None:
            a, b = (clips_of(setup, one.seeds, evaluations) for setup in (one.reference, one.setup))
            intervals = compare(a, b, RULES)
        for stage, human_filter in MEASURES:
            row: dict[str, Any] = {**one.facts, "stage": stage, "human_filter": human_filter}
            each = scores_of_seeds(one.setup, one.seeds, evaluations, stage, human_filter)
            row |= {"epdms": float(np.mean(each)), "each": " ".join(f"{score:.1f}" for score in each)}
            row |= {"reference": "", "difference": "", "low": "", "high": ""}
            if one.reference is not None:
                found = intervals[stage, human_filter]
                row |= {"reference": one.reference.label, "difference": 100.0 * found.difference}
                row |= {"low": 100.0 * found.low, "high": 100.0 * found.high}
            rows.append(row)
    return rows


RULES = CompareSettings(a="", b="")  # draws, confidence and seed as `python -m planners.compare` has them


def clips_of(setup: Setup, seeds: int, evaluations: Path) -> list[list[ClipResult]]:
    """The scored clips of each seed's training."""
    return [_clips(evaluations / f"{setup.label}-{seed}") for seed in range(seeds)]


@cache
def _clips(folder: Path) -> list[ClipResult]:
    return by_clip(read_rows(folder))


_scores = cache(scores_of)


def scores_of_seeds(setup: Setup, seeds: int, evaluations: Path, stage: str, human_filter: str) -> list[float]:
    """EPDMS of each seed, in percent."""
    name = name_of(stage, human_filter)
    return [_scores(evaluations / f"{setup.label}-{seed}")[name] for seed in range(seeds)]


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


def text_of(found: Sequence[Mapping[str, Any]], evaluations: Path, human_filter: str) -> str:
    """The two-stage scores among the rows of comparisons.csv, to be printed."""
    title = f"{title_of('final', human_filter)}; {FILTERS_NOTE[0]}"
    lines = [title]
    lines += [f"{'part':<12}{'trained':<46}{'equal':>8}{'seeds':>7}{'EPDMS':>8}{'difference':>12}   95 % interval"]
    for row in found:
        if (row["stage"], row["human_filter"]) == ("final", human_filter):
            line = f"{row['part']:<12}{row['setup']:<46}{row['budget']:>8}{row['seeds']:7}{row['epdms']:8.2f}"
            if row["reference"]:
                line += f"{row['difference']:+12.2f}   {row['low']:+.2f} .. {row['high']:+.2f}"
            lines.append(line)
    for name in BOUNDS:
        score = scores_of(evaluations / name)[name_of("final", human_filter)]
        lines.append(f"{name:<73}" + (f"{score:8.2f}" if np.isfinite(score) else "       -"))
    return "\n".join(lines)


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    try:
        return run(fill(StudySettings, compose("study", argv), "study"))
    except (ConfigError, ValueError, FileNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_CONFIG
    except SweepFailed as error:
        print(f"error: {error}", file=sys.stderr)
        return FAILED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

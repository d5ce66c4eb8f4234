"""`python -m planners study`: does simulated data make planners better? Trains, evaluates and compares; docs/study.md.

    python -m planners study vocabulary=<K x 40 x 3>.npy             all of it
    python -m planners study ... minutes=25                          a part of it: what is done stays done
    python -m planners study ... parts=[main,rounds]                 some comparisons only
    python -m planners study ... minutes=0                           the tables of what is done, again

Seeds of parts are trained and evaluated one after the other, small ones together; when the minutes are out, the tables
hold what is done, and say with how many seeds. They hold every part that is evaluated in `out`, whichever were asked
for now. What is written goes to `report`: frames.parquet, EPDMS of each frame by each planner; the tables and pictures
that `python -m planners report` makes of it; and the learning curves.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from factory.config.compose import ConfigError, compose, fill
from planners.command import Stopped, command
from planners.data.index import DataSettings, open_dataset
from planners.evaluation.aggregation import BOUNDS
from planners.evaluation.frames_file import FRAMES, rows_of
from planners.study.figures import draw_learning
from planners.study.report import write_study, write_tables
from planners.study.setups import Comparison, Sizes, StudySettings, comparisons, planned, so_far, with_all_parts
from planners.study.sweep import (
    EVALUATIONS,
    SweepSettings,
    Training,
    batches,
    evaluate_all,
    folder_of,
    is_done,
    is_evaluated,
    train_all,
)
from planners.training.checkpoint import read_record


def run(
    settings: SweepSettings, asked: Sequence[Training], known: Sequence[Training], wanted: Sequence[Comparison]
) -> None:
    """Train and score what is missing of `asked`, one batch after the other, and report on what there is.

    known: of which what is done is reported, whoever asked for it; wanted: of these, what is compared. Raises Stopped,
    Failed.
    """
    out, labels = Path(settings.out), {one.label for one in asked}
    try:
        for batch in batches(asked):
            print("; ".join(dict.fromkeys("{}, seed {}".format(*one.unit) for one in batch)), file=sys.stderr)
            train_all(batch, out, settings)
            evaluate_all(batch, out, settings.benchmark, settings, *settings.evaluate)
    except Stopped as stopped:
        print(stopped, file=sys.stderr)
    done = evaluated(known, out)
    if standing := so_far(wanted, done):
        write_report(standing, [one for one in known if one.label in done and not one.members], settings)
    if not done >= labels:
        raise Stopped(f"{len(labels & done)} of {len(labels)} planners are evaluated: the same command goes on")


def evaluated(planned: Sequence[Training], out: Path) -> set[str]:
    """Labels of all that is trained to its end and evaluated as it is now, by this command or one before it."""
    trained = {one.label for one in planned if not one.members and is_done(out, one)}
    whole = [one for one in planned if trained.issuperset(one.members or (one.label,))]
    return {one.label for one in whole if is_evaluated(out, one)}


def write_report(standing: Sequence[Comparison], trained: Sequence[Training], settings: SweepSettings) -> None:
    """The per-frame rows of what is evaluated, and the tables and pictures, which are made of them alone."""
    out, report = Path(settings.out), Path(settings.report or settings.out)
    report.mkdir(parents=True, exist_ok=True)
    compared = [one.setup.label_of(seed) for one in standing for seed in range(one.seeds)]
    bounds = [name for name in BOUNDS if (out / EVALUATIONS / name).is_dir()]
    labels = dict.fromkeys([*(training.label for training in trained), *compared, *bounds])
    facts = [facts_of(training, out) for training in trained]
    write_study(report / FRAMES, rows_of(labels, out / EVALUATIONS, settings.benchmark), facts, standing)
    first = min(training.facts["seed"] for training in trained)
    drawn = {one.label: folder_of(out, one) for one in trained if one.facts["seed"] == first}
    draw_learning(drawn, report / "learning.png")
    print(write_tables(report, report, settings.human_filter))


def facts_of(training: Training, out: Path) -> Mapping[str, Any]:
    """What one training is, as its own record has it."""
    record = read_record(folder_of(out, training))
    counts = {"parameters": record["parameters"], "optimiser_steps": record["trained"]["steps"], **record["samples"]}
    return {"training": training.label, **training.facts, **counts}


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


@command
def main(argv: Sequence[str]) -> None:
    """The command."""
    settings = fill(StudySettings, compose("study", argv, StudySettings), "study")
    sizes, whole = sizes_of(settings), with_all_parts(settings)
    wanted = comparisons(whole)
    run(settings, planned(comparisons(settings), settings, sizes), planned(wanted, whole, sizes), wanted)

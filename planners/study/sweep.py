"""Many trainings and their evaluation on one benchmark, by a few processes, and the tables of what is done.

Resumable: what is trained or evaluated already is not again.
"""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from factory.exits import Failed, Stopped
from factory.graph.progress import RateBar
from planners.evaluation.aggregation import BOUNDS, PAPER, HumanFilter
from planners.evaluation.planner_names import find_planner
from planners.evaluation.score_rows import RECORD
from planners.evaluation.score_rows import is_done as evaluation_is_done
from planners.evaluation.score_rows import read_record as read_evaluation
from planners.study.report import FRAMES, rows_of, write_study, write_tables
from planners.study.setups import Comparison, completed_comparisons
from planners.training.checkpoint import read_record
from planners.training.many import ONE_THREAD, SweepResources, Training, folder_of, is_done, stop_event, train_all

EVALUATIONS = "evaluations"
BATCH = 48  # planners that are trained and evaluated together: cores idle at the end of either
EVALUATED_TOGETHER = 24  # planners in one process at the most


@dataclass(frozen=True, kw_only=True)
class SweepSettings(SweepResources):
    """What every sweep is told."""

    benchmark: str  # the folder that factory.run preset=hard_benchmark made of held-out clips
    out: str  # the same command on the same folder goes on
    report: str | None = None  # folder of the tables; null: out
    human_filter: HumanFilter = PAPER  # of tables.md, the paper's or today's; CSVs hold both
    evaluate: tuple[str, ...] = ()  # further overrides of `planners evaluate`


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
    done = evaluated_labels(known, out)
    if standing := completed_comparisons(wanted, done):
        write_report(standing, [one for one in known if one.label in done and not one.members], settings)
    if not done >= labels:
        raise Stopped(f"{len(labels & done)} of {len(labels)} planners are evaluated: the same command goes on")


def evaluated_labels(planned: Sequence[Training], out: Path) -> set[str]:
    """Labels of all that is trained to its end and evaluated as it is now, by this command or one before it."""
    trained = {one.label for one in planned if not one.members and is_done(out, one)}
    whole = [one for one in planned if trained.issuperset(one.members or (one.label,))]
    return {one.label for one in whole if is_evaluated(out, one)}


def write_report(standing: Sequence[Comparison], trained: Sequence[Training], settings: SweepSettings) -> None:
    """The per-frame rows of what is evaluated, and the tables, which are made of them alone."""
    out, report = Path(settings.out), Path(settings.report or settings.out)
    report.mkdir(parents=True, exist_ok=True)
    compared = [one.setup.label_of(seed) for one in standing for seed in range(one.seeds)]
    bounds = [name for name in BOUNDS if (out / EVALUATIONS / name).is_dir()]
    labels = dict.fromkeys([*(training.label for training in trained), *compared, *bounds])
    facts = [facts_of(training, out) for training in trained]
    write_study(report / FRAMES, rows_of(labels, out / EVALUATIONS, settings.benchmark), facts, standing)
    write_tables(report / FRAMES, report, settings.human_filter)
    print(f"look at {report / 'tables.md'}")


def facts_of(training: Training, out: Path) -> Mapping[str, Any]:
    """What one training is, as its own record has it."""
    record = read_record(folder_of(out, training))
    counts = {"parameters": record["parameters"], "optimiser_steps": record["trained"]["steps"], **record["samples"]}
    return {"training": training.label, **training.facts, **counts}


def batches(planned: Sequence[Training]) -> list[list[Training]]:
    """Units one after the other, as many as make BATCH; what all begin with is done before."""
    found: list[list[Training]] = []
    for _, unit in groupby(planned, key=lambda one: one.unit):
        if not found or found[-1][-1].unit[0] == "begin" or len(found[-1]) >= BATCH:
            found.append([])
        found[-1] += unit
    return found


def evaluate_all(
    everyone: Sequence[Training], out: Path, benchmark: str, resources: SweepResources, *more: str
) -> None:
    """Evaluate on a benchmark, into `out`/evaluations; those that are evaluated already are not again.

    Processes of `python -m planners evaluate` share the planners, a few each at a time, so that a kill costs little.
    more: overrides of that command. Raises Stopped where time ran out or somebody interrupted before all were, and
    Failed.
    """
    base = [sys.executable, "-m", "planners", "evaluate", f"benchmark={benchmark}", *more, f"out={out / EVALUATIONS}"]

    def evaluate(share: Sequence[Training], *how: str) -> int:
        if stop.is_set():
            return 0
        named = ",".join(f"{one.label}: '{one.spec(out)}'" for one in share)
        command = [*base, f"planners={{{named}}}", *how]
        ended = subprocess.run(command, env=ONE_THREAD | os.environ, capture_output=True, text=True)  # noqa: S603 - a list, no shell
        if ended.returncode != 0:
            raise Failed(f"the evaluation ended with exit {ended.returncode}: {ended.stderr.strip()[-500:]}")
        return len(share)

    done = 0
    with (
        stop_event(resources.left_s) as stop,
        RateBar("evaluations", len(everyone)) as counter,
        ThreadPoolExecutor(resources.at_once) as pool,
    ):
        shares = shares_of(everyone, resources.at_once)
        for n in pool.map(lambda share: evaluate(share, "bounds=false", "tables=false"), shares):
            done += n
            counter.show(done)
        if done < len(everyone) or not evaluate(everyone):  # nothing is left but the bounds and the tables of all
            raise Stopped(f"{done} of {len(everyone)} are evaluated: the same command goes on")


def shares_of(everyone: Sequence[Training], at_once: int) -> list[Sequence[Training]]:
    """What each process evaluates, taken in turn: neighbours are of one kind, and kinds take different times."""
    n = min(at_once * -(-len(everyone) // (at_once * EVALUATED_TOGETHER)), len(everyone))
    return [everyone[i::n] for i in range(n)]


def is_evaluated(out: Path, one: Training) -> bool:
    """Whether it stands under its label as it is now, evaluated as the bounds were last."""
    bound, mine = (out / EVALUATIONS / name for name in (BOUNDS[-1], one.label))
    if not (bound / RECORD).is_file():
        return False
    shared = {k: v for k, v in read_evaluation(bound).items() if k not in ("planner", "planner_digest")}
    return evaluation_is_done(mine, {"planner_digest": find_planner(one.spec(out)).digest, **shared})

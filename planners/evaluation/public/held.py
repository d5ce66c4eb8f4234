"""NAVSIM's tables held against each other: a released file, one that NAVSIM wrote, or a folder that `evaluate` made.

Rows pair by their tokens. What of the two-stage score is published stands in a file's summary alone: follow-ups weigh
by where the plan ended, which no such file holds, so these differences have no interval.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from factory.config.compose import ConfigError
from planners.evaluation.aggregation import HumanFilter, Measured
from planners.evaluation.bootstrap import Interval
from planners.evaluation.public.tables import FILTERS, PublicTable, file_name, read_table
from tasks.reward.one_stage import COLUMNS
from tasks.world.arrays import Array

Measure = tuple[str, str]  # stage, human filter
SUFFIXES = (".csv", ".csv.gz")
NOTE = (
    "tables of NAVSIM's: stage_two and final are the files' own summaries and have no interval, since no file says "
    "where a plan ended"
)


def is_table(path: str) -> bool:
    """Whether a run of `compare` is a file of NAVSIM's."""
    return path.endswith(SUFFIXES)


def read_side(paths: Sequence[str]) -> list[list[PublicTable]]:
    """Of each run its table, of a folder both of its tables. Raises ConfigError naming what is none."""
    runs = []
    for path in map(Path, paths):
        files = [path]
        if path.is_dir():
            files = [path / file_name(human_filter) for human_filter in FILTERS]
            if not files[0].is_file():
                raise ConfigError(
                    f"{path}: no {files[0].name}: evaluate writes it on a benchmark whose frames have NAVSIM's tokens "
                    "(docs/training.md), and only of such can a planner be held against a table of NAVSIM's"
                )
        try:
            runs.append([read_table(file) for file in files])
        except (OSError, ValueError) as error:
            raise ConfigError(str(error)) from error
    return runs


def measured_of(runs: Sequence[Sequence[PublicTable]], column: str) -> dict[Measure, Measured]:
    """(stage, filter) -> one column of the runs over their tokens; what a run does not hold is left out.

    Raises ConfigError where runs are not over the same tokens, or some of a stage failed.
    """
    found = {}
    for name in _measures(runs):
        rows = [_rows(run, *name) for run in runs]
        whole = [one for one in rows if one]
        if len(whole) == len(rows):
            found[name] = _paired(runs, whole, column)
    return found


def check_same_tokens(first: Mapping[Measure, Measured], second: Mapping[Measure, Measured]) -> None:
    """Raises ConfigError where the sides share no stage, or hold one of other tokens."""
    if not first.keys() & second.keys():
        stages = [sorted({name[0] for name in side}) for side in (first, second)]
        raise ConfigError(f"a is of {', '.join(stages[0])}, b of {', '.join(stages[1])}: nothing to hold against it")
    for name in first.keys() & second.keys():
        if other := set(first[name].clips) ^ set(second[name].clips):
            raise ConfigError(f"{name[0]}: {len(other)} tokens stand on one side alone, such as {min(other)}")


def summaries(
    a: Sequence[Sequence[PublicTable]], b: Sequence[Sequence[PublicTable]], column: str
) -> dict[Measure, Interval]:
    """(stage, filter) -> difference of the published means of two stages, without an interval."""
    of_a, of_b = (_published(side, column) for side in (a, b))
    return {
        name: Interval(of_b[name] - of_a[name], np.nan, np.nan, of_a[name], of_b[name]) for name in of_a if name in of_b
    }


def _measures(runs: Sequence[Sequence[PublicTable]]) -> list[Measure]:
    return [*((runs[0][0].stage, which) for which in FILTERS), ("follow_ups", "none")]


def _rows(run: Sequence[PublicTable], stage: str, human_filter: str) -> Mapping[str, Array] | None:
    """Token -> (C,) of one run."""
    if run[0].stage != stage and stage != "follow_ups":
        raise ConfigError(f"{run[0].file}: a table of {run[0].stage}, another run has {stage}")
    if stage == "follow_ups":
        return run[0].follow_ups
    if len(run) > 1:  # of a folder, whose files say by their names what they are
        return dict(zip(FILTERS, run))[_which(human_filter)].logged
    return run[0].scores(_which(human_filter))


def _which(human_filter: str) -> HumanFilter:
    return "filtered" if human_filter == "filtered" else "unfiltered"


def _paired(runs: Sequence[Sequence[PublicTable]], rows: Sequence[Mapping[str, Array]], column: str) -> Measured:
    tokens = tuple(sorted(rows[0]))
    for run, one in zip(runs, rows):
        if other := one.keys() ^ rows[0].keys():
            failed = " and failed" if min(other) in (*run[0].failed, *runs[0][0].failed) else ""
            raise ConfigError(
                f"{run[0].file} and {runs[0][0].file} differ in {len(other)} tokens, such as {min(other)}{failed}"
            )
    scores = np.array([[one[token][COLUMNS.index(column)] for token in tokens] for one in rows])
    known = np.isfinite(scores).all(axis=0)  # extended comfort alone is not of every frame
    kept = tuple(token for token, there in zip(tokens, known) if there)
    return Measured(kept, ("",) * len(kept), scores[:, known], np.ones((len(rows), len(kept))))


def _published(runs: Sequence[Sequence[PublicTable]], column: str) -> dict[Measure, float]:
    """Means over the runs of what their files say of stage two and both stages."""
    place, found = COLUMNS.index(column), {}
    for name in (("stage_two", "none"), *(("final", which) for which in FILTERS)):
        said = [_summary(run, *name) for run in runs]
        values = [float(one[place]) for one in said if one is not None]
        if len(values) == len(runs) and np.isfinite(values).all():
            found[name] = float(np.mean(values))
    return found


def _summary(run: Sequence[PublicTable], stage: str, human_filter: str) -> Array | None:
    if stage == "stage_two" or len(run) == 1:
        its_own = stage == "stage_two" or run[0].human_filter == human_filter
        return run[0].summary.get(stage) if its_own else None
    return dict(zip(FILTERS, run))[_which(human_filter)].summary.get(stage)

"""All attempts of a store as columns of integers: what counts over millions of rows is drawn from.

One row per clip, expert and candidate: that of the newest run; of one run the sample. So a candidate counts once, and
what a redo failed at is seen, not the old sample that it was to replace.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from factory.store.counts.codes import Codes, Ints, codes, combinations
from factory.store.outcomes import Kind
from factory.store.samples import MADE_UNDER, run_number
from tasks.stages import ATTEMPT, TASKS

ATTEMPT_COLUMNS = [*(name for name in MADE_UNDER if name != "attempt_id"), "clip_id", "candidate_index"]
SAMPLE_COLUMNS = ATTEMPT_COLUMNS
OUTCOME_COLUMNS = [*ATTEMPT_COLUMNS, "kind", "stage", "reason", "error_kind"]
ACCEPTED, EXHAUSTED = "", "exhausted"  # among `whys`
STAGES_OF = {task.name: task.stages for task in TASKS}


@dataclass(frozen=True)
class Attempts:
    """In the order of expert, clip, candidate; all arrays (N,). The expert "" stands for the clip as a whole."""

    clip_ids: tuple[str, ...]  # by `clip`
    experts: tuple[str, ...]  # by `expert`, sorted
    whys: tuple[str, ...]  # by `why`: ACCEPTED, EXHAUSTED, "stage.reason" or "failed.kind"
    clip: Codes
    expert: Codes
    candidate: Codes
    why: Codes
    task: Codes  # place in tasks.stages.ATTEMPT of the task that it ended in, behind them all where it was accepted

    @cached_property
    def accepted(self) -> NDArray[np.bool_]:
        """Where a sample stands."""
        return self.why == self.whys.index(ACCEPTED)

    @cached_property
    def exhausted(self) -> NDArray[np.bool_]:
        """Where a walk came to the end of its list: no attempt."""
        return self.why == self.whys.index(EXHAUSTED)

    @cached_property
    def failed(self) -> NDArray[np.bool_]:
        """Where something broke."""
        return np.array([why.startswith("failed.") for why in self.whys])[self.why]

    @cached_property
    def starts(self) -> Ints:
        """Places at which a walk begins, one for each (expert, clip) with rows."""
        new = (np.diff(self.expert, prepend=-1) != 0) | (np.diff(self.clip, prepend=-1) != 0)
        return np.flatnonzero(new)

    @cached_property
    def round(self) -> Codes:
        """That each attempt was tried for: the accepted ones before it in its walk."""
        before: Codes = np.cumsum(self.accepted, dtype=np.int32)
        before -= self.accepted
        before -= np.repeat(before[self.starts], np.diff(self.starts, append=len(before)))
        return before


def attempts_of(samples: pa.Table, outcomes: pa.Table, runs: Sequence[Mapping[str, Any]]) -> Attempts:
    """From rows with the columns SAMPLE_COLUMNS and OUTCOME_COLUMNS; runs: the records of run.json, oldest first."""
    rows = pa.concat_tables([outcomes.select(ATTEMPT_COLUMNS), samples.select(ATTEMPT_COLUMNS)])
    n_outcomes, n_ages = outcomes.num_rows, 2 * len(runs) + 2
    clip, clip_ids = codes(rows["clip_id"])
    expert, experts = codes(rows["expert"])
    candidate = rows["candidate_index"].to_numpy()
    why, whys, task = _whys(outcomes)
    why = np.concatenate([why, np.zeros(samples.num_rows, np.int32)])
    task = np.concatenate([task, np.full(samples.num_rows, len(ATTEMPT), np.int32)])
    age = 2 * (_ages(rows, runs) + 1)  # -1: of no record
    age[n_outcomes:] += 1
    sizes = len(clip_ids), int(candidate.max(initial=-1)) + 2, n_ages
    newest = _last_of_each(_ordered(expert, list(zip(sizes, (clip, candidate + 1, age)))), n_ages)
    columns = [clip, expert, candidate, why, task]
    del clip, expert, candidate, why, task, age  # of millions of rows each as a whole and as it is kept, in turn
    kept = [columns.pop(0)[newest] for _ in range(len(columns))]
    return Attempts(clip_ids, experts, whys, *kept)


def _ordered(first: Codes, then: Sequence[tuple[int, Codes]]) -> Ints:
    """A number for each row, in the order of several columns; then: with how many values each."""
    place = first.astype(np.int64)
    for size, number in then:
        place *= size
        place += number
    return place


def _last_of_each(place: Ints, n_ages: int) -> Ints:
    """Of places that differ in their age alone, which counts in ones, the row of the last; of rows alike the last.

    The places are written over.
    """
    order = np.argsort(place, kind="stable")
    place[:] = place[order]
    place //= n_ages
    is_last = np.ones(len(place), bool)
    np.not_equal(place[1:], place[:-1], out=is_last[:-1])
    return order[is_last]


def _whys(outcomes: pa.Table) -> tuple[Codes, tuple[str, ...], Codes]:
    """What became of the rows of `outcomes`, in words, of which the first is for samples; the tasks they ended in."""
    found, at = combinations(outcomes, ("kind", "stage", "reason", "error_kind"))
    words = [_why(*row) for row in found]
    known = list(dict.fromkeys([ACCEPTED, EXHAUSTED, *words]))
    tasks = np.array([_task(stage) for _, stage, _, _ in found], np.int32)
    return np.array([known.index(word) for word in words], np.int32)[at], tuple(known), tasks[at]


def _task(stage: str) -> int:
    """Place in ATTEMPT of the task of that stage or name; of one that was not told the first."""
    return next((i for i, name in enumerate(ATTEMPT) if stage == name or stage in STAGES_OF[name]), 0)


def _why(kind: str, stage: str, reason: str, error_kind: str) -> str:
    if kind == Kind.EXHAUSTED:
        return EXHAUSTED
    return f"failed.{error_kind}" if kind == Kind.FAILED else f"{stage}.{reason}"


def _ages(rows: pa.Table, runs: Sequence[Mapping[str, Any]]) -> Codes:
    """The number of the run that each row is of (factory.store.samples.run_number)."""
    names = [name for name in MADE_UNDER if name != "attempt_id"]
    found, at = combinations(rows, names)
    number = run_number(runs)
    made = [dict(zip(names, texts)) for texts in found]
    return np.array([number(row) for row in made], np.int32)[at]

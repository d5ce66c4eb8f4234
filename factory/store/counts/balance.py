"""What was planned and what became of it, from the tables alone: planned = accepted + rejected + failed + pending.

Counted are clips on the way to their list of candidates; then, for each expert, attempts from task to task: all that
its walks came to, and of a walk that has not ended the next one, which pends at the first task; and then samples: one
for each clip, expert and round that a run set out to make. A walk that ended, at the end of its list or at a failed
attempt, ended for all rounds ahead of it. A failed attempt of which no task was told, as its process died or ran over
its limits, counts at the first.
"""

import io
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from factory.store.counts.attempts import Attempts
from factory.store.counts.codes import Ints
from tasks.stages import ATTEMPT, STAGES

CLIP, PERTURB, WRITE = STAGES[0].name, STAGES[1].name, STAGES[-1].name
COUNTS = ("planned", "accepted", "rejected", "failed", "pending")
BALANCE_COLUMNS = ["clip_id", "stage", "reason"]  # of `candidates`


@dataclass(frozen=True)
class Balance:
    """One stage, or task of attempts; of the last one, which a sample has passed when it is there, each round of an
    expert."""

    stage: str
    expert: str  # empty: of clips
    round: int  # -1: of clips or attempts
    planned: int  # clips, attempts or samples
    accepted: int  # went on to the next stage, or are samples
    rejected: int  # turned down for good: their clip was, or their walk came to its end
    failed: int  # stand at a failed clip or attempt
    pending: int  # nothing became of them yet


@dataclass(frozen=True)
class BalanceSheet:
    """All stages; none where no run wrote down its plan."""

    stages: tuple[Balance, ...] = ()
    walks_pending: int = 0  # (clip, expert) with a pending sample

    @property
    def samples(self) -> dict[str, int]:
        """planned, accepted, rejected, failed, pending of all experts and rounds."""
        made = [one for one in self.stages if one.stage == WRITE]
        return {name: sum(getattr(one, name) for one in made) for name in COUNTS}

    def text(self, width: int = 120) -> str:
        """As a table for a terminal."""
        table = Table("stage", "expert", "round", *COUNTS)
        for one in self.stages:
            counts = (f"{getattr(one, name):,}" for name in COUNTS)
            table.add_row(one.stage, one.expert, "" if one.round < 0 else str(one.round), *counts)
        sink = io.StringIO()
        Console(file=sink, width=width, no_color=True).print(table)
        return sink.getvalue()


def balance_of(plans: pa.Table, attempts: Attempts, lists: pa.Table) -> BalanceSheet:
    """Of tables in hand; lists: rows of `candidates` with BALANCE_COLUMNS."""
    clips, rounds = planned_rounds(plans)
    if not len(clips):
        return BalanceSheet()
    ours = np.array(attempts.clip_ids, object)
    at = np.full(len(ours), -1, np.int64)  # attempts' number of a clip -> place in `clips`, -1: in no plan
    where = np.searchsorted(clips, ours) if len(ours) else at
    inside = where < len(clips)
    at[inside] = np.where(clips[where[inside]] == ours[inside], where[inside], -1)
    listed = np.zeros(len(clips), bool)
    listed[_places(clips, lists["clip_id"])] = True
    empty = np.zeros(len(clips), bool)
    empty[_places(clips, lists.filter(pc.not_equal(lists["reason"], ""))["clip_id"])] = True
    dropped, broken, _ = _ends(attempts, "", at, len(clips))
    read = listed & ~dropped & ~broken
    found = [
        _balance(CLIP, "", -1, np.ones(len(clips), bool), read, dropped, broken),
        _balance(PERTURB, "", -1, read, read & ~empty, read & empty, np.zeros(len(clips), bool)),
    ]
    walks_pending = 0
    for expert, wanted in sorted(rounds.items()):
        fell, broke, made = _ends(attempts, expert, at, len(clips))
        fell, broke = fell | dropped, broke | broken
        pending = int(np.count_nonzero((made < wanted) & ~fell & ~broke))
        walks_pending += pending
        found += _of_attempts(attempts, expert, at, pending)
        for number in range(int(wanted.max())):
            found.append(_balance(WRITE, expert, number, wanted > number, made > number, fell, broke))
    return BalanceSheet(tuple(found), walks_pending)


def _of_attempts(attempts: Attempts, expert: str, at: Ints, pending: int) -> list[Balance]:
    """A line for each task; pending: walks that have not ended, each with one attempt that is to be made next."""
    mine = np.zeros(len(attempts.task), bool)
    if expert in attempts.experts:
        mine = (attempts.expert == attempts.experts.index(expert)) & (at[attempts.clip] >= 0) & ~attempts.exhausted
    failed = np.bincount(attempts.task[mine & attempts.failed], minlength=len(ATTEMPT) + 1)
    ended = np.bincount(attempts.task[mine], minlength=len(ATTEMPT) + 1)
    found = []
    for number, task in enumerate(ATTEMPT):
        left, broke = int(ended[number + 1 :].sum()), int(failed[number])
        fell = int(ended[number]) - broke
        found.append(Balance(task, expert, -1, left + fell + broke + pending, left, fell, broke, pending))
        pending = 0
    return found


def planned_rounds(plans: pa.Table) -> tuple[NDArray[np.object_], dict[str, Ints]]:
    """(C,) clip_ids in order, and for each expert (C,) the rounds wanted of each: the most of all plans."""
    rows = plans.to_pylist()
    clips = np.array(sorted({clip for row in rows for clip in row["clip_ids"]}), object)
    rounds = {expert: np.zeros(len(clips), np.int64) for row in rows for expert, _ in row["rounds"]}
    for row in rows:
        at = np.searchsorted(clips, np.array(row["clip_ids"], object))
        for expert, wanted in row["rounds"]:
            rounds[expert][at] = np.maximum(rounds[expert][at], wanted)
    return clips, rounds


def _balance(
    stage: str,
    expert: str,
    number: int,
    planned: NDArray[np.bool_],
    accepted: NDArray[np.bool_],
    rejected: NDArray[np.bool_],
    failed: NDArray[np.bool_],
) -> Balance:
    """Of arrays over clips; what is accepted counts before what failed, and that before what was rejected."""
    made = planned & accepted
    broke = planned & failed & ~made
    fell = planned & rejected & ~made & ~broke
    left = planned & ~made & ~broke & ~fell
    counts = (planned, made, fell, broke, left)
    return Balance(stage, expert, number, *(int(np.count_nonzero(which)) for which in counts))


def _ends(attempts: Attempts, expert: str, at: Ints, n: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_], Ints]:
    """Over n planned clips: whether the expert's walk ended by rejection, whether it stands at a failure, its samples.

    Ended is the walk of an expert that is tried once, or the clip as a whole, by a rejection; any other by its list.
    """
    rejected, failed, made = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, np.int64)
    if expert not in attempts.experts:
        return rejected, failed, made
    mine = (attempts.expert == attempts.experts.index(expert)) & (at[attempts.clip] >= 0)
    place = at[attempts.clip]
    fell = attempts.exhausted | ((attempts.candidate < 0) & ~attempts.accepted & ~attempts.failed)
    rejected[place[mine & fell]] = True
    failed[place[mine & attempts.failed]] = True
    np.add.at(made, place[mine & attempts.accepted], 1)
    return rejected, failed, made


def _places(clips: NDArray[np.object_], column: pa.ChunkedArray) -> Ints:
    """Of those clip_ids of a column that are among `clips`."""
    found = np.array(column.to_pylist(), object)
    at = np.searchsorted(clips, found) if len(found) else np.zeros(0, np.int64)
    inside = at < len(clips)
    return at[inside][clips[at[inside]] == found[inside]]

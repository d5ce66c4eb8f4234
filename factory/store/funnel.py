"""What the tables come to: attempts as columns, what became of what was planned, the acceptance funnel."""

import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from factory.store.samples import CAMERA_LEFT_OUT, MADE_UNDER, Kind, Store, plans_of, run_number_lookup
from factory.store.table import Codes, Ints, distinct_texts, text_codes
from tasks.stages import ATTEMPT, STAGES, TASKS
from tasks.world.repair.records import RepairCount, counts_text

# All attempts of a store as columns of integers: what counts over millions of rows is drawn from.
#
# One row per clip, expert and candidate: that of the newest run; of one run the sample. So a candidate counts once, and
# what a redo failed at is seen, not the old sample that it was to replace.

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
    def walk_starts(self) -> Ints:
        """Places at which a walk begins, one for each (expert, clip) with rows."""
        new = (np.diff(self.expert, prepend=-1) != 0) | (np.diff(self.clip, prepend=-1) != 0)
        return np.flatnonzero(new)

    @cached_property
    def round(self) -> Codes:
        """That each attempt was tried for: the accepted ones before it in its walk."""
        before: Codes = np.cumsum(self.accepted, dtype=np.int32)
        before -= self.accepted
        before -= np.repeat(before[self.walk_starts], np.diff(self.walk_starts, append=len(before)))
        return before


def attempts_from_tables(samples: pa.Table, outcomes: pa.Table, runs: Sequence[Mapping[str, Any]]) -> Attempts:
    """From rows with the columns SAMPLE_COLUMNS and OUTCOME_COLUMNS; runs: the records of run.json, oldest first."""
    rows = pa.concat_tables([outcomes.select(ATTEMPT_COLUMNS), samples.select(ATTEMPT_COLUMNS)])
    n_outcomes, n_ages = outcomes.num_rows, 2 * len(runs) + 2
    clip, clip_ids = text_codes(rows["clip_id"])
    expert, experts = text_codes(rows["expert"])
    candidate = rows["candidate_index"].to_numpy()
    why, whys, task = _reasons(outcomes)
    why = np.concatenate([why, np.zeros(samples.num_rows, np.int32)])
    task = np.concatenate([task, np.full(samples.num_rows, len(ATTEMPT), np.int32)])
    names, number = [name for name in MADE_UNDER if name != "attempt_id"], run_number_lookup(runs)
    made, at = distinct_texts(rows, names)
    numbers = np.array([number(dict(zip(names, texts))) for texts in made], np.int32)[at]
    age = 2 * (numbers + 1)  # -1: of no record
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


def _reasons(outcomes: pa.Table) -> tuple[Codes, tuple[str, ...], Codes]:
    """What became of the rows of `outcomes`, in words, of which the first is for samples; the tasks they ended in."""
    found, at = distinct_texts(outcomes, ("kind", "stage", "reason", "error_kind"))
    words = [_reason(*row) for row in found]
    known = list(dict.fromkeys([ACCEPTED, EXHAUSTED, *words]))
    # The place in ATTEMPT of the task of a stage or name; of one that was not told the first.
    places = {name: i for i, task in reversed(list(enumerate(ATTEMPT))) for name in (task, *STAGES_OF[task])}
    tasks = np.array([places.get(stage, 0) for _, stage, _, _ in found], np.int32)
    return np.array([known.index(word) for word in words], np.int32)[at], tuple(known), tasks[at]


def _reason(kind: str, stage: str, reason: str, error_kind: str) -> str:
    if kind == Kind.EXHAUSTED:
        return EXHAUSTED
    return f"failed.{error_kind}" if kind == Kind.FAILED else f"{stage}.{reason}"


# What was planned and what became of it, from the tables alone: planned = accepted + rejected + failed + pending.
#
# Counted are clips on the way to their list of candidates; then, for each expert, attempts from task to task: all that
# its walks came to, and of a walk that has not ended the next one, which pends at the first task; and then samples: one
# for each clip, expert and round that a run set out to make. A walk that ended, at the end of its list or at a failed
# attempt, ended for all rounds ahead of it. A failed attempt of which no task was told, as its process died or ran over
# its limits, counts at the first.

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


def balance_sheet(plans: pa.Table, attempts: Attempts, lists: pa.Table) -> BalanceSheet:
    """Of tables in hand; lists: rows of `candidates` with BALANCE_COLUMNS."""
    clips, rounds = wanted_rounds_by_expert(plans)
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
    dropped, broken, _ = _walk_ends(attempts, "", at, len(clips))
    read = listed & ~dropped & ~broken
    found = [
        _balance(CLIP, "", -1, np.ones(len(clips), bool), read, dropped, broken),
        _balance(PERTURB, "", -1, read, read & ~empty, read & empty, np.zeros(len(clips), bool)),
    ]
    for expert, wanted in sorted(rounds.items()):
        fell, broke, made = _walk_ends(attempts, expert, at, len(clips))
        fell, broke = fell | dropped, broke | broken
        pending = int(np.count_nonzero((made < wanted) & ~fell & ~broke))
        found += _of_attempts(attempts, expert, at, pending)
        for number in range(int(wanted.max())):
            found.append(_balance(WRITE, expert, number, wanted > number, made > number, fell, broke))
    return BalanceSheet(tuple(found))


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


def wanted_rounds_by_expert(plans: pa.Table) -> tuple[NDArray[np.object_], dict[str, Ints]]:
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


def _walk_ends(attempts: Attempts, expert: str, at: Ints, n: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_], Ints]:
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


# The acceptance funnel: per expert and round, what was tried, accepted, turned down and why; from the tables alone.
#
# An attempt belongs to the round it was tried for: the number of accepted candidates before it in its walk. The rates.
# Attempts: accepted of tried. First drive: of the clips that had the round before, those of which the first drive was
# accepted, as one random draw a round would be; an attempt without a plan is no drive. Clips: those with at least r+1
# accepted samples, of those with at least r and of all.

BEFORE_A_DRIVE = ("rollout.", "expert.")  # reasons for which an attempt has nothing that could be driven
LIST_COLUMNS = ["clip_id", "n_candidates", "gate_counts", "stage", "reason", "repairs"]


@dataclass(frozen=True)
class FunnelRow:
    """One round of one expert."""

    expert: str
    round: int
    accepted: int  # attempts
    rejected: int
    failed: int
    clips_before: int  # with at least `round` accepted samples: those this round can come from
    clips: int  # with at least round + 1 accepted samples
    clips_total: int  # in which this expert was to drive
    reasons: Mapping[str, int] = field(default_factory=dict)  # "stage.reason" or "failed.kind" -> attempts
    first_drives: int = 0  # clips whose first drive of this round was accepted
    simulated: bool = True  # from candidates; False: the log's own drive, tried once a clip

    @property
    def tried(self) -> int:
        return self.accepted + self.rejected + self.failed

    @property
    def attempt_rate(self) -> float:
        return self.accepted / self.tried if self.tried else float("nan")

    @property
    def clip_rate(self) -> float:
        """Of the clips that had the round before."""
        return self.clips / self.clips_before if self.clips_before else float("nan")

    @property
    def first_drive_rate(self) -> float:
        """Of the clips that had the round before: accepted without a second drive, as one random draw would be."""
        return self.first_drives / self.clips_before if self.clips_before else float("nan")

    @property
    def clip_rate_of_all(self) -> float:
        return self.clips / self.clips_total if self.clips_total else float("nan")


@dataclass(frozen=True)
class Repaired:
    """What was put right or left out in the logs of the prepared clips; a thing counts in each clip that it is in."""

    clips: int  # in which anything was
    counts: tuple[RepairCount, ...]  # by name of the pass, all clips

    @property
    def text(self) -> str:
        """One line, `12 objects in 7 clips repaired, 3 left out: gaps filled 12, listed twice 3 (left out)`."""
        made, left = sum(count.repaired for count in self.counts), sum(count.left_out for count in self.counts)
        objects, clips = "object" if made == 1 else "objects", "clip" if self.clips == 1 else "clips"
        summary = f"{made:,} {objects} in {self.clips:,} {clips} repaired, {left:,} left out"
        return f"{summary}: {counts_text(self.counts)}" if self.clips else ""


@dataclass(frozen=True)
class Funnel:
    """All rows, and what happened before any attempt."""

    rows: tuple[FunnelRow, ...]
    clips_prepared: int
    clips_without_candidates: Mapping[str, int]  # reason -> clips
    clip_outcomes: Mapping[str, int]  # "stage.reason" or "failed.kind" -> clips that never got to attempts
    gates: Mapping[str, int]  # gate -> vocabulary entries dropped, all clips
    candidates: int
    exhausted: Mapping[str, int]  # expert -> walks that came to the end of their list
    balance: BalanceSheet  # of what was planned
    repaired: Repaired
    cameras_left_out: Mapping[str, int] = field(default_factory=dict)  # too poor in their block -> clips

    @property
    def cameras_text(self) -> str:
        """One line, empty where none is: `cameras too poor in their block, left out: CAM_R1 in 12 clips`."""
        each = ", ".join(f"{name} in {n:,} clip{'s' * (n != 1)}" for name, n in self.cameras_left_out.items())
        return f"cameras too poor in their block, left out: {each}" if each else ""

    def text(self, width: int = 120) -> str:
        """The funnel as a table for a terminal."""
        head = f"clips prepared {self.clips_prepared}, candidates {self.candidates}"
        for title, counts in (
            ("dropped by gate", self.gates),
            ("without candidates", self.clips_without_candidates),
            ("clips dropped", self.clip_outcomes),
            ("walks exhausted", self.exhausted),
        ):
            if counts:
                head += f"\n{title}: " + ", ".join(f"{name} {n}" for name, n in counts.items())
        for line in filter(None, (self.cameras_text, self.repaired.text)):
            head += f"\n{line}"
        table = Table(
            "expert",
            "round",
            "tried",
            "accepted",
            "attempts %",
            "1st drive %",
            "clips",
            "clips %",
            "of all %",
            "why not",
        )
        for r in self.rows:
            why = ", ".join(f"{name.removeprefix('reward.')} {n}" for name, n in r.reasons.items())
            numbers = map(str, (r.round, r.tried, r.accepted))
            tries = map(_percent_text, (r.attempt_rate, r.first_drive_rate))
            clips = map(_percent_text, (r.clip_rate, r.clip_rate_of_all))
            table.add_row(r.expert, *numbers, *tries, f"{r.clips}/{r.clips_before}", *clips, why)
        sink = io.StringIO()
        Console(file=sink, width=width, no_color=True).print(table)
        return f"{head}\n{sink.getvalue()}"


def funnel_of(store: Store, clip_ids: Collection[str] | None = None) -> Funnel:
    """The funnel of a store, or of some of its clips."""
    samples, outcomes, lists = (_of_clips(rows, clip_ids) for rows in funnel_tables(store))
    return funnel_of_tables(samples, outcomes, lists, plans_of(store.plans, clip_ids), store.runs())


def funnel_tables(store: Store, more: Sequence[str] = ()) -> tuple[pa.Table, pa.Table, pa.Table]:
    """Samples, outcomes and lists of candidates with the columns that a funnel needs; more: others of samples.

    Texts are numbers into a dictionary.
    """
    columns = list(dict.fromkeys([*SAMPLE_COLUMNS, *more]))
    samples = store.samples.read(columns, encoded=True)
    return (
        samples,
        store.outcomes.read(OUTCOME_COLUMNS, encoded=True),
        store.candidates.read(LIST_COLUMNS, encoded=True),
    )


def funnel_of_tables(
    samples: pa.Table, outcomes: pa.Table, lists: pa.Table, plans: pa.Table, runs: Sequence[Mapping[str, Any]]
) -> Funnel:
    """The same of tables in hand, with the columns SAMPLE_COLUMNS, OUTCOME_COLUMNS, LIST_COLUMNS and those of `plans`.

    runs: the records of run.json, oldest first.
    """
    attempts = attempts_from_tables(samples, outcomes, runs)
    exhausted = np.bincount(attempts.expert[attempts.exhausted], minlength=len(attempts.experts))
    of_clips = np.zeros(len(attempts.whys), np.int64)
    if "" in attempts.experts:
        whole = attempts.why[attempts.expert == attempts.experts.index("")]
        of_clips = np.bincount(whole, minlength=len(attempts.whys))
    gates = _gates(lists["gate_counts"])
    cameras = [gate for gate in gates if gate.startswith(CAMERA_LEFT_OUT)]
    empty = lists.select(["stage", "reason"]).filter(pc.not_equal(lists["reason"], "")).unify_dictionaries()
    without = empty.group_by(["stage", "reason"]).aggregate([([], "count_all")])
    return Funnel(
        rows=tuple(
            row for number, name in enumerate(attempts.experts) if name for row in expert_rows(attempts, number)
        ),
        clips_prepared=lists.num_rows,
        clips_without_candidates=_sorted_counts(
            {f"{row['stage']}.{row['reason']}": row["count_all"] for row in without.to_pylist()}
        ),
        clip_outcomes=_sorted_counts(dict(zip(attempts.whys, of_clips.tolist()))),
        cameras_left_out={gate.removeprefix(CAMERA_LEFT_OUT): gates.pop(gate) for gate in sorted(cameras)},
        gates=gates,
        candidates=pc.sum(lists["n_candidates"]).as_py() or 0,
        exhausted={name: n for name, n in zip(attempts.experts, exhausted.tolist()) if n},
        balance=balance_sheet(plans, attempts, lists),
        repaired=_repaired(lists["repairs"]),
    )


def image_sources_text(store: Store, clip_ids: Collection[str]) -> str:
    """One line: how many samples of these clips have images from where."""
    rows = _of_clips(store.samples.read(["clip_id", "image_source"]), clip_ids)
    counts = {row["values"]: row["counts"] for row in pc.value_counts(rows["image_source"]).to_pylist()}
    return "images: " + (", ".join(f"{source} {n}" for source, n in sorted(counts.items())) or "no samples")


def expert_rows(attempts: Attempts, number: int) -> list[FunnelRow]:
    """A row for each round that the expert of that number tried anything for."""
    mine = attempts.expert == number
    clips = len(np.unique(attempts.clip[mine]))
    tried = mine & ~attempts.exhausted
    if not tried.any():
        return []
    at, why, accepted = attempts.round[tried], attempts.why[tried], attempts.accepted[tried]
    rounds, n_whys = int(at.max()) + 1, len(attempts.whys)
    counts = np.bincount(at * n_whys + why, minlength=rounds * n_whys).reshape(rounds, n_whys)
    drove = ~np.array([name.startswith(BEFORE_A_DRIVE) for name in attempts.whys])[why]
    walk_round = attempts.clip[tried][drove].astype(np.int64) * (rounds + 1) + at[drove]
    first = accepted[drove] & (np.diff(walk_round, prepend=-1) != 0)
    first_drives = np.bincount(at[drove][first], minlength=rounds)
    simulated = bool((attempts.candidate[tried] >= 0).any())
    rows, before = [], clips
    for round_ in range(rounds):
        reasons = _sorted_counts(dict(zip(attempts.whys, counts[round_].tolist())))
        made = reasons.pop(ACCEPTED, 0)  # one sample per clip and round
        failed = sum(n for why, n in reasons.items() if why.startswith("failed."))
        rejected = sum(reasons.values()) - failed
        counts_of = (made, rejected, failed, before, made, clips)
        drives = int(first_drives[round_])
        rows.append(FunnelRow(attempts.experts[number], round_, *counts_of, reasons, drives, simulated))
        before = made
    return rows


def _gates(column: pa.ChunkedArray) -> dict[str, int]:
    """Sums by name over a column of maps, in the order in which the names come up."""
    flat = [pa.table([chunk.keys, chunk.items], names=["gate", "n"]) for chunk in column.chunks if len(chunk.keys)]
    if not flat:
        return {}
    sums = pa.concat_tables(flat).group_by("gate", use_threads=False).aggregate([("n", "sum")])
    return dict(zip(sums["gate"].to_pylist(), sums["n_sum"].to_pylist()))


def _repaired(column: pa.ChunkedArray) -> Repaired:
    """Sums by pass over a column of lists of counts."""
    clips = int(pc.sum(pc.greater(pc.list_value_length(column), 0)).as_py() or 0)
    flat = [pa.Table.from_struct_array(pc.list_flatten(chunk)) for chunk in column.chunks]
    if not clips:
        return Repaired(0, ())
    sums = pa.concat_tables(flat).group_by("what").aggregate([("repaired", "sum"), ("left_out", "sum")])
    rows = sums.select(["what", "repaired_sum", "left_out_sum"]).sort_by("what").to_pylist()
    return Repaired(clips, tuple(RepairCount(*row.values()) for row in rows))


def _sorted_counts(counts: Mapping[str, int]) -> dict[str, int]:
    """Without zeros; of equal counts by name."""
    return dict(sorted(((name, n) for name, n in counts.items() if n), key=lambda item: (-item[1], item[0])))


def _of_clips(rows: pa.Table, chosen: Collection[str] | None) -> pa.Table:
    if chosen is None:
        return rows
    return rows.filter(pc.is_in(rows["clip_id"], value_set=pa.array(sorted(chosen), pa.string())))


def _percent_text(rate: float) -> str:
    return "-" if rate != rate else f"{100 * rate:.1f}"

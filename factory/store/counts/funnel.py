"""The acceptance funnel: per expert and round, what was tried, accepted, turned down and why; from the tables alone.

An attempt belongs to the round it was tried for: the number of accepted candidates before it in its walk. The rates.
Attempts: accepted of tried. First try: of the clips that had the round before, those accepted without a second try, as
one random draw a round would be. Clips: those with at least r+1 accepted samples, of those with at least r and of all.
"""

import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from rich.console import Console
from rich.table import Table

from factory.store.counts.attempts import ACCEPTED, OUTCOME_COLUMNS, SAMPLE_COLUMNS, Attempts, attempts_of
from factory.store.counts.balance import BalanceSheet, balance_of
from factory.store.plans import plans_of
from factory.store.samples import Store

LIST_COLUMNS = ["clip_id", "n_candidates", "gate_counts", "stage", "reason"]


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
    first_tries: int = 0  # clips whose first attempt of this round was accepted
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
    def first_try_rate(self) -> float:
        """Of the clips that had the round before: accepted without a second try, as one random draw would be."""
        return self.first_tries / self.clips_before if self.clips_before else float("nan")

    @property
    def clip_rate_of_all(self) -> float:
        return self.clips / self.clips_total if self.clips_total else float("nan")


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
        table = Table(
            "expert", "round", "tried", "accepted", "attempts %", "1st try %", "clips", "clips %", "of all %", "why not"
        )
        for r in self.rows:
            why = ", ".join(f"{name.removeprefix('reward.')} {n}" for name, n in r.reasons.items())
            numbers = map(str, (r.round, r.tried, r.accepted))
            tries = map(_percent, (r.attempt_rate, r.first_try_rate))
            clips = map(_percent, (r.clip_rate, r.clip_rate_of_all))
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
    attempts = attempts_of(samples, outcomes, runs)
    exhausted = np.bincount(attempts.expert[attempts.exhausted], minlength=len(attempts.experts))
    of_clips = np.zeros(len(attempts.whys), np.int64)
    if "" in attempts.experts:
        whole = attempts.why[attempts.expert == attempts.experts.index("")]
        of_clips = np.bincount(whole, minlength=len(attempts.whys))
    empty = lists.select(["stage", "reason"]).filter(pc.not_equal(lists["reason"], "")).unify_dictionaries()
    without = empty.group_by(["stage", "reason"]).aggregate([([], "count_all")])
    return Funnel(
        rows=tuple(
            row for number, name in enumerate(attempts.experts) if name for row in expert_rows(attempts, number)
        ),
        clips_prepared=lists.num_rows,
        clips_without_candidates=_most_first(
            {f"{row['stage']}.{row['reason']}": row["count_all"] for row in without.to_pylist()}
        ),
        clip_outcomes=_most_first(dict(zip(attempts.whys, of_clips.tolist()))),
        gates=_gates(lists["gate_counts"]),
        candidates=pc.sum(lists["n_candidates"]).as_py() or 0,
        exhausted={name: n for name, n in zip(attempts.experts, exhausted.tolist()) if n},
        balance=balance_of(plans, attempts, lists),
    )


def image_sources_text(store: Store, clip_ids: Collection[str]) -> str:
    """One line: how many samples of these clips have images from where, those from lidar alone apart."""
    rows = _of_clips(store.samples.read(["clip_id", "image_source", "tags"]), clip_ids).combine_chunks()
    tags = rows["tags"].combine_chunks()
    lidar = pc.list_parent_indices(tags).filter(pc.equal(pc.list_flatten(tags), "lidar_only"))
    alone = pc.is_in(pa.array(range(rows.num_rows), pa.int64()), value_set=lidar.cast(pa.int64()))
    sources = pc.if_else(alone, "render (lidar only)", rows["image_source"])
    counts = {row["values"]: row["counts"] for row in pc.value_counts(sources).to_pylist()}
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
    first = accepted & (np.diff(attempts.clip[tried].astype(np.int64) * (rounds + 1) + at, prepend=-1) != 0)
    first_tries = np.bincount(at[first], minlength=rounds)
    simulated = bool((attempts.candidate[tried] >= 0).any())
    rows, before = [], clips
    for round_ in range(rounds):
        reasons = _most_first(dict(zip(attempts.whys, counts[round_].tolist())))
        made = reasons.pop(ACCEPTED, 0)  # one sample per clip and round
        failed = sum(n for why, n in reasons.items() if why.startswith("failed."))
        rejected = sum(reasons.values()) - failed
        tries = int(first_tries[round_])
        rows.append(
            FunnelRow(
                attempts.experts[number], round_, made, rejected, failed, before, made, clips, reasons, tries, simulated
            )
        )
        before = made
    return rows


def _gates(column: pa.ChunkedArray) -> dict[str, int]:
    """Sums by name over a column of maps, in the order in which the names come up."""
    flat = [pa.table([chunk.keys, chunk.items], names=["gate", "n"]) for chunk in column.chunks if len(chunk.keys)]
    if not flat:
        return {}
    sums = pa.concat_tables(flat).group_by("gate", use_threads=False).aggregate([("n", "sum")])
    return dict(zip(sums["gate"].to_pylist(), sums["n_sum"].to_pylist()))


def _most_first(counts: Mapping[str, int]) -> dict[str, int]:
    """Without zeros; of equal counts by name."""
    return dict(sorted(((name, n) for name, n in counts.items() if n), key=lambda item: (-item[1], item[0])))


def _of_clips(rows: pa.Table, chosen: Collection[str] | None) -> pa.Table:
    if chosen is None:
        return rows
    return rows.filter(pc.is_in(rows["clip_id"], value_set=pa.array(sorted(chosen), pa.string())))


def _percent(rate: float) -> str:
    return "-" if rate != rate else f"{100 * rate:.1f}"

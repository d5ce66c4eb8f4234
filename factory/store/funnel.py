"""The acceptance funnel: per expert and round, what was tried, accepted, turned down and why; from the tables alone.

An attempt belongs to the round it was tried for: the number of accepted candidates before it in its walk. The rates.
Attempts: accepted of tried. First try: of the clips that had the round before, those accepted without a second try, as
one random draw a round would be. Clips: those with at least r+1 accepted samples, of those with at least r and of all.
"""

import io
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pyarrow as pa
from rich.console import Console
from rich.table import Table

from factory.store.outcomes import Kind
from factory.store.samples import MADE_UNDER, Store, run_number

Row = Mapping[str, Any]
SAMPLE_COLUMNS = [*MADE_UNDER, "clip_id", "candidate_index"]
OUTCOME_COLUMNS = [*SAMPLE_COLUMNS, "kind", "stage", "reason", "error_kind"]
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
    chosen = None if clip_ids is None else set(clip_ids)
    samples = _rows(store.samples.read(SAMPLE_COLUMNS), chosen)
    outcomes = _rows(store.outcomes.read(OUTCOME_COLUMNS), chosen)
    return funnel_of_rows(samples, outcomes, _rows(store.candidates.read(LIST_COLUMNS), chosen), store.runs())


def funnel_of_rows(
    samples: Sequence[Row], outcomes: Sequence[Row], lists: Sequence[Row], runs: Sequence[Mapping[str, Any]]
) -> Funnel:
    """The same of rows in hand, with the columns SAMPLE_COLUMNS, OUTCOME_COLUMNS and LIST_COLUMNS.

    runs: the records of run.json, oldest first.
    """
    samples, outcomes = _newest(samples, outcomes, run_number(runs))
    walks: dict[str, dict[str, list[tuple[int, str]]]] = defaultdict(lambda: defaultdict(list))
    clip_outcomes: Counter[str] = Counter()
    exhausted: Counter[str] = Counter()
    for row in samples:
        walks[row["expert"]][row["clip_id"]].append((row["candidate_index"], ""))
    for row in outcomes:
        if not row["expert"]:
            clip_outcomes[_why(row)] += 1
        elif row["kind"] == Kind.EXHAUSTED:
            exhausted[row["expert"]] += 1
            walks[row["expert"]][row["clip_id"]].extend([])
        else:
            walks[row["expert"]][row["clip_id"]].append((row["candidate_index"], _why(row)))
    gates: Counter[str] = Counter()
    for row in lists:
        gates.update(dict(row["gate_counts"] or ()))
    without = Counter(f"{row['stage']}.{row['reason']}" for row in lists if row["reason"])
    return Funnel(
        rows=tuple(row for expert in sorted(walks) for row in _expert_rows(expert, walks[expert])),
        clips_prepared=len(lists),
        clips_without_candidates=dict(without.most_common()),
        clip_outcomes=dict(clip_outcomes.most_common()),
        gates=dict(gates),
        candidates=sum(row["n_candidates"] for row in lists),
        exhausted=dict(sorted(exhausted.items())),
    )


def image_sources_text(store: Store, clip_ids: Collection[str]) -> str:
    """One line: how many samples of these clips have images from where, those from lidar alone apart."""
    rows = _rows(store.samples.read(["clip_id", "image_source", "tags"]), set(clip_ids))
    lidar = "render (lidar only)"
    counts = Counter(lidar if "lidar_only" in row["tags"] else str(row["image_source"]) for row in rows)
    return "images: " + (", ".join(f"{source} {n}" for source, n in sorted(counts.items())) or "no samples")


def _expert_rows(expert: str, clips: Mapping[str, list[tuple[int, str]]]) -> list[FunnelRow]:
    accepted: Counter[int] = Counter()
    first_tries: Counter[int] = Counter()
    reasons: dict[int, Counter[str]] = defaultdict(Counter)
    for attempts in clips.values():
        at, fresh = 0, True
        for _, why in sorted(attempts):
            if why:
                reasons[at][why] += 1
                fresh = False
            else:
                accepted[at] += 1
                first_tries[at] += fresh
                at, fresh = at + 1, True
    rounds = max([*accepted, *reasons], default=-1) + 1
    before = len(clips)
    simulated = any(candidate >= 0 for attempts in clips.values() for candidate, _ in attempts)
    rows = []
    for number in range(rounds):
        whys = reasons[number]
        failed = sum(n for why, n in whys.items() if why.startswith("failed."))
        rows.append(
            FunnelRow(
                expert,
                number,
                accepted[number],
                whys.total() - failed,
                failed,
                before,
                accepted[number],  # one sample per clip and round
                len(clips),
                dict(whys.most_common()),
                first_tries[number],
                simulated,
            )
        )
        before = accepted[number]
    return rows


def _newest(
    samples: Sequence[Row], outcomes: Sequence[Row], run_of: Callable[[Row], int]
) -> tuple[list[Row], list[Row]]:
    """One row per clip, expert and candidate: that of the newest run; of one run the sample.

    So a candidate counts once, and what a redo failed at is seen, not the old sample that it was to replace.
    """
    newest: dict[tuple[str, str, int], tuple[int, Row]] = {}
    for row in (*outcomes, *samples):
        place, run = (row["clip_id"], row["expert"], row["candidate_index"]), run_of(row)
        if place not in newest or run >= newest[place][0]:
            newest[place] = run, row
    rows = [row for _, row in newest.values()]
    return [row for row in rows if "kind" not in row], [row for row in rows if "kind" in row]


def _rows(table: pa.Table, chosen: set[str] | None) -> list[Row]:
    return [row for row in table.to_pylist() if chosen is None or row["clip_id"] in chosen]


def _why(row: Mapping[str, object]) -> str:
    return f"failed.{row['error_kind']}" if row["kind"] == Kind.FAILED else f"{row['stage']}.{row['reason']}"


def _percent(rate: float) -> str:
    return "-" if rate != rate else f"{100 * rate:.1f}"

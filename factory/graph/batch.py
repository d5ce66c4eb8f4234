"""Results on their way to the tables: gathered by reference, written as shards by tasks, committed in groups.

A batch closes when the rows of one partition reach 128 MB or after 30 s; its shards are written by tasks; when all of
them stand, the driver commits the whole batch. What is not committed when a run dies is tried again by the next one.
"""

import ctypes
import ctypes.util
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import pyarrow as pa

from factory.graph.local import Graph, Ticket
from factory.graph.steps import Failure
from factory.store.attempts import ClipCandidates, Outcome
from factory.store.parquet_file import Shard
from factory.store.samples import Store

SHARD_BYTES = 128 * 2**20
SHARD_SECONDS = 30.0


class WriteFailed(RuntimeError):
    """A shard could not be written."""


@dataclass(frozen=True)
class PendingRow:
    """An accepted row that lies with a worker."""

    result: Any
    n_bytes: int
    partition: tuple[int, str]  # round, expert
    licence: str


@dataclass
class PendingCommit:
    """What one commit holds."""

    rows: dict[tuple[int, str], list[PendingRow]] = field(default_factory=lambda: defaultdict(list))
    n_bytes: Counter[tuple[int, str]] = field(default_factory=Counter)  # of rows: asked on every turn of the loop
    candidates: list[ClipCandidates] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    replaced: list[str] = field(default_factory=list)  # attempt_ids whose old rows go
    unlisted: list[str] = field(default_factory=list)  # clip_ids whose candidate list goes
    shards: list[Shard] = field(default_factory=list)
    writing: int = 0
    opened: float = 0.0

    @property
    def is_empty(self) -> bool:
        return not (self.rows or self.candidates or self.outcomes or self.replaced or self.unlisted)

    @property
    def largest(self) -> int:
        """Bytes of the largest partition."""
        return max(self.n_bytes.values(), default=0)


@cache
def _trim() -> Callable[[int], int] | None:
    """glibc's malloc_trim; None where the C library has none."""
    name = ctypes.util.find_library("c") if sys.platform == "linux" else None
    return getattr(ctypes.CDLL(name), "malloc_trim", None) if name else None


def give_back_freed() -> None:
    """Hand memory that is free, but kept for later, back to the machine: of the C library's many arenas and Arrow's.

    A driver of days would else hold what each of its threads once needed. About a millisecond.
    """
    pa.default_memory_pool().release_unused()
    if trim := _trim():
        trim(0)


class Gatherer:
    """Fills the open batch, sends full ones to be written, commits the written ones."""

    def __init__(
        self,
        graph: Graph,
        store: Store,
        shard_bytes: int = SHARD_BYTES,
        shard_seconds: float = SHARD_SECONDS,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._graph, self._store, self._clock = graph, store, clock
        self.committed: Callable[[Sequence[Shard], float], None] = lambda shards, seconds: None  # told of every commit
        self._shard_bytes, self._shard_seconds = shard_bytes, shard_seconds
        self._open = PendingCommit()
        self._written_by: dict[Ticket, PendingCommit] = {}

    @property
    def n_writing(self) -> int:
        return len({id(batch) for batch in self._written_by.values()})

    def add(
        self,
        rows: Sequence[PendingRow] = (),
        candidates: Sequence[ClipCandidates] = (),
        outcomes: Sequence[Outcome] = (),
        replaced: Sequence[str] = (),
        unlisted: Sequence[str] = (),
    ) -> None:
        """Results that must become visible together."""
        if self._open.is_empty:
            self._open.opened = self._clock()
        for row in rows:
            self._open.rows[row.partition].append(row)
            self._open.n_bytes[row.partition] += row.n_bytes
        self._open.candidates.extend(candidates)
        self._open.outcomes.extend(outcomes)
        self._open.replaced.extend(replaced)
        self._open.unlisted.extend(unlisted)

    def send_if_due(self) -> None:
        batch = self._open
        age = self._clock() - batch.opened
        if not batch.is_empty and (batch.largest >= self._shard_bytes or age >= self._shard_seconds):
            self.send()

    def send(self) -> None:
        """Close the open batch and have its shards written."""
        batch, self._open = self._open, PendingCommit()
        for partition in sorted(batch.rows):
            ticket = self._graph.submit("write", *(row.result for row in batch.rows[partition]))
            self._written_by[ticket] = batch
            batch.writing += 1
        if not batch.writing:
            self._commit(batch)

    def finished(self, ticket: Ticket, report: Any) -> bool:
        """Take the report of a write; False where the ticket is not one. Raises WriteFailed and the store's errors."""
        batch = self._written_by.pop(ticket, None)
        if batch is None:
            return False
        if isinstance(report, Failure):
            said = report.error.splitlines()[-1]
            raise WriteFailed(f"a file of samples could not be written: {said}; run the same command again to go on")
        batch.shards.append(report)
        batch.writing -= 1
        if not batch.writing:
            self._commit(batch)
        return True

    def _commit(self, batch: PendingCommit) -> None:
        licences = {row.licence for rows in batch.rows.values() for row in rows}
        began = time.perf_counter()
        self._store.commit(batch.candidates, batch.shards, batch.outcomes, batch.replaced, batch.unlisted, licences)
        self.committed(batch.shards, time.perf_counter() - began)
        batch.rows.clear()
        give_back_freed()

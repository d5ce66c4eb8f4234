"""The table `outcomes`: what became of every attempt that is not a sample, one row per attempt_id.

A row about a clip as a whole (a bad file, a standing ego) has candidate -1 and no expert; `exhausted` stands behind the
last candidate of a walk. A newer outcome of the same attempt replaces the older one.
Timings live here and nowhere else.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import pyarrow as pa

from factory.store.columns import schema_of
from factory.store.parquet_file import TableSpec


class Kind(StrEnum):
    ACCEPTED = "accepted"  # stands in `samples`, never here
    REJECTED = "rejected"
    FAILED = "failed"
    EXHAUSTED = "exhausted"


class ErrorKind(StrEnum):
    NONE = ""
    INPUT = "input"  # the clip is broken: waits for retry or a raised stage version
    BUG = "bug"  # the code raised: likewise
    MACHINE = "machine"  # the machine is ill (factory.store.disk): the next run tries again, however often
    SYSTEM = "system"  # a worker died at it, a file could not be read: the next run tries again
    LIMIT = "limit"  # ended over its seconds or its memory: the next run tries again
    POISON = "poison"  # failed(system | limit) in QUARANTINE_AFTER runs: waits like a bug


QUARANTINE_AFTER = 3  # runs, each with Ray's own retries


@dataclass(frozen=True)
class Outcome:
    """One row of the table."""

    attempt_id: str
    clip_id: str
    dataset: str
    log_id: str
    expert: str
    expert_digest: str
    candidate_index: int
    kind: str  # Kind
    settings_hash: str
    stage_versions: str  # canonical JSON
    stage: str = ""  # rejected: by which stage; failed: in which task of an attempt, where that is known
    reason: str = ""  # rejected: why
    detail: str = ""
    error_kind: str = ""  # ErrorKind
    error: str = ""  # last lines of the traceback
    tries: int = 1  # runs that tried it; failed(machine): those that count
    n_tried: int = 0  # exhausted: length of the candidate list
    subscores: dict[str, float] = field(default_factory=dict)  # rejected: as far as known
    seconds: dict[str, float] = field(default_factory=dict)  # stage -> seconds


SCHEMA = schema_of(Outcome)
OUTCOMES = TableSpec("outcomes", SCHEMA, "attempt_id")


def outcomes_table(outcomes: Sequence[Outcome]) -> pa.Table:
    """Column by column: a row holds nothing that had to be copied first."""
    columns = [pa.array([getattr(row, field.name) for row in outcomes], field.type) for field in SCHEMA]
    return pa.Table.from_arrays(columns, schema=SCHEMA)

"""The table `candidates`: one row per prepared clip with its ordered candidate list and what each gate dropped."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import pyarrow as pa

from factory.store.columns import schema_of
from factory.store.parquet_file import TableSpec
from factory.store.table import KeyedTable


@dataclass(frozen=True)
class CandidateRow:
    """One perturbation that passed every gate and filter, in the order in which walks try it."""

    index: int  # place in the clip's ordered list, 0 ...
    vocabulary_index: int  # -1: the log itself; -2 - number of a planner's drift
    end_x: float  # [m] LQR-reached end pose, frame of the logged pose at T+H
    end_y: float  # [m]
    end_heading: float  # [rad]
    end_speed: float  # [m/s]
    cell: tuple[int, int]  # (longitudinal, lateral) cell of the interleaved grid
    score: float  # EPDMS (/14) against log replay
    reactive_score: float  # EPDMS (/14) among reacting agents


@dataclass(frozen=True)
class ClipCandidates:
    """One row of the table."""

    clip_id: str
    dataset: str
    log_id: str
    content_digest: str
    prepare_digest: str
    vocabulary_digest: str
    gate_counts: dict[str, int]
    candidates: tuple[CandidateRow, ...]
    stage: str = ""  # why there are none
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Listed:
    """What a run must know of a clip's row; the candidates themselves stay in the table and in the prepared clip."""

    prepare_digest: str
    content_digest: str
    n_candidates: int


SCHEMA = schema_of(ClipCandidates)
SCHEMA = SCHEMA.insert(SCHEMA.get_field_index("candidates"), pa.field("n_candidates", pa.int32()))
CANDIDATES = TableSpec("candidates", SCHEMA, "clip_id")


def candidates_table(rows: Sequence[ClipCandidates]) -> pa.Table:
    return pa.Table.from_pylist(
        [
            vars(row) | {"candidates": [vars(each) for each in row.candidates], "n_candidates": len(row.candidates)}
            for row in rows
        ],
        schema=SCHEMA,
    )


def listed_of(table: KeyedTable) -> dict[str, Listed]:
    """clip_id -> what the table says of the clip."""
    rows = table.read(["clip_id", *(field.name for field in fields(Listed))])
    return {row.pop("clip_id"): Listed(**row) for row in rows.to_pylist()}

"""The table `candidates`: one row per prepared clip with its ordered candidate list and what each gate dropped."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import pyarrow as pa

from factory.store.table import TableSpec
from factory.work import CandidateRow


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


CANDIDATE = pa.struct(
    [
        ("index", pa.int32()),
        ("vocabulary_index", pa.int32()),
        ("end_x", pa.float64()),
        ("end_y", pa.float64()),
        ("end_heading", pa.float64()),
        ("end_speed", pa.float64()),
        ("cell", pa.list_(pa.int32())),
        ("score", pa.float64()),
        ("reactive_score", pa.float64()),
    ]
)
SCHEMA = pa.schema(
    [
        *(
            pa.field(name, pa.string())
            for name in ("clip_id", "dataset", "log_id", "content_digest", "prepare_digest", "vocabulary_digest")
        ),
        pa.field("gate_counts", pa.map_(pa.string(), pa.int64())),
        pa.field("n_candidates", pa.int32()),
        pa.field("candidates", pa.list_(CANDIDATE)),
        pa.field("stage", pa.string()),
        pa.field("reason", pa.string()),
    ]
)
CANDIDATES = TableSpec("candidates", SCHEMA, "clip_id")


def candidates_table(rows: Sequence[ClipCandidates]) -> pa.Table:
    return pa.Table.from_pylist(
        [
            asdict(row) | {"gate_counts": list(row.gate_counts.items()), "n_candidates": len(row.candidates)}
            for row in rows
        ],
        schema=SCHEMA,
    )


def candidates_of(table: pa.Table) -> list[ClipCandidates]:
    """Rows of a complete candidates table."""
    out = []
    for row in table.drop_columns(["n_candidates"]).to_pylist():
        candidates = tuple(CandidateRow(**c | {"cell": tuple(c["cell"])}) for c in row["candidates"])
        out.append(ClipCandidates(**row | {"gate_counts": dict(row["gate_counts"] or ()), "candidates": candidates}))
    return out

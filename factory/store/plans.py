"""The table `plans`: what runs set out to do, one row for each different answer, there before its first task is begun.

What is planned under an `out` is all of them together: for each clip and expert the most rounds that any run asked for.
A plan is named by its content, so that the same command again finds its own.
"""

import hashlib
from collections.abc import Collection, Mapping, Sequence

import pyarrow as pa

from factory.store.parquet_file import TableSpec
from factory.store.table import KeyedTable

SCHEMA = pa.schema(
    [
        pa.field("plan_id", pa.string()),
        pa.field("rounds", pa.map_(pa.string(), pa.int32())),  # expert -> samples of each clip
        pa.field("clip_ids", pa.list_(pa.string())),
    ]
)
PLANS = TableSpec("plans", SCHEMA, "plan_id")


def plan_table(rounds: Mapping[str, int], clip_ids: Sequence[str]) -> pa.Table:
    """One plan as a row."""
    clips, wanted = sorted(clip_ids), dict(sorted(rounds.items()))
    text = "\x1f".join((*(f"{expert} {n}" for expert, n in wanted.items()), "", *clips))
    row = {"plan_id": hashlib.sha256(text.encode()).hexdigest()[:16], "rounds": wanted, "clip_ids": clips}
    return pa.Table.from_pylist([row], schema=SCHEMA)


def plans_of(table: KeyedTable, clip_ids: Collection[str] | None = None) -> pa.Table:
    """All plans, or as if some clips were all that there are."""
    plans = table.read()
    if clip_ids is None:
        return plans
    chosen = set(clip_ids)
    rows = [row | {"clip_ids": [clip for clip in row["clip_ids"] if clip in chosen]} for row in plans.to_pylist()]
    return pa.Table.from_pylist(rows, schema=SCHEMA)

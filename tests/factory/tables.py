"""The tables of a store as plain values, for comparison: timings left out, rows in the order of their keys."""

from pathlib import Path

import pyarrow as pa

from factory.store.location import Location
from factory.store.samples import Store


def tables_of(out: Path | Location) -> tuple[pa.Table, list[object], list[object]]:
    """(samples, outcomes, candidates)."""
    store = Store(out)
    samples = store.samples.read().sort_by("attempt_id")
    outcomes = store.outcomes.read().drop_columns(["seconds"]).sort_by("attempt_id").to_pylist()
    candidates = store.candidates.read().sort_by("clip_id").to_pylist()
    return samples, outcomes, candidates


def assert_same_rows(a: pa.Table, b: pa.Table) -> None:
    """Exactly equal, NaN to NaN."""
    assert a.schema.equals(b.schema)
    for name in a.column_names:
        assert repr(a[name].to_pylist()) == repr(b[name].to_pylist()), name


def assert_same_tables(a: Path | Location, b: Path | Location) -> None:
    """Identical rows, every column but timings."""
    left, right = tables_of(a), tables_of(b)
    assert left[0]["attempt_id"].to_pylist() == right[0]["attempt_id"].to_pylist()
    assert_same_rows(left[0], right[0])
    assert repr(left[1:]) == repr(right[1:])  # NaN to NaN

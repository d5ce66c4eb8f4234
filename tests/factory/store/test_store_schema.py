"""The sample row: one declaration gives schema, validation and docs."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from factory.store.schema import COLUMNS, FIELDS, SCHEMA, BadRow, Stamp, sample_rows_to_table, table_to_rows
from tests.factory.store.formats import formats_table
from tests.factory.toy import row_of, stream

DOCS = Path(__file__).parents[3] / "docs" / "formats.md"
STAMP = Stamp("a1", "recovery", "d", 1, 7, "v", "s", "{}")


def full_row() -> dict[str, object]:
    return row_of(stream("row")) | vars(STAMP)


def same(a: object, b: object) -> bool:
    if isinstance(a, dict):
        assert isinstance(b, dict)
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b))  # type: ignore[arg-type]
    return bool(np.array_equal(np.asarray(a), np.asarray(b), equal_nan=np.asarray(a).dtype.kind == "f"))


def test_a_row_comes_back_as_it_went_in() -> None:
    row = full_row()
    table = sample_rows_to_table([row])
    assert table.schema.equals(SCHEMA, check_metadata=True)
    back = table_to_rows(table)[0]
    assert [name for name in row if not same(row[name], back[name])] == []
    assert back["agent_boxes"].shape == (3, 56, 5)  # type: ignore[attr-defined]


def test_an_empty_world_is_a_valid_sample() -> None:
    empty = {f.name: [] for f in FIELDS if f.shape and isinstance(f.shape[0], str)}
    back = table_to_rows(sample_rows_to_table([full_row() | empty]))[0]
    assert back["agent_boxes"].shape == (0, 56, 5)  # type: ignore[attr-defined]
    assert back["lane_polygons"] == []


def test_the_docs_say_what_the_schema_is() -> None:
    text = DOCS.read_text()
    assert formats_table() in text, "docs/formats.md is behind: put the output of formats_table() there"
    for field in FIELDS:
        arrow: pa.DataType = SCHEMA.field(field.name).type
        for size in field.shape:
            assert pa.types.is_fixed_size_list(arrow) == isinstance(size, int)
            assert isinstance(size, str) or arrow.list_size == size
            arrow = arrow.value_type
        assert pa.types.is_struct(arrow) or str(arrow).replace("double", "float64").replace("float32", "float32") in {
            field.dtype,
            {"float32": "float", "float64": "double"}.get(field.dtype, field.dtype),
        }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"label_10hz": np.zeros((8, 3))}, r"label_10hz: shape \[40, 3\] expected, got \[8, 3\]"),
        ({"agent_boxes": np.zeros((3, 41, 5))}, r"agent_boxes: shape \['N', 56, 5\] expected"),
        ({"label_10hz": np.full((40, 3), np.nan)}, "label_10hz: holds NaN"),
        ({"agent_valid": np.zeros((3, 56))}, "agent_valid: bool expected, got float64"),
        ({"command": None}, "command: missing"),
        ({"command": 3}, "command: string expected"),
        ({"lable": 1}, "unknown columns"),
        ({"cameras": [{"name": "front"}]}, "cameras: members"),
        ({"lane_polygons": [np.zeros((4, 3))]}, r"lane_polygons: shape \['P', 2\] expected"),
        ({"lane_polygons": [np.zeros((4, 2)), np.zeros((4, 3))]}, r"lane_polygons: shape \['P', 2\] expected"),
        ({"lane_polygons": [np.zeros((4, 2)), np.full((4, 2), np.nan)]}, "lane_polygons: holds NaN"),
        ({"lane_polygons": [np.zeros((4, 2)), np.full((4, 2), "a")]}, "lane_polygons: float32 expected"),
    ],
)
def test_a_row_that_does_not_fit_is_refused_by_column(change: dict[str, object], message: str) -> None:
    with pytest.raises(BadRow, match=message):
        sample_rows_to_table([full_row() | change])


def test_absent_agents_may_be_nan_and_nullable_columns_may_be_left_out() -> None:
    row = full_row() | {"agent_boxes": np.full((3, 56, 5), np.nan)}
    for name, column in COLUMNS.items():
        if column.nullable:
            del row[name]
    back = table_to_rows(sample_rows_to_table([row]))[0]
    assert back["stage1_nc"] is None and back["images"] is None and back["label_progress"] is None

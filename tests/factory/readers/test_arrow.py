"""Files of Arrow: as Arrow itself reads them; refused before they are unpacked where they unpack to far more."""

import io
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from factory.readers.arrow import read_arrow, read_feather
from factory.readers.base import BadClip

ROWS = np.arange(1000.0)
RUNS = pa.RunEndEncodedArray.from_arrays(pa.array([2**31 - 1], pa.int64()), pa.array([1.0]))
SAME = pa.DictionaryArray.from_arrays(pa.array([0] * 10_000, pa.int32()), ["x" * 10**6])
NAMES = pa.DictionaryArray.from_arrays(pa.array([0] * 9, pa.int32()), ["x" * 10**8])


def ipc(column: object, packed: str | None = "zstd", rows_a_batch: int = 10**9) -> bytes:
    table = pa.table({"a": column})
    options = pa.ipc.IpcWriteOptions(compression=packed)
    with pa.ipc.new_file(sink := io.BytesIO(), table.schema, options=options) as writer:
        writer.write_table(table, rows_a_batch)
    return sink.getvalue()


@pytest.mark.parametrize("packed", ["zstd", "lz4", None])
@pytest.mark.parametrize(
    "column", [ROWS, ["a", "b"] * 500, [[1, 2]] * 1000, pa.array(["a"] * 1000).dictionary_encode()]
)
def test_a_file_is_read_as_arrow_reads_it(column: object, packed: str | None, tmp_path: Path) -> None:
    for rows_a_batch in (10**9, 70):
        (path := tmp_path / "a.arrow").write_bytes(ipc(column, packed, rows_a_batch))
        assert read_arrow(path, "feather").equals(pa.ipc.open_file(path).read_all())


@pytest.mark.parametrize(
    "column",
    [np.zeros(10**7), ["x" * 10**8], pa.nulls(2**31 - 1), RUNS, NAMES, SAME],
    ids=["0", "text", "nulls", "runs", "names", "same"],
)
def test_what_unpacks_to_far_more_than_the_file_has_is_refused_before(column: object, tmp_path: Path) -> None:
    (path := tmp_path / "a.arrow").write_bytes(ipc(column))
    before = pa.default_memory_pool().max_memory()
    with pytest.raises(BadClip, match=r"a\.arrow: size: unpacks to more than the 16,\d+,\d+ bytes that a file of"):
        read_arrow(path, "feather")
    assert pa.default_memory_pool().max_memory() <= before + 10**6


def test_a_footer_that_tells_of_something_else_is_refused(tmp_path: Path) -> None:
    many = ipc(ROWS, rows_a_batch=500)
    for other in (ipc(ROWS), ipc(ROWS.astype("f4"), rows_a_batch=500)):
        ends = [int.from_bytes(data[-10:-6], "little") + 10 for data in (many, other)]
        (path := tmp_path / "a.arrow").write_bytes(many[: -ends[0]] + other[-ends[1] :])
        with pytest.raises(BadClip, match="its footer tells of others than its 2 batches and 1 columns"):
            read_arrow(path, "feather")


@pytest.mark.parametrize("packed", [False, True])
def test_a_column_of_lists_is_refused_by_its_name(packed: bool, tmp_path: Path) -> None:
    lists = pa.array([[[1]]] * 9)
    column = pa.DictionaryArray.from_arrays(pa.array([0] * 9, pa.int32()), lists[:1]) if packed else lists
    (path := tmp_path / "a.feather").write_bytes(ipc(column))
    with pytest.raises(BadClip, match="a: holds lists or records"):
        read_feather(path, ("a",), whole=False)

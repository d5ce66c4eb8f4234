"""Exactly once: two-step commits, unique keys, one writer, damage that is found."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from factory.store.location import Location, Shard, write_shard
from factory.store.schema import TableSpec
from factory.store.table import DuplicateKey, KeyedTable

SPEC = TableSpec(
    "things",
    pa.schema([("key", pa.string()), ("round", pa.int32()), ("value", pa.list_(pa.float64(), 2))]),
    "key",
    ("round",),
)


def rows(keys: str, value: float = 0.0, round_: int = 0) -> pa.Table:
    return pa.table(
        {"key": list(keys), "round": [round_] * len(keys), "value": [[value, 1.0]] * len(keys)}, schema=SPEC.schema
    )


def shard(location: Location, keys: str, value: float = 0.0, round_: int = 0) -> Shard:
    return write_shard(location, SPEC, rows(keys, value, round_))


def content(location: Location) -> dict[str, float]:
    table = KeyedTable(location, SPEC).read()
    return {k: v[0] for k, v in zip(table["key"].to_pylist(), table["value"].to_pylist())}


@pytest.fixture
def location(tmp_path: Path) -> Location:
    return Location.parse(tmp_path / "things")


def test_a_file_that_no_commit_names_does_not_exist_for_readers(location: Location) -> None:
    table = KeyedTable(location, SPEC)
    table.commit([shard(location, "ab")])
    shard(location, "cd")
    assert sorted(content(location)) == ["a", "b"]


def test_writing_the_same_rows_twice_makes_one_file(location: Location) -> None:
    assert shard(location, "ab") == shard(location, "ba")
    assert len(list(Path(location.uri).rglob("*.parquet"))) == 1


def test_a_key_is_stored_once_and_a_refused_commit_changes_nothing(location: Location) -> None:
    table = KeyedTable(location, SPEC)
    table.commit([shard(location, "ab")])
    for again in ([shard(location, "bc")], [shard(location, "x"), shard(location, "x", 1.0, round_=1)]):
        with pytest.raises(DuplicateKey):
            table.commit(again)
    assert sorted(content(location)) == ["a", "b"] and table.version == 1


def test_replacing_rows_is_one_transaction_that_keeps_their_neighbours(location: Location) -> None:
    table = KeyedTable(location, SPEC)
    table.commit([shard(location, "abc", 1.0), shard(location, "d", 1.0, round_=1)])
    before = table.version
    table.commit([shard(location, "b", 2.0)], drop=["b", "d", "not there"])
    assert content(location) == {"a": 1.0, "c": 1.0, "b": 2.0}
    assert table.version == (before or 0) + 1
    table.commit([shard(location, "d", 3.0)])
    assert content(location)["d"] == 3.0


def test_a_damaged_file_of_an_object_store_is_named(location: Location) -> None:
    KeyedTable(location, SPEC).commit([shard(location, "a"), shard(location, "b", round_=1)])
    table = KeyedTable(Location(f"file://{location.uri}"), SPEC)
    path = sorted(table.live_files())[1]
    Path(location.uri, path).write_bytes(b"PAR1")
    with pytest.raises(OSError, match=path):
        list(table.files())


@pytest.mark.slow
def test_no_flipped_byte_of_the_data_gives_other_rows(location: Location) -> None:
    """Also where the page would still be decompressed: its checksum tells."""
    table = KeyedTable(location, SPEC)
    table.commit([shard(location, "abcdefgh")])
    (path,) = Path(location.uri).rglob("*.parquet")
    whole, rows = path.read_bytes(), KeyedTable(location, SPEC).read()
    footer = int.from_bytes(whole[-8:-4], "little")
    found = 0
    for at in range(4, len(whole) - footer - 8):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        try:
            assert KeyedTable(location, SPEC).read() == rows, f"byte {at}"
        except OSError:
            found += 1
    assert found > 0


def test_row_groups_stay_below_4_mb(location: Location) -> None:
    spec = TableSpec("big", pa.schema([("key", pa.string()), ("blob", pa.binary())]), "key")
    big = pa.table({"key": list("abcde"), "blob": [bytes([i]) * (3 * 2**19) for i in range(5)]}, schema=spec.schema)
    written = write_shard(location, spec, big)
    metadata = pq.ParquetFile(f"{location.uri}/{written.path}").metadata
    sizes = [metadata.row_group(i).total_byte_size for i in range(metadata.num_row_groups)]
    assert metadata.num_row_groups == 3 and big.slice(0, metadata.row_group(0).num_rows).nbytes <= 4 * 2**20, sizes

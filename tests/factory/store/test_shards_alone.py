"""A shard says of itself which expert and round it holds, and every engine reads a table of such shards as before."""

import shutil
from collections.abc import Callable
from pathlib import Path

import duckdb
import polars as pl
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from deltalake import DeltaTable

from factory.store.location import Shard
from factory.store.samples import Store
from factory.store.verify import verify
from tests.factory.toy import ToyWork, executed, refs

PLACE = ["attempt_id", "expert", "round"]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    executed(ToyWork(), refs(3), ["recovery", "human"], 2, Store(folder))
    return folder


def places(rows: list[dict[str, object]]) -> list[tuple[object, ...]]:
    return sorted(tuple(row[name] for name in PLACE) for row in rows)


@pytest.mark.parametrize(
    "read",
    [
        lambda file: pq.read_table(file).to_pylist(),
        lambda file: pq.ParquetFile(file).read(PLACE).to_pylist(),
        lambda file: duckdb.sql(f"select * from '{file}'").to_arrow_table().to_pylist(),
        lambda file: pl.read_parquet(file).select(PLACE).to_dicts(),
    ],
    ids=["pyarrow", "pyarrow file", "duckdb", "polars"],
)
def test_a_shard_that_was_sent_alone_tells_expert_and_round(
    out: Path, tmp_path: Path, read: Callable[[Path], list[dict[str, object]]]
) -> None:
    for path, partition in Store(out).samples.live_files().items():
        alone = shutil.copy(out / "samples" / path, tmp_path / "alone.parquet")
        assert {(row["expert"], str(row["round"])) for row in read(Path(alone))} == {
            (partition["expert"], partition["round"])
        }


def test_numbers_that_differ_take_no_more_than_their_bytes(out: Path) -> None:
    """A dictionary of coordinates is larger than they are; one of texts that stand again is not."""
    for path in Store(out).samples.live_files():
        group = pq.read_metadata(out / "samples" / path).row_group(0)
        columns = [group.column(k) for k in range(group.num_columns)]
        numbers = {c.has_dictionary_page for c in columns if c.physical_type in ("FLOAT", "DOUBLE")}
        texts = {c.path_in_schema: c.has_dictionary_page for c in columns if c.physical_type == "BYTE_ARRAY"}
        assert numbers == {False} and texts["clip_id"] and texts["expert"]


ENGINES = {
    "delta-rs": lambda uri: DeltaTable(uri).to_pyarrow_table(columns=PLACE).to_pylist(),
    "duckdb on delta-rs": lambda uri: delta_in_duckdb(uri),
    "polars": lambda uri: pl.scan_delta(uri).select(PLACE).collect().to_dicts(),
    "duckdb on files": lambda uri: (
        duckdb.sql(f"select {', '.join(PLACE)} from read_parquet('{uri}/**/*.parquet', hive_partitioning=true)")
        .to_arrow_table()
        .to_pylist()
    ),
    "pyarrow on files": lambda uri: ds.dataset(uri, partitioning="hive").to_table(columns=PLACE).to_pylist(),
}


def delta_in_duckdb(uri: str) -> list[dict[str, object]]:
    samples = DeltaTable(uri).to_pyarrow_dataset()  # found by its name
    assert samples.count_rows()
    found = duckdb.sql(f"select {', '.join(PLACE)} from samples where expert <> 'nobody' and round >= 0")
    table: pa.Table = found.to_arrow_table()
    return table.to_pylist()


@pytest.mark.parametrize("engine", ENGINES)
def test_every_engine_reads_expert_and_round_of_every_row(out: Path, engine: str) -> None:
    ours = Store(out).samples.read(PLACE).to_pylist()
    assert places(ENGINES[engine](str(out / "samples"))) == places(ours) and len(ours) >= 6


def test_a_shard_in_another_s_place_is_damage(out: Path, tmp_path: Path) -> None:
    shutil.copytree(out, tmp_path / "out")
    store = Store(tmp_path / "out")
    (path,) = (path for path, part in store.samples.live_files().items() if part == {"round": "0", "expert": "human"})
    file = tmp_path / "out" / "samples" / path
    keys = tuple(pq.ParquetFile(file).read(["attempt_id"])["attempt_id"].to_pylist())
    moved = f"round=0/expert=recovery/{file.name}"
    file.rename(file.parents[2] / moved)
    shard = Shard(moved, (file.parents[2] / moved).stat().st_size, {"round": "0", "expert": "recovery"}, keys)
    store.samples.replace_files([path], [(shard, 0)])
    assert f"samples/{moved}: expert is human, the log says recovery" in verify(store).damage[0]

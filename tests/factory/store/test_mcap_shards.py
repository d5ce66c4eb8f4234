"""MCAP shards: every bit of a Parquet shard, for this reader and for any other; kept in step by runs, exactly once."""

import io
import struct
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from factory.config.run import load_config
from factory.exits import COMPLETE
from factory.graph import episodes
from factory.graph.execute import Execution, RunSummary, execute
from factory.store.location import Location
from factory.store.mcap_files import McapShard, McapTable, parse, shard_bytes, source_of, varint, write_mcap_shard
from factory.store.reader import SampleTable
from factory.store.samples import Store
from factory.store.schema import BOOKKEEPING
from factory.store.verify import compact, verify
from tests.factory.damage import damaged
from tests.factory.tables import assert_same_rows
from tests.factory.toy import RAGGED, ToyWork, refs, row_of, stream
from tests.planners.samples import grey_pictures, sample, write_table

IDS = {name: value for name, value in sample(0).items() if name in BOOKKEEPING}


def a_shard(folder: Path, n: int = 7, group_rows: int = 3, **columns: Any) -> Path:
    """A Parquet shard of n samples."""
    out = write_table(folder, [sample(i, **grey_pictures(3 * i), **columns) for i in range(n)], group_rows=group_rows)
    ((path, _),) = Store(out).samples.live_files().items()
    return folder / "samples" / path


def both(path: Path) -> tuple[McapShard, pq.ParquetFile]:
    parquet = pq.ParquetFile(path)
    return McapShard(pa.BufferReader(shard_bytes(parquet))), parquet


def test_every_value_of_every_column_comes_back(tmp_path: Path) -> None:
    for number, sizes in enumerate((dict.fromkeys(RAGGED, 0), RAGGED, dict.fromkeys(RAGGED, 1))):
        with patch.dict(RAGGED, sizes):
            rows = [row_of(stream("mcap", i)) | {**IDS, "attempt_id": f"attempt{i}"} for i in range(3)]
        folder = tmp_path / str(number)
        write_table(folder, rows, group_rows=2)
        ((path, _),) = Store(folder).samples.live_files().items()
        mcap, parquet = both(folder / "samples" / path)
        assert mcap.rows.tolist() == [2, 1]
        assert_equal(mcap.read(list(mcap.leaves)), parquet.read())


def assert_equal(a: pa.Table, b: pa.Table) -> None:
    """The names of a list's items aside."""
    assert a.column_names == b.column_names
    for name in a.column_names:
        assert repr(a[name].to_pylist()) == repr(b[name].to_pylist()), name


def test_numbers_keep_their_bits_and_nulls_are_no_zeros(tmp_path: Path) -> None:
    odd = np.frombuffer(struct.pack("<4I", 0x7FC01234, 0x80000000, 0x00000001, 0xFF800000), np.float32)
    boxes = np.zeros((1, 56, 5), np.float32)
    boxes[0, 0, :3] = odd[:3]
    agents = {
        "agent_ids": ["a"],
        "agent_kinds": ["vehicle"],
        "agent_boxes": boxes,
        "agent_velocities": np.zeros((1, 56, 2), np.float32),
        "agent_valid": np.ones((1, 56), bool),
        "agent_heights": np.ones(1, np.float32),
        "agent_center_z": np.zeros((1, 56), np.float32),
    }
    mcap, _ = both(a_shard(tmp_path, 1, stage1_nc=-0.0, stage1_dac=None, label_subscores=None, **agents))
    rows = mcap.read(list(mcap.leaves))
    kept = rows["agent_boxes"].combine_chunks().flatten().flatten().flatten().to_numpy()
    assert kept.tobytes() == boxes.tobytes()
    assert str(rows["stage1_nc"][0]) == "-0.0" and not rows["stage1_dac"][0].is_valid
    assert not rows["label_subscores"][0].is_valid and rows["proposal_10hz"][0].is_valid is not None


def test_a_column_reads_its_own_chunks_and_no_others(tmp_path: Path) -> None:
    path = a_shard(tmp_path)
    data = shard_bytes(pq.ParquetFile(path))
    shard = McapShard(pa.BufferReader(data))
    chunk = shard.index.chunks[1, "/agents"]
    spoilt = bytearray(data)
    at = chunk.chunk_start_offset + chunk.chunk_length // 2
    spoilt[at] ^= 1
    other = McapShard(pa.BufferReader(bytes(spoilt)))
    leaves = [leaf for leaf in shard.leaves if not leaf.startswith("agent_")]
    assert other.read_row_group(1, leaves).equals(shard.read_row_group(1, leaves))
    with pytest.raises(ValueError, match="row group 1"):
        other.read_row_group(1, list(shard.leaves))


def test_any_other_reader_finds_typed_messages_by_topic_time_and_place(tmp_path: Path) -> None:
    path = a_shard(tmp_path)
    rows, data = pq.read_table(path, partitioning=None).to_pylist(), shard_bytes(pq.ParquetFile(path))
    reader = make_reader(io.BytesIO(data), validate_crcs=True, decoder_factories=[DecoderFactory()])
    summary = reader.get_summary()
    assert summary is not None and all(schema.encoding == "protobuf" for schema in summary.schemas.values())
    assert all(FileDescriptorSet.FromString(schema.data).file for schema in summary.schemas.values())
    assert all(channel.schema_id for channel in summary.channels.values())
    assert all(chunk.compression == "zstd" and chunk.message_index_offsets for chunk in summary.chunk_indexes)
    seen: dict[str, int] = {}
    for _, channel, message, content in reader.iter_decoded_messages():
        row = rows[message.sequence]
        seen[channel.topic] = seen.get(channel.topic, 0) + 1
        if channel.topic.startswith("/camera/"):
            assert content.data in [image["jpeg"] for image in row["images"]]
            assert content.format == "jpeg" and content.timestamp.ToNanoseconds() == message.log_time
        elif channel.topic == "/sample":
            assert content.attempt_id == row["attempt_id"] and content.command == row["command"]
            assert message.log_time == (10 * message.sequence + 2) * 10**9
        elif channel.topic == "/scores":
            assert content.stage2_score == row["stage2_score"]
            assert content.HasField("stage1_nc") == (row["stage1_nc"] is not None)
        elif channel.topic == "/agents":
            flat = np.array(row["agent_boxes"], np.float32).ravel()
            assert np.array_equal(np.array(content.agent_boxes, np.float32), flat, equal_nan=True)
            assert list(content.agent_valid) == np.array(row["agent_valid"]).ravel().tolist()
        elif channel.topic == "/map":
            assert list(content.lane_polygons_sizes) == [len(ring) for ring in row["lane_polygons"]]
            assert list(content.light_states) == np.array(row["light_states"]).ravel().tolist()
        elif channel.topic == "/cameras":
            assert [camera.name for camera in content.cameras] == [camera["name"] for camera in row["cameras"]]
            assert list(content.cameras[0].ego_from_camera) == row["cameras"][0]["ego_from_camera"]
    assert {topic: n for topic, n in seen.items() if not topic.startswith("/camera/")} == dict.fromkeys(
        ("/agents", "/cameras", "/ego", "/images", "/labels", "/map", "/sample", "/scores"), len(rows)
    )
    assert seen["/camera/front/image"] == 2 * len(rows)
    within = reader.iter_decoded_messages(starting_at=3 * 10**10, ending_before=4 * 10**10)
    assert {message.sequence for _, _, message, _ in within} == {3}


def test_what_is_no_message_is_refused() -> None:
    assert varint(300) == b"\xac\x02"
    for bad in (b"\x0a\x05ab", b"\x80", b"\xff" * 11, b"\x0b", b"\x09123"):
        with pytest.raises(ValueError, match=r"field|number"):
            parse(bad)


def test_a_damaged_shard_is_refused_or_read_as_it_was(tmp_path: Path) -> None:
    path = a_shard(tmp_path, 3)
    whole = shard_bytes(pq.ParquetFile(path))
    leaves, refused = list(both(path)[0].leaves), 0
    expected = repr(McapShard(pa.BufferReader(whole)).read(leaves).to_pylist())
    for content in damaged(whole, every=len(whole) // 60):
        try:
            assert repr(McapShard(pa.BufferReader(content)).read(leaves).to_pylist()) == expected
        except ValueError:
            refused += 1
    assert refused > 40


def run(out: Path, shards: bool = True, **options: Any) -> RunSummary:
    work = options.pop("work", ToyWork())
    options = {"rounds": 2, "shard_seconds": 0.0, **options}
    rounds = options.pop("rounds")
    how = Execution("local", mcap_shards=shards, **options)
    return execute(work, refs(3), ["recovery", "human"], rounds, Store(out), how, say=str)


def assert_rows_in_step(out: Path) -> None:
    """The MCAP shards are those of the samples, one for each, and hold the same rows."""
    table, store = McapTable(Location.parse(out)), Store(out)
    assert sorted(map(source_of, table.live_files())) == sorted(store.samples.live_files())
    assert_same_rows(table.read().sort_by("attempt_id"), store.samples.read().sort_by("attempt_id"))
    assert verify(store).damage == ()


def assert_in_step(out: Path) -> None:
    """And nothing lies beside them."""
    assert_rows_in_step(out)
    assert verify(Store(out)).orphans == ()
    parquet, mcap = SampleTable(out), SampleTable(out, format="mcap")
    assert mcap.attempt_ids == parquet.attempt_ids
    assert repr(mcap[len(mcap) - 1]) == repr(parquet[len(parquet) - 1])
    assert [str(row) for row in mcap.iterate(["attempt_id", "label_2hz"])] == [
        str(row) for row in parquet.iterate(["attempt_id", "label_2hz"])
    ]


def test_a_run_writes_them_once_and_its_next_rounds_are_added(tmp_path: Path) -> None:
    first = run(tmp_path, rounds=1)
    assert first.exit_code == COMPLETE
    assert_in_step(tmp_path)
    before = set(McapTable(Location.parse(tmp_path)).live_files())
    assert run(tmp_path, rounds=1).executed.episodes == 0
    more = run(tmp_path, rounds=2)
    assert_in_step(tmp_path)
    after = set(McapTable(Location.parse(tmp_path)).live_files())
    assert before < after and more.executed.episodes == len(after) - len(before)


def test_they_may_be_asked_for_later_and_follow_what_is_replaced(tmp_path: Path) -> None:
    run(tmp_path, shards=False)
    with pytest.raises(FileNotFoundError, match="samples_mcap"):
        SampleTable(tmp_path, format="mcap")
    assert run(tmp_path).executed.attempts == 0
    assert_in_step(tmp_path)
    other = ToyWork(digests={"recovery": "recovery-2"})
    run(tmp_path, shards=False, work=other, on_change="redo")
    with pytest.raises(ValueError, match=r"store\.episodes=all"):
        SampleTable(tmp_path, format="mcap")
    run(tmp_path, work=other)
    live = McapTable(Location.parse(tmp_path)).live_files()
    assert sorted(map(source_of, live)) == sorted(Store(tmp_path).samples.live_files())


def test_compacting_brings_them_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for rounds in (1, 2):
        run(tmp_path, rounds=rounds)
    run(tmp_path, shards=False, rounds=3)  # whose samples have none yet
    table, before = McapTable(Location.parse(tmp_path)), SampleTable(tmp_path)
    rows, opened = list(map(str, before)), set(table.live_files())
    assert [found.after for found in compact(Store(tmp_path)) if found.table == "samples_mcap"] == [
        len(Store(tmp_path).samples.live_files())
    ]
    table.refresh()
    assert not opened & set(table.live_files()), "every shard was merged with another"
    assert_rows_in_step(tmp_path)
    assert sorted(map(str, SampleTable(tmp_path, format="mcap"))) == sorted(rows)
    version = McapTable(Location.parse(tmp_path)).version
    assert all(found.before == found.after for found in compact(Store(tmp_path)))
    assert McapTable(Location.parse(tmp_path)).version == version, "there was nothing to do"
    assert run(tmp_path, rounds=3).executed.episodes == 0


def test_a_compaction_killed_between_the_two_tables_is_made_good_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    def die(*arguments: Any) -> None:
        raise Killed

    for rounds in (1, 2):
        run(tmp_path, rounds=rounds)
    with monkeypatch.context() as patched:
        patched.setattr(McapTable, "keep_up", die)
        with pytest.raises(Killed):
            list(compact(Store(tmp_path)))
    with pytest.raises(ValueError, match="lacks"):
        SampleTable(tmp_path, format="mcap")
    list(compact(Store(tmp_path)))
    assert_rows_in_step(tmp_path)


def test_a_run_killed_between_the_two_tables_ends_in_the_same_shards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    def die(self: episodes.McapShards, ticket: Any, report: Any) -> bool:
        if ticket in self._writing:  # the file is there, and no log names it
            raise Killed
        return False

    with monkeypatch.context() as patched:
        patched.setattr(episodes.McapShards, "finished", die)
        with pytest.raises(Killed):
            run(tmp_path / "killed")
    assert len(Store(tmp_path / "killed").samples) > 0
    assert len(McapTable(Location.parse(tmp_path / "killed"))) == 0
    assert run(tmp_path / "killed").exit_code == COMPLETE
    assert_in_step(tmp_path / "killed")


def test_the_same_shard_is_the_same_file(tmp_path: Path) -> None:
    run(tmp_path, shards=False)
    out = Location.parse(tmp_path)
    for path, partition in Store(tmp_path).samples.live_files().items():
        assert write_mcap_shard(out, path, partition) == write_mcap_shard(out, path, partition)
    names = out.child("samples_mcap").names()
    assert len(names) == len(Store(tmp_path).samples.live_files())


def test_verify_names_a_damaged_shard_and_its_repair_has_it_made_again(tmp_path: Path) -> None:
    from factory.store.verify import drop_damaged

    run(tmp_path)
    path = min(McapTable(Location.parse(tmp_path)).live_files())
    file = tmp_path / "samples_mcap" / path
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(data)
    verdict = verify(Store(tmp_path))
    assert verdict.files == (f"samples_mcap/{path}",) and path in verdict.damage[0]
    drop_damaged(Store(tmp_path), verdict)
    assert verify(Store(tmp_path)).damage == ()
    assert run(tmp_path).executed.episodes == 1
    assert_in_step(tmp_path)


def test_the_setting_of_the_form() -> None:
    assert load_config([]).store.episodes == "none" and load_config(["store.episodes=all"]).store.episodes == "all"
    with pytest.raises(ValueError, match="episodes"):
        load_config(["store.episodes=20"])

"""Prepared clips on disk: exact, and no way for a file to run code."""

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from factory.store.location import FORMAT, BadCacheFile, ClipCache, Location, decode_tree, encode_tree
from factory.store.samples import CandidateRow
from tasks.stages import Rejected
from tasks.world.clip import AgentKind, AgentTracks


def forged(tree: object) -> bytes:
    text = json.dumps({"sizes": {}, "tuples": [], "root": tree}).encode()
    plain = FORMAT.to_bytes(8, "little") + len(text).to_bytes(8, "little") + text
    return len(plain).to_bytes(8, "little") + pa.compress(plain, codec="zstd", asbytes=True)


def tracks() -> AgentTracks:
    rng = np.random.default_rng(0)
    return AgentTracks(
        ("1", "2"),
        (AgentKind.VEHICLE, AgentKind.PEDESTRIAN),
        rng.random((4, 2, 5)),
        rng.random((4, 2, 2)),
        np.array([[True, False]] * 4),
        rng.random((4, 2)),
        np.array([1.5, 1.8]),
    )


def test_a_tree_of_dataclasses_comes_back_exactly() -> None:
    value = {"tracks": tracks(), "lanes": frozenset({"a", "b"}), "pair": (np.float64(0.1), None), 3: [True, "x"]}
    back = decode_tree(encode_tree(value))
    assert list(back) == list(value) and back["lanes"] == value["lanes"] and back["pair"] == value["pair"]
    assert back["tracks"].kinds == tracks().kinds and isinstance(back["tracks"].kinds[0], AgentKind)
    for name in ("boxes", "velocities", "valid", "center_z", "heights"):
        assert np.array_equal(getattr(back["tracks"], name), getattr(tracks(), name))
        assert getattr(back["tracks"], name).dtype == getattr(tracks(), name).dtype


def test_an_array_or_tuple_that_stands_twice_is_stored_once() -> None:
    big = np.random.default_rng(0).random(10_000)
    assert len(encode_tree((big, big, {"again": big}))) < 1.1 * len(encode_tree((big,)))
    names = tuple(map(str, big))
    first, again = decode_tree(encode_tree([names, {"again": names}]))
    assert first == names and again["again"] is first


def test_a_part_of_a_tree_is_read_without_the_rest() -> None:
    row, strange = CandidateRow(0, 1, 0.5, 0.0, 0.0, 0.0, (0, 1), 1.0, 1.0), {"class": "this:Poem", "members": {}}
    members = {"file": {"class": "tests:none", "members": {"end_x": 0.5}}, "problem": strange}
    assert decode_tree(encode_tree(row), ["end_x"]) == 0.5 and decode_tree(encode_tree(row), ["cell"]) == (0, 1)
    assert decode_tree(forged({"class": "this:Poem", "members": members}), ["file", "end_x"]) == 0.5
    for none in (["nothing"], ["end_x", "more"], ["cell", "0"]):
        assert decode_tree(encode_tree(row), none) is None


def test_a_file_of_another_version_is_refused_by_its_number() -> None:
    size, packed = encode_tree(1)[:8], encode_tree(1)[8:]
    plain = pa.decompress(packed, decompressed_size=int.from_bytes(size, "little"), codec="zstd")
    older = (FORMAT - 1).to_bytes(8, "little") + bytes(plain)[8:]
    with pytest.raises(BadCacheFile, match=f"this version reads {FORMAT}"):
        decode_tree(size + pa.compress(older, codec="zstd", asbytes=True))


def test_a_tuple_that_holds_itself_is_refused() -> None:
    plain = json.dumps({"sizes": {}, "tuples": [[{"tuple": 0}]], "root": {"tuple": 0}}).encode()
    plain = FORMAT.to_bytes(8, "little") + len(plain).to_bytes(8, "little") + plain
    with pytest.raises(BadCacheFile, match="recursion"):
        decode_tree(len(plain).to_bytes(8, "little") + pa.compress(plain, codec="zstd", asbytes=True))


@pytest.mark.parametrize(
    "name",
    [
        "os:system",
        "subprocess:Popen",
        "factory.store.location:io.BytesIO",
        "factory.graph.steps:warm",
        "tasks.stages:nothing",
    ],
)
def test_a_file_cannot_name_what_is_not_a_dataclass_of_ours(name: str) -> None:
    with pytest.raises(BadCacheFile):
        decode_tree(forged({"class": name, "members": {}}))


def test_a_file_makes_nobody_import_a_module_of_others() -> None:
    """An import runs code: `this` prints a poem, others may do worse."""
    with pytest.raises(BadCacheFile, match="not a class a cache file may name"):
        decode_tree(forged({"class": "this:Poem", "members": {}}))
    assert "this" not in sys.modules


@pytest.mark.parametrize("size", [2**63, 2**30 + 1, 2**29, 0])
def test_a_file_that_says_another_size_than_it_has_is_refused_unread(size: int) -> None:
    """2 MB of zeros in a few bytes: nothing is made of them before their size is known."""
    packed = pa.compress(bytes(2**21), codec="zstd", asbytes=True)
    with pytest.raises(BadCacheFile):
        decode_tree(size.to_bytes(8, "little") + packed)


def test_what_cannot_be_stored_is_refused_when_written() -> None:
    with pytest.raises(TypeError, match="cannot be cached"):
        encode_tree({"f": open})
    with pytest.raises(TypeError, match="objects"):
        encode_tree(np.array([object()]))


def test_damage_is_found_and_absence_is_none(tmp_path: Path) -> None:
    cache = ClipCache(Location.parse(tmp_path))
    assert cache.load("x") is None
    cache.store("x", (Rejected("clip", "ego_standing"), CandidateRow(0, 1, 0.0, 0.0, 0.0, 0.0, (0, 1), 1.0, 1.0)))
    assert cache.load("x") == (
        Rejected("clip", "ego_standing"),
        CandidateRow(0, 1, 0.0, 0.0, 0.0, 0.0, (0, 1), 1.0, 1.0),
    )
    path = tmp_path / "x.clip"
    for damage in (path.read_bytes()[:-100], b"", b"PK"):
        path.write_bytes(damage)
        with pytest.raises(BadCacheFile):
            cache.load("x")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.clip"]  # no drafts left


# Listing a folder in which other processes make and remove folders.


def test_a_folder_that_vanishes_while_it_is_listed_has_no_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("kept", "going"):
        (tmp_path / name).mkdir()
    (tmp_path / "kept" / "file").write_text("here")
    out, scandir = Location.parse(tmp_path), os.scandir

    def gone_once_named(folder: Path) -> Iterator[os.DirEntry[str]]:
        entries = list(scandir(folder))
        if folder == tmp_path:
            (tmp_path / "going").rmdir()
        return iter(entries)

    monkeypatch.setattr(os, "scandir", gone_once_named)
    assert out.names() == ["kept/file"]
    (tmp_path / "going").mkdir()
    assert list(out.ages_s(0.0)) == ["kept/file"]


def test_a_folder_that_is_not_there_has_no_files(tmp_path: Path) -> None:
    assert Location.parse(tmp_path / "nowhere").names() == []

"""A cache is a cache: wherever a file in it is damaged, it is made again, the same, and one line says so."""

import logging
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from factory.datasets.navsim.maps import cached_tables, cached_tables_path
from factory.datasets.navsim.reader import cached_table, read_and_cache_table
from factory.datasets.town.reader import SyntheticReader, SyntheticTownsReader, TownLogReader
from factory.datasets.town.settings import TownSettings
from factory.datasets.town.town import SUMS
from factory.graph.steps import PrepareReport, cache_key, prepare
from factory.setup.settings import _recovery_table
from factory.setup.vocabulary import load_recovery_table, save_recovery_table, save_vocabulary
from factory.stages.assets import RIG_SUFFIX, _resumed, _write_rig_file, damaged_blocks, read_rig_file
from factory.stages.entries import tiny_clip
from factory.stages.scene_file import BadScene, read_scene, write_scene
from factory.stages.warm import _is_compiled, part_marker
from factory.store.location import BadCacheFile, Location, SceneFiles, encode_tree
from tasks.caches import (
    SEAL_BYTES,
    Damaged,
    append_checksum,
    json_with_checksum,
    parse_json_with_checksum,
    with_checksum,
)
from tasks.experts.recovery import RecoveryTable
from tasks.hard_scenes import OneStageClip
from tasks.kernels.compiled import kernel
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories
from tests.factory.damage import damaged
from tests.factory.datasets.navsim.geopackage_writer import stub_rows, write_root
from tests.factory.datasets.navsim.logs import NAME, frame
from tests.factory.datasets.navsim.openscene_writer import write_frames
from tests.factory.stages.test_scene_file import scene
from tests.factory.toy import ToyWork, refs

Lines = Callable[[], list[str]]


@pytest.fixture
def lines(caplog: pytest.LogCaptureFixture) -> Lines:
    """What was logged since it was last asked."""

    def taken() -> list[str]:
        messages = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
        caplog.clear()
        return messages

    return taken


def test_a_prepared_clip(tmp_path: Path) -> None:
    (ref,), work, out = refs(1), ToyWork(), Location(str(tmp_path))
    golden = encode_tree(prepare(work, out, ref)[1])
    key = cache_key(ref.clip_id, work.identity.prepare_digest)
    path = tmp_path / "cache" / "prepared" / f"{key}.clip"
    whole = path.read_bytes()
    for content in [*damaged(whole), whole[:-SEAL_BYTES]]:
        path.write_bytes(content)
        report, clip = prepare(work, out, ref)
        assert isinstance(report, PrepareReport) and not report.from_cache
        assert report.note.startswith(f"cache file {key}: it") and report.note.endswith("; prepared again")
        assert encode_tree(clip) == golden and path.read_bytes() == whole
    report, _ = prepare(work, out, ref)
    assert isinstance(report, PrepareReport) and report.from_cache and not report.note


def test_a_clip_s_scenes_are_named(tmp_path: Path) -> None:
    files, path = SceneFiles(Location(str(tmp_path))), tmp_path / "warm.clip"
    files.store(OneStageClip(tiny_clip()))
    whole = path.read_bytes()
    for content in [*damaged(whole), whole[:-SEAL_BYTES]]:
        path.write_bytes(content)
        with pytest.raises(BadCacheFile, match=f"{path}: "):
            files.load("warm")


@pytest.mark.slow
def test_a_city_s_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: Lines) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_root(tmp_path, "us-ma-boston", stub_rows())
    map_file = next(tmp_path.glob("us-ma-boston/*/map.gpkg"))
    cached_tables(map_file)
    path = cached_tables_path(map_file)
    whole = path.read_bytes()
    for content in damaged(whole, every=len(whole) // 6):
        path.write_bytes(content)
        cached_tables(map_file)
        (line,) = lines()
        assert line.startswith(f"{path}: damaged") and path.read_bytes() == whole


def test_the_table_of_a_log(tmp_path: Path, lines: Lines) -> None:
    log = write_frames(tmp_path, "mini", NAME, [frame(k) for k in range(3)])
    read_and_cache_table(log, tmp_path / "kept")
    (path,) = (tmp_path / "kept").iterdir()
    whole = path.read_bytes()
    for content in damaged(whole):
        path.write_bytes(content)
        assert cached_table(log, tmp_path / "kept") is None
        (line,) = lines()
        assert line.startswith(f"{path}: it") and line.endswith(f"made again of {log}")
    read_and_cache_table(log, tmp_path / "kept")
    assert path.read_bytes() == whole


def test_a_fit_that_is_half_done(tmp_path: Path, lines: Lines) -> None:
    path, start = tmp_path / "block-1.fit.npz", SimpleNamespace()
    with path.open("wb") as file:
        np.savez(file, iteration=np.array(500), owner=np.arange(20))
    append_checksum(path, path.name)
    for content in damaged(path.read_bytes()):
        path.write_bytes(content)
        assert _resumed(path, start) is start  # type: ignore[comparison-overlap, arg-type]
        (line,) = lines()
        assert line.startswith(f"{path} is damaged")


@pytest.mark.slow
def test_a_recovery_table_is_made_again_in_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: Lines
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    reader = SyntheticReader(tmp_path / "towns", 1, 0, TownSettings(cameras=(), lidar_beams=0))
    save_vocabulary(tmp_path / "v.npy", Vocabulary(kinematic_trajectories(20, 0)), {})
    run = SimpleNamespace(
        clips=lambda: (reader, reader.index()),
        config=SimpleNamespace(vocabulary=SimpleNamespace(file=None), clips={"root": "town"}, repairs="make"),
    )
    golden = _recovery_table(run, [str(tmp_path / "v.npy")]).digest  # type: ignore[arg-type]
    (path,) = (tmp_path / "cache").rglob("recovery-*.npz")
    whole = path.read_bytes()
    save_recovery_table(tmp_path / "x.clip", RecoveryTable(np.zeros((3, 40, 3))), {}, "recovery-0.npz")
    another = (tmp_path / "x.clip").read_bytes()
    for content in (whole[:9000] + bytes([whole[9000] ^ 1]) + whole[9001:], whole[:100], b"", another):
        path.write_bytes(content)
        assert _recovery_table(run, [str(tmp_path / "v.npy")]).digest == golden  # type: ignore[arg-type]
        (line,) = lines()
        assert line.startswith(f"{path}: ") and line.endswith("it is made again")
        assert load_recovery_table(path).digest == golden


def test_a_recovery_table_is_read_right_or_named(tmp_path: Path) -> None:
    table, path = RecoveryTable(np.random.default_rng(0).normal(size=(3, 40, 3))), tmp_path / "table.npz"
    save_recovery_table(path, table, {})
    for content in damaged(path.read_bytes(), every=7):
        path.write_bytes(content)
        try:
            assert load_recovery_table(path).trajectories.tobytes() == table.trajectories.tobytes()
        except ValueError as error:
            assert str(error).startswith(f"{path}: ")


def test_compiled_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: Lines) -> None:
    def total(values: np.ndarray) -> float:
        out = 0.0
        for value in values:
            out += value * value
        return out

    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    values = np.random.default_rng(0).normal(size=101)
    golden = kernel(total)(values)
    (path,) = tmp_path.rglob("*.kernel")
    whole = path.read_bytes()
    for content in damaged(whole, every=len(whole) // 3):
        path.write_bytes(content)
        assert kernel(total)(values) == golden
        (line,) = lines()
        assert line.startswith(f"{path}: it") and line.endswith("; compiled again")
        again = kernel(total)
        assert again(values) == golden and sum(again.stats.cache_hits.values()) == 1  # type: ignore[attr-defined]


def test_the_list_of_a_part_s_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: Lines) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    path = part_marker("judge")
    path.parent.mkdir()
    (path.parent / "a.kernel").touch()
    path.write_bytes(with_checksum(b"a.kernel", path.name))
    assert _is_compiled("judge")
    for content in damaged(with_checksum(b"a.kernel", path.name), every=1):
        path.write_bytes(content)
        assert not _is_compiled("judge")
        (line,) = lines()
        assert line.startswith(f"{path}: it")


Kept = tuple[list[Path], Callable[[int], object]]  # two files of a cache, and what is loaded by the key of each


def prepared_clips(folder: Path) -> Kept:
    work, out, both = ToyWork(), Location(str(folder)), refs(2)
    keys = [cache_key(ref.clip_id, work.identity.prepare_digest) for ref in both]
    return [folder / f"cache/prepared/{key}.clip" for key in keys], lambda i: encode_tree(
        prepare(work, out, both[i])[1]
    )


def city_tables(folder: Path) -> Kept:
    write_root(folder, "us-ma-boston", stub_rows(scale=2.0))
    maps = [next(folder.glob(f"{city}/*/map.gpkg")) for city in ("us-ma-boston", "sg-one-north")]
    return [cached_tables_path(path) for path in maps], lambda i: cached_tables(maps[i])["lanes_polygons"].xy.tobytes()


def log_tables(folder: Path) -> Kept:
    logs = [write_frames(folder, split, NAME, [frame(k) for k in range(n)]) for split, n in (("mini", 3), ("test", 4))]
    load = lambda i: len(cached_table(logs[i], folder / "kept") or read_and_cache_table(logs[i], folder / "kept"))  # noqa: E731
    found = []
    for i in range(2):
        load(i)
        found += [path for path in (folder / "kept").iterdir() if path not in found]
    return found, load


def kernels(folder: Path) -> Kept:
    def twice(value: float) -> float:
        return 2.0 * value

    def thrice(value: float) -> float:
        return 3.0 * value

    both, found = (twice, thrice), list[Path]()
    for function in both:
        kernel(function)(1.0)
        found += [path for path in folder.rglob("*.kernel") if path not in found]
    return found, lambda i: kernel(both[i])(1.0)


@pytest.mark.parametrize("kind", [prepared_clips, city_tables, log_tables, kernels])
def test_a_whole_file_under_another_s_name_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: Lines, kind: Callable[[Path], Kept]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    paths, load = kind(tmp_path)
    golden = [load(0), load(1)]
    whole = [path.read_bytes() for path in paths]
    assert golden[0] != golden[1] and whole[0] != whole[1] and not lines()
    for i, path in enumerate(paths):
        path.write_bytes(whole[1 - i])
    assert [load(0), load(1)] == golden
    if kind is not prepared_clips:  # which notes it in its report
        assert [line.partition(": ")[0] for line in lines()] == list(map(str, paths))
    assert kind is kernels or [path.read_bytes() for path in paths] == whole  # machine code differs by a counter
    assert [load(0), load(1)] == golden and not lines()


def test_what_is_half_done_and_a_list_of_kernels_are_not_another_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: Lines
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    start, fit = SimpleNamespace(), tmp_path / "block-1.fit.npz"
    with fit.open("wb") as file:
        np.savez(file, iteration=np.array(500), owner=np.arange(20))
    append_checksum(fit, fit.name)
    assert _resumed(fit.rename(tmp_path / "block-2.fit.npz"), start) is start  # type: ignore[comparison-overlap, arg-type]
    part_marker("judge").parent.mkdir()
    part_marker("judge").write_bytes(with_checksum(b"", part_marker("judge").name))
    assert _is_compiled("judge")
    part_marker("judge").rename(part_marker("fit"))
    assert not _is_compiled("fit")
    assert [line.endswith(("begins again", "made again")) for line in lines()] == [True, True]


def test_scenes_of_another_clip_are_refused_by_name(tmp_path: Path) -> None:
    files = SceneFiles(Location(str(tmp_path)))
    files.store(OneStageClip(tiny_clip()))
    (tmp_path / "warm.clip").rename(tmp_path / "cold.clip")
    with pytest.raises(BadCacheFile, match=rf"{tmp_path}/cold\.clip holds clip warm; remove it"):
        files.load("cold")


def test_a_kept_block_under_another_s_name_is_refused(tmp_path: Path) -> None:
    """By whoever renders from it and by verify; scenes have no names where a user keeps them."""
    for name in ("1", "2"):
        path = tmp_path / f"cache/block-{name}.safetensors"
        write_scene(path, scene())
        _write_rig_file(path, {"used": [], "taken": []})
    assert not damaged_blocks(Location(str(tmp_path)))
    for suffix in (".safetensors", RIG_SUFFIX):
        (tmp_path / f"cache/block-1{suffix}").rename(tmp_path / f"cache/block-2{suffix}")
    other = tmp_path / "cache/block-2.safetensors"
    with pytest.raises(BadScene, match=f"{other}: it is of another block, written as block-1"):
        read_scene(other, other.stem)
    assert read_scene(other).digest
    with pytest.raises(Damaged, match="of another block"):
        read_rig_file(other.with_suffix(RIG_SUFFIX))
    assert damaged_blocks(Location(str(tmp_path))).keys() == {f"cache/block-2{s}" for s in (".safetensors", RIG_SUFFIX)}


def test_damage_is_damage() -> None:
    """No copy that the others try is the file itself."""
    whole = bytes(range(256)) * 3
    assert whole not in damaged(whole) and len(list(damaged(whole))) == 24


@pytest.mark.slow
@pytest.mark.parametrize("several", [False, True])
def test_a_town(tmp_path: Path, lines: Lines, several: bool) -> None:
    """Tables and maps alike; whoever indexes it mends it, and clips are what they were."""
    settings = TownSettings(cameras=(), lidar_beams=0)
    if several:
        reader: TownLogReader = SyntheticTownsReader([3], logs_per_town=1, cache_dir=tmp_path, settings=settings)
    else:
        reader = SyntheticReader(tmp_path, 1, 0, settings)
    ref = reader.index().refs[0]
    golden = reader.digest(ref)
    (root,) = tmp_path.iterdir()
    whole = {path: path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}
    assert {path.name for path in whole} >= {"annotations.feather", SUMS}
    at = root / next(path for path in whole if path.name == "annotations.feather")
    at.write_bytes(whole[at][:-1] + b"-")
    assert reader.digest(ref) != golden
    changes: list[tuple[Path, bytes | None]] = [(at, whole[at][:-1] + b"-"), (root / SUMS, b"{}")]
    for path, change in changes if several else [*changes, (at, None), (root / SUMS, None)]:
        if change is None:
            path.unlink()
        else:
            path.write_bytes(change)
        assert reader.index().refs[0] == ref
        (line,) = lines()
        assert line.startswith(f"{root} is damaged (") and path.name in line
        assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == whole
    assert reader.digest(ref) == golden
    assert reader.index().refs and not lines()
    assert list(tmp_path.iterdir()) == [root]
    # Another town's folder under this one's name.
    told = parse_json_with_checksum(whole[root / SUMS])
    (root / SUMS).write_text(json_with_checksum(told | {"folder": "town-4"}))
    (root / "another_log").mkdir()
    (root / "another_log/map.json").write_text("{}")
    assert reader.index().refs[0] == ref
    (line,) = lines()
    assert line.startswith(f"{root} is damaged ({SUMS} is of town-4)")
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == whole
    assert not (root / "another_log").exists()

"""Several towns as one data set: split by seed, each town written once, whole, and by itself."""

from pathlib import Path

import pytest

from factory.datasets.town.drive import SCENARIOS
from factory.datasets.town.reader import SyntheticTownsReader
from factory.datasets.town.settings import LOGS_PER_TOWN, TownSettings
from factory.readers.base import BadClip, ClipRef

BLIND = TownSettings(cameras=(), lidar_beams=0)


def reader_of(folder: Path, seeds: list[int], n_logs: int = 1, **rest: object) -> SyntheticTownsReader:
    return SyntheticTownsReader(seeds, logs_per_town=n_logs, cache_dir=folder, settings=BLIND, **rest)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("towns")


@pytest.fixture(scope="module")
def reader(folder: Path) -> SyntheticTownsReader:
    return reader_of(folder, [18, 9], split="test")


@pytest.mark.slow
def test_every_clip_carries_the_split_and_names_its_town(reader: SyntheticTownsReader) -> None:
    refs = reader.index().refs
    assert len(refs) == 2 * 3
    assert len({ref.clip_id for ref in refs}) == len(refs)
    assert {ref.log_id.split("-")[1] for ref in refs[:3]} == {"18"}
    assert {ref.log_id.split("-")[1] for ref in refs[3:]} == {"9"}
    clip = reader.read(refs[-1])
    assert (clip.dataset, clip.split, clip.log_id) == ("synthetic", "test", refs[-1].log_id)
    assert clip.content_digest == reader.digest(refs[-1])


def test_nine_towns_of_two_logs_have_every_kind_of_drive_once(folder: Path) -> None:
    indices = [i for town in reader_of(folder, list(range(9)), 2).towns for i in town.indices]
    assert sorted(indices) == list(range(LOGS_PER_TOWN)) and len(SCENARIOS) == LOGS_PER_TOWN


def test_others_of_the_same_towns_are_those_behind_the_first(folder: Path) -> None:
    first, second = (reader_of(folder, [4, 5], 3, first_log=n).towns for n in (0, 3))
    for one, other in zip(first, second):
        assert one.seed == other.seed
        assert not set(one.indices) & set(other.indices)
        assert other.indices == tuple((one.indices[-1] + 1 + i) % LOGS_PER_TOWN for i in range(3))
        assert one.root != other.root
    assert first == reader_of(folder, [4, 5], 3).towns
    with pytest.raises(ValueError, match="first_log=16"):
        reader_of(folder, [4], 3, first_log=16)


@pytest.mark.slow
def test_a_town_is_written_once_and_only_where_it_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = reader_of(tmp_path, [0, 1])
    first = next(iter(made.towns[1].logs()))
    made.read(ClipRef("synthetic", first, 0))
    assert [town.root.is_dir() for town in made.towns] == [False, True]
    made.index()
    assert [town.root.is_dir() for town in made.towns] == [True, True]
    assert "town 1 of 1: seed 0, 1 logs painted" in capsys.readouterr().err


def test_first_window_skips_the_start_of_every_log(reader: SyntheticTownsReader, folder: Path) -> None:
    later = reader_of(folder, [18, 9], split="test", first_window=1).index().refs
    assert later == tuple(ref for ref in reader.index().refs if ref.start_ms >= 1000)
    none_left = reader_of(folder, [18], first_window=3).index()
    assert not none_left.refs
    assert "a clip needs 12.6 s" in next(iter(none_left.skipped_logs.values()))


def test_wrong_wishes_are_refused_by_name(reader: SyntheticTownsReader) -> None:
    with pytest.raises(ValueError, match=r"clips\.seeds"):
        SyntheticTownsReader([1, 1])
    with pytest.raises(ValueError, match=r"clips\.split=held_out"):
        SyntheticTownsReader([1], split="held_out")
    with pytest.raises(ValueError, match=r"clips\.logs_per_town=19"):
        SyntheticTownsReader([1], logs_per_town=19)
    with pytest.raises(ValueError, match="first_window"):
        SyntheticTownsReader([1], first_window=-1)
    with pytest.raises(BadClip, match="no log elsewhere"):
        reader.read(ClipRef("synthetic", "elsewhere", 0))

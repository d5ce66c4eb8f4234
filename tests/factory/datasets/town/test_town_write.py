"""The town on disk: Argoverse 2's layout, the same bytes for the same seed, whole or not there."""

import hashlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow.feather
import pytest

import factory.datasets.town.reader as reader_module
from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import LOG_STEPS, STEPS_PER_SWEEP, TownSettings
from factory.datasets.town.town import LICENCE, WINDOWS_PER_LOG, write_town
from tasks.world.clip import Clip
from tasks.world.road_map import LightState

HISTORY_S = 1.5
SMALL = TownSettings(("ring_front_center", "ring_rear_left"), width=64, height=36, lidar_beams=8, lidar_azimuths=90)


def digests(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> SyntheticReader:
    """Two logs; the second is not used to its end."""
    reader = SyntheticReader(tmp_path_factory.mktemp("towns"), WINDOWS_PER_LOG + 1, 0, SMALL)
    reader.index()
    return reader


@pytest.fixture
def town(reader: SyntheticReader) -> Path:
    return reader.root


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_with_any_number_of_threads(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_town(tmp_path, 1, 0, SMALL, threads=1)
    assert "town 0: 100 % painted" in capsys.readouterr().err
    shorter, longer = digests(tmp_path), digests(town)
    assert shorter
    assert shorter.items() <= longer.items()


@pytest.mark.slow
def test_a_log_has_argoverse_2s_files(town: Path) -> None:
    log = sorted(town.glob("*/"))[1]  # the signalised crossroads
    assert (log / "LICENSE").read_text(encoding="utf-8").splitlines()[0] == LICENCE
    stamps = np.unique(pyarrow.feather.read_table(log / "annotations.feather")["timestamp_ns"].to_numpy())
    poses = pyarrow.feather.read_table(log / "city_SE3_egovehicle.feather")["timestamp_ns"].to_numpy()
    assert set(stamps) <= set(poses)
    images = sorted((log / "sensors" / "cameras" / "ring_front_center").glob("*.jpg"))
    assert {int(path.stem) for path in images} <= set(poses)
    assert np.diff([int(path.stem) for path in images]).tolist() == [500_000_000] * (len(images) - 1)
    picture = cv2.imread(str(images[0]))
    assert picture is not None
    assert picture.shape == (36, 64, 3)
    sweep = pyarrow.feather.read_table(sorted((log / "sensors" / "lidar").glob("*.feather"))[0])
    assert sweep.column_names == ["x", "y", "z", "intensity", "laser_number", "offset_ns"]
    mounts = pyarrow.feather.read_table(log / "calibration" / "egovehicle_SE3_sensor.feather").to_pylist()
    assert [row["sensor_name"] for row in mounts] == [*SMALL.cameras, "up_lidar", "down_lidar"]
    assert [mounts[-1][axis] for axis in ("tx_m", "ty_m", "tz_m")] == [1.2, 0.0, 1.62]
    assert len(list((log / "map").glob("log_map_archive_*.json"))) == 1


def test_the_reader_yields_exactly_the_clips_asked_for(reader: SyntheticReader) -> None:
    refs = reader.index().refs
    assert len(refs) == WINDOWS_PER_LOG + 1
    clip = reader.read(refs[-1])
    assert (clip.dataset, clip.licence) == ("synthetic", LICENCE)
    assert {camera.name for camera in clip.cameras} == set(SMALL.cameras)
    assert len(clip.images) == 2 * 20
    assert len(clip.sweeps) == 20
    assert clip.lights.lane_ids
    assert LightState.UNKNOWN not in clip.lights.states
    assert len(clip.route.lane_path) >= 2
    assert len(clip.agents) > 10
    kinds = {kind.value for kind in clip.agents.kinds}
    assert {"VEHICLE", "PEDESTRIAN"} <= kinds


def test_a_town_is_written_once_and_never_seen_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blind = TownSettings(cameras=(), lidar_beams=0)

    def killed(out: Path, *_rest: object) -> None:
        (out / "half").mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(reader_module, "write_town", killed)
    reader = SyntheticReader(tmp_path, 1, 0, blind)
    with pytest.raises(KeyboardInterrupt):
        reader.index()
    assert not reader.root.exists()
    monkeypatch.undo()
    assert len(reader.index().refs) == 1
    monkeypatch.setattr(reader_module, "write_town", killed)
    assert len(SyntheticReader(tmp_path, 1, 0, blind).index().refs) == 1


def _until_now(clip: Clip) -> dict[tuple[str, str], bytes]:
    """Photos of a clip's history by camera and stamp."""
    shown = [file for file in clip.images if file.time_s <= HISTORY_S + 1e-6]
    return {(file.sensor, Path(file.uri).name): Path(file.uri).read_bytes() for file in shown}


@pytest.mark.slow
def test_36_photo_steps_are_what_the_histories_of_a_logs_windows_show(reader: SyntheticReader, tmp_path: Path) -> None:
    short = SyntheticReader(tmp_path, WINDOWS_PER_LOG, 0, replace(SMALL, photo_steps=36))
    for ref, whole in zip(short.index().refs, reader.index().refs):
        few, many = (_until_now(clip) for clip in (short.read(ref), reader.read(whole)))
        assert few == many
        assert len(many) == len(SMALL.cameras) * 4
    taken = sorted(short.root.rglob("*.jpg"))
    assert len(taken) == len(SMALL.cameras) * 8, "2 Hz from 0 to 3.5 s, none that no window shows"
    assert len(list(short.root.rglob("lidar/*.feather"))) == len(range(0, LOG_STEPS, STEPS_PER_SWEEP))


def test_another_seed_gives_another_town(town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blind = TownSettings(cameras=(), lidar_beams=0)
    folder = write_town(tmp_path, 1, 1, blind)[0]
    assert capsys.readouterr().err == ""  # no line where nothing is waited for
    first = sorted(town.glob("*/"))[0]
    name = "city_SE3_egovehicle.feather"
    assert (folder / name).read_bytes() != (first / name).read_bytes()
    assert not (folder / "sensors").exists()


def test_impossible_settings_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="n_clips"):
        SyntheticReader("anywhere", 0)
    with pytest.raises(ValueError, match="unknown cameras"):
        TownSettings(cameras=("roof",))
    with pytest.raises(ValueError, match="steps_per_photo must divide 5"):
        TownSettings(steps_per_photo=2)
    with pytest.raises(ValueError, match="quality 0"):
        TownSettings(jpeg_quality=0)
    with pytest.raises(ValueError, match="photo_steps must be 1 to 116"):
        TownSettings(photo_steps=117)

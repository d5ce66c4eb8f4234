"""Sidecars made of nuScenes' own folders: tables written here by its public schema, photos where the ego drove."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factory.__main__ import main
from factory.datasets.scenarionet.nuscenes_cameras import import_cameras, on_scenarionet_clock, rows_of
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.readers.base import BadClip
from factory.stages.assets import Sensing, block_sensing
from factory.stages.sensors import block_of, load_sensors
from tasks.render.scene.engine import encode_jpeg
from tasks.render.settings import RenderSettings
from tests.factory.datasets.scenarionet import scenarionet_scenarios as town

START_US = 1_533_151_603_547_590
KEYFRAMES_US = START_US + np.concatenate([[0], np.cumsum(np.resize([400_000, 600_000, 500_000], 24))])
FRONT = (0.5, -0.5, 0.5, -0.5)  # w, x, y, z: a camera that looks ahead
LATE_US = {"CAM_FRONT": -35_000, "CAM_BACK": 20_000}
Tables = dict[str, list[dict[str, Any]]]


def ego_at(stamp_us: int) -> list[float]:
    return [town.EGO_START + town.EGO_SPEED * (stamp_us - START_US) / 1e6, town.EGO_Y, 0.0]


def tables_of(*scenes: str) -> Tables:
    """Two cameras at 12 Hz, a lidar at 20 Hz and a radar, of scenes that are alike."""
    sensors = [("CAM_FRONT", "camera"), ("CAM_BACK", "camera"), ("LIDAR_TOP", "lidar"), ("RADAR_FRONT", "radar")]
    out: Tables = {name: [] for name in ("scene", "sample", "sensor", "calibrated_sensor", "sample_data", "ego_pose")}
    for channel, modality in sensors:
        k = [[126.64, 0.0, 81.63], [0.0, 126.64, 49.15], [0.0, 0.0, 1.0]] if modality == "camera" else []
        turn = [0.7071067811865476, 0.0, 0.0, -0.7071067811865476] if channel == "LIDAR_TOP" else FRONT
        where = {"translation": [1.7, 0.0, 1.5], "rotation": turn, "camera_intrinsic": k}
        out["sensor"].append({"token": f"s-{channel}", "channel": channel, "modality": modality})
        out["calibrated_sensor"].append({"token": f"c-{channel}", "sensor_token": f"s-{channel}", **where})
    for scene in scenes:
        out["scene"].append({"token": f"t-{scene}", "name": scene, "log_token": "l", "nbr_samples": len(KEYFRAMES_US)})
        for k, stamp in enumerate(KEYFRAMES_US.tolist()):
            out["sample"].append({"token": f"{scene}-{k}", "timestamp": stamp, "scene_token": f"t-{scene}"})
        for channel, modality in sensors:
            rate = {"camera": 12, "lidar": 20, "radar": 13}[modality]
            keys = [stamp + LATE_US.get(channel, 0) for stamp in KEYFRAMES_US.tolist()]
            between = np.arange(keys[0], keys[-1], 1_000_000 // rate).tolist()
            between = [stamp for stamp in between if min(abs(stamp - key) for key in keys) > 20_000]
            for stamp, is_key in sorted([*((s, True) for s in keys), *((s, False) for s in between)]):
                folder = "samples" if is_key else "sweeps"
                suffix = ".jpg" if modality == "camera" else ".pcd.bin"
                sample = int(np.abs(KEYFRAMES_US - stamp).argmin())
                row = {
                    "token": f"{scene}-{channel}-{stamp}",
                    "sample_token": f"{scene}-{sample}",
                    "ego_pose_token": f"{scene}-{channel}-{stamp}",
                    "calibrated_sensor_token": f"c-{channel}",
                    "filename": f"{folder}/{channel}/{scene}__{channel}__{stamp}{suffix}",
                    "fileformat": suffix[1:],
                    "width": 160 if modality == "camera" else 0,
                    "height": 90 if modality == "camera" else 0,
                    "timestamp": stamp,
                    "is_key_frame": is_key,
                }
                out["sample_data"].append(row)
                where = {"translation": ego_at(stamp), "rotation": [1.0, 0.0, 0.0, 0.0]}
                out["ego_pose"].append({"token": row["ego_pose_token"], "timestamp": stamp, **where})
    return out


def write(root: Path, tables: Tables, version: str = "v1.0-mini", pictures: bool = True) -> Path:
    (root / version).mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        (root / version / f"{name}.json").write_text(json.dumps(rows, indent=0))  # as nuScenes' are
    jpeg = encode_jpeg(np.random.default_rng(0).integers(0, 255, (90, 160, 3), np.uint8), 90)
    points = np.array([[0.0, 10.0, -1.5, 12.0, 3.0], [-5.0, 20.0, 0.5, 200.0, 30.0]], "<f4").tobytes()
    for row in tables["sample_data"] if pictures else ():
        path = root / row["filename"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(jpeg if path.suffix == ".jpg" else points)
    return root


@pytest.fixture(scope="module")
def nuscenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("nuscenes"), tables_of("scene-0001", "scene-0002"))


def test_a_clip_has_twelve_photos_a_second_each_where_it_was_taken_and_on_the_log_s_clock(
    nuscenes: Path, tmp_path: Path
) -> None:
    (done,) = import_cameras(nuscenes, tmp_path / "photos", only=["scene-0001"])
    assert (done.cameras, done.sweeps, done.missing) == (2, 25, ())
    log = town.save(town.nuscenes(), tmp_path / "logs", "sd_nuscenes_v1.0-mini_scene-0001.pkl")
    reader = ScenarioNetReader(log, cameras=tmp_path / "photos", sensor_root=nuscenes)
    clip = reader.read(reader.index().refs[0])
    assert block_sensing(clip, RenderSettings()) is Sensing.PHOTOS
    front = [image for image in clip.images if image.sensor == "CAM_FRONT"]
    assert 110 < len(front) < 125  # of 9.5 s
    for image in front:
        stamp = int(Path(image.uri).stem.rpartition("__")[2])
        assert image.world_from_ego[:3, 3] == pytest.approx(ego_at(stamp), abs=1e-9)
        expected = np.interp(stamp, KEYFRAMES_US, 0.5 * np.arange(len(KEYFRAMES_US)), left=-0.035 / 0.8)
        assert clip.start_s + image.time_s == pytest.approx(expected, abs=1e-5)
    camera = clip.cameras[0]
    assert (camera.name, camera.width, camera.intrinsics[1, 2]) == ("CAM_FRONT", 160, 49.15)
    np.testing.assert_allclose(camera.ego_from_camera[:3, 2], [1.0, 0.0, 0.0], atol=1e-12)  # looks ahead
    np.testing.assert_allclose(camera.ego_from_camera[:3, 0], [0.0, -1.0, 0.0], atol=1e-12)  # its right is right
    data = load_sensors(block_of(clip), clip.cameras, 32, 18)
    assert len(data.photos) == len(clip.block.images) and len(data.sweeps) == 25
    np.testing.assert_allclose(data.sweeps[3].points, [[11.7, 0.0, 0.0], [21.7, 5.0, 2.0]], atol=1e-5)


def test_keyframes_alone_are_two_hertz(nuscenes: Path, tmp_path: Path) -> None:
    done = list(import_cameras(nuscenes, tmp_path, sweeps=False))
    assert [(one.scene, one.photos, one.sweeps) for one in done] == [("scene-0001", 50, 25), ("scene-0002", 50, 25)]
    frames = json.loads(done[1].path.read_text())["frames"]
    assert {frame["file"].partition("/")[0] for frame in frames} == {"samples"}
    times = sorted(frame["t_s"] for frame in frames if frame["camera"] == "CAM_BACK")
    assert np.abs(np.array(times) - 0.5 * np.arange(25)).max() < 0.03


def test_the_clock_is_the_identity_where_keyframes_are_half_a_second_apart_and_goes_on_beyond_them() -> None:
    keys = START_US + 500_000 * np.arange(5)
    stamps = START_US + np.array([-40_000, 0, 123_456, 2_000_000, 2_100_000])
    np.testing.assert_allclose(on_scenarionet_clock(stamps, keys.tolist()), (stamps - START_US) / 1e6, atol=1e-9)
    np.testing.assert_allclose(on_scenarionet_clock(KEYFRAMES_US, KEYFRAMES_US.tolist()), 0.5 * np.arange(25))
    with pytest.raises(ValueError, match="1 keyframes has no clock"):
        on_scenarionet_clock(stamps, [START_US])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is no JSON, or ends within a row"),
        ('{"a": 1}', "is no JSON list of rows"),
        ('[{"a": 1}, 2]', "holds a int among its rows"),
        ('[{"a": 1}, {"b": ', "is no JSON, or ends within a row: '{\"b\": '"),
    ],
)
def test_a_table_that_is_none_is_named(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "sample.json").write_text(text)
    with pytest.raises(BadClip, match=rf"sample\.json: table: {re.escape(said)}"):
        list(rows_of(tmp_path / "sample.json"))


def spoiled(table: str, key: str, value: object) -> Callable[[Tables], None]:
    return lambda tables: tables[table][0].update({key: value})


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (spoiled("scene", "name", None), r"scene\.json: name: missing in a row, or no text: None"),
        (spoiled("sample", "timestamp", "1"), r"sample\.json: timestamp: missing in row scene-0001-0, or no whole"),
        (spoiled("sample_data", "filename", "../x.jpg"), r"filename: '\.\./x\.jpg' is no path below the folder"),
        (spoiled("calibrated_sensor", "sensor_token", "x"), r"sensor_token: x is in no row of sensor\.json"),
        (spoiled("calibrated_sensor", "rotation", [2, 0, 0, 0]), "rotation: c-CAM_FRONT: a quaternion that is not of"),
        (spoiled("calibrated_sensor", "camera_intrinsic", []), "camera_intrinsic: c-CAM_FRONT: expected 3 x 3 finite"),
        (lambda tables: tables["ego_pose"].clear(), r"ego_pose\.json: token: no pose scene-0001-CAM_"),
    ],
)
def test_tables_that_do_not_hold_together_are_named(tmp_path: Path, spoil: Callable[[Tables], None], said: str) -> None:
    tables = tables_of("scene-0001")
    spoil(tables)
    with pytest.raises(BadClip, match=said):
        list(import_cameras(write(tmp_path, tables, pictures=False), tmp_path / "out"))


def test_the_command_says_what_it_wrote_and_what_was_not_there(
    nuscenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write(tmp_path / "part", tables_of("scene-0001"), pictures=False)
    for path in (nuscenes / "samples").rglob("*scene-0001*"):  # the archives of sweeps were not unpacked
        (root / path.relative_to(nuscenes)).parent.mkdir(parents=True, exist_ok=True)
        (root / path.relative_to(nuscenes)).write_bytes(path.read_bytes())
    assert main(["import", "nuscenes-cameras", f"root={root}", f"out={tmp_path / 'out'}"]) == 0
    said = capsys.readouterr().out
    assert f"scene-0001  50 photos of 2 cameras, 25 sweeps: {tmp_path}/out/scene-0001/cameras.json" in said
    assert re.search(r"  \d+ files of the tables are not there, such as sweeps/CAM_BACK/scene-0001__CAM_BACK__", said)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "version= is missing: {root} has v1.0-mini, v1.0-trainval"),
        (["version=v1.0-test"], "version=v1.0-test: not there: {root} has v1.0-mini, v1.0-trainval"),
        (["version=v1.0-mini", "only=[scene-9]"], "has no scene-9; there are scene-0001"),
        (["version=v1.0-mini"], "none of the photos that its tables name is there; unpack samples/ and sweeps/"),
    ],
)
def test_the_command_refuses_in_one_line(
    tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for version in ("v1.0-mini", "v1.0-trainval"):
        write(tmp_path / "data", tables_of("scene-0001"), version, pictures=False)
    assert main(["import", "nuscenes-cameras", f"root={tmp_path / 'data'}", f"out={tmp_path / 'out'}", *words]) == 2
    error = capsys.readouterr().err
    assert said.format(root=tmp_path / "data") in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()
    assert main(["import", "simscale", "root=x", "out=y", "version=v1.0-mini"]) == 2
    assert "version= and sweeps= are of import nuscenes-cameras" in capsys.readouterr().err

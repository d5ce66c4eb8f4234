"""The reader of NAVSIM's layout reads what is there, and stops where the public code would stop or lose a scene."""

import hashlib
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from tests.factory.datasets.navsim.openscene_reader import (
    CAMERA_SHAPE,
    CAMERAS,
    TRAINED_ON,
    SceneFilter,
    Unreadable,
    check_sums,
    read_log_split,
    read_rewards,
    read_scene_filter,
    read_scenes,
    read_split,
)

LOG = "2021.05.12.19.36.12_veh-35_00005_00204-0a678d2136b35b56-002"
ORIGIN = np.array([664_400.25, 3_997_000.5])  # UTM, m
RADIUS_M, TURN_PER_FRAME = 20.0, 0.1  # the ego drives on a circle
TWELVE = SceneFilter(4, 8, 1)
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # of a camera that looks where the ego drives


def frame(i: int) -> dict[str, Any]:
    yaw = TURN_PER_FRAME * i
    camera = {
        "sensor2lidar_rotation": AHEAD,
        "sensor2lidar_translation": np.array([1.7, 0.0, 1.5]),
        "cam_intrinsic": np.array([[1545.0, 0.0, 960.0], [0.0, 1545.0, 560.0], [0.0, 0.0, 1.0]]),
        "distortion": np.array([-0.356, 0.172, -0.002, 0.0, -0.052]),
    }
    cams = {name.upper(): {"data_path": f"{LOG}/{name.upper()}/{i:016x}.jpg", **camera} for name in CAMERAS}
    return {
        "token": f"{i:016x}-002",
        "timestamp": 1_620_000_000_000_000 + 500_000 * i,
        "log_name": LOG,
        "scene_token": "0a678d2136b35b56-002",
        "map_location": "us-nv-las-vegas-strip",
        "roadblock_ids": ["12", "13"],
        "lidar_path": "",
        "ego2global_translation": np.array([*(ORIGIN + RADIUS_M * np.array([np.sin(yaw), 1 - np.cos(yaw)])), 610.0]),
        "ego2global_rotation": np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]),
        "ego_dynamic_state": [4.0, 0.0, 0.1 * i, 0.8],
        "traffic_lights": [(77, True), (78, False)],
        "driving_command": np.array([1, 0, 0, 0]),
        "cams": cams,
        "anns": {
            "gt_boxes": np.array([[10.0, 2.0, 0.8, 4.6, 1.9, 1.6, 0.0], [5.0, -4.0, 0.9, 0.7, 0.7, 1.8, 1.0]]),
            "gt_names": np.array(["vehicle", "pedestrian"]),
            "gt_velocity_3d": np.array([[3.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
            "instance_tokens": [f"{2 * i:016x}", f"{2 * i + 1:016x}"],
            "track_tokens": ["aa", "bb"],
        },
    }


def pickled(value: Any) -> bytes:
    """By the names that numpy 1 has too; protocol 3 writes them as they are."""
    return pickle.dumps(value, protocol=3).replace(b"numpy._core", b"numpy.core")


@pytest.fixture
def frames() -> list[dict[str, Any]]:
    return [frame(i) for i in range(12)]


def written(folder: Path, frames: list[dict[str, Any]]) -> Path:
    (folder / f"{LOG}.pkl").write_bytes(pickled(frames))
    return folder


def test_a_circle_comes_back_in_the_frame_of_the_ego_now(tmp_path: Path, frames: list[dict[str, Any]]) -> None:
    scenes = read_scenes(written(tmp_path, frames), tmp_path, TWELVE)
    assert list(scenes) == [f"{3:016x}-002"]
    scene = scenes[f"{3:016x}-002"]
    turned = TURN_PER_FRAME * np.arange(-3, 9)
    circle = np.stack([RADIUS_M * np.sin(turned), RADIUS_M * (1 - np.cos(turned)), turned], 1)
    np.testing.assert_allclose(scene.history(), circle[:4], atol=1e-6)
    np.testing.assert_allclose(scene.future(), circle[4:], atol=1e-8)
    assert scene.history().dtype == np.float32 and scene.future().shape == (8, 3)
    np.testing.assert_allclose(scene.status(), np.float32([1, 0, 0, 0, 4.0, 0.0, 0.3, 0.8]))
    assert scene.simulated and not scene.second_stage
    assert (scene.log_name, scene.scene_token, scene.map_name) == (LOG, "0a678d2136b35b56-002", "us-nv-las-vegas-strip")


def test_a_frame_keeps_its_boxes_lights_and_cameras(tmp_path: Path, frames: list[dict[str, Any]]) -> None:
    now = next(iter(read_scenes(written(tmp_path, frames), tmp_path / "blobs", TWELVE).values())).now
    np.testing.assert_array_equal(now.boxes, frames[3]["anns"]["gt_boxes"])
    np.testing.assert_array_equal(now.velocities, frames[3]["anns"]["gt_velocity_3d"])
    assert now.names.tolist() == ["vehicle", "pedestrian"] and now.track_tokens == ("aa", "bb")
    assert now.traffic_lights == ((77, True), (78, False)) and now.roadblock_ids == ("12", "13")
    assert tuple(now.cameras) == CAMERAS
    shot = now.cameras["cam_b0"]
    assert shot.file == tmp_path / "blobs" / LOG / "CAM_B0" / f"{3:016x}.jpg"
    np.testing.assert_array_equal(shot.rotation @ [0, 0, 1], [1, 0, 0])


def test_a_frame_without_boxes_is_a_frame(tmp_path: Path, frames: list[dict[str, Any]]) -> None:
    nothing = {"gt_boxes": np.zeros((0, 7)), "gt_names": np.array([]), "gt_velocity_3d": np.zeros((0, 3))}
    frames[3]["anns"] = {**nothing, "instance_tokens": [], "track_tokens": []}
    scene = next(iter(read_scenes(written(tmp_path, frames), tmp_path, TWELVE).values()))
    assert scene.now.boxes.shape == (0, 7) and len(scene.now.names) == 0


@pytest.mark.parametrize(
    ("chosen", "tokens"),
    [
        (SceneFilter(4, 8, 1), [3, 4, 5, 6, 7]),  # of 16 frames
        (SceneFilter(4, 8), [3]),  # the second window is too short
        (SceneFilter(4, 4, 4), [3, 7, 11]),
        (SceneFilter(2, 6, 1, max_scenes=2), [1, 2]),
        (SceneFilter(4, 8, 1, tokens=[f"{6:016x}-002"]), [6]),
        (SceneFilter(4, 8, 1, log_names=[LOG]), [3, 4, 5, 6, 7]),
    ],
)
def test_windows_are_those_of_the_public_loader(tmp_path: Path, chosen: SceneFilter, tokens: list[int]) -> None:
    logs = written(tmp_path, [frame(i) for i in range(16)])
    assert list(read_scenes(logs, tmp_path, chosen)) == [f"{i:016x}-002" for i in tokens]


def test_a_window_without_a_route_is_left_out(tmp_path: Path, frames: list[dict[str, Any]]) -> None:
    frames[3]["roadblock_ids"] = []
    logs = written(tmp_path, frames)
    assert not read_scenes(logs, tmp_path, TWELVE)
    assert read_scenes(logs, tmp_path, replace(TWELVE, has_route=False))


LOOKED_UP = [
    *("token", "timestamp", "log_name", "scene_token", "map_location", "roadblock_ids", "lidar_path", "anns", "cams"),
    *("ego2global_translation", "ego2global_rotation", "ego_dynamic_state", "traffic_lights", "driving_command"),
]


@pytest.mark.parametrize("key", LOOKED_UP)
def test_a_key_that_is_looked_up_must_be_there(tmp_path: Path, frames: list[dict[str, Any]], key: str) -> None:
    del frames[3][key]
    with pytest.raises(KeyError, match=key):
        read_scenes(written(tmp_path, frames), tmp_path, TWELVE)


def spoilt(key: str, value: Any, inside: str | None = None) -> Any:
    def spoil(frames: list[dict[str, Any]]) -> None:
        (frames[3] if inside is None else frames[3][inside])[key] = value

    return spoil


def short_token(frames: list[dict[str, Any]]) -> None:
    frames[3]["token"] = "0123456789abc-002"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (spoilt("track_tokens", ["aa"], "anns"), "lengths"),
        (spoilt("track_tokens", ["aa", "aa"], "anns"), "twice"),
        (spoilt("gt_names", ["vehicle", "pedestrian"], "anns"), "mask"),
        (spoilt("gt_names", np.array(["vehicle", "tram"]), "anns"), "tram"),
        (spoilt("gt_boxes", np.zeros((2, 6)), "anns"), r"\(2, 6\)"),
        (spoilt("lidar_path", None), "lidar_path"),
        (spoilt("map_location", "town"), "town"),
        (spoilt("log_name", "another"), "another"),
        (spoilt("timestamp", 1_620_000_000_000_000), "increase"),
        (spoilt("driving_command", np.array([0, 1, 0])), "driving_command"),
        (spoilt("ego_dynamic_state", [4.0, 0.0]), "ego_dynamic_state"),
        (lambda frames: frames[3]["cams"].pop("CAM_B0"), "cam_b0"),
        (lambda frames: frames[3]["cams"]["CAM_F0"].update(distortion=np.zeros(4)), "cam_f0"),
        (short_token, "second stage"),
    ],
)
def test_what_the_public_code_cannot_use_raises(
    tmp_path: Path, frames: list[dict[str, Any]], spoil: Any, message: str
) -> None:
    spoil(frames)
    with pytest.raises((Unreadable, KeyError), match=message):
        read_scenes(written(tmp_path, frames), tmp_path, TWELVE)


def test_a_filter_that_names_what_is_not_there_raises(tmp_path: Path, frames: list[dict[str, Any]]) -> None:
    logs = written(tmp_path, frames)
    with pytest.raises(Unreadable, match="gone"):
        read_scenes(logs, tmp_path, replace(TWELVE, log_names=[LOG, "gone"]))
    with pytest.raises(Unreadable, match="gone"):
        read_scenes(logs, tmp_path, replace(TWELVE, tokens=["gone"]))


def test_pictures_are_decoded_and_must_have_the_size_that_is_cut(tmp_path: Path, frames: list[dict[str, Any]]) -> None:
    shot = next(iter(read_scenes(written(tmp_path, frames), tmp_path, TWELVE).values())).now.cameras["cam_f0"]
    shot.file.parent.mkdir(parents=True)
    pixels = np.zeros(CAMERA_SHAPE, np.uint8)
    pixels[:, :960, 0] = 200
    Image.fromarray(pixels).save(shot.file)
    assert np.abs(shot.image().astype(int) - pixels)[:, [0, 500, 1400]].max() < 3
    shot.file.write_bytes(shot.file.read_bytes()[:-3000])
    with pytest.raises(Unreadable, match="truncated"):
        shot.image()
    Image.fromarray(pixels[:540]).save(shot.file)
    with pytest.raises(Unreadable, match="540"):
        shot.image()


def test_pickles_hold_what_numpy_1_can_read_and_no_code(tmp_path: Path, frames: list[dict[str, Any]]) -> None:
    file = tmp_path / f"{LOG}.pkl"
    for data in (pickle.dumps(frames), pickle.dumps(Path("x")), pickled(frames)[:-20]):
        file.write_bytes(data)
        with pytest.raises(Unreadable, match=LOG):
            read_scenes(tmp_path, tmp_path, TWELVE)


def test_split_files_name_a_filter_and_logs(tmp_path: Path) -> None:
    target = {"_target_": "navsim.common.dataclasses.SceneFilter", "_convert_": "all"}
    chosen = {"num_history_frames": 4, "num_future_frames": 8, "frame_interval": 1, "log_names": [LOG], "tokens": ["t"]}
    (tmp_path / "scene_filter").mkdir()
    inner, outer = tmp_path / "scene_filter" / "mine.yaml", tmp_path / "mine.yaml"
    inner.write_text(yaml.safe_dump(target | chosen))
    outer.write_text(yaml.safe_dump({"data_split": "mine", "defaults": [{"scene_filter": "mine"}]}))
    assert read_split(outer) == ("mine", SceneFilter(4, 8, 1, log_names=[LOG], tokens=["t"]))
    inner.write_text(yaml.safe_dump(target | {"history": 4}))
    with pytest.raises(Unreadable, match="history"):
        read_scene_filter(inner)
    inner.write_text(yaml.safe_dump(chosen))
    with pytest.raises(Unreadable, match="_target_"):
        read_scene_filter(inner)
    outer.write_text(yaml.safe_dump({"train_logs": [LOG], "val_logs": []}))
    assert read_log_split(outer) == {"train_logs": [LOG], "val_logs": []}
    outer.write_text(yaml.safe_dump({"train_logs": [LOG]}))
    with pytest.raises(KeyError, match="val_logs"):
        read_log_split(outer)


def test_rewards_must_hold_every_token_and_metric(tmp_path: Path) -> None:
    file = tmp_path / "rewards.pkl"
    rewards = {"a-000": {metric: np.full(6, 0.5, np.float16) for metric in TRAINED_ON}}

    def read(tokens: list[str], n: int = 6) -> Any:
        file.write_bytes(pickled(rewards))
        return read_rewards(file, tokens, n)

    np.testing.assert_array_equal(read(["a-000"])["a-000"]["ego_progress"], np.full(6, 0.5, np.float16))
    with pytest.raises(KeyError, match="b-000"):
        read(["a-000", "b-000"])
    with pytest.raises(Unreadable, match="float16"):
        read(["a-000"], 7)
    rewards["a-000"]["lane_keeping"] = np.full(6, np.nan, np.float16)
    with pytest.raises(Unreadable, match="lane_keeping"):
        read(["a-000"])
    del rewards["a-000"]["lane_keeping"]
    with pytest.raises(KeyError, match="lane_keeping"):
        read(["a-000"])


def test_a_manifest_names_every_file_and_its_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "one").write_bytes(b"1")
    sums = {"a/one": hashlib.sha256(b"1").hexdigest()}
    check_sums(tmp_path, sums)
    for wrong in ({}, sums | {"two": ""}, {"a/one": hashlib.sha256(b"2").hexdigest()}):
        with pytest.raises(Unreadable, match="manifest"):
            check_sums(tmp_path, wrong)

"""A log's pickle as typed frames: what each key becomes, and what is refused by frame and key."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factory.datasets.navsim.log import CAMERA_NAMES, parse_frame, parse_frames, read_frames
from factory.readers.base import BadClip
from tasks.world.clip import AgentKind
from tests.factory.datasets.navsim.logs import NAME, SPEED_MPS, frame


def _write(folder: Path, frames: Any) -> Path:
    path = folder / f"{NAME}.pkl"
    path.write_bytes(pickle.dumps(frames, pickle.HIGHEST_PROTOCOL))
    return path


def test_a_frame_holds_what_its_keys_say(tmp_path: Path) -> None:
    log = read_frames(_write(tmp_path, [frame(0), frame(1)]))
    assert log.name == NAME and len(log.frames) == 2
    second = log.frames[1]
    assert second.pose.tolist() == [331_000.0 + SPEED_MPS / 2, 4_690_000.0, 0.0]
    assert second.world_from_ego[:3, 3].tolist() == [331_004.0, 4_690_000.0, 12.0]
    assert second.dynamic_state.tolist() == [SPEED_MPS, 0.0, 0.25, 0.0]
    assert second.lights == (("21", False),) and second.command == "straight"
    assert second.boxes is not None
    assert second.boxes.kinds == (AgentKind.VEHICLE, AgentKind.TRAFFIC_CONE)
    assert [camera.name for camera in second.cameras] == list(CAMERA_NAMES)
    assert second.cameras[0].ego_from_camera[:3, 3].tolist() == [1.6, 0.0, 1.5]
    assert second.lidar_path == f"{NAME}/MergedPointCloud/{second.token}.pcd"


@pytest.mark.parametrize("key", ["frame_idx", "occ_gt_final_path", "log_token", "vehicle_name"])
def test_keys_that_navsim_does_not_read_are_not_looked_at(key: str) -> None:
    plain = parse_frame(frame(0), "f", "")
    assert parse_frame(frame(0, **{key: object()}), "f", "").token == plain.token


def test_other_spellings_of_the_same_values_are_read(tmp_path: Path) -> None:
    cams = {name.lower(): {"data_path": None} for name in CAMERA_NAMES}
    nobody = {
        "gt_boxes": np.zeros((0, 7)), "gt_names": np.array([]), "gt_velocity_3d": np.zeros((0, 3)),
        "instance_tokens": [], "track_tokens": [],
    }  # fmt: skip
    other = frame(
        0,
        timestamp=np.int64(1_623_693_600_000_000),
        cams=cams,
        anns=nobody,
        lidar_path=None,
        traffic_lights=[(np.int64(21), np.bool_(True)), ["22", False]],
        map_location="las_vegas",
        ego2global_rotation=[1.0, 0.0, 0.0, 0.0],
        driving_command=[0, 0, 0, 1],
        roadblock_ids=[],
    )
    (read,) = read_frames(_write(tmp_path, [other])).frames
    assert read.cameras == () and read.lidar_path is None and read.map_location == "us-nv-las-vegas-strip"
    assert read.boxes is not None and read.boxes.boxes.shape == (0, 7)
    assert read.lights == (("21", True), ("22", False)) and read.command == "unknown" and read.roadblock_ids == ()


def test_a_command_of_three_places_has_no_unknown() -> None:
    """As the first logs have it."""
    for place, command in enumerate(("left", "straight", "right", "unknown")):
        assert parse_frame(frame(0, driving_command=np.eye(4)[place]), "f", "").command == command
        assert place == 3 or parse_frame(frame(0, driving_command=np.eye(3)[place]), "f", "").command == command


@pytest.mark.parametrize("given", [[0, 1, 1, 0], [0, 0, 0], [1], [0, 0, 0, 0, 1], [[0, 1, 0, 0]], "left", None, np.nan])
def test_a_command_that_is_none_is_refused_where_it_is_used_and_there_alone(given: Any) -> None:
    read = parse_frame(frame(0, driving_command=given), "f", "frames[0].")
    assert read.token
    with pytest.raises(BadClip, match=r"frames\[0\]\.driving_command: "):
        _ = read.command


def test_a_test_set_s_log_has_no_boxes() -> None:
    without = frame(0)
    del without["anns"]
    assert parse_frame(without, "f", "").boxes is None


def test_the_heading_is_the_public_reader_s() -> None:
    """pyquaternion's yaw_pitch_roll: R = Rx(roll) Ry(pitch) Rz(yaw)."""
    x, y, z, w = Rotation.from_euler("XYZ", [0.03, -0.05, 2.1]).as_quat()
    read = parse_frame(frame(0, ego2global_rotation=[w, x, y, z]), "f", "")
    assert read.pose[2] == pytest.approx(2.1, abs=1e-12)
    ground = np.arctan2(*read.world_from_ego[[1, 0], 0])
    assert abs(ground - 2.1) > 5e-4


def test_velocities_are_rounded_as_the_public_reader_rounds_them() -> None:
    read = parse_frame(frame(0, ego_dynamic_state=[0.1, 0.2, 0.3, 0.4]), "f", "")
    assert read.dynamic_state.tolist() == [float(np.float32(v)) for v in (0.1, 0.2, 0.3, 0.4)]


def _anns(**other: Any) -> dict[str, Any]:
    return {**frame(1)["anns"], **other}


@pytest.mark.parametrize(
    ("other", "field", "says"),
    [
        ({"token": 5}, "token", "is a int"),
        ({"token": ""}, "token", "is empty"),
        ({"timestamp": 1.5}, "timestamp", "expected a whole number"),
        ({"ego2global_translation": [1.0, 2.0]}, "ego2global_translation", r"shape \(2,\)"),
        ({"ego2global_translation": [1.0, np.nan, 0.0]}, "ego2global_translation", "NaN"),
        ({"ego2global_rotation": [2.0, 0.0, 0.0, 0.0]}, "ego2global_rotation", "length 2"),
        ({"ego_dynamic_state": "fast"}, "ego_dynamic_state", "no numbers"),
        ({"roadblock_ids": "10 20"}, "roadblock_ids", "expected a list of text"),
        ({"roadblock_ids": [10, 20]}, "roadblock_ids", "holds 10"),
        ({"roadblock_ids": ["10", None]}, "roadblock_ids", "holds None"),
        ({"traffic_lights": [("", True)]}, "traffic_lights", "lane connector id"),
        ({"traffic_lights": {21: True}}, "traffic_lights", "expected a list"),
        ({"traffic_lights": [(21, True, 3)]}, "traffic_lights", "is_red"),
        ({"cams": {}}, "cams.CAM_F0", "all eight cameras"),
        ({"cams": {**frame(1)["cams"], "CAM_B0": {"data_path": "a.jpg"}}}, "cams.CAM_B0.sensor2lidar_rotation", "miss"),
        ({"lidar_path": 5}, "lidar_path", "expected text"),
        ({"anns": 5}, "anns", "expected a dict"),
        ({"anns": _anns(gt_boxes=np.zeros((2, 6)))}, "anns.gt_boxes", "shape"),
        ({"anns": _anns(gt_boxes=np.zeros((2, 7)))}, "anns.gt_boxes", "not positive"),
        ({"anns": _anns(gt_names=np.array(["vehicle", "tram"]))}, "anns.gt_names", "unknown class tram"),
        ({"anns": _anns(gt_names=np.array(["vehicle"]))}, "anns.gt_names", "1 entries, but 2 boxes"),
        ({"anns": _anns(track_tokens=[None, "a"])}, "anns.track_tokens", "holds None"),
        ({"anns": _anns(track_tokens=["", "a"])}, "anns.track_tokens", "an empty token"),
        ({"anns": _anns(instance_tokens=["a", None])}, "anns.instance_tokens", "holds None"),
        ({"anns": _anns(track_tokens=["a", "a"])}, "anns.track_tokens", "a stands twice"),
        ({"anns": _anns(instance_tokens=["a"])}, "anns.instance_tokens", "1 entries"),
        ({"anns": {}}, "anns.gt_boxes", "missing"),
        ({"log_name": "other"}, "log_name", "rename the file"),
        ({"timestamp": frame(0)["timestamp"]}, "timestamp", "time does not go on"),
    ],
)
def test_a_wrong_value_is_refused_by_file_frame_and_key(
    tmp_path: Path, other: dict[str, Any], field: str, says: str
) -> None:
    path = _write(tmp_path, [frame(0), frame(1, **other)])
    with pytest.raises(BadClip, match=says) as refused:
        read_frames(path)
    assert (refused.value.file, refused.value.field) == (str(path), f"frames[1].{field}")


def test_a_log_under_another_name_is_told_so_where_wrong_frames_are_left_out(tmp_path: Path) -> None:
    path = _write(tmp_path, [frame(k, log_name="other") for k in range(3)])
    with pytest.raises(BadClip, match="rename the file"):
        read_frames(path, whole=False)


@pytest.mark.parametrize("key", [key for key in frame(0) if key not in ("can_bus", "anns", "driving_command")])
def test_a_missing_key_is_named(key: str) -> None:
    item = frame(0)
    del item[key]
    with pytest.raises(BadClip) as refused:
        parse_frames([item], Path(f"{NAME}.pkl"))
    assert refused.value.field == f"frames[0].{key}" and refused.value.problem == "missing"


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda data: data[:-400], "pickle"),
        (lambda data: b"", "pickle"),
        (lambda data: b"cos\nsystem\n(S'true'\ntR.", "refused global os.system"),
        (lambda data: pickle.dumps({"a": 1}), "expected a list of frames"),
        (lambda data: pickle.dumps([]), "expected a list of frames"),
        (lambda data: pickle.dumps([5]), "expected a dict"),
    ],
)
def test_what_is_no_log_is_refused(tmp_path: Path, damage: Callable[[bytes], bytes], says: str) -> None:
    path = _write(tmp_path, [frame(0)])
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(BadClip, match=says):
        read_frames(path)


def test_a_token_or_a_place_that_changes_within_a_log_is_refused() -> None:
    path = Path(f"{NAME}.pkl")
    with pytest.raises(BadClip, match=r"token: .* stands twice"):
        parse_frames([frame(0), frame(1, token=frame(0)["token"])], path)
    with pytest.raises(BadClip, match="map_location: changes"):
        parse_frames([frame(0), frame(1, map_location="sg-one-north")], path)

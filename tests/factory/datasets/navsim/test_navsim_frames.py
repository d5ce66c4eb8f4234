"""Logs in NAVSIM's layout: every key as the page lists it, and the sample in it as the public code computes it."""

import pickle
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factory.datasets.navsim.export import ExportSummary
from factory.datasets.navsim.frames import (
    CAMERAS,
    YAW_DEG,
    CannotExport,
    ExportSettings,
    connector_number,
    derivatives,
    openscene_frames,
    poses_in_space,
    sample_names,
    sample_pictures,
)
from factory.datasets.navsim.pickles import dumps
from tasks.world.frames import to_local, to_world
from tests.factory.datasets.navsim.navsim_samples import INSTANTS_S, TOKENS, YAWS, colour, exported
from tests.tasks.streets import SPEED_MPS

PAGE = Path(__file__).resolve().parents[4] / "docs/navsim_format.md"
KINDS = ["human", "pdm_closed"]
ANY = ExportSettings()
Frames = list[dict[str, Any]]


def frames_of(expert: str, **columns: Any) -> tuple[Any, Frames]:
    """A row, and its log as read back."""
    row = exported(1, expert, **columns)
    names = sample_names(row, ANY)
    return row, pickle.loads(dumps(openscene_frames(row, names, sample_pictures(row, names, ANY).cams, ANY)))


def yaw_of(wxyz: Any) -> float:
    """pyquaternion's yaw_pitch_roll[0], which the public code takes for the heading."""
    w, x, y, z = wxyz
    return float(np.arctan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (y * y + z * z)))


def poses_of(frames: Frames) -> Any:
    """(12, 3) as `Scene._build_ego_status` reads them."""
    return np.array([[*frame["ego2global_translation"][:2], yaw_of(frame["ego2global_rotation"])] for frame in frames])


def kind_of(value: object) -> str:
    """A value's type and shape as the page writes them; of boxes, N for how many."""
    match value:
        case np.ndarray():
            dtype = "str" if value.dtype.kind == "U" else str(value.dtype)
            return f"{dtype} ({', '.join(map(str, value.shape))}{',' * (value.ndim == 1)})"
        case [float(), *_]:
            return f"list[float] {len(value)}"
        case [(int(), bool()), *_]:
            return "list[(int, bool)]"
        case [str(), *_]:
            return "list[str]"
    return type(value).__name__


def listed(table: str) -> dict[str, str]:
    """Key -> type of one of the page's tables."""
    body = re.search(rf"<!-- {table}: .*?-->\n(.*?)<!-- end of {table} -->", PAGE.read_text(), re.S)
    assert body is not None
    return dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \|", body[1], re.M))


@pytest.mark.parametrize("expert", KINDS)
def test_a_log_has_the_keys_types_and_shapes_of_the_page(expert: str) -> None:
    lights = {"light_lane_ids": ["77"], "light_states": np.full((1, 56), 3, np.int8)}
    _, frames = frames_of(expert, **lights)
    assert len(frames) == 12
    optional = {"sample_prev": 0, "sample_next": 11}
    for i, frame in enumerate(frames):
        found = {key: kind_of(value) for key, value in frame.items()}
        for key, end in optional.items():
            assert found[key] == ("NoneType" if i == end else "str")
            found[key] = "str or None"
        assert found == listed("frame")
        assert tuple(frame["cams"]) == CAMERAS
        for camera in frame["cams"].values():
            assert {key: kind_of(value) for key, value in camera.items()} == listed("camera")
        n = len(frame["anns"]["track_tokens"])
        assert n > 0
        boxes = {key: kind_of(value).replace(f"({n},", "(N,") for key, value in frame["anns"].items()}
        assert boxes == listed("anns")
    assert all(array.flags.writeable for array in frames[0]["anns"].values() if isinstance(array, np.ndarray))


@pytest.mark.parametrize("expert", KINDS)
def test_the_public_code_s_trajectories_are_the_sample_s(expert: str) -> None:
    row, frames = frames_of(expert)
    poses = poses_of(frames)
    local = to_local(poses[3], poses)
    np.testing.assert_allclose(local[4:], row["label_2hz"], atol=2e-6)
    np.testing.assert_allclose(local[:4], row["ego_history_2hz"], atol=2e-6)
    np.testing.assert_allclose(poses[3], row["now_pose"], atol=1e-9)
    status = np.array(frames[3]["ego_dynamic_state"])
    np.testing.assert_allclose(status, row["ego_status"], atol=1e-6)
    times = [frame["timestamp"] for frame in frames]
    assert set(np.diff(times)) == {500_000} and times[3] == round(1e6 * (row["clip_start_s"] + row["now_s"]))


def test_a_human_drives_on_at_the_log_s_speed() -> None:
    _, frames = frames_of("human")
    for frame in frames:
        np.testing.assert_allclose(frame["ego_dynamic_state"], [SPEED_MPS, 0.0, 0.0, 0.0], atol=2e-3)
        np.testing.assert_allclose(frame["can_bus"][7:16], [0, 0, 0, SPEED_MPS, 0, 0, 0, 0, 0], atol=2e-3)
        np.testing.assert_array_equal(frame["can_bus"][:3], frame["ego2global_translation"])
        np.testing.assert_array_equal(frame["can_bus"][3:7], frame["ego2global_rotation"])


def test_before_now_a_simulated_ego_moves_as_it_was_driven() -> None:
    row, frames = frames_of("pdm_closed")
    driven = row["perturbed_states"][[25, 30, 35]]
    np.testing.assert_array_equal([frame["ego_dynamic_state"] for frame in frames[:3]], driven[:, [3, 4, 5, 6]])
    np.testing.assert_array_equal([frame["ego2global_translation"][:2] for frame in frames[:3]], driven[:, :2])
    np.testing.assert_array_equal([frame["can_bus"][15] for frame in frames[:3]], driven[:, 9])


@pytest.mark.parametrize("expert", KINDS)
def test_boxes_and_velocities_stand_in_the_ego_frame_of_their_own_instant(expert: str) -> None:
    """Turned back to the world by the public code's heading, they are the sample's."""
    row, frames = frames_of(expert)
    poses = poses_of(frames)
    for i, frame in enumerate(frames):
        found, step = frame["anns"], 5 * i
        here = np.flatnonzero(row["agent_valid"][:, step])
        assert found["track_tokens"] == [row["agent_ids"][k] for k in here]
        assert list(found["gt_names"]) == [row["agent_kinds"][k].lower() for k in here]
        stored = row["agent_boxes"][here, step].astype(float)
        world = to_world(poses[i], found["gt_boxes"][:, [0, 1, 6]])
        expected = to_world(row["now_pose"], stored[:, :3])
        np.testing.assert_allclose(world[:, :2], expected[:, :2], atol=1e-5)
        np.testing.assert_allclose(np.cos(world[:, 2] - expected[:, 2]), 1.0, atol=1e-9)
        np.testing.assert_allclose(found["gt_boxes"][:, 3:5], stored[:, 3:], atol=1e-6)
        height = frame["ego2global_translation"][2] + found["gt_boxes"][:, 2]
        np.testing.assert_allclose(height, row["agent_center_z"][here, step], atol=1e-5)
        of_world = to_world(np.array([0.0, 0.0, poses[i, 2]]), np.pad(found["gt_velocity_3d"][:, :2], ((0, 0), (0, 1))))
        of_now = np.pad(row["agent_velocities"][here, step].astype(float), ((0, 0), (0, 1)))
        np.testing.assert_allclose(
            of_world[:, :2], to_world(np.array([0.0, 0.0, row["now_pose"][2]]), of_now)[:, :2], atol=1e-5
        )


def test_tokens_are_the_log_s_own_where_it_has_names_and_chained() -> None:
    _, human = frames_of("human")
    _, simulated = frames_of("pdm_closed", round=2)
    assert (human[3]["token"], human[11]["token"]) == TOKENS
    assert simulated[3]["token"] == f"{TOKENS[1]}-002" and simulated[3]["scene_token"] == f"{TOKENS[0]}-002"
    assert simulated[3]["log_name"] == f"2021.05.12_veh-35_00005_00204-{TOKENS[0]}-002"
    for frames in (human, simulated):
        tokens = [frame["token"] for frame in frames]
        assert len(set(tokens)) == 12
        assert [frame["sample_prev"] for frame in frames] == [None, *tokens[:-1]]
        assert [frame["sample_next"] for frame in frames] == [*tokens[1:], None]
    one_time = {frame["timestamp"]: frame["token"] for frame in human}
    for frame in simulated:  # 2.5 s .. 8 s after T, the human 1.5 s before .. 4 s after it
        if frame["timestamp"] in one_time:
            assert frame["token"] == one_time[frame["timestamp"]] + "-002", "the two logs name an instant alike"


def test_every_camera_s_picture_is_that_of_the_one_that_looks_its_way(openscene: tuple[Path, ExportSummary]) -> None:
    to, _ = openscene
    (log,) = (to / "navsim_logs/synthetic_reaction_pdm_v1.0-0").iterdir()
    ours = {
        slot: min(YAWS, key=lambda n: abs(np.angle(np.exp(1j * (YAWS[n] - np.deg2rad(d))))))
        for slot, d in YAW_DEG.items()
    }
    assert len(set(ours.values())) == 8
    paths = set()
    for time_s, frame in zip(INSTANTS_S, pickle.loads(log.read_bytes())):
        for name, camera in frame["cams"].items():
            path = to / "sensor_blobs/synthetic_reaction_pdm_v1.0-0" / camera["data_path"]
            assert re.fullmatch(rf"{TOKENS[0]}-000/{name}/[0-9a-f]{{16}}-000\.jpg", camera["data_path"])
            paths.add(path)
            pixels = cv2.imread(str(path))[..., ::-1]
            np.testing.assert_allclose(pixels.mean((0, 1)), colour(ours[name], float(time_s)), atol=3)
            ahead = camera["sensor2lidar_rotation"][:, 2]
            assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(YAWS[ours[name]])
    assert len(paths) == 96


@settings(max_examples=30)
@given(st.floats(-3.1, 3.1), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_on_any_slope_the_public_code_reads_the_heading_and_the_road_s_normal_stays(
    heading: float, pitch: float, roll: float
) -> None:
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    known = np.eye(4)
    known[:3, :3] = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]) @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    matrices, quaternions = poses_in_space(np.array([[5.0, -2.0, heading]]), known[None])
    assert yaw_of(quaternions[0]) == pytest.approx(heading, abs=1e-12)
    np.testing.assert_allclose(matrices[0, :3, 2], known[:3, 2], atol=1e-12)
    w, *v = quaternions[0]
    x, y, z = v
    first = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    np.testing.assert_allclose(matrices[0, :3, 0], first, atol=1e-12)
    up = known[:3, 2]
    assert matrices[0, 2, 3] == pytest.approx(-(5.0 * up[0] - 2.0 * up[1]) / up[2]), "on the plane"


def test_differences_of_a_circle_are_its_speed_and_centripetal_acceleration() -> None:
    speed, radius = 6.0, 20.0
    turned = speed / radius * 0.1 * np.arange(56)
    poses = np.column_stack([radius * np.sin(turned), radius * (1 - np.cos(turned)), turned])
    dynamics, yaw_rates = derivatives(poses)
    np.testing.assert_allclose(dynamics[1:-1, :2], np.tile([speed, 0], (54, 1)), atol=2e-3)
    np.testing.assert_allclose(dynamics[[0, -1], :2], np.tile([speed, 0], (2, 1)), atol=0.05)
    np.testing.assert_allclose(dynamics[:, 2:], np.tile([0, speed**2 / radius], (56, 1)), atol=4e-3)
    np.testing.assert_allclose(yaw_rates, speed / radius, atol=1e-12)


def test_a_log_at_2_hz_has_the_accelerations_of_its_frames() -> None:
    """Between frames it is straight: over single steps a steady braking would come in jerks, five times as hard."""
    speed, braking, heading = 8.0, -1.4, 0.7
    frames_s, steps_s = 0.5 * np.arange(12), 0.1 * np.arange(56)
    way = np.interp(steps_s, frames_s, speed * frames_s + braking / 2 * frames_s**2)
    poses = np.column_stack([np.cos(heading) * way, np.sin(heading) * way, np.full(56, heading)])
    dynamics, _ = derivatives(poses)
    still = np.zeros(12)
    expected = np.column_stack([speed + braking * frames_s, still, still + braking, still])
    np.testing.assert_allclose(dynamics[::5], expected, atol=1e-9)


def test_lights_are_red_or_not_and_keyed_by_numbers() -> None:
    states = np.zeros((3, 56), np.int8)
    states[0, :20], states[1], states[2] = 3, 2, 1
    _, frames = frames_of("human", light_lane_ids=["77", "lane-a", "78"], light_states=states)
    number = connector_number("lane-a")
    assert 0 <= number < 1 << 60 and connector_number("lane-b") != number
    for i, frame in enumerate(frames):
        assert frame["traffic_lights"] == [(77, 5 * i < 20), (number, False), (78, False)]


@pytest.mark.parametrize(("command", "place"), [("left", 0), ("straight", 1), ("right", 2), ("unknown", 3)])
def test_commands_are_one_hot_in_navsim_s_order(command: str, place: int) -> None:
    _, frames = frames_of("human", command=command)
    assert all(frame["driving_command"].tolist() == np.eye(4)[place].tolist() for frame in frames)


def test_a_scene_without_agents_has_empty_boxes_of_the_same_types() -> None:
    none: dict[str, Any] = {"agent_ids": [], "agent_kinds": [], "agent_valid": np.zeros((0, 56), bool)}
    none |= {"agent_boxes": np.zeros((0, 56, 5)), "agent_velocities": np.zeros((0, 56, 2))}
    _, frames = frames_of("human", **none, agent_heights=np.zeros(0), agent_center_z=np.zeros((0, 56)))
    anns = frames[5]["anns"]
    assert anns["gt_boxes"].shape == (0, 7) and anns["gt_velocity_3d"].shape == (0, 3)
    assert anns["gt_names"].dtype.kind == "U" and len(anns["gt_names"]) == len(anns["track_tokens"]) == 0


def test_a_place_that_the_public_code_does_not_know_is_refused_until_it_is_named() -> None:
    row = exported(0, "human", map_location="PIT_city_47896")
    names = sample_names(row, ANY)
    with pytest.raises(CannotExport, match=r"its map is of PIT_city_47896.*give map_location="):
        openscene_frames(row, names, ({},) * 12, ANY)
    named = openscene_frames(row, names, ({},) * 12, ExportSettings(map_location="us-ma-boston"))
    assert {frame["map_location"] for frame in named} == {"us-ma-boston"}
    with pytest.raises(ValueError, match="map_location=town"):
        ExportSettings(map_location="town")

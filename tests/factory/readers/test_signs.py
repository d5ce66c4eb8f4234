"""Calibrations, poses and stamps of another meaning: a reader's clip that has them is refused by what gives it away."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from factory.readers.base import BadClip, camera_sign, motion_sign, read_clip, stamps_sign
from tasks.world.clip import Camera, Clip, SensorFile
from tasks.world.frames import HEADING, VX, X
from tests.factory.readers.test_validate import REF, OneClip, a_clip

Array = NDArray[np.float64]
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # of a camera: x right, y down, z forward


def turned(yaw_deg: float, pitch_deg: float = 0.0, place: tuple[float, float, float] = (1.6, 0.3, 1.5)) -> Array:
    """Pose of a camera that looks yaw to the left and pitch up."""
    (cy, cp), (sy, sp) = (f(np.radians([yaw_deg, pitch_deg])) for f in (np.cos, np.sin))
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = yaw @ pitch @ AHEAD, place
    return pose


def camera(pose: Array, focal: float = 1545.0, size: tuple[int, int] = (1920, 1080)) -> Camera:
    intrinsics = np.array([[focal, 0.0, 960.0], [0.0, focal, 560.0], [0.0, 0.0, 1.0]])
    return Camera("front", *size, intrinsics, np.zeros(5), pose)


def axes(*columns: tuple[int, int, int]) -> Array:
    """The front camera's pose with its own axes renamed."""
    pose = turned(0.0)
    pose[:3, :3] = pose[:3, :3] @ np.array(columns, float).T
    return pose


CAMERAS: dict[str, tuple[Camera, str]] = {
    "the sky": (camera(turned(40.0, 75.0)), "looks at the sky, 75 deg above the horizon"),
    "the ground": (camera(turned(40.0, -80.0)), "looks at the ground, -80 deg above"),
    "axes of the ego": (camera(np.eye(4)), "looks at the sky, 90 deg"),
    "axes of OpenGL": (camera(axes((1, 0, 0), (0, -1, 0), (0, 0, -1))), "image's top is 180 deg off upright"),
    "on its side": (camera(axes((0, 1, 0), (-1, 0, 0), (0, 0, 1))), "image's top is 90 deg off upright"),
    "camera from ego": (camera(np.linalg.inv(turned(0.0))), "its inverse would be right: expected ego from camera"),
    "camera from ego, left": (camera(np.linalg.inv(turned(90.0))), "its inverse would be right"),
    "camera from ego, right": (camera(np.linalg.inv(turned(-90.0, 0.0, (1.3, -0.6, 1.4)))), "its inverse would"),
    "millimetres": (camera(turned(0.0, 0.0, (1600.0, 0.0, 1500.0))), "which it were in millimetres"),
    "centimetres": (camera(turned(0.0, 0.0, (160.0, 0.0, 150.0))), "which it were in centimetres"),
    "a lorry ahead": (camera(turned(0.0, 0.0, (12.0, 0.0, 1.5))), "stands 12.0 m ahead, .* not on the vehicle"),
    "the pavement": (camera(turned(0.0, 0.0, (1.0, -4.0, 1.5))), "-4.0 m left"),
    "under the road": (camera(turned(0.0, 0.0, (1.0, 0.0, -1.5))), "-1.5 m above the rear axle"),
    "in image widths": (camera(turned(0.0), 0.8), r"focal length of 0.8 px .* expected pixels"),
    "another size": (camera(turned(0.0), size=(960, 540)), r"principal point \(960, 560\) px .* of this size"),
}


@pytest.mark.parametrize("kind", CAMERAS)
def test_a_camera_of_another_meaning_is_told_by_its_name(kind: str) -> None:
    wrong, said = CAMERAS[kind]
    with pytest.raises(BadClip, match=rf"clip {REF.clip_id} .*cameras\.front: .*{said}"):
        read_clip(OneClip(replace(a_clip(), cameras=(wrong,))), REF)


def test_cameras_all_around_and_some_way_up_and_down_are_taken() -> None:
    for yaw in range(0, 360, 15):
        for pitch in (-50.0, 0.0, 50.0):
            assert camera_sign(camera(turned(yaw, pitch))) is None
            if np.sin(np.radians(yaw)) > -0.5:  # to the right, a pose and its inverse are much alike
                assert camera_sign(camera(np.linalg.inv(turned(yaw, pitch)))) is not None


def with_states(change: Callable[[Array], Array]) -> Callable[[Clip], Clip]:
    return lambda clip: replace(clip, ego_states=change(clip.ego_states.copy()))


def headings(change: Callable[[Array], Array]) -> Callable[[Array], Array]:
    def changed(states: Array) -> Array:
        states[:, HEADING] = change(states[:, HEADING])
        return states

    return changed


def moved_to(place: tuple[float, float]) -> Callable[[Clip], Clip]:
    """The ego and its poses elsewhere, the map where it was."""

    def changed(clip: Clip) -> Clip:
        states, poses = clip.ego_states.copy(), clip.world_from_ego.copy()
        states[:, :2] += place
        poses[:, :2, 3] += place
        return replace(clip, ego_states=states, world_from_ego=poses)

    return changed


def seen_from(clip: Clip, apart_m: float) -> Clip:
    pose = clip.world_from_ego[10].copy()
    pose[1, 3] += apart_m
    return replace(clip, sweeps=(SensorFile("lidar", "0.pcd", 1.0, pose),))


POSES: dict[str, tuple[Callable[[Clip], Clip], str]] = {
    "compass": (with_states(headings(lambda h: np.pi / 2 - h)), "ego_states: headings are 90 deg off the direction of"),
    "backwards": (with_states(headings(lambda h: h + np.pi)), "headings are 180 deg off .*median of 95 steps"),
    "another frame": (
        moved_to((5000.0, 900.0)),
        r"road_map: the drive \(x 4,988 to 5,064, y 900 to 900 m\) is nowhere",
    ),
    "poses in space elsewhere": (
        lambda clip: replace(clip, world_from_ego=clip.world_from_ego + 500.0 * np.eye(4)[:, [3, 0, 1, 2]].T),
        "world_from_ego: up to 500 m from where ego_states",
    ),
    "a sweep elsewhere": (lambda clip: seen_from(clip, 300.0), r"sweeps\[0\].world_from_ego: up to 300 m"),
}


@pytest.mark.parametrize("kind", POSES)
def test_poses_of_another_meaning_are_told_by_their_field(kind: str) -> None:
    spoil, said = POSES[kind]
    with pytest.raises(BadClip, match=said):
        read_clip(OneClip(spoil(a_clip())), REF)


def test_a_place_ninety_metres_off_the_road_and_a_late_sweep_are_no_other_frame() -> None:
    read_clip(OneClip(moved_to((0.0, 90.0))(a_clip())), REF)
    read_clip(OneClip(seen_from(a_clip(), 5.0)), REF)


def test_a_car_may_reverse_stand_or_creep_but_not_race_backwards() -> None:
    states = a_clip().ego_states.copy()
    for speed in (0.0, 0.5, 3.0):
        states[:, X], states[:, VX] = -speed * 0.1 * np.arange(len(states)), -speed
        assert motion_sign(states) is None
    states[:, X] = -10.0 * 0.1 * np.arange(len(states))
    assert "180 deg" in str(motion_sign(states))
    states[:, X] = 8000.0 * 0.1 * np.arange(len(states))
    assert "8,000 m/s" in str(motion_sign(states))


UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


@pytest.mark.parametrize("apart_s", [0.05, 0.1, 0.5])
@pytest.mark.parametrize("told", UNITS)
@pytest.mark.parametrize("expected", UNITS)
def test_stamps_in_another_unit_are_told_by_their_rate(expected: str, told: str, apart_s: float) -> None:
    stamps = 1_600_000_000 * UNITS[told] + apart_s * UNITS[told] * np.arange(40)
    sign = stamps_sign(stamps, expected)
    assert (sign is None) == (expected == told)
    assert sign is None or (f"were in {told}" in sign and sign.endswith(f"expected {expected}"))


def test_gaps_single_stamps_and_a_slow_clock_are_no_other_unit() -> None:
    seconds = np.array([0.0, 0.1, 0.2, 60.0, 60.1])
    for stamps in (seconds, seconds[:1], seconds[:0], 1.03 * seconds):
        assert stamps_sign(stamps, "s") is None


def test_the_real_rigs_are_taken(shared_root: Path) -> None:
    from factory.datasets.av2.reader import read_cameras

    rig = read_cameras(next((shared_root / "data/av2/sensor").rglob("calibration")).parent)
    assert len(rig) == 9 and not any(map(camera_sign, rig))

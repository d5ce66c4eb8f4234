"""A rig that is not what it is said to be: found, corrected, told. Corners of a drawn street, noise 0.3 px."""

from collections.abc import Sequence
from dataclasses import replace

import drawn_rig
import numpy as np
import pytest
from drawn_rig import cameras, corners_seen, files, straight_on
from scipy.spatial import KDTree

from tasks.render.rig.adjust import motions_of_twists, twists_of
from tasks.render.rig.correct import RigCorrection, correct_rig
from tasks.world.clip import Camera

pytestmark = pytest.mark.slow
NAMES = list(drawn_rig.YAWS_DEG)


def apart(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    (twist,) = twists_of((np.linalg.inv(one) @ other)[None])
    return float(np.linalg.norm(twist[:3])), float(np.degrees(np.linalg.norm(twist[3:])))


def off_by(found: Camera, true: Camera) -> tuple[float, float]:
    return apart(true.ego_from_camera, found.ego_from_camera)


def beside(rig: Sequence[Camera]) -> np.ndarray:
    """The second camera as the first has it: what all share is the ego's frame as well, and priors divide it."""
    return np.asarray(np.linalg.inv(rig[0].ego_from_camera) @ rig[1].ego_from_camera)


def turned(camera: Camera, turn_deg: tuple[float, ...], shift_m: tuple[float, ...]) -> Camera:
    motion = motions_of_twists(np.array([[*shift_m, *np.radians(turn_deg)]]))[0]
    return replace(camera, ego_from_camera=camera.ego_from_camera @ motion)


def correct(said: list[Camera]) -> RigCorrection:
    true, taken = cameras(), files(NAMES)
    found = correct_rig(said, taken, corners_seen(true, taken))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def as_said() -> RigCorrection:
    return correct(cameras())


def test_a_rig_that_is_right_stays(as_said: RigCorrection) -> None:
    for found, true in zip(as_said.cameras, cameras()):
        metres, degrees = off_by(found, true)
        assert metres < 0.01 and degrees < 0.05, (found.name, metres, degrees)
    assert as_said.ego_shift_m < 0.02 and not as_said.strangers
    for change in as_said.changes:
        assert change.corners > 500 and change.after_px < 0.4


def test_a_camera_turned_by_2_degrees_and_moved_by_10_cm_is_put_right() -> None:
    true = cameras()
    said = [turned(c, (1.2, -1.4, 0.8), (0.06, 0.05, -0.06)) if c.name == "left" else c for c in true]
    assert off_by(said[1], true[1]) == pytest.approx((0.0985, 2.01), rel=0.01)
    found = correct(said)
    metres, degrees = apart(beside(true), beside(found.cameras))
    assert metres < 0.01 and degrees < 0.1, (metres, degrees)  # 0.3 cm, 0.01 deg
    assert max(off_by(a, b) for a, b in zip(found.cameras, true)) < (0.05, 0.6)  # 2.8 cm, 0.44 deg
    change = found.changes[1]
    assert np.linalg.norm(change.turn_deg) == pytest.approx(2.01, abs=0.6)
    assert all(np.linalg.norm(other.turn_deg) < 0.6 for other in found.changes if other is not change)
    assert change.before_px > 5.0 and change.after_px < 0.4


def test_a_focal_length_wrong_by_a_pixel_is_found() -> None:
    front, *others = cameras()
    found = correct([replace(front, intrinsics=front.intrinsics + np.diag([1.0, 1.0, 0.0])), *others])
    first, *rest = (np.mean(change.focal_px) for change in found.changes)
    assert first - np.mean(rest) == pytest.approx(-1.0, abs=0.6)  # -1.2: noise leaves half a pixel in 700
    assert found.changes[0].after_px < 0.33


def test_rows_that_are_read_one_after_the_other_are_put_where_the_ego_was() -> None:
    """Within 30 ms at 15 m/s. Straight on at one speed a street that leans explains the photos as well, to 0.01 px."""
    two, taken = ["front", "left"], files(["front", "left"], fast, 0.2)
    true = [replace(camera, readout_s=0.03) for camera in cameras() if camera.name in two]
    corners = corners_seen(true, taken, drive=fast)
    tree = KDTree(drawn_rig.street_points(np.random.Generator(np.random.Philox(key=[0, 7]))))
    off_m = []
    for readout_s in (0.03, 0.0):
        found = correct_rig([replace(c, readout_s=readout_s) for c in true], taken, corners)
        assert found is not None and all(change.after_px < 0.35 for change in found.changes)
        near = np.linalg.norm(found.points[:, :2] - taken[6].world_from_ego[:2, 3], axis=1) < 15.0
        off_m.append(float(np.median(tree.query(found.points[near])[0])))
    by_rows, at_once = off_m
    assert by_rows < 0.05 and at_once > 0.1, off_m  # 0.03 m, 0.14 m: 2 and 10 px at 10 m


def fast(time_s: float) -> np.ndarray:
    return straight_on(time_s, 15.0)


def test_swapped_files_are_named() -> None:
    true, taken = cameras(), files(NAMES)
    corners = corners_seen(true, taken)
    a, b = (i for i, file in enumerate(taken) if file.time_s == 2.5 and file.sensor in ("front", "back"))
    corners[a], corners[b] = corners[b], corners[a]
    found = correct_rig(true, taken, corners)
    assert found is not None and found.strangers == (a, b)


def test_the_same_corners_give_the_same_bytes(as_said: RigCorrection) -> None:
    again = correct(cameras())
    assert again.points.tobytes() == as_said.points.tobytes()
    assert all((a.world_from_ego == b.world_from_ego).all() for a, b in zip(again.files, as_said.files))


def test_photos_that_share_nothing_correct_nothing() -> None:
    taken = files(NAMES)[:12]
    corners = [corners_seen(cameras(), [file], seed=i)[0] for i, file in enumerate(taken)]
    assert correct_rig(cameras(), taken, corners) is None

"""The road where the ego drove: what its wheels stood on, and which corners may be."""

import numpy as np
import pytest

from tasks.render.fit.state import fit_road, height_above_road
from tasks.render.scene.features import AHEAD_M, SPACING_M, WIDE_M, SurfacePoints, driven_road, drop_below_road
from tasks.world.arrays import Array


def drive(n: int, step_m: float, climb: float = 0.0) -> Array:
    """Poses (n, 4, 4) on a road that rises by `climb` per metre and leads to the north-east."""
    ahead = np.array([np.cos(0.8), np.sin(0.8), climb]) / np.hypot(1.0, climb)
    left = np.array([-np.sin(0.8), np.cos(0.8), 0.0])
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = np.stack([ahead, left, np.cross(ahead, left)], axis=1)
    poses[:, :3, 3] = np.array([600.0, 1600.0, 5.0]) + step_m * np.arange(n)[:, None] * ahead
    return poses


@pytest.mark.parametrize("climb", [0.0, 0.08])
def test_it_is_a_strip_of_even_points_on_the_plane_that_the_wheels_stood_on(climb: float) -> None:
    poses = drive(9, 4.0, climb)
    road = driven_road(poses, -0.3)
    local = (road - poses[0, :3, 3]) @ poses[0, :3, :3]
    np.testing.assert_allclose(local[:, 2], -0.3, atol=1e-9)
    assert np.abs(local[:, 1]).max() == pytest.approx(WIDE_M)
    assert local[:, 0].min() == pytest.approx(0.0, abs=1e-9)
    assert local[:, 0].max() == pytest.approx(8 * 4.0 + AHEAD_M, abs=2 * SPACING_M)
    area = (8 * 4.0 + AHEAD_M) * (2 * WIDE_M + SPACING_M)
    assert len(road) == pytest.approx(area / SPACING_M**2, rel=0.02)


def test_where_the_ego_stands_its_poses_count_once() -> None:
    standing = np.repeat(drive(2, 0.001), 50, axis=0)
    assert len(driven_road(standing, 0.0)) == len(driven_road(standing[:1], 0.0))


def test_corners_below_the_road_are_mistakes_and_those_above_or_far_beside_are_not() -> None:
    road = driven_road(drive(2, 4.0), 0.0)
    middle, up = road.reshape(-1, 31, 3)[60, 15], np.array([0.0, 0.0, 1.0])
    beside = middle + np.array([0.0, WIDE_M + 4.0, 0.0])
    far = middle + np.array([0.0, 40.0, 0.0])
    kept = [middle + up, beside - 0.1 * up, far - 9.0 * up]
    dropped = [middle - 0.05 * up, middle - 2.0 * up, beside - up]
    np.testing.assert_allclose(drop_below_road(np.array(kept + dropped), road), kept)


def test_the_fit_s_road_is_the_driven_one_whatever_corners_lie_below_the_cameras() -> None:
    poses = drive(12, 4.0, 0.03)
    road = driven_road(poses, 0.0)
    rng = np.random.default_rng(0)
    below = road[rng.integers(0, len(road), 800)] + rng.uniform([-3, -3, -1.5], [3, 3, 0.6], (800, 3))
    eyes = poses[:, :3, 3] + 1.5 * poses[:, :3, 2]
    surface = fit_road(SurfacePoints(road, drop_below_road(below, road)).every, eyes)
    assert surface is not None
    off = height_above_road(road[: -int(AHEAD_M / SPACING_M) * 31], surface)
    assert np.isfinite(off).all() and np.abs(off).max() < 0.04

"""The road found in lidar points, and Gaussians laid on it."""

import numpy as np
import pytest

from tasks.render.fit.state import LONGEST_M, THICKNESS_M, fit_road, height_above_road, lay_flat
from tasks.render.splatting.gaussians import rotations_of

RNG = np.random.default_rng(0)


def street_points(tilt: float) -> np.ndarray:
    xy = RNG.uniform([-20.0, -12.0], [20.0, 12.0], (30_000, 2))
    ground = np.column_stack([xy, tilt * xy[:, 0] + RNG.normal(0.0, 0.02, len(xy))])
    wall = np.column_stack([RNG.uniform(-20, 20, 8000), np.full(8000, 6.0), RNG.uniform(0.0, 6.0, 8000)])
    car = RNG.uniform([2.0, -5.0, 0.3], [6.0, -3.0, 1.5], (4000, 3))
    return np.concatenate([ground, wall, car])


def test_the_road_is_the_plane_under_wall_and_car() -> None:
    eyes = np.column_stack([np.linspace(-15, 15, 8), np.zeros(8), 1.6 + 0.03 * np.linspace(-15, 15, 8)])
    road = fit_road(street_points(0.03), eyes)
    assert road is not None
    x = RNG.uniform([-12, -4], [12, 4], (200, 2))
    np.testing.assert_allclose(height_above_road(np.column_stack([x, 0.03 * x[:, 0] + 1.0]), road), 1.0, atol=0.03)
    assert np.isnan(height_above_road(np.array([[500.0, 0.0, 0.0]]), road)).all()


def test_without_points_below_the_cameras_there_is_no_road() -> None:
    assert fit_road(np.zeros((0, 3)), np.array([[0.0, 0.0, 1.6]])) is None


def test_road_gaussians_lie_flat_on_the_surface_and_keep_their_heading() -> None:
    eyes = np.column_stack([np.linspace(-15, 15, 8), np.zeros(8), np.full(8, 1.6)])
    road = fit_road(street_points(0.0), eyes)
    assert road is not None
    means = RNG.uniform([-8, -4, -0.3], [8, 4, 0.3], (50, 3)).astype(np.float32)
    quats = RNG.normal(size=(50, 4)).astype(np.float32)
    quats[0] = np.array([np.cos(0.4), 0.0, 0.0, np.sin(0.4)])  # flat already, turned by 0.8 rad
    log_scales = np.full((50, 3), np.log(0.1), np.float32)
    log_scales[1, 0], log_scales[45, 0] = np.log(4.0), np.log(4.0)
    others = means[40:].copy()
    lay_flat(means, quats, log_scales, np.arange(40), road)
    turns = rotations_of(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    assert (np.abs(turns[:40, 2, 2]) > 0.995).all()
    assert (np.abs(height_above_road(means[:40], road)) < 0.021).all()
    assert (log_scales[:40, 2] <= np.log(THICKNESS_M) + 1e-6).all()
    assert np.exp(log_scales[[1, 45, 0], 0]) == pytest.approx([LONGEST_M, 4.0, 0.1])
    assert np.isclose(np.arctan2(turns[0, 1, 0], turns[0, 0, 0]), 0.8, atol=0.05)
    np.testing.assert_array_equal(means[40:], others)

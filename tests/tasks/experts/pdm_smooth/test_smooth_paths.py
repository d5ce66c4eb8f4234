"""Paths of the smooth planner: they begin as the ego moves and end on parallels of the line."""

import math

import numpy as np
import pytest

from tasks.experts.pdm_smooth.paths import bend_speeds, line_ahead, merging_paths, quintic
from tasks.world.vehicle import EGO_STATE_SIZE, HEADING, PACIFICA, STEERING, VX, X, Y

RADIUS_M = 40.0
OFFSETS, MERGES = (0.0, -1.0, 1.0), (3.0, 5.0)


def bend() -> np.ndarray:
    """(P, 3) a left bend of 40 m, points 0.75 m apart, one of them twice as where lanes join."""
    angle = np.arange(0.0, 2.0, 0.75 / RADIUS_M)
    angle = np.insert(angle, 30, angle[30])
    return np.column_stack([RADIUS_M * np.sin(angle), RADIUS_M - RADIUS_M * np.cos(angle), angle])


def beside(angle: float, left_m: float, turned: float, curvature: float, speed: float = 8.0) -> np.ndarray:
    """(11,) an ego that far to the left of the bend and turned that much against it."""
    ego, radius = np.zeros(EGO_STATE_SIZE), RADIUS_M - left_m
    ego[[X, Y]] = radius * math.sin(angle), RADIUS_M - radius * math.cos(angle)
    ego[HEADING], ego[VX], ego[STEERING] = angle + turned, speed, math.atan(curvature * PACIFICA.wheel_base)
    return ego


@pytest.mark.parametrize("left_m", [-1.5, 0.0, 1.5])
@pytest.mark.parametrize(("turned", "curvature"), [(0.0, 1.0 / RADIUS_M), (0.15, -0.03), (-0.2, 0.05)])
def test_every_path_begins_with_the_ego_s_pose_and_curvature_and_ends_on_its_parallel(
    left_m: float, turned: float, curvature: float
) -> None:
    ego = beside(0.5, left_m, turned, curvature)
    line = line_ahead(bend(), ego, 2.0)
    assert line is not None
    paths = merging_paths(line, ego, OFFSETS, MERGES, 10.0)
    assert len(paths.x) == 6
    np.testing.assert_allclose(np.hypot(paths.x[:, 0] - ego[X], paths.y[:, 0] - ego[Y]), 0.0, atol=5e-3)
    np.testing.assert_allclose(paths.heading[:, 0], ego[HEADING], atol=2e-3)
    first = np.diff(paths.heading[:, :2], axis=1)[:, 0] / paths.progress[:, 1]  # the mean over half a metre
    rate = 60.0 * (abs(left_m) + 1.0) / 24.0**3 + 60.0 * abs(turned) / 24.0**2  # of the curvature, about the most
    np.testing.assert_allclose(first, curvature, atol=0.25 * rate + 3e-3)
    aside = RADIUS_M - np.hypot(paths.x, paths.y - RADIUS_M)
    cut = 2.0**2 / (2.0 * RADIUS_M)  # what averaging a circle moves it inwards
    np.testing.assert_allclose(aside[:, -6:].mean(axis=1), np.repeat(OFFSETS, 2) + cut, atol=0.02)


def test_the_polynomial_has_the_values_it_was_made_for_and_its_slope_is_its_derivative() -> None:
    way = np.linspace(0.0, 30.0, 3001)
    d, slope = quintic(way, (1.2, -0.1, 0.02), -0.5, 20.0)
    np.testing.assert_allclose([d[0], slope[0], d[-1], slope[-1]], [1.2, -0.1, -0.5, 0.0])
    np.testing.assert_allclose(np.gradient(d, way)[1:-1], slope[1:-1], atol=2e-4)
    np.testing.assert_allclose((slope[1] - slope[0]) / way[1], 0.02, atol=1e-3)
    half = quintic(np.array([10.0]), (1.0, 0.0, 0.0), 0.0, 20.0)[:, 0]
    np.testing.assert_allclose(half, [0.5, -1.875 / 20.0])  # 1 - 10 s^3 + 15 s^4 - 6 s^5


def test_an_ego_short_of_the_line_is_led_straight_to_it() -> None:
    straight = np.column_stack([np.arange(0.0, 60.0), np.zeros((60, 2))])
    ego = np.zeros(EGO_STATE_SIZE)
    ego[X], ego[VX] = -4.2, 5.0
    line = line_ahead(straight, ego, 2.0)
    assert line is not None
    np.testing.assert_allclose(line.xy[:3], [[-4.2, 0.0], [-3.7, 0.0], [-3.2, 0.0]], atol=1e-9)


def test_hardly_any_line_ahead_is_none() -> None:
    straight = np.column_stack([np.arange(0.0, 60.0), np.zeros((60, 2))])
    ego = np.zeros(EGO_STATE_SIZE)
    for x in (57.5, 59.5, 80.0):
        ego[X] = x
        assert line_ahead(straight, ego, 2.0) is None
    assert line_ahead(straight[:2], np.zeros(EGO_STATE_SIZE), 2.0) is None


def test_bends_are_taken_at_the_bounded_lateral_acceleration_and_slowed_down_for() -> None:
    """20 m straight on, then the bend: sqrt(2 * 40) m/s in it, sqrt(v^2 + 2 b s) before it."""
    straight = np.column_stack([np.arange(-20.0, 0.0, 0.5), np.zeros((40, 2))])
    ego = np.zeros(EGO_STATE_SIZE)
    ego[X], ego[VX] = -20.0, 8.0
    line = line_ahead(np.concatenate([straight, bend()]), ego, 0.5)
    assert line is not None
    paths = merging_paths(line, ego, (0.0,), (3.0,), 10.0)
    speeds = bend_speeds(paths, 2.0, 1.0)[0]
    within = (paths.progress[0] > 23.0) & (paths.progress[0] < 60.0)
    np.testing.assert_allclose(speeds[within], math.sqrt(2.0 * RADIUS_M), rtol=0.02)
    at = np.searchsorted(paths.progress[0], [2.0, 10.0])
    np.testing.assert_allclose(speeds[at], np.sqrt(2.0 * RADIUS_M + 2.0 * (20.0 - paths.progress[0, at])), rtol=0.02)

"""Vocabulary trajectories driven on from the ego's own speed: closed forms, and what stays as it was."""

import numpy as np

from tasks.experts.vocabulary.settings import VocabularySettings
from tasks.experts.vocabulary.trajectories import Moving
from tasks.world.kinematic_vocabulary import kinematic_trajectories
from tasks.world.vehicle import EGO_STATE_SIZE, VX, YAW_RATE
from tasks.world.vocabulary import Vocabulary

T = 0.1 * np.arange(1, 41)


def arc(speed: float, accel: float = 0.0, curvature: float = 0.0) -> np.ndarray:
    """(40, 3) along a circle through the origin, at first along x."""
    way = speed * T + accel * T**2 / 2.0
    heading = curvature * way
    chord = way * np.sinc(heading / (2.0 * np.pi))
    return np.column_stack([chord * np.cos(heading / 2.0), chord * np.sin(heading / 2.0), heading])


def moving(*trajectories: np.ndarray) -> Moving:
    return Moving(Vocabulary(np.stack(trajectories)))


def state(speed: float, yaw_rate: float = 0.0) -> np.ndarray:
    ego = np.zeros(EGO_STATE_SIZE)
    ego[VX], ego[YAW_RATE] = speed, yaw_rate
    return ego


def test_speed_and_yaw_rate_at_the_start_are_exact_for_constant_accelerations() -> None:
    found = moving(arc(8.0, -1.5), arc(5.0, 0.0, 0.04))
    np.testing.assert_allclose(found.speed_mps, [8.0, 5.0], atol=1e-3)  # chords of 0.1 s
    np.testing.assert_allclose(found.yaw_rate_radps, [0.0, 0.2], atol=1e-9)


def test_only_what_starts_within_both_bounds_is_tried() -> None:
    rows = moving(arc(8.0), arc(9.9), arc(10.1), arc(8.0, 0.0, 0.02), arc(8.0, 0.0, 0.03), arc(6.1))
    chosen = VocabularySettings(speed_off_mps=2.0, yaw_rate_off_radps=0.2)
    np.testing.assert_array_equal(rows.starting_like(state(8.0), chosen), [0, 1, 3, 5])
    np.testing.assert_array_equal(rows.starting_like(state(8.0, 0.3), chosen), [3, 4])
    assert len(rows.starting_like(state(25.0), chosen)) == 0


def test_a_start_that_is_off_fades_in_closed_form() -> None:
    rows = moving(arc(8.0), arc(8.0, 0.0, 0.02))
    poses = rows.started_at(9.5, np.array([0, 1]), blend_s=0.8)
    way = 8.0 * T + 1.5 * 0.8 * (1.0 - np.exp(-T / 0.8))
    np.testing.assert_allclose(poses[0], np.column_stack([way, np.zeros((40, 2))]), atol=1e-9)
    np.testing.assert_allclose(poses[1, :, 2], 0.02 * np.minimum(way, 32.0), atol=1e-4)
    radius = np.hypot(poses[1, way < 31.9, 0], poses[1, way < 31.9, 1] - 50.0)
    np.testing.assert_allclose(radius, 50.0, atol=2e-3)  # the same circle


def test_at_its_own_speed_a_trajectory_stays_as_it_is() -> None:
    vocabulary = kinematic_trajectories(60, 3)
    rows = moving(*vocabulary)
    for k in range(60):
        poses = rows.started_at(float(rows.speed_mps[k]), np.array([k]), 1.0)[0]
        np.testing.assert_allclose(poses, vocabulary[k], atol=1e-9)


def test_nobody_drives_backwards_and_who_stands_goes_straight_on() -> None:
    rows = moving(arc(0.0), arc(1.5, -0.37), *kinematic_trajectories(50, 4))
    members = np.arange(52)
    for speed in (0.0, 1.0, 3.0):
        poses = rows.started_at(speed, members, 1.0)
        steps = np.diff(poses[..., :2], axis=1, prepend=0.0)
        middle = np.diff(poses[..., 2], axis=1, prepend=0.0) / 2.0
        heading = poses[..., 2] - middle
        forward = steps[..., 0] * np.cos(heading) + steps[..., 1] * np.sin(heading)
        assert forward.min() > -1e-9
    np.testing.assert_allclose(rows.started_at(2.0, np.array([0]), 1.0)[0, :, 0], 2.0 * (1.0 - np.exp(-T)), atol=1e-12)

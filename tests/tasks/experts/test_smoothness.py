"""Roughness in closed form, and the order it makes."""

import numpy as np

from tasks.experts.smoothness import best_first, roughness
from tasks.world.vehicle import AX, EGO_STATE_SIZE, YAW_RATE


def states(accel: np.ndarray, yaw_rate: np.ndarray) -> np.ndarray:
    out = np.zeros((1, 41, EGO_STATE_SIZE))
    out[0, :, AX], out[0, :, YAW_RATE] = accel, yaw_rate
    return out


def test_roughness_is_the_length_of_jerk_and_yaw_acceleration_in_units_of_extended_comfort_s_limits() -> None:
    t = 0.1 * np.arange(41)
    np.testing.assert_allclose(roughness(states(1.5 * t, -0.4 * t)), [np.hypot(1.5 / 0.5, 0.4 / 0.1)])
    assert roughness(states(np.full(41, 2.0), np.full(41, 0.3))) == 0.0, "steady is not rough, however much of it"


def test_the_seam_counts_in_acceleration_and_not_in_the_unknown_yaw_rate_now() -> None:
    seam = np.where(np.arange(41) == 0, 0.0, 1.0)
    np.testing.assert_allclose(roughness(states(seam, np.zeros(41))), 10.0 / np.sqrt(40.0) / 0.5)
    assert roughness(states(np.zeros(41), seam)) == 0.0


def test_within_a_step_of_the_score_the_smoother_is_first_and_equals_keep_their_order() -> None:
    scores = np.array([0.90, 0.999, 1.0, 0.985, 0.5, 1.0])
    rough = np.array([0.0, 2.0, 3.0, 1.0, 0.0, 3.0])
    np.testing.assert_array_equal(best_first(scores, rough, 0.02), [3, 1, 2, 5, 0, 4])
    np.testing.assert_array_equal(best_first(scores, rough, 1e-9), [2, 5, 1, 3, 0, 4])

"""The data-free vocabulary is a function of (k, seed) and drives like a car."""

import numpy as np

from tasks.world.vocabulary import CURVATURE_MAX_1PM, LATERAL_ACCEL_MAX_MPS2, kinematic_trajectories


def test_equal_seeds_give_equal_trajectories() -> None:
    np.testing.assert_array_equal(kinematic_trajectories(50, 3), kinematic_trajectories(50, 3))
    assert not np.array_equal(kinematic_trajectories(50, 3), kinematic_trajectories(50, 4))


def test_turns_stay_within_the_turning_circle_and_the_lateral_acceleration() -> None:
    poses = kinematic_trajectories(500, 0)
    from_start = np.concatenate([np.zeros((500, 1, 3)), poses], axis=1)
    step = np.diff(from_start, axis=1)
    distance = np.hypot(step[..., 0], step[..., 1])
    # The chord of an arc is a little shorter than the arc itself, hence the small slack.
    assert np.all(np.abs(step[..., 2]) <= CURVATURE_MAX_1PM * distance * 1.001 + 1e-9)
    assert np.all(np.abs(step[..., 2]) * distance / 0.01 <= LATERAL_ACCEL_MAX_MPS2 * 1.001)


def test_nobody_drives_backwards() -> None:
    poses = kinematic_trajectories(500, 0)
    step = np.diff(poses, axis=1)
    forward = step[..., 0] * np.cos(poses[:, :-1, 2]) + step[..., 1] * np.sin(poses[:, :-1, 2])
    assert forward.min() > -1e-3

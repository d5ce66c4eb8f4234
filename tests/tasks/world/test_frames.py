"""SE(2) poses: inverse, invariance, and the corner order that the reward counts on."""

import numpy as np

from tasks.world.frames import box_corners, points_to_local, to_local, to_world, wrap_angle


def random_poses(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return np.concatenate([rng.uniform(-200, 200, (*shape, 2)), rng.uniform(-np.pi, np.pi, (*shape, 1))], axis=-1)


def test_to_local_undoes_to_world() -> None:
    rng = np.random.default_rng(0)
    origin, local = random_poses(rng), random_poses(rng, 7, 5)
    back = to_local(origin, to_world(origin, local))
    assert np.abs(back[..., :2] - local[..., :2]).max() < 1e-10
    assert np.abs(wrap_angle(back[..., 2] - local[..., 2])).max() < 1e-12


def test_a_pose_in_its_own_frame_is_zero_and_ahead_is_plus_x() -> None:
    origin = np.array([3.0, -2.0, 2.1])
    assert np.allclose(to_local(origin, origin), 0.0)
    ahead = origin[:2] + 5.0 * np.array([np.cos(2.1), np.sin(2.1)])
    assert np.allclose(points_to_local(origin, ahead), [5.0, 0.0])


def test_local_poses_do_not_change_when_the_world_is_moved_and_turned() -> None:
    rng = np.random.default_rng(1)
    origin, poses, motion = random_poses(rng), random_poses(rng, 20), random_poses(rng)
    before, after = to_local(origin, poses), to_local(to_world(motion, origin), to_world(motion, poses))
    assert np.abs(before[:, :2] - after[:, :2]).max() < 1e-10
    assert np.abs(wrap_angle(before[:, 2] - after[:, 2])).max() < 1e-12


def test_wrapped_angles_lie_in_the_half_open_interval() -> None:
    angles = np.array([-np.pi, np.pi, 3 * np.pi, 0.0, -7.0])
    wrapped = wrap_angle(angles)
    assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()
    assert np.allclose(np.exp(1j * wrapped), np.exp(1j * angles))


def test_corners_run_front_left_rear_left_rear_right_front_right() -> None:
    box = np.array([10.0, 20.0, np.pi / 2, 4.0, 2.0])  # facing +y: left is -x
    assert np.allclose(box_corners(box), [[9, 22], [9, 18], [11, 18], [11, 22]])

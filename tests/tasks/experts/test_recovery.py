"""The recovery expert: what it retrieves, and that what it makes of it can be driven."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tasks.experts.protocol import Plan
from tasks.experts.recovery import (
    FeasibleSettings,
    RecoveryExpert,
    RecoverySettings,
    RecoveryTable,
    make_feasible,
    start_velocities,
    warped_to_end,
)
from tasks.stages import Rejected
from tasks.world.clip import NOW, Scene
from tasks.world.frames import AX, HEADING, PACIFICA, STEERING, VX, VY, to_local, to_world
from tasks.world.vocabulary import kinematic_trajectories

Road = Callable[..., Scene]
RNG = np.random.default_rng(0)
T = 0.1 * np.arange(1, 41)


def straight(speed: float, accel: float = 0.0) -> np.ndarray:
    return np.stack([speed * T + accel * T**2 / 2.0, np.zeros(40), np.zeros(40)], axis=1)


def start_state(speed: float, accel: float = 0.0, steering: float = 0.0) -> np.ndarray:
    state = np.zeros(11)
    state[VX], state[AX], state[STEERING] = speed, accel, steering
    return state


def motion(trajectory: np.ndarray, state: np.ndarray) -> dict[str, np.ndarray]:
    """Speed, acceleration, jerk and curvature of poses that follow `state` at the origin, by differences."""
    poses = np.concatenate([np.zeros((1, 3)), trajectory])
    step = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    speed = step / 0.1
    accel = np.diff(np.concatenate([[state[VX]], speed])) / np.concatenate([[0.05], np.full(39, 0.1)])
    turn = np.diff(np.unwrap(poses[:, 2]))
    curvature = turn / np.maximum(step, 1e-6)
    return {"speed": speed, "accel": accel[1:], "jerk": np.diff(accel[1:]) / 0.1, "curvature": curvature, "turn": turn}


def test_start_velocities_are_exact_for_constant_acceleration() -> None:
    np.testing.assert_allclose(start_velocities(straight(8.0, -1.5)[None]), [[8.0, 0.0]], atol=1e-12)


def drives(velocity: np.ndarray, accel: np.ndarray, yaw_rate: np.ndarray) -> np.ndarray:
    """(M, 40, 3) constant velocity (M, 2) and acceleration (M, 2) from the origin, headings that turn steadily."""
    xy = velocity[:, None] * T[:, None] + accel[:, None] * T[:, None] ** 2 / 2.0
    return np.concatenate([xy, yaw_rate[:, None, None] * T[:, None]], axis=2)


def test_a_row_is_matched_by_its_velocity_at_the_start_and_its_pose_and_speed_at_four_seconds() -> None:
    """The features by hand: p(t) = v t + a t^2 / 2; the end speed is that of the last 0.2 s, 3.9 s in the mean."""
    rng = np.random.default_rng(0)
    velocity, accel, yaw_rate = rng.uniform(0, 12, (50, 2)), rng.uniform(-2, 2, (50, 2)), rng.uniform(-0.3, 0.3, 50)
    late, ahead = velocity + 3.9 * accel, np.stack([np.cos(4.0 * yaw_rate), np.sin(4.0 * yaw_rate)], axis=1)
    ends = [4.0 * velocity + 8.0 * accel, 4.0 * yaw_rate, (late * ahead).sum(axis=1)]
    expected = np.column_stack([velocity, *ends])
    table = RecoveryTable(drives(velocity, accel, yaw_rate))
    np.testing.assert_allclose(table.features, expected, atol=1e-9)
    assert [table.published(vector + 1e-6) for vector in expected] == list(range(50))
    assert [table.nearest(vector + 1e-6, 3)[0] for vector in expected] == list(range(50))


def ending_at(velocity: tuple[float, float], end: np.ndarray) -> np.ndarray:
    """(40, 3) from a velocity to an end pose (3,), at a constant acceleration."""
    start = np.array([velocity])
    return drives(start, (end[None, :2] - 4.0 * start) / 8.0, end[2:] / 4.0)[0]


def published(rows: np.ndarray, scene: Scene) -> int:
    """The row that the paper's expert follows from this scene, as it is."""
    plan = RecoveryExpert(RecoveryTable(rows), RecoverySettings(match="paper")).plan(scene, RNG)
    assert isinstance(plan, Plan) and plan.goal is None
    found = [np.abs(plan.poses - to_world(scene.ego_state[: HEADING + 1], row)).max() < 1e-9 for row in rows]
    assert sum(found) == 1
    return found.index(True)


def test_the_ego_s_velocity_is_matched_forward_with_forward_and_sideways_with_sideways(road: Road) -> None:
    """Rows that end alike: one starts as the ego moves, one as it would with its two components exchanged."""
    scene = road(speed=10.0)
    states = scene.ego_history.copy()
    states[-1, VY] = 1.5
    scene = replace(scene, ego_history=states)
    goal = to_local(scene.ego_state[: HEADING + 1], scene.clip.ego_states[NOW + 40, : HEADING + 1])
    assert published(np.stack([ending_at(v, goal) for v in ((1.5, 10.0), (10.0, 1.5), (10.0, -1.5))]), scene) == 1


def test_the_goal_is_the_log_s_pose_at_four_seconds_not_a_step_before_or_after(road: Road) -> None:
    scene = road(speed=10.0)
    ends = to_local(scene.ego_state[: HEADING + 1], scene.clip.ego_states[NOW + 39 : NOW + 42, : HEADING + 1])
    assert published(np.stack([ending_at((10.0, 0.0), end) for end in ends]), scene) == 1


def test_end_headings_are_compared_around_the_circle() -> None:
    left, right = straight(5.0), straight(5.0)
    left[:, 2], right[:, 2] = np.pi - 0.05, 2.0
    target = np.array([5.0, 0.0, 20.0, 0.0, -np.pi + 0.05, -5.0])
    table = RecoveryTable(np.stack([right, left]))
    assert (table.published(target), *table.nearest(target, 2)) == (1, 1, 0)


def test_the_nearest_row_is_the_one_with_the_least_sum_of_differences() -> None:
    """One row is 3 m off along the road, the other 2 m along and 2 m aside: 3 against 4, by squares 9 against 8."""
    table = RecoveryTable(
        np.stack([ending_at((5.0, 0.0), np.array([x, y, 0.0])) for x, y in ((23.0, 0.0), (22.0, 2.0))])
    )
    assert table.published(np.array([5.0, 0.0, 20.0, 0.0, 0.0, 0.0])) == 0


def test_what_hardly_differs_in_the_table_counts_the_more() -> None:
    """Ends spread over 100 m and 0.2 rad: 5 m less, or 0.1 rad less? The equation takes the metres for more."""
    rows = np.stack([ending_at((5.0, 0.0), np.array([x, 0.0, a])) for x, a in zip(range(0, 100, 5), 10 * [0.0, 0.2])])
    table = RecoveryTable(rows)
    target = np.array([5.0, 0.0, 50.0, 0.0, 0.2, table.features[10, 5]])
    assert table.published(target) == 10 and rows[10, -1, 2] == 0.0
    assert rows[table.nearest(target, 1)[0], -1, 2] == pytest.approx(0.2)


def test_the_published_expert_drives_as_some_human_did(road: Road) -> None:
    wanted = straight(10.0)
    wanted[:, 1] = -1.2 * (T / 4.0) ** 2 * (3.0 - 2.0 * T / 4.0)  # 1.2 m to the right, where the log is
    assert published(np.stack([straight(10.0), wanted * [1, -1, 1], wanted, straight(4.0)]), road(10.0, y=1.2)) == 2


def test_a_clip_that_ends_before_the_goal_is_refused(road: Road) -> None:
    with pytest.raises(ValueError, match="ends 39 steps after step 56; 40 are needed"):
        RecoveryExpert(RecoveryTable(straight(5.0)[None])).plan(replace(road(), step=56), RNG)


@pytest.mark.parametrize("y", [0.0, 1.2, -1.5])
def test_every_way_back_ends_at_the_log_and_the_log_s_own_comes_first(road: Road, y: float) -> None:
    scene = road(speed=10.0, y=y)
    expert = RecoveryExpert(RecoveryTable(kinematic_trajectories(200, 2)))
    plans = list(expert.plans(scene, RNG))
    log = scene.clip.ego_states[NOW + 1 : NOW + 41]
    assert len(plans) > len(expert.settings.fades_s)
    for plan in plans:
        assert isinstance(plan, Plan) and plan.goal is not None
        assert np.hypot(*(plan.poses[-1, :2] - log[-1, :2])) < 2.0
        assert plan.goal.missed(log[-1, : HEADING + 1], float(log[-1, VX])) is None
    first, quick = plans[0], plans[1]
    assert isinstance(first, Plan) and isinstance(quick, Plan)
    aside = [np.abs(np.asarray(plan.poses)[14, 1] - log[14, 1]) for plan in (first, quick)]
    assert aside[1] <= aside[0] <= max(abs(y), 1e-6), "after 1.5 s the one that fades within 1.5 s is nearer"


def test_from_far_ahead_of_a_log_that_goes_slower_there_is_no_way_back(road: Road) -> None:
    """12 m ahead at 10 m/s of a log that does 4 m/s: it would have to stop within 4 m."""
    scene = road(speed=4.0)
    states = scene.ego_history.copy()
    states[:, 0] += 12.0
    states[:, VX] = 10.0
    ahead = replace(scene, ego_history=states)
    found = list(RecoveryExpert(RecoveryTable(kinematic_trajectories(200, 2))).plans(ahead, RNG))
    assert [made.reason for made in found if isinstance(made, Rejected)] == ["out_of_reach"] and len(found) == 1
    assert "m/s off the log" in found[0].detail


def test_a_trajectory_that_is_led_to_an_end_starts_as_it_did() -> None:
    end = np.array([31.0, -2.0, 0.0])
    led = warped_to_end(straight(8.0), end)
    np.testing.assert_allclose(led[-1], end, atol=1e-3)
    slope = np.gradient(led[:, 1], led[:, 0])
    np.testing.assert_allclose(led[1:-1, 2], np.arctan(slope)[1:-1], atol=1e-2, err_msg="it looks where it goes")
    np.testing.assert_allclose(led[:4], straight(8.0)[:4], atol=0.03)
    np.testing.assert_allclose(warped_to_end(straight(8.0), straight(8.0)[-1]), straight(8.0), atol=1e-12)


def test_a_drivable_trajectory_stays_as_it_is() -> None:
    for speed, accel in ((10.0, 0.0), (6.0, 1.2), (12.0, -2.0), (0.0, 0.0)):
        wanted = straight(speed, accel)
        np.testing.assert_allclose(make_feasible(wanted, start_state(speed, accel)), wanted, atol=0.02)


@pytest.mark.parametrize(("speed", "accel", "steering"), [(8.0, 0.0, 0.0), (3.0, 1.0, 0.1), (13.0, -1.5, -0.03)])
def test_limits_hold_from_the_actual_start_state(speed: float, accel: float, steering: float) -> None:
    limits = FeasibleSettings()
    state = start_state(speed, accel, steering)
    for wanted in kinematic_trajectories(40, 5):
        result = make_feasible(wanted, state)
        assert not isinstance(result, str), result
        found = motion(result, state)
        fast = found["speed"] > 1.0
        assert (found["speed"] > -1e-2).all()
        assert (found["accel"] > limits.accel_min_mps2 - 0.05).all()
        assert (found["accel"] < limits.accel_max_mps2 + 0.05).all()
        assert (np.abs(found["jerk"]) < limits.jerk_max_mps3 + 0.3).all()
        kappa0 = np.tan(steering) / PACIFICA.wheel_base
        assert (np.abs(found["curvature"][fast]) < max(limits.curvature_max_1pm, abs(kappa0)) + 0.01).all()
        assert (np.abs(found["turn"] / 0.1) < max(limits.yaw_rate_max_radps, abs(kappa0) * speed) + 0.05).all()
        assert abs(found["speed"][0] - speed - 0.05 * accel) < 0.05, "it starts with the speed it has"


def test_it_comes_back_to_the_reference_after_a_wrong_start() -> None:
    result = make_feasible(straight(8.0), start_state(9.5, 0.0, 0.02))
    assert not isinstance(result, str)
    assert np.hypot(*(result[-1, :2] - straight(8.0)[-1, :2])) < 0.5
    assert abs(result[-1, 2]) < 0.02


def test_a_start_that_breaks_a_limit_itself_still_has_a_plan() -> None:
    for state in (start_state(10.0, -6.0), start_state(0.3, -3.0), start_state(15.0, 3.5), start_state(4.0, 0.0, 0.9)):
        assert not isinstance(make_feasible(straight(8.0), state), str)


def test_the_same_problem_gives_the_same_bits() -> None:
    wanted = kinematic_trajectories(3, 9)
    first = make_feasible(wanted[0], start_state(7.0))
    make_feasible(wanted[1], start_state(2.0))
    np.testing.assert_array_equal(make_feasible(wanted[0], start_state(7.0)), first)


def test_a_motion_that_no_limits_allow_is_a_rejection_and_never_the_raw_trajectory(road: Road) -> None:
    impossible = RecoverySettings(feasible=FeasibleSettings(jerk_max_mps3=-1.0))
    result = RecoveryExpert(RecoveryTable(kinematic_trajectories(50, 2)), impossible).plan(road(y=1.0), RNG)
    assert isinstance(result, Rejected)
    assert (result.stage, result.reason) == ("expert", "no_plan")
    assert "longitudinal QP" in result.detail


def test_the_digest_knows_the_table_and_the_settings() -> None:
    table, other = RecoveryTable(kinematic_trajectories(5, 0)), RecoveryTable(kinematic_trajectories(5, 1))
    digests = {
        RecoveryExpert(table).digest(),
        RecoveryExpert(other).digest(),
        RecoveryExpert(table, RecoverySettings(match="paper")).digest(),
        RecoveryExpert(table, RecoverySettings(retrieved=1)).digest(),
    }
    assert len(digests) == 4
    assert RecoveryExpert(table).digest() == RecoveryExpert(RecoveryTable(kinematic_trajectories(5, 0))).digest()

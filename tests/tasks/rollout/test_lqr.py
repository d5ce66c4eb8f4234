"""The tracker follows plans a car can drive, whatever the frame, and gives each plan the same states in any batch."""

import numpy as np
import pytest

from tasks.rollout.lqr import track
from tasks.world.frames import AX, HEADING, STEERING, VX, X, Y

TIMES_S = 0.1 * np.arange(1, 41)


def ego_at(x: float, y: float, heading: float, speed: float) -> np.ndarray:
    state = np.zeros(11)
    state[[X, Y, HEADING, VX]] = x, y, heading, speed
    return state


def arc(speed: float, curvature: float) -> np.ndarray:
    turn = speed * curvature * TIMES_S
    return np.stack([np.sin(turn) / curvature, (1.0 - np.cos(turn)) / curvature, turn], axis=-1)


def test_a_standing_ego_with_a_standing_plan_does_not_move():
    states = track(ego_at(5.0, -3.0, 1.2, 0.0), np.tile([5.0, -3.0, 1.2], (1, 40, 1)))
    np.testing.assert_allclose(states[0, :, :3], np.tile([5.0, -3.0, 1.2], (41, 1)), atol=1e-12)


def test_a_plan_to_stand_still_brings_the_ego_to_rest():
    brake = np.minimum(TIMES_S, 2.0)
    plan = np.stack([6.0 * brake - 1.5 * brake**2, np.zeros(40), np.zeros(40)], axis=-1)
    states = track(ego_at(0.0, 0.0, 0.0, 6.0), plan[None])
    assert abs(states[0, -1, VX]) < 0.3
    assert states[0, :, AX].min() > -6.0


def test_an_arc_is_followed_within_half_a_metre_and_steers_to_its_curvature():
    start = ego_at(0.0, 0.0, 0.0, 6.0)
    start[STEERING] = np.arctan(3.089 * 0.05)
    states = track(start, arc(6.0, 0.05)[None])
    assert np.hypot(*(states[0, 1:, :2] - arc(6.0, 0.05)[:, :2]).T).max() < 0.5
    np.testing.assert_allclose(np.tan(states[0, -1, STEERING]) / 3.089, 0.05, rtol=0.1)


def test_no_plans_give_no_states():
    assert track(np.zeros(11), np.zeros((0, 40, 3))).shape == (0, 41, 11)


def test_read_only_and_strided_plans_are_driven_as_they_are():
    plans = np.repeat(arc(9.0, -0.04)[None], 6, axis=0)
    plans[:, :, 1] += 0.1 * np.arange(6)[:, None]
    expected = track(ego_at(0.0, 0.0, 0.0, 9.0), plans, local=True)
    strided = np.asfortranarray(plans)[::2]
    plans.flags.writeable = False
    assert np.array_equal(track(ego_at(0.0, 0.0, 0.0, 9.0), plans, local=True), expected)
    assert np.array_equal(track(ego_at(0.0, 0.0, 0.0, 9.0), strided, local=True), expected[::2])


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("ego_state0", {"ego_state0": np.zeros(10)}),
        ("ego_state0", {"ego_state0": np.full(11, np.nan)}),
        ("poses", {"poses": np.zeros((40, 3))}),
        ("poses", {"poses": np.zeros((2, 41, 3))}),
        ("poses", {"poses": np.full((2, 40, 3), np.inf)}),
        ("planned_pose0", {"planned_pose0": np.zeros((1, 3))}),
        ("planned_pose0", {"planned_pose0": np.zeros(3)}),
        ("planned_pose0", {"planned_pose0": np.full((2, 3), np.nan)}),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_name(field: str, change: dict[str, np.ndarray]):
    good = {"ego_state0": np.zeros(11), "poses": np.zeros((2, 40, 3)), "planned_pose0": np.zeros((2, 3))}
    with pytest.raises(ValueError, match=f"^{field} must"):
        track(**(good | change))


def test_a_bad_value_is_named_with_its_place():
    trajectories = np.zeros((5, 40, 3))
    trajectories[3, 7, 1] = np.nan
    with pytest.raises(ValueError, match=r"trajectories must be finite and at most 1e\+08, element \[3, 7, 1\] is not"):
        track(np.zeros(11), trajectories, local=True)


def test_states_go_where_they_are_wanted_and_nowhere_else():
    plans, ego = np.stack([arc(6.0, curvature) for curvature in (0.01, 0.05, -0.05)]), ego_at(0.0, 0.0, 0.0, 6.0)
    into = np.full((4, 41, 11), 7.0)
    assert np.array_equal(track(ego, plans, local=True, out=into[1:]), track(ego, plans, local=True))
    assert np.array_equal(into[1:], track(ego, plans, local=True)) and (into[0] == 7.0).all()
    for wrong in (into, into[1:3], np.zeros((41, 3, 11)).swapaxes(0, 1)):
        with pytest.raises(ValueError, match="out must be contiguous"):
            track(ego, plans, local=True, out=wrong)

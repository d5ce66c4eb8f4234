"""PDM-Closed on a straight road, where its proposals are known in closed form (docs/reward.md 4)."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tasks.experts.pdm_closed import SPEED_FRACTIONS, PdmClosed, forecast, idm_step, plan_for, proposals
from tasks.experts.protocol import Plan
from tasks.stages import Rejected
from tasks.world.clip import AgentKind, AgentTracks, Scene
from tasks.world.frames import PACIFICA

Road = Callable[..., Scene]
Objects = Callable[..., AgentTracks]
RNG = np.random.default_rng(0)
CAR = (4.5, 1.9)


def test_a_proposal_brakes_for_a_tenth_of_a_second_and_then_follows_the_model_on_the_road_it_sees(
    road: Road,
) -> None:
    start, limit, fractions = 8.0, 10.0, np.array(SPEED_FRACTIONS)
    speed = plan_for(road(speed=start, limit=limit)).proposals.progress_velocity[:5, :, 1]
    np.testing.assert_allclose(speed[:, 1], start - 0.3, atol=1e-12)
    gap = 400.0 - 50.0 - 0.1 * start - PACIFICA.half_length  # to the end of the route
    wanted = 1.0 + 7.7 * 1.5 + 7.7 * 7.7 / (2.0 * np.sqrt(1.5 * 3.0))
    accel = 1.5 * (1.0 - (7.7 / (fractions * limit)) ** 10 - (wanted / gap) ** 2)
    np.testing.assert_allclose(speed[:, 2], 7.7 + 0.1 * np.clip(accel, -3.0, 1.5), atol=1e-12)


def test_a_stop_before_an_oncoming_car_overshoots(road: Road, objects: Objects) -> None:
    near = np.array([1.0, -10.0, 0.0])  # at the least gap: the hardest braking, 0.3 m/s in a step
    np.testing.assert_allclose(idm_step(0.0, 0.2, near, 15.0), [0.02, -0.1], atol=1e-12)
    scene = road(speed=3.0, agents=objects([[85.0, 0.0, np.pi, *CAR]], [8.0], [AgentKind.VEHICLE]))
    assert plan_for(scene).proposals.progress_velocity[..., 1].min() < 0.0


def test_idm_keeps_the_speed_where_the_closed_form_says_so() -> None:
    speed, target = 8.0, 15.0
    wanted = 1.0 + speed * 1.5
    gap = wanted / np.sqrt(1.0 - (speed / target) ** 10)  # equal speeds: dv/dt = 0 at this gap
    after = idm_step(3.0, speed, np.array([3.0 + gap, speed, 0.0]), target)
    np.testing.assert_allclose(after, [3.8, speed], atol=1e-12)


def test_a_red_light_is_a_standing_lead_and_running_it_scores_nothing(road: Road) -> None:
    red, green = plan_for(road(speed=10.0, red=True)), plan_for(road(speed=10.0, red=False))
    assert (red.proposals.poses[:, 50, 0] + PACIFICA.front_length < 100.0).all()
    assert (green.proposals.poses[4, 50, 0]) > 90.0
    fast = plan_for(road(speed=22.0, red=True))  # 46 m at 3 m/s2 is too short: it cannot stop any more
    assert (fast.scores.tlc == 0.0).all()
    assert (fast.scores.pdm_score == 0.0).all()


def test_an_ego_that_stands_within_the_red_connector_is_not_held_by_it(road: Road) -> None:
    inside = road(speed=0.0, red=True)
    history = inside.ego_history.copy()
    history[:, 0] += 60.0 - PACIFICA.rear_axle_to_center
    inside = replace(inside, ego_history=history)
    assert plan_for(inside).proposals.poses[4, 50, 0] > 115.0


def test_of_equally_good_proposals_the_first_is_the_plan(road: Road, objects: Objects) -> None:
    """Behind a car that stands nobody gets 5 m far, so that progress is the same for all who keep the rules."""
    blocked = road(speed=0.5, agents=objects([[59.0, 0.0, 0.0, CAR[0], 12.0]], [0.0], [AgentKind.VEHICLE]))
    plan = plan_for(blocked)
    best = np.flatnonzero(plan.scores.pdm_score == plan.scores.pdm_score.max())
    assert len(best) > 1 and plan.chosen == best[0]


def test_the_plan_is_the_first_best_proposal_and_sees_nothing_of_the_future(road: Road, objects: Objects) -> None:
    scene = road(agents=objects([[80.0, 0.0, 0.0, *CAR]], [6.0], [AgentKind.VEHICLE]))
    plan = plan_for(scene)
    assert plan.chosen == int(np.argmax(plan.scores.pdm_score))
    result = PdmClosed().plan(scene, RNG)
    assert isinstance(result, Plan)
    np.testing.assert_array_equal(result.poses, plan.proposals.poses[plan.chosen, 1:41])

    boxes = scene.agents.boxes.copy()
    boxes[scene.step + 1 :] = np.nan
    valid = scene.agents.valid.copy()
    valid[scene.step + 1 :] = False
    blind = replace(scene, agents=replace(scene.agents, boxes=boxes, valid=valid))
    np.testing.assert_array_equal(plan_for(blind).poses, result.poses)


def test_a_free_proposal_inherits_the_velocity_of_a_slower_ones_lead() -> None:
    # A cyclist cuts into the path after 2 s: ahead of the slow proposals, behind the fast ones, which drive freely.
    ego = np.zeros(11)
    ego[3] = 12.0
    line = np.stack([np.linspace(-20, 300, 321), np.zeros(321), np.zeros(321)], axis=1)
    heading, speed = -1.2, 5.0
    cyclist = AgentTracks(
        ("a",),
        (AgentKind.BICYCLE,),
        np.array([[[17.0, 12.0, heading, 1.5, 0.6]]]),
        speed * np.array([[[np.cos(heading), np.sin(heading)]]]),
        np.ones((1, 1), bool),
        np.zeros((1, 1)),
        np.ones(1),
    )
    seen = forecast(ego, cyclist)
    leads = proposals(ego, line, seen, None).leads[:5, :41]
    free = leads[..., 2] > 0.0
    inherited = leads[..., 1][free]
    np.testing.assert_allclose(inherited[inherited != 0.0], speed * np.cos(heading), atol=1e-12)
    assert (inherited != 0.0).any()
    assert (leads[0][free[0]][:, 1] == 0.0).all(), "the slowest of a path inherits nothing"


def test_a_route_without_length_is_a_rejection(road: Road) -> None:
    scene = replace(road(), centerline=np.zeros((3, 3)))
    result = PdmClosed().plan(scene, RNG)
    assert isinstance(result, Rejected)
    assert (result.stage, result.reason) == ("expert", "no_plan")
    with pytest.raises(ValueError, match="length"):
        plan_for(scene)


def test_a_speed_limit_of_zero_is_an_error_and_not_a_division(road: Road) -> None:
    with pytest.raises(ValueError, match=r"speed_limit_mps: 0\.0 m/s cannot be driven"):
        plan_for(road(limit=0.0))

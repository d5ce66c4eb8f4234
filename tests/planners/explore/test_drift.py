"""Where drivers drift to, against closed forms and the closed loop of `planners drive`."""

from dataclasses import dataclass

import numpy as np
import pytest

from planners.drive.drivers import DriveEnd, MakeSample
from planners.drive.eyes import NoEyes
from planners.drive.loop import LoopSettings, drive
from planners.drive.starts import lengthened
from planners.explore.drift import CLIP_STEPS, NO_PLAN, Drifted, Handover, Judging, drift, from_the_log, ways_of
from tasks.experts.pdm_closed.settings import PdmSettings
from tasks.perturb import PerturbSettings
from tasks.rollout.lqr import track
from tasks.rollout.settings import TrafficSettings
from tasks.settings import ExpertGate
from tasks.world.clip import HORIZON_STEPS, NOW, Clip, Scene, scene_of_clip
from tests.planners.drive.streets import Steady, car, nobody, start_on, street_with

JUDGING = Judging(PerturbSettings(), TrafficSettings(), PdmSettings(), ExpertGate())
CLOSED, OPEN = Handover(0.0, True), Handover(0.0, False)


def long(clip: Clip) -> Clip:
    return lengthened(clip, CLIP_STEPS)


def came(clip: Clip, way: Handover, speed_mps: float, turn_rad: float = 0.0) -> Drifted:
    found = drift(long(clip), way, Steady(speed_mps, turn_rad), NoEyes(), JUDGING)
    assert isinstance(found, Drifted), found
    return found


def test_the_ways_are_the_closed_loops_in_order_and_then_the_open_one() -> None:
    ways = ways_of(True, (0.0, 1.5))
    assert list(map(str, ways)) == ["closed loop from 0.0 s", "closed loop from 1.5 s", "open loop from 0.0 s"]
    assert ways_of(False, (0.0,)) == (CLOSED,)


@pytest.mark.parametrize("way", [CLOSED, OPEN, Handover(3.0, True)])
def test_who_drives_as_the_log_ends_where_the_log_does_and_fails_nothing(way: Handover) -> None:
    found = came(street_with(nobody()), way, 8.0)
    np.testing.assert_allclose(found.end_pose, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.ego_states[:, :3], street_with(nobody()).ego_states[NOW : NOW + 41, :3], atol=1e-6)
    assert found.there.fails == ""
    assert found.there.score == pytest.approx((9.0 + 5.0 * found.there.subscores["ep"]) / 14.0)


def test_the_closed_loop_is_that_of_planners_drive() -> None:
    """Among the same traffic, as long as nothing ends the drive."""
    clip, settings = street_with(car(40.0, 7.0)), LoopSettings(seconds=5.0, bound_m=1000.0)
    driven = drive(start_on(clip, settings), Steady(6.5), settings)
    np.testing.assert_array_equal(came(clip, CLOSED, 6.5).ego_states, driven.ego_states[:41])


def test_the_open_loop_is_one_plan_tracked_to_its_end() -> None:
    clip = street_with(nobody())
    scene = scene_of_clip(clip)
    plan = Steady(6.0).plan(scene, dict)
    assert not isinstance(plan, DriveEnd)
    np.testing.assert_array_equal(came(clip, OPEN, 6.0).ego_states, track(scene.ego_state, plan[None])[0])


def test_until_it_is_handed_over_a_drive_is_the_log_and_the_later_the_less_it_drifts() -> None:
    clip = street_with(nobody())
    drifts = [came(clip, Handover(after_s, True), 6.0) for after_s in (0.0, 1.0, 2.0, 3.0)]
    for after, found in enumerate(drifts):
        start = NOW + 10 * after
        np.testing.assert_array_equal(found.ego_states[: 10 * after + 1], clip.ego_states[NOW : start + 1])
        assert found.ego_states.shape == (41, 11)
    behind = [found.end_pose[0] for found in drifts]
    assert behind == sorted(behind) and -8.0 < behind[0] < -4.0 and behind[-1] < -0.3


def test_a_planner_fails_from_where_it_then_hits_somebody() -> None:
    """A car stands 60 m ahead: at 8 m/s it is reached after T+H, and nobody has touched it before."""
    found = came(street_with(car(60.0)), CLOSED, 8.0)
    assert (found.there.fails, found.there.score, found.there.subscores["nc"]) == ("nc", 0.0, 0.0)
    log = from_the_log(long(street_with(car(60.0))), Steady(8.0), NoEyes(), JUDGING)
    assert not isinstance(log, str) and log.subscores["nc"] == 1.0


def test_a_drive_from_the_log_is_judged_over_the_first_four_seconds() -> None:
    found = from_the_log(long(street_with(car(25.0))), Steady(8.0), NoEyes(), JUDGING)
    assert not isinstance(found, str)
    assert (found.fails, found.score) == ("nc", 0.0)


@pytest.mark.parametrize(
    ("speed_mps", "turn_rad", "gate"), [(1.0, 0.0, "longitudinal"), (8.0, 0.03, "lateral"), (8.0, 0.6, "longitudinal")]
)
def test_what_drifts_beyond_the_perturbation_s_gates_is_no_drift(speed_mps: float, turn_rad: float, gate: str) -> None:
    assert drift(long(street_with(nobody())), CLOSED, Steady(speed_mps, turn_rad), NoEyes(), JUDGING) == gate


@dataclass(frozen=True)
class GivesUp:
    """Has a plan until a step of the clip."""

    last_step: int
    needs_pictures: bool = False

    def plan(self, scene: Scene, look: MakeSample) -> np.ndarray | DriveEnd:
        return Steady(8.0).plan(scene, look) if scene.step < self.last_step else DriveEnd.NO_PLAN


@pytest.mark.parametrize("last_step", [NOW, NOW + 10, NOW + HORIZON_STEPS, NOW + HORIZON_STEPS + 20])
def test_who_has_no_plan_on_the_way_is_no_drift(last_step: int) -> None:
    assert drift(long(street_with(nobody())), CLOSED, GivesUp(last_step), NoEyes(), JUDGING) == NO_PLAN

"""The closed loop against closed forms: how long a drive is, who drives it, and from where."""

from dataclasses import replace

import numpy as np
import pytest

from planners.drive.drivers import HumanDriver, make_driver
from planners.drive.loop import LoopSettings, drive
from planners.drive.starts import logged_start
from planners.evaluation.planner_names import find_planner
from tasks.settings import TrafficSettings
from tasks.world.clip import NOW
from tasks.world.frames import PACIFICA, VX, X, Y
from tests.planners.drive.streets import Steady, car, nobody, start_on, street_with
from tests.tasks.streets import moved, street_clip

LONG = LoopSettings(seconds=60.0)  # as long as the log
CONSTANT_VELOCITY = make_driver(find_planner("constant_velocity"))


def test_constant_velocity_keeps_its_speed() -> None:
    """At 8 m/s for the 8 s of the log."""
    made = drive(start_on(street_with(nobody()), LONG), CONSTANT_VELOCITY, LONG)
    assert (made.n_steps, len(made.plans)) == (80, 16)
    np.testing.assert_allclose(made.ego_states[:, X], 0.8 * np.arange(81), atol=1e-5)
    assert np.abs(made.ego_states[:, Y]).max() < 1e-6


@pytest.mark.parametrize(("seconds", "steps"), [(0.517, 5), (1.016, 5), (1.017, 10), (2.3, 20), (5.5, 50)])
def test_a_drive_is_as_long_as_whole_plans_fit_into_its_seconds(seconds: float, steps: int) -> None:
    settings = LoopSettings(seconds)
    made = drive(start_on(street_with(nobody()), settings), CONSTANT_VELOCITY, settings)
    assert (made.n_steps, len(made.plans)) == (steps, steps // 5)


def test_reactive_traffic_stops_behind_an_ego_that_stands_and_a_replayed_log_runs_into_it() -> None:
    start = start_on(street_with(car(-30.0, 8.0), speed_mps=0.0), LONG)
    front = {
        mode: drive(start, Steady(0.0), replace(LONG, traffic=TrafficSettings(mode=mode))).agents.boxes[-1, 0, 0] + 2.3
        for mode in ("idm", "replay")
    }
    assert front["idm"] < -PACIFICA.rear_length < 0.0 < front["replay"]


def test_the_human_drives_as_its_log() -> None:
    clip = street_with(nobody())
    made = drive(start_on(clip, LONG), HumanDriver(), LONG)
    assert np.abs(made.ego_states[:, [X, Y]] - clip.ego_states[NOW:, [X, Y]]).max() < 0.05


def test_pdm_closed_keeps_clear_of_who_stands_ahead() -> None:
    pdm = make_driver(find_planner("pdm_closed"))
    made = drive(start_on(street_with(car(50.0)), LONG), pdm, LONG)
    assert made.ego_states[-1, VX] < 2.0
    assert made.ego_states[-1, X] + PACIFICA.front_length < 50.0 - 2.3


def test_drives_of_the_nonlinear_controller_are_their_own_and_each_begins_anew() -> None:
    """A plan at 4 m/s of a car at 8: the linear one brakes otherwise."""
    nonlinear = replace(LONG, controller="nonlinear")
    first, again, linear = (
        drive(start_on(street_with(nobody()), settings), Steady(4.0), settings)
        for settings in (nonlinear, nonlinear, LONG)
    )
    assert first.ego_states.tobytes() == again.ego_states.tobytes()
    assert 0.01 < np.abs(first.ego_states - linear.ego_states)[:, X].max() < 5.0
    assert first.ego_states[-1, VX] == pytest.approx(4.0, abs=0.05)


def test_from_a_perturbed_start_the_plans_are_followed_at_once() -> None:
    """From the log its first 0.5 s at 8 m/s are driven whatever is planned."""
    start = start_on(street_with(nobody()), LONG)
    aside = replace(start, number=0, candidate_index=7)
    speeds = [drive(one, Steady(0.0), LONG).ego_states[:6, VX] for one in (start, aside)]
    assert (speeds[0] == 8.0).all()
    assert speeds[1][0] == 8.0 and (np.diff(speeds[1]) < 0.0).all()


def test_the_same_start_is_driven_to_the_same_bytes() -> None:
    first, second = (drive(start_on(street_clip(), LONG), CONSTANT_VELOCITY, LONG) for _ in range(2))
    assert first.ego_states.tobytes() == second.ego_states.tobytes()
    assert first.agents.boxes.tobytes() == second.agents.boxes.tobytes()


def test_a_drive_does_not_depend_on_where_the_world_lies() -> None:
    here = drive(start_on(street_with(car(50.0)), LONG), CONSTANT_VELOCITY, LONG)
    turned = moved(street_with(car(50.0)), np.array([300.0, -80.0, 2.1]))
    there = drive(start_on(turned, LONG), CONSTANT_VELOCITY, LONG)
    apart = [np.hypot(*(one.ego_states[:, [X, Y]] - one.ego_states[0, [X, Y]]).T) for one in (here, there)]
    np.testing.assert_allclose(*apart, atol=1e-6)


def test_a_clip_that_is_too_short_is_refused() -> None:
    with pytest.raises(ValueError, match="must have 656 steps, not 96"):
        drive(logged_start(street_clip()), CONSTANT_VELOCITY, LONG)


@pytest.mark.parametrize("seconds", [0.1, 601.0, np.nan])
def test_settings_that_bound_no_drive_are_refused(seconds: float) -> None:
    with pytest.raises(ValueError, match="seconds"):
        LoopSettings(seconds)

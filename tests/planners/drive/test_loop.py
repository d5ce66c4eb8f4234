"""The closed loop against closed forms: what ends a drive, when, and what it is measured by."""

from dataclasses import replace

import numpy as np
import pytest

from planners.drive.drivers import DriveEnd, HumanDriver, make_driver
from planners.drive.loop import LoopSettings, drive, measure_drive
from planners.drive.starts import logged_start
from planners.evaluation.planner_names import find_planner
from tasks.settings import PdmSettings, TrafficSettings
from tasks.world.clip import NOW
from tasks.world.frames import PACIFICA, VX, X, Y
from tests.planners.drive.streets import FAR, Steady, car, nobody, start_on, street_with
from tests.tasks.streets import moved, street_clip

REPLAY = replace(FAR, traffic=TrafficSettings(mode="replay"))
CONSTANT_VELOCITY = make_driver(find_planner("constant_velocity"), PdmSettings())


def test_constant_velocity_drives_a_straight_road_to_its_end() -> None:
    """At 8 m/s from 0 to where the front bumper is at 300 m, the first of steps of 0.8 m that is not short of it."""
    made = drive(start_on(street_with(nobody()), FAR), CONSTANT_VELOCITY, FAR)
    assert made.ended is DriveEnd.ROAD_END
    assert made.n_steps == np.ceil((300.0 - PACIFICA.front_length) / 0.8) == 370
    found = measure_drive(made)
    assert found.distance_m == pytest.approx(296.0, abs=1e-6)
    assert (found.route_completed, found.comfortable, found.collision, found.off_road_m) == (1.0, 1.0, False, 0.0)


def test_a_standing_vehicle_ahead_is_hit_at_the_closed_form_time() -> None:
    """Its rear is at 50 - 2.3 m; the bumper, 4.049 m before the axle, is first there after 55 steps of 0.8 m."""
    made = drive(start_on(street_with(car(50.0)), FAR), CONSTANT_VELOCITY, FAR)
    assert made.ended is DriveEnd.COLLISION
    assert made.n_steps == np.ceil((47.7 - PACIFICA.front_length) / 0.8) == 55
    assert made.hit is not None
    assert (made.hit.track_id, made.hit.at_fault, round(made.hit.speed_mps, 6)) == ("car", True, 8.0)
    assert measure_drive(made).at_fault_collision


def test_who_is_run_into_from_behind_is_not_at_fault() -> None:
    """A car that replays its log at 8 m/s, its front at -30 + 2.3 m, is first at the rear bumper after 34 steps."""
    made = drive(start_on(street_with(car(-30.0, 8.0), speed_mps=0.0), REPLAY), Steady(0.0), REPLAY)
    assert made.ended is DriveEnd.COLLISION
    assert made.n_steps == np.ceil((30.0 - 2.3 - PACIFICA.rear_length) / 0.8) == 34
    assert made.hit is not None and not made.hit.at_fault
    found = measure_drive(made)
    assert found.collision and not found.at_fault_collision and found.failures == 0


def test_reactive_traffic_stops_behind_an_ego_that_stands() -> None:
    made = drive(start_on(street_with(car(-30.0, 8.0), speed_mps=0.0), FAR), Steady(0.0), FAR)
    assert made.ended is DriveEnd.TIME
    assert made.agents.boxes[-1, 0, 0] + 2.3 < -PACIFICA.rear_length


def test_traffic_goes_on_when_its_log_has_ended() -> None:
    """A car that drives ahead at 9 m/s is ahead still after 20 s, twice as long as its log: it left with nothing."""
    settings = LoopSettings(seconds=20.0, bound_m=1000.0)
    made = drive(start_on(street_with(car(20.0, 9.0)), settings), Steady(5.0), settings)
    assert made.n_steps == 200
    assert made.agents.valid[:, 0].all()
    assert made.agents.boxes[-1, 0, 0] - made.agents.boxes[-11, 0, 0] > 5.0


def test_the_known_world_ends_a_bound_away_from_where_the_log_was() -> None:
    """The log's last place is 64 m ahead: with 30 m more the first step beyond is at 94.4 m."""
    settings = LoopSettings()
    made = drive(start_on(street_with(nobody()), settings), CONSTANT_VELOCITY, settings)
    assert made.ended is DriveEnd.SCENE_END
    assert made.ego_states[-1, X] == pytest.approx(94.4, abs=1e-6)
    assert made.road.length_m == 94.0
    assert measure_drive(made).route_completed == 1.0


def test_time_is_up_after_so_many_seconds() -> None:
    settings = LoopSettings(seconds=2.3)
    made = drive(start_on(street_with(nobody()), settings), CONSTANT_VELOCITY, settings)
    assert (made.ended, made.n_steps, len(made.plans)) == (DriveEnd.TIME, 23, 5)


def test_the_human_drives_as_its_log_and_ends_with_it() -> None:
    clip = street_with(nobody())
    made = drive(start_on(clip, FAR), HumanDriver(), FAR)
    assert (made.ended, made.n_steps) == (DriveEnd.LOG_END, 80)
    assert np.abs(made.ego_states[:, [X, Y]] - clip.ego_states[NOW:, [X, Y]]).max() < 0.05


def test_pdm_closed_keeps_clear_of_who_stands_ahead() -> None:
    settings = LoopSettings(seconds=12.0, bound_m=1000.0)
    made = drive(
        start_on(street_with(car(50.0)), settings), make_driver(find_planner("pdm_closed"), PdmSettings()), settings
    )
    assert made.ended is DriveEnd.TIME
    assert made.ego_states[-1, VX] < 0.5


def test_leaving_the_road_is_one_event_and_ends_nothing() -> None:
    """The road's right edge is 3.5 m to the right, and the body 1.15 m wide on that side."""
    settings = LoopSettings(seconds=5.0, bound_m=1000.0)
    made = drive(start_on(street_with(nobody()), settings), Steady(8.0, turn_rad=-0.15), settings)
    found = measure_drive(made)
    assert found.off_road_events == found.failures == 1
    first = int(np.argmax(made.off_road))
    assert made.ego_states[first, Y] < -1.0
    assert made.off_road[first:].all()
    assert found.off_road_s == pytest.approx(0.1 * (made.n_steps - first + 1))
    assert 0.0 < found.off_road_m < found.distance_m


def test_braking_hard_is_uncomfortable_while_it_lasts() -> None:
    settings = LoopSettings(seconds=10.0, bound_m=1000.0)
    made = drive(start_on(street_with(nobody()), settings), Steady(0.0), settings)
    assert 0.1 < measure_drive(made).comfortable < 0.99


def test_the_same_start_is_driven_to_the_same_bytes() -> None:
    settings = LoopSettings(seconds=6.0, bound_m=1000.0)
    first, second = (drive(start_on(street_clip(), settings), CONSTANT_VELOCITY, settings) for _ in range(2))
    assert first.ego_states.tobytes() == second.ego_states.tobytes()
    assert first.agents.boxes.tobytes() == second.agents.boxes.tobytes()


def test_a_drive_does_not_depend_on_where_the_world_lies() -> None:
    settings = LoopSettings(seconds=6.0, bound_m=1000.0)
    here = drive(start_on(street_with(car(50.0)), settings), CONSTANT_VELOCITY, settings)
    turned = moved(street_with(car(50.0)), np.array([300.0, -80.0, 2.1]))
    there = drive(start_on(turned, settings), CONSTANT_VELOCITY, settings)
    assert (here.ended, here.n_steps) == (there.ended, there.n_steps)
    assert np.abs(here.along_m - there.along_m).max() < 1e-6


def test_who_touches_the_ego_from_the_start_on_is_no_collision() -> None:
    """As in the public log replay; the ego drives away from it."""
    settings = LoopSettings(seconds=4.0, bound_m=1000.0)
    made = drive(start_on(street_with(car(-2.0)), settings), CONSTANT_VELOCITY, settings)
    assert made.ended is DriveEnd.TIME


def test_a_clip_that_is_too_short_is_refused() -> None:
    with pytest.raises(ValueError, match="must have 661 steps, not 96"):
        drive(logged_start(street_clip()), CONSTANT_VELOCITY, FAR)


@pytest.mark.parametrize(("name", "value"), [("seconds", 0.1), ("bound_m", 0.0), ("bound_m", np.inf)])
def test_settings_that_bound_no_drive_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        LoopSettings(**{name: value})

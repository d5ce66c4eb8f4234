"""The second after a drive: how the ego goes on, and whom it hits then, in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.attempt import BRAKING_MPS2, extrapolate, hit_after_s
from tasks.reward.epdms import prepare_scene
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, AgentKind, Scene, scene_of_clip
from tasks.world.frames import HEADING, PACIFICA, STEERING, VX, YAW_RATE, X, Y, to_world
from tests.tasks.rollout import worlds
from tests.tasks.rollout.worlds import Track
from tests.tasks.streets import moved, street_clip

Array = NDArray[np.float64]
END_X_M = 8.0 * 4.0  # the street's ego drives 8 m/s along y = 0 and is at the origin at T
FRONT_M = PACIFICA.front_length
PEDESTRIAN = {"kind": AgentKind.PEDESTRIAN, "size": (0.6, 0.6)}


def drive(speed_mps: float = 8.0, steering: float = 0.0, start_x: float = 0.0) -> Array:
    """(41, 11) along y = 0 at constant speed; the steering angle is that of the last row."""
    states = np.zeros((HORIZON_STEPS + 1, 11))
    states[:, X] = start_x + speed_mps * STEP_S * np.arange(HORIZON_STEPS + 1)
    states[:, VX], states[-1, STEERING] = speed_mps, steering
    return states


def test_straight_on_it_keeps_its_speed_or_brakes_to_a_stand() -> None:
    t = STEP_S * np.arange(1, 11)
    np.testing.assert_allclose(extrapolate(drive())[41:, X], END_X_M + 8.0 * t)
    np.testing.assert_array_equal(extrapolate(drive())[:41], drive())
    braking = extrapolate(drive(), 3.0)[41:]
    np.testing.assert_allclose(braking[:, X], END_X_M + 8.0 * t - 1.5 * t**2)
    np.testing.assert_allclose(braking[:, VX], 8.0 - 3.0 * t)
    short = extrapolate(drive(1.5), 3.0)[41:]
    np.testing.assert_allclose(short[5:, X], 6.0 + 1.5**2 / 6.0)  # stands after half a second: v^2 / 2 b
    np.testing.assert_allclose(short[5:, VX], 0.0, atol=1e-15)
    back = extrapolate(drive(-0.3), 3.0)[41:]
    np.testing.assert_allclose(back[:, X], -1.2 - 0.3**2 / 6.0)
    np.testing.assert_array_equal(extrapolate(drive(0.0), 3.0)[41:, X], 0.0)


@pytest.mark.parametrize("braking", [0.0, 3.0])
@pytest.mark.parametrize("steering", [-0.5, 0.02, 0.6])
def test_it_stays_on_the_circle_of_its_steering_angle(braking: float, steering: float) -> None:
    """Radius wheel base / tan(steering), and the arc is as long as the way straight on; against tiny Euler steps."""
    states = extrapolate(drive(6.0, steering), braking)
    radius = PACIFICA.wheel_base / math.tan(steering)
    after = states[41:]
    np.testing.assert_allclose(np.hypot(after[:, X] - 24.0, after[:, Y] - radius), abs(radius))
    np.testing.assert_allclose(after[:, HEADING] * radius, extrapolate(drive(6.0), braking)[41:, X] - 24.0)
    np.testing.assert_allclose(after[:, YAW_RATE] * radius, after[:, VX])
    x, y, heading, speed, dt = 24.0, 0.0, 0.0, 6.0, 1e-4
    for _ in range(round(1.0 / dt)):
        x, y = x + dt * speed * math.cos(heading), y + dt * speed * math.sin(heading)
        heading, speed = heading + dt * speed / radius, speed - dt * braking
    np.testing.assert_allclose(after[-1, [X, Y, HEADING, VX]], [x, y, heading, speed], atol=2e-3)


def scene_with(*members: Track) -> Scene:
    """The street at T, with these tracks alone."""
    clip = street_clip()
    return scene_of_clip(replace(clip, agents=worlds.tracks(*members)))


def hits(scene: Scene, states: Array, braking: float = 0.0, mode: str = "idm") -> float:
    """Seconds to the hit after a drive from the scene."""
    traffic = prepare_traffic(scene, TrafficSettings(mode=mode))  # type: ignore[arg-type]
    return hit_after_s(traffic, prepare_scene(scene, roll_out(traffic, states).agents), states, braking)


def ahead_of_the_end(gap_m: float, **options: object) -> Track:
    """Something 1 m long whose near side is so far ahead of where the bumper ends, standing."""
    return Track(END_X_M + FRONT_M + gap_m + 0.5, **{"size": (1.0, 1.0)} | options)  # type: ignore[arg-type]


@pytest.mark.parametrize("gap_m", [0.3, 1.1, 4.1, 7.5])
def test_what_stands_ahead_is_hit_when_the_gap_is_driven(gap_m: float) -> None:
    scene = scene_with(ahead_of_the_end(gap_m))
    assert hits(scene, drive()) == pytest.approx(STEP_S * math.ceil(gap_m / 0.8))
    way = 8.0 * STEP_S * np.arange(11) - 1.5 * (STEP_S * np.arange(11)) ** 2
    expected = STEP_S * np.argmax(way >= gap_m) if way[-1] >= gap_m else math.inf
    assert hits(scene, drive(), BRAKING_MPS2) == pytest.approx(expected)


def test_nobody_is_hit_beyond_a_second_nor_from_a_stand() -> None:
    assert hits(scene_with(ahead_of_the_end(8.1)), drive()) == math.inf
    assert hits(scene_with(Track(FRONT_M + 0.3 + 2.3)), drive(0.0)) == math.inf
    assert hits(scene_with(), drive()) == math.inf


def test_things_count_as_road_users_do_and_who_touches_the_ego_at_the_end_does_not() -> None:
    assert hits(scene_with(ahead_of_the_end(1.1, kind=AgentKind.TRAFFIC_CONE)), drive()) == pytest.approx(0.2)
    assert hits(scene_with(ahead_of_the_end(-0.1)), drive()) == math.inf
    both = scene_with(ahead_of_the_end(-0.1), ahead_of_the_end(2.0))
    assert hits(both, drive()) == pytest.approx(0.3)


def test_who_runs_into_the_ego_from_behind_or_its_side_is_to_blame_as_nc_has_it() -> None:
    """Log replay, so that nobody brakes for it."""
    behind = Track(END_X_M - PACIFICA.rear_length - 3.0 - 2.3 - 4.0 * 14.0, speed=14.0)
    assert hits(scene_with(behind), drive(), mode="replay") == math.inf
    beside = -PACIFICA.half_width - 0.3 - 4.0 * 1.5  # at whose end a walker touches the ego's side
    walker = Track(END_X_M + FRONT_M + 2.2, beside - 1.0, np.pi / 2, 1.5, **PEDESTRIAN)  # type: ignore[arg-type]
    assert hits(scene_with(walker), drive(), mode="replay") == math.inf  # against the door, after 0.7 s
    sooner = replace(walker, y=beside)
    assert hits(scene_with(sooner), drive(), mode="replay") == pytest.approx(0.3)  # before the bumper


def test_a_car_that_brakes_for_the_ego_is_not_the_one_that_is_hit() -> None:
    """It comes to a stand in the ego's way in replay; among reacting traffic it follows its own lane's leader."""
    way = np.minimum(0.8 * (np.arange(96) - NOW), 33.0)  # stops at x = 18 + 33
    stops = Track(0.0, poses=np.column_stack([18.0 + way - 6.0, 0.0 * way, 0.0 * way]))
    scene = scene_with(stops)
    assert hits(scene, drive(), mode="replay") < math.inf
    assert hits(scene, drive()) == math.inf


def test_moving_the_world_moves_the_hit_along() -> None:
    origin = np.array([310.0, -95.0, 2.2])
    scene = scene_with(ahead_of_the_end(2.0))
    there = scene_of_clip(moved(scene.clip, origin))
    states = drive()
    states_there = states.copy()
    states_there[:, :3] = to_world(origin, states[:, :3])
    assert hits(there, states_there) == hits(scene, states) == pytest.approx(0.3)

"""The joint rollout as claims: who moves, who waits, and that nothing jumps."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from tasks.rollout.lane_following import logged_path
from tasks.rollout.simulate import TrafficSettings, next_scene, prepare_traffic, roll_out, simulate
from tasks.world.clip import CLIP_STEPS, NOW, STEP_S, AgentKind, AgentTracks, Rollout, Scene, scene_of_clip
from tasks.world.frames import PACIFICA, box_corners
from tasks.world.road_map import LightState, TrafficLights
from tests.tasks.rollout import worlds
from tests.tasks.rollout.worlds import Track
from tests.tasks.streets import moved

IDM = TrafficSettings()
PLAIN = TrafficSettings(yields=False)  # whoever is driven wants to go at its target speed


def run(scene: Scene, settings: TrafficSettings = IDM) -> Rollout:
    return simulate(scene, worlds.straight_plan(scene), settings)


def overlap_area(agents: AgentTracks, i: int, j: int) -> float:
    """Largest shared area [m2] over all steps."""
    both = agents.valid[:, i] & agents.valid[:, j]
    a, b = (shapely.polygons(box_corners(agents.boxes[both, k])) for k in (i, j))
    return float(shapely.area(shapely.intersection(a, b)).max(initial=0.0))


def test_a_car_alone_accelerates_towards_the_target_speed_on_its_lane() -> None:
    rollout = run(worlds.scene(worlds.straight_road(), Track(0.0, speed=5.0)), PLAIN)
    speed = rollout.agents.velocities[:, 0, 0]
    assert rollout.simulated.tolist() == [True]
    assert (np.diff(speed) > 0).all() and 8.0 < speed[-1] < 9.0
    assert rollout.agents.boxes[:, 0, 1] == pytest.approx(0.0, abs=1e-9)
    moved = np.diff(rollout.agents.boxes[:, 0, 0])
    assert moved == pytest.approx(STEP_S * 0.5 * (speed[1:] + speed[:-1]), abs=1e-6)


def test_the_lanes_speed_limit_replaces_the_default_target() -> None:
    road = {"road": replace(worlds.straight_road()["road"], speed_limit_mps=4.0)}
    speed = run(worlds.scene(road, Track(0.0, speed=4.0))).agents.velocities[:, 0, 0]
    assert speed == pytest.approx(4.0, abs=1e-6)


def test_a_follower_stops_behind_a_standing_car_with_the_minimum_gap() -> None:
    """Two rollouts long: it never touches, and settles about min_gap_m behind."""
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=8.0), Track(32.0))
    first = run(scene, PLAIN)
    second = run(next_scene(scene, first, scene.centerline), PLAIN)
    boxes = np.concatenate([first.agents.boxes, second.agents.boxes[1:]])
    gap = boxes[:, 1, 0] - boxes[:, 0, 0] - worlds.CAR[0]
    assert gap.min() > 0.9 and gap[-1] < 4.0
    assert first.simulated.tolist() == [True, False]
    assert (boxes[:, 1] == scene.agents.boxes[NOW, 1]).all()


def test_the_ego_is_for_others_what_a_car_of_its_size_about_its_true_centre_is() -> None:
    size = (PACIFICA.length, PACIFICA.width)
    parked = Track(30.0 + PACIFICA.rear_axle_to_center, 0.0, 0.0, 0.0, AgentKind.VEHICLE, size)
    behind = Track(0.0, speed=8.0)
    ego = run(worlds.scene(worlds.straight_road(), behind, ego=(30.0, 0.0, 0.0)))
    car = run(worlds.scene(worlds.straight_road(), behind, parked))
    np.testing.assert_allclose(ego.agents.boxes[:, 0], car.agents.boxes[:, 0], atol=1e-9)


def test_who_was_driven_once_stays_so_also_where_a_later_rollout_drives_others() -> None:
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=8.0), Track(40.0, speed=8.0), Track(80.0, speed=8.0))
    before = replace(scene, ever_simulated=np.array([True, False, False]))
    rollout = replace(run(scene), simulated=np.array([False, True, False]))
    after = next_scene(before, rollout, scene.centerline)
    assert after.ever_simulated is not None and after.ever_simulated.tolist() == [True, True, False]


def test_who_would_be_driven_later_is_not_when_the_rollout_is_left_before() -> None:
    """A car that waits at a junction until its log starts, 2 s from now."""
    waits = np.column_stack([np.full(CLIP_STEPS, 20.0), np.zeros(CLIP_STEPS), np.zeros(CLIP_STEPS)])
    waits[NOW + 20 :, 0] += 0.8 * np.arange(CLIP_STEPS - NOW - 20)
    scene = worlds.scene(worlds.straight_road(), Track(0.0, poses=waits))
    states, traffic = run(scene).ego_states, prepare_traffic(scene, IDM)
    assert roll_out(traffic, states).simulated.tolist() == [True]
    assert roll_out(traffic, states, 5).simulated.tolist() == [False]


def test_a_car_leaves_its_first_segment_and_takes_the_fork_its_log_takes() -> None:
    turn = np.column_stack([np.linspace(28.5, 60, 30), np.zeros(30), np.zeros(30)])
    arc = np.radians(np.linspace(0, 90, 30))
    bend = np.column_stack([60 + 12 * np.sin(arc), 12 - 12 * np.cos(arc), arc])
    out = np.column_stack([np.full(36, 72.0), np.linspace(12, 40, 36), np.full(36, np.pi / 2)])
    logged = np.concatenate([turn, bend, out])
    assert len(logged) == CLIP_STEPS
    scene = worlds.scene(worlds.fork(), Track(0.0, poses=logged))
    turning = run(next_scene(scene, run(scene), scene.centerline)).agents.boxes[-1, 0]
    assert turning[0] == pytest.approx(72.0, abs=0.3) and turning[1] > 15.0
    assert turning[2] == pytest.approx(np.pi / 2, abs=0.05)


def test_without_a_log_beyond_the_fork_the_straightest_way_is_taken() -> None:
    scene = worlds.scene(worlds.fork(), Track(40.0, speed=9.0, last=NOW))
    rollout = run(scene)
    assert rollout.agents.valid[:, 0].all(), "a driven car goes on when its log ends"
    assert rollout.agents.boxes[-1, 0, 0] > 70.0 and abs(rollout.agents.boxes[-1, 0, 1]) < 0.05


def test_a_car_slows_down_before_a_curve() -> None:
    turn = {k: v for k, v in worlds.fork().items() if k != "ahead"}
    turn["in"] = replace(turn["in"], successors=("left",))
    scene = worlds.scene(turn, Track(38.0, speed=10.0, last=NOW))
    speed = np.hypot(*run(scene).agents.velocities[:, 0].T)
    assert speed.min() < 7.0  # sqrt(3 m/s2 * 12 m) = 6 m/s
    assert np.diff(speed).min() > -0.45


def red_until(step: int) -> TrafficLights:
    states = np.full((CLIP_STEPS, 1), LightState.GREEN, np.int8)
    states[:step] = LightState.RED
    return TrafficLights(("ahead",), states)


def test_a_red_light_stops_and_a_green_one_lets_go() -> None:
    def nose(until: int) -> float:
        scene = worlds.scene(worlds.fork(), Track(30.0, speed=7.0, last=NOW), lights=red_until(until))
        return float(run(scene).agents.boxes[-1, 0, 0] + worlds.CAR[0] / 2.0)

    assert 50.0 < nose(CLIP_STEPS) < 60.0
    assert nose(0) > 60.0
    assert nose(CLIP_STEPS) < nose(NOW + 20)


def test_a_stop_at_a_junction_that_only_the_log_explains_is_kept() -> None:
    """The log stops at x = 55 (nose 57.3, entry at 60) from 2 s after T on: a light the map does not have."""
    way = np.minimum(55.0, 55.0 - 8.0 * STEP_S * (NOW + 20 - np.arange(CLIP_STEPS)))
    scene = worlds.scene(worlds.fork(), Track(0.0, poses=np.column_stack([way, 0 * way, 0 * way])))
    first = run(scene, PLAIN)
    last = run(next_scene(scene, first, scene.centerline), PLAIN).agents.boxes[-1, 0, 0]
    assert 52.0 < last < 58.0


def test_a_car_that_stands_starts_no_sooner_than_in_its_log_and_keeps_its_box_to_the_bit() -> None:
    way = np.maximum(0.0, (np.arange(CLIP_STEPS) - NOW - 20) * STEP_S * 5.0)
    scene = worlds.scene(worlds.straight_road(), Track(0.0, poses=np.column_stack([way, 0 * way, 0 * way])))
    boxes = run(scene).agents.boxes[:, 0]
    assert (boxes[:20] == boxes[0]).all() and boxes[-1, 0] > 1.0


def test_a_parked_car_stays_and_one_off_the_lanes_replays() -> None:
    scene = worlds.scene(worlds.straight_road(), Track(10.0, 2.2), Track(0.0, 40.0, speed=5.0))
    rollout = run(scene)
    assert rollout.simulated.tolist() == [False, False]
    assert (rollout.agents.boxes[:, 0] == scene.agents.boxes[NOW, 0]).all()
    assert np.array_equal(rollout.agents.boxes[:, 1], scene.agents.boxes[NOW : NOW + 41, 1])


WAITING_CAR = Track(57.0, speed=1.0)  # driven: creeps up to the ego ahead and stays across x = 58
BEHIND_EGO = (63.6, 0.0, 0.0)


def test_a_car_that_crosses_off_the_lanes_replays_to_the_bit_until_it_must_brake_for_a_driven_car() -> None:
    crossing = Track(58.0, -30.0, np.pi / 2, 8.0)
    scene = worlds.scene(worlds.straight_road(), WAITING_CAR, crossing, ego=BEHIND_EGO)
    rollout = run(scene)
    agents, logged = rollout.agents, scene.agents.boxes[NOW : NOW + 41, 1]
    late = int(np.argmax((agents.boxes[:, 1] != logged).any(axis=1)))
    assert 10 < late < 30 and rollout.simulated.tolist() == [True, True]
    speed = agents.velocities[:, 1, 1]
    assert np.diff(speed).min() > -IDM.emergency_decel * STEP_S - 1e-9 and speed[-1] < 3.0
    assert agents.boxes[:, 1, 0] == pytest.approx(58.0, abs=1e-6)
    assert overlap_area(agents, 0, 1) == 0.0
    assert overlap_area(replace(agents, boxes=np.stack([agents.boxes[:, 0], logged], axis=1)), 0, 1) > 1.0
    second = run(next_scene(scene, rollout, scene.centerline))
    assert overlap_area(second.agents, 0, 1) == 0.0 and second.agents.velocities[-1, 1, 1] < 0.1


def test_a_car_that_touches_a_driven_one_does_not_drive_through_it() -> None:
    scene = worlds.scene(worlds.straight_road(), WAITING_CAR, Track(58.0, -3.0, np.pi / 2, 3.0), ego=BEHIND_EGO)
    y = run(scene).agents.boxes[:, 1, 1]
    assert y[-1] < -3.0 + 3.0 * STEP_S + 3.0**2 / (2.0 * IDM.emergency_decel) + 0.1  # stopped, one step late
    assert -np.diff(y, 2).min() < IDM.emergency_decel * STEP_S**2 + 1e-9


def test_a_replayed_car_waits_neither_for_the_ego_nor_for_a_driven_car_beside_its_way() -> None:
    beside = Track(20.0, speed=8.0)
    scene = worlds.scene(worlds.straight_road(), beside, Track(80.0, -20.0, np.pi / 2, 8.0), ego=(79.0, 0.0, 0.0))
    rollout = run(scene)
    assert rollout.simulated.tolist() == [True, False]
    assert np.array_equal(rollout.agents.boxes[:, 1], scene.agents.boxes[NOW : NOW + 41, 1])


@pytest.mark.parametrize("settings", [IDM, PLAIN, *(TrafficSettings(mode=mode) for mode in ("replay", "navsim"))])
@pytest.mark.parametrize("kind", [AgentKind.PEDESTRIAN, AgentKind.BICYCLE])
def test_nobody_on_foot_or_on_a_bicycle_waits_for_the_ego(settings: TrafficSettings, kind: AgentKind) -> None:
    """As every page says: they walk their log through an ego that stands on their way."""
    walker = Track(0.0, kind=kind, size=(0.6, 0.6), poses=walk(14.0, -3.6, 1.0))
    scene = worlds.scene(worlds.straight_road(), walker, ego=(13.0, 0.0, 0.0))
    agents = run(scene, settings).agents
    assert np.array_equal(agents.boxes[:, 0], scene.agents.boxes[NOW : NOW + 41, 0])
    assert np.hypot(agents.boxes[:, 0, 0] - 14.4, agents.boxes[:, 0, 1]).min() < 0.5, "it meets the ego's body"


def test_a_log_is_a_path_unless_it_stands_or_reverses() -> None:
    along = np.arange(0.0, 30.0, 0.4)
    track = np.column_stack([along, 0.05 * (-1.0) ** np.arange(75), 0 * along, 0.1 * along, np.full(75, 4.0)])
    path = logged_path(track, 50.0)
    assert path is not None and np.hypot(*np.diff(path.xy, axis=0).T) == pytest.approx(0.5, abs=0.01)
    assert np.abs(path.xy[:, 1]).max() < 0.3 and path.xy[-1, 0] == pytest.approx(50.0, abs=0.6)
    assert path.height == pytest.approx(0.1 * np.clip(path.xy[:, 0], 0.0, 29.6), abs=0.2)
    reversing = track.copy()
    reversing[:, 2] = np.pi
    for none in (reversing, track[:2], track[:0]):
        assert logged_path(none, 50.0) is None


def test_a_parked_car_hidden_at_first_appears_where_the_log_sees_it_even_near_the_ego() -> None:
    scene = worlds.scene(worlds.straight_road(), Track(10.0, 2.2, first=NOW + 5, last=NOW + 8), ego=(0.0, 0.0, 0.0))
    agents = run(scene).agents
    assert agents.valid[:, 0].tolist() == [False] * 5 + [True] * 36
    assert (agents.boxes[5:, 0] == scene.agents.boxes[NOW + 5, 0]).all()


def test_a_driven_car_follows_the_height_of_its_lane() -> None:
    edge = np.array([[-100.0, 0.0, -5.0], [500.0, 0.0, 25.0]])  # 5 % uphill
    road = {"road": replace(worlds.straight_road()["road"], left_boundary=edge, right_boundary=edge)}
    agents = run(worlds.scene(road, Track(0.0, speed=8.0))).agents
    rise = agents.center_z[:, 0] - agents.center_z[0, 0]
    assert rise == pytest.approx(0.05 * (agents.boxes[:, 0, 0] - agents.boxes[0, 0, 0]), abs=0.03)


def test_an_entering_car_waits_for_room_and_enters_driven_else_never() -> None:
    def entry(ego_x: float) -> Rollout:
        return run(worlds.scene(worlds.straight_road(), Track(0.0, speed=8.0, first=NOW + 10), ego=(ego_x, 0.0, 0.0)))

    free = entry(200.0)
    assert not free.agents.valid[:10, 0].any() and free.agents.valid[10:, 0].all() and free.simulated[0]
    assert free.agents.boxes[10, 0, 0] == pytest.approx(8.0)
    # The ego stands 25 m behind the place of first sight: the car enters once its log is 30 m away.
    waits = entry(8.0 - 25.0)
    first = int(np.argmax(waits.agents.valid[:, 0]))
    assert first > 10 and waits.agents.boxes[first, 0, 0] + 17.0 - 1.461 >= 30.0
    assert not entry(20.0).agents.valid.any()


def test_a_pedestrian_waits_for_a_driven_car_and_then_goes_on_late() -> None:
    """It crosses at x = 14 just when a car is there whose driver does not look (no lookahead)."""
    walker = Track(14.0, kind=AgentKind.PEDESTRIAN, size=(0.6, 0.6), poses=walk(14.0, -3.6, 1.0))
    scene = worlds.scene(worlds.straight_road(), Track(-6.0, speed=8.0), walker)
    agents = run(scene, replace(PLAIN, lookahead_m=0.01)).agents
    by_log = agents.boxes.copy()
    by_log[:, 1] = scene.agents.boxes[NOW : NOW + 41, 1]
    assert overlap_area(replace(agents, boxes=by_log), 0, 1) > 0.05
    assert overlap_area(agents, 0, 1) == 0.0
    y = agents.boxes[:, 1, 1]
    assert y[-1] < by_log[-1, 1, 1] - 0.2 and y[-1] > y[25] + 0.3


def walk(x: float, y: float, speed: float) -> np.ndarray:
    """(96, 3) poses of one who walks along +y and is at (x, y) at NOW."""
    way = y + speed * STEP_S * (np.arange(CLIP_STEPS) - NOW)
    return np.column_stack([np.full(CLIP_STEPS, x), way, np.full(CLIP_STEPS, np.pi / 2)])


def test_replay_returns_the_log_bit_for_bit() -> None:
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=5.0), Track(30.0, speed=1.0, first=40, last=60))
    rollout = run(scene, TrafficSettings(mode="replay"))
    for name in ("boxes", "velocities", "valid", "center_z"):
        assert np.array_equal(
            getattr(rollout.agents, name), getattr(scene.agents, name)[NOW : NOW + 41], equal_nan=name != "valid"
        )
    assert not rollout.simulated.any()


def busy_scene() -> Scene:
    members = [
        Track(0.0, 0.3, 0.02, 8.0),
        Track(18.0, -0.4, speed=6.0),
        Track(45.0, 0.2, speed=4.0, last=30),
        Track(-30.0, 0.0, speed=9.0, first=25),
        Track(30.0, -6.0, np.pi / 2, 1.4, AgentKind.PEDESTRIAN, (0.6, 0.6)),
        Track(52.0, 2.3),
    ]
    return worlds.scene(worlds.fork(), *members, ego=(-12.0, 0.5, 0.03), ego_speed=7.0)


def test_row_zero_is_the_scene_and_nothing_jumps() -> None:
    scene = busy_scene()
    agents = run(scene).agents
    for name in ("boxes", "velocities", "valid", "center_z"):
        assert np.array_equal(getattr(agents, name)[0], getattr(scene.agents, name)[NOW], equal_nan=name != "valid")
    both = agents.valid[1:] & agents.valid[:-1]
    moved = np.hypot(*np.moveaxis(np.diff(agents.boxes[..., :2], axis=0), -1, 0))[both]
    turned = np.abs(np.diff(agents.boxes[..., 2], axis=0))[both]
    assert moved.max() < 1.1 and turned.max() < 0.06


@pytest.mark.parametrize("settings", [PLAIN, IDM])
def test_the_order_of_the_agents_does_not_matter(settings: TrafficSettings) -> None:
    scene = busy_scene()
    order = np.array([3, 5, 0, 4, 2, 1])

    def shuffled(agents: AgentTracks) -> AgentTracks:
        return AgentTracks(
            tuple(agents.track_ids[i] for i in order),
            tuple(agents.kinds[i] for i in order),
            agents.boxes[:, order],
            agents.velocities[:, order],
            agents.valid[:, order],
            agents.center_z[:, order],
            agents.heights[order],
        )

    plain = run(scene, settings)
    other = run(scene_of_clip(replace(scene.clip, agents=shuffled(scene.clip.agents))), settings)
    assert np.array_equal(plain.agents.boxes[:, order], other.agents.boxes, equal_nan=True)
    assert np.array_equal(plain.simulated[order], other.simulated)


@pytest.mark.parametrize("settings", [PLAIN, IDM])
def test_a_shifted_and_turned_world_rolls_out_the_same(settings: TrafficSettings) -> None:
    scene = busy_scene()
    angle, shift = 2.1, (3000.0, -1500.0)
    there = scene_of_clip(moved(scene.clip, np.array([*shift, angle])))
    expected, got = run(scene, settings).agents, run(there, settings).agents
    assert np.array_equal(expected.valid, got.valid)
    c, s = np.cos(angle), np.sin(angle)
    xy = expected.boxes[..., :2] @ np.array([[c, s], [-s, c]]) + shift
    assert got.boxes[..., :2][got.valid] == pytest.approx(xy[expected.valid], abs=1e-6)


def test_a_pedestrian_made_late_in_the_first_rollout_stays_late_in_the_second() -> None:
    walker = Track(30.0, -6.0, np.pi / 2, 1.5, AgentKind.PEDESTRIAN, (0.6, 0.6))
    scene = worlds.scene(worlds.straight_road(), walker)
    first = run(scene)
    late = first.agents.boxes.copy()
    late[21:] = late[11:31]  # it waited a second
    rollout = replace(first, agents=replace(first.agents, boxes=late))
    second = run(next_scene(scene, rollout, scene.centerline))
    expected = scene.agents.boxes[NOW + 30 : NOW + 71]
    assert second.agents.boxes == pytest.approx(expected)


def test_settings_that_mean_nothing_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="headway_s"):
        TrafficSettings(headway_s=0.0)
    with pytest.raises(ValueError, match="lookahead_m"):
        TrafficSettings(lookahead_m=np.inf)
    with pytest.raises(ValueError, match="min_gap_m"):
        TrafficSettings(min_gap_m=-1.0)
    with pytest.raises(ValueError, match="mode"):
        TrafficSettings(mode="idle")  # type: ignore[arg-type]

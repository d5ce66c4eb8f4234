"""Drivers that keep the intent of their log and give way, as claims; zones against a slow twin."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out, simulate
from tasks.world.clip import CLIP_STEPS, NOW, STEP_S, AgentKind, AgentTracks, Rollout, Scene
from tasks.world.frames import box_corners
from tasks.world.road_map import Lane, LightState, TrafficLights
from tests.tasks.rollout import worlds
from tests.tasks.rollout.test_traffic_twin import stages
from tests.tasks.rollout.worlds import Track, lane

Array = NDArray[np.float64]

TIME = STEP_S * (np.arange(CLIP_STEPS) - NOW)
EAST, NORTH = 0.0, np.pi / 2


def run(scene: Scene, ego_speed: float | None = None) -> Rollout:
    return simulate(scene, worlds.straight_plan(scene, ego_speed), TrafficSettings())


def crossroads() -> dict[str, Lane]:
    """A road along +x and one along +y that cross at the origin; a bend from the first into the second."""
    bend = worlds.arc((-10.0, 10.0), 10.0, -90.0, 0.0)
    return {
        "west": lane("west", [(-150.0, 0.0), (-10.0, 0.0)], successors=("east", "bend")),
        "east": lane("east", [(-10.0, 0.0), (150.0, 0.0)], is_intersection=True),
        "south": lane("south", [(0.0, -150.0), (0.0, -10.0)], successors=("north",)),
        "north": lane("north", [(0.0, -10.0), (0.0, 150.0)], is_intersection=True),
        "bend": lane("bend", bend, successors=("off",), is_intersection=True),
        "off": lane("off", [(0.0, 10.0), (0.0, 150.0)]),
    }


def along(way: Array, heading: float, **options: object) -> Track:
    """One at path length `way` (96,) from the origin."""
    poses = np.column_stack([way * np.cos(heading), way * np.sin(heading), np.full(CLIP_STEPS, heading)])
    return Track(0.0, poses=poses, **options)  # type: ignore[arg-type]


def way_of(rollout: Rollout, i: int) -> Array:
    """(41,) how far agent i has come [m], on its straight road."""
    return np.hypot(*(rollout.agents.boxes[:, i, :2] - rollout.agents.boxes[0, i, :2]).T)


def touching(agents: AgentTracks, i: int = 0, j: int = 1) -> bool:
    both = agents.valid[:, i] & agents.valid[:, j]
    a, b = (shapely.polygons(box_corners(agents.boxes[both, k])) for k in (i, j))
    return bool((shapely.area(shapely.intersection(a, b)) > 0.0).any())


def test_one_that_nobody_holds_up_drives_as_its_log_does() -> None:
    """Hard and softly, into a stop of a second and out of it."""
    speed = np.interp(TIME, [-2.0, 0.5, 1.5, 2.5, 4.5], [9.0, 7.0, 0.0, 0.0, 6.0])
    way = np.cumsum(speed) * STEP_S
    rollout = run(worlds.scene(worlds.straight_road(), along(way, EAST)))
    assert rollout.simulated.all()
    assert way_of(rollout, 0) == pytest.approx(way[NOW : NOW + 41] - way[NOW], abs=0.3)
    simulated = np.hypot(*rollout.agents.velocities[:, 0].T)
    assert simulated == pytest.approx(speed[NOW : NOW + 41], abs=0.5)
    assert (simulated[18:24] == 0.0).all()


def test_a_car_that_stands_in_its_log_stands_to_the_bit_though_its_box_jitters() -> None:
    """It is no parked one: it drives away after the rollout."""
    way = np.maximum(0.0, (TIME - 5.0) * 4.0) + 0.04 * np.sin(np.arange(CLIP_STEPS))
    poses = np.column_stack([way, 0 * way, 0 * way])
    scene = worlds.scene(worlds.straight_road(), Track(0.0, poses=poses))
    boxes = run(scene).agents.boxes[:, 0]
    assert (boxes == boxes[0]).all()


def test_one_that_was_held_up_drives_later_as_its_log_did_there() -> None:
    """An ego creeps in front of it; behind its log it is as fast as that was at the same place, or accelerates."""
    speed = np.interp(np.arange(CLIP_STEPS) * 1.0, [0, NOW, NOW + 10, CLIP_STEPS - 1], [8.0, 8.0, 4.0, 4.0])
    way = np.cumsum(speed) * STEP_S
    way -= way[NOW]
    scene = worlds.scene(worlds.straight_road(), along(way, EAST), ego=(10.0, 0.0, 0.0), ego_speed=3.0)
    rollout = run(scene)
    late = way[NOW : NOW + 41] - way_of(rollout, 0)
    assert late[-1] > 1.5
    assert np.hypot(*rollout.agents.velocities[:, 0].T)[-5:] == pytest.approx(3.0, abs=0.5)


def test_of_two_that_would_meet_the_later_one_waits_and_the_first_does_not_notice() -> None:
    """Both logs cross after about 2.5 s; the eastbound one is half a second and a little ahead."""
    first, second = along(8.0 * (TIME - 2.5) + 5.0, EAST), along(8.0 * (TIME - 2.5), NORTH)
    for members in ((first, second), (second, first)):
        rollout = run(worlds.scene(crossroads(), *members))
        logged = worlds.tracks(*members).window(NOW, NOW + 41)
        assert touching(logged) and not touching(rollout.agents)
        a, b = (0, 1) if members[0] is first else (1, 0)
        assert way_of(rollout, a) == pytest.approx(8.0 * STEP_S * np.arange(41), abs=0.1)
        assert way_of(rollout, b)[-1] < 8.0 * 4.0 - 3.0
        lost = -np.diff(np.hypot(*rollout.agents.velocities[:, b].T)) / STEP_S
        assert lost.max() < 4.0


def test_of_two_that_come_at_once_the_one_from_the_right_goes_first() -> None:
    """The northbound one comes from the right of the eastbound one."""
    rollout = run(worlds.scene(crossroads(), along(8.0 * (TIME - 2.5), EAST), along(8.0 * (TIME - 2.5), NORTH)))
    assert not touching(rollout.agents)
    assert way_of(rollout, 1)[-1] == pytest.approx(32.0, abs=0.1) and way_of(rollout, 0)[-1] < 30.0


def test_who_turns_gives_way_to_who_goes_straight_on() -> None:
    """Also where the turning one comes a little sooner; the bend leads into the northbound lane."""
    bend = np.array(worlds.arc((-10.0, 10.0), 10.0, -90.0, 0.0))
    line = np.concatenate([[(-60.0, 0.0)], bend, [(0.0, 60.0)]])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = 50.0 + 5.0 * (TIME - 2.0)
    xy = np.stack([np.interp(at, length, line[:, k]) for k in (0, 1)], axis=1)
    heading = np.unwrap(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
    turns = Track(0.0, poses=np.column_stack([xy, heading]))
    straight = along(7.0 * (TIME - 3.2), NORTH)
    rollout = run(worlds.scene(crossroads(), turns, straight))
    assert way_of(rollout, 1)[-1] == pytest.approx(28.0, abs=0.3)
    assert not touching(rollout.agents)


def test_a_red_light_takes_the_right_of_way() -> None:
    """Without it the eastbound one, which comes first, would go first."""
    red = TrafficLights(("east",), np.full((CLIP_STEPS, 1), LightState.RED, np.int8))
    first, second = along(8.0 * (TIME - 3.5) + 5.0, EAST), along(8.0 * (TIME - 3.5), NORTH)
    rollout = run(worlds.scene(crossroads(), first, second, lights=red))
    assert way_of(rollout, 1)[-1] == pytest.approx(32.0, abs=0.1)
    assert rollout.agents.boxes[:, 0, 0].max() + worlds.CAR[0] / 2.0 < -9.5


def test_who_could_only_make_an_emergency_stop_goes_on_and_the_other_one_brakes() -> None:
    """The northbound one comes from the right, but the eastbound one is 4 m before the crossing at 9 m/s."""
    near, from_right = along(9.0 * TIME - 8.0, EAST), along(6.0 * TIME - 8.5, NORTH)
    rollout = run(worlds.scene(crossroads(), near, from_right))
    assert way_of(rollout, 0) == pytest.approx(9.0 * STEP_S * np.arange(41), abs=0.1)
    assert not touching(rollout.agents)


def test_who_is_late_waits_for_one_that_walks_across() -> None:
    """By its log it had passed before; held up by the ego it comes when somebody crosses, and stops before her."""
    walker = Track(
        30.0, 0.0, NORTH, 0.0, AgentKind.PEDESTRIAN, (0.6, 0.6),
        poses=np.column_stack([np.full(CLIP_STEPS, 24.0), 1.4 * (TIME - 3.2), np.full(CLIP_STEPS, NORTH)]),
    )  # fmt: skip
    car = along(9.0 * TIME - 2.0, EAST)
    scene = worlds.scene(worlds.straight_road(), car, walker, ego=(8.0, 0.0, 0.0), ego_speed=6.0)
    agents = run(scene, 6.0).agents
    logged = scene.agents.window(NOW, NOW + 41)
    assert (agents.boxes[:, 1] == logged.boxes[:, 1]).all(), "she keeps to her log"
    alone = roll_out(
        prepare_traffic(
            worlds.scene(worlds.straight_road(), car, ego=(8.0, 0.0, 0.0), ego_speed=6.0), TrafficSettings()
        ),
        scene.clip.ego_states[NOW : NOW + 41],
    )
    assert not touching(agents)
    assert agents.boxes[-1, 0, 0] < alone.agents.boxes[-1, 0, 0] - 1.0


def test_who_merges_gives_way_to_who_is_on_the_road() -> None:
    roads = {
        "road": lane("road", [(-150.0, 0.0), (0.0, 0.0)], successors=("on",)),
        "ramp": lane("ramp", worlds.arc((0.0, -25.0), 25.0, 180.0, 90.0), successors=("on",), is_intersection=True),
        "on": lane("on", [(0.0, 0.0), (200.0, 0.0)]),
    }
    way = 7.0 * (TIME - 3.5)
    angle = np.pi / 2 - way / 25.0
    arc = np.column_stack([25.0 * np.cos(angle), 25.0 * np.sin(angle) - 25.0, angle - np.pi / 2])
    flat = np.column_stack([way, 0 * way, 0 * way])
    merges = Track(0.0, poses=np.where((way < 0.0)[:, None], arc, flat))
    stays = along(way - 1.0, EAST)
    rollout = run(worlds.scene(roads, merges, stays))
    assert touching(worlds.tracks(merges, stays).window(NOW, NOW + 41)) and not touching(rollout.agents)
    assert way_of(rollout, 1)[-1] == pytest.approx(28.0, abs=0.2)


def test_the_random_worlds_of_the_twins_reach_the_zones() -> None:
    """Who gives way there does otherwise without zones: of paths, and of others' logs."""
    of_paths, of_logs, differ = 0, 0, 0
    for seed in range(30):
        for traffic, egos in stages(seed):
            yielding = traffic.yielding
            assert yielding is not None
            of_paths += int((yielding.zone_path >= 0).sum())
            of_logs += int((yielding.zone_path < 0).sum())
            blind = replace(traffic, yielding=yielding._replace(zone_start=np.zeros_like(yielding.zone_start)))
            a, b = (roll_out(each, egos[0]).agents.boxes.tobytes() for each in (traffic, blind))
            differ += a != b
    assert min(of_paths, of_logs, differ) > 10


def test_zones_are_where_cells_overlap() -> None:
    """Each zone's beginning and end against all pairs of cells, as shapely sees them."""
    seen = 0
    for seed in range(40):
        traffic, _ = stages(seed)[0]
        yielding, paths, roles = traffic.yielding, traffic.paths, traffic.roles
        assert yielding is not None and paths is not None and roles is not None
        owner = {int(m): i for numbers in (roles.path, roles.logged_path) for i, m in enumerate(numbers) if m >= 0}
        for m in range(len(paths.heading)):
            for z in range(yielding.zone_start[m], yielding.zone_start[m + 1]):
                o = int(yielding.zone_path[z])
                if o < 0:
                    continue
                a, b = (
                    cells(traffic.scene.clip.agents, owner[path], paths.xy[path], paths.heading[path])
                    for path in (m, o)
                )
                first = round((yielding.zone_in[z] + 0.25) / 0.5)
                meets = shapely.area(shapely.intersection(a[first], b)) > 1e-9
                assert meets.any()
                last = round((yielding.zone_out[z] - 0.25) / 0.5)
                assert (shapely.area(shapely.intersection(a[last], b)) > 1e-9).any()
                seen += 1
    assert seen > 10


def cells(log: AgentTracks, i: int, xy: Array, heading: Array) -> NDArray[np.object_]:
    """The cells of a path, as wide as agent i and a decimetre more on each side."""
    width = float(np.nanmax(log.boxes[:, i, 4])) + 0.2
    boxes = np.column_stack([xy, heading, np.full(len(xy), 0.5), np.full(len(xy), width)])
    polygons: NDArray[np.object_] = shapely.polygons(box_corners(boxes))
    return polygons

"""`traffic=navsim`: the public reactive traffic, by its recorded answers, a slow twin, and its rules one by one.

recorded/navsim_traffic.npz: three crowds of 21 to 29 vehicles on lanes of the synthetic town, with speed limits by
chance, and what autonomousvision/navsim @ 0a380a9 with nuplan-devkit @ e924167, shapely 2.2.0 (GEOS 3.14.1) and numpy
1.26 answered; written by `PEER=... python -m tests.bench.bench_traffic 32 <file>`, which also compares as many crowds
as one likes.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tasks.attempt import drive_and_judge
from tasks.experts.protocol import Plan
from tasks.rollout.idm import IdmDriver
from tasks.rollout.navsim import drive_agents, idm_acceleration
from tasks.rollout.simulate import TrafficSettings, next_scene, prepare_traffic, roll_out, simulate
from tasks.world.clip import NOW, STEP_S, AgentKind, Rollout, Scene
from tasks.world.frames import PACIFICA
from tasks.world.road_map import RoadMap
from tests.tasks.rollout import slow_navsim, worlds
from tests.tasks.rollout.crowds import Crowd, crowd, crowd_of
from tests.tasks.rollout.worlds import CAR, Track

NAVSIM = TrafficSettings(mode="navsim")
DRIVER = IdmDriver(*(getattr(NAVSIM, name) for name in IdmDriver._fields))
RECORDED = Path(__file__).parent / "recorded" / "navsim_traffic.npz"
seeds = st.integers(0, 2**31)


BESIDE = (40.0, -50.0, 0.0)  # an ego out of everyone's way, but within 100 m


def run(scene: Scene) -> Rollout:
    return simulate(scene, worlds.straight_plan(scene), NAVSIM)


def first_acceleration(of: Rollout, i: int) -> float:
    """[m/s2] of agent i in the first step."""
    speed = np.hypot(*of.agents.velocities[:2, i].T)
    return float(speed[1] - speed[0]) / STEP_S


def recorded() -> Iterator[tuple[Crowd, dict[str, NDArray[np.generic]]]]:
    with np.load(RECORDED) as file:
        for i in sorted({int(name.split("/")[0]) for name in file.files}):
            own = {name.split("/")[1]: file[name] for name in file.files if name.startswith(f"{i}/")}
            yield crowd_of(own), own


def test_crowds_move_as_the_public_code_has_moved_them() -> None:
    seen = 0
    for one, answer in recorded():
        ours = roll_out(prepare_traffic(one.scene, NAVSIM), one.ego_states)
        assert np.array_equal(ours.agents.valid, answer["public_valid"])
        np.testing.assert_allclose(ours.agents.boxes, answer["public_boxes"], rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.agents.velocities, answer["public_velocities"], rtol=0, atol=1e-9)
        seen += int(ours.simulated.sum())
    assert seen > 40


def test_geos_is_asked_about_fewer_than_half_of_the_looks() -> None:
    looks = asked = 0
    for one, _ in recorded():
        agents = prepare_traffic(one.scene, NAVSIM).navsim
        assert agents is not None
        tracks, times = drive_agents(agents, DRIVER, one.ego_states)
        looks, asked = looks + int(np.isfinite(tracks[..., 3]).sum()), asked + times
    assert 0 < asked < 0.5 * looks, (asked, looks)


def test_what_geos_made_around_one_ego_changes_nothing_around_the_next() -> None:
    for one, _ in recorded():
        egos = [one.ego_states + np.pad([shift, 0.0], (0, 9)) for shift in (0.0, 3.0, -5.0)]
        shared = prepare_traffic(one.scene, NAVSIM)
        for states in (*egos, egos[0]):
            alone, again = (roll_out(of, states).agents for of in (prepare_traffic(one.scene, NAVSIM), shared))
            assert again.boxes.tobytes() == alone.boxes.tobytes() and np.array_equal(again.valid, alone.valid)
        assert shared.navsim is not None and shared.navsim.shapes


def test_far_from_the_map_s_origin_the_traffic_is_the_same() -> None:
    """Where numbers are rounded to 5e-10 m, as in the public maps."""
    one, far = crowd(worlds.fork(), 3, (5, 12)), np.array([664430.0, 3997650.0])
    moved = {
        name: replace(lane, ring=lane.ring + far, centerline=lane.centerline + np.pad(far, (0, 1)))
        for name, lane in one.road_map.lanes.items()
    }
    now, ego = one.now + np.pad(far, (0, 5)), one.ego_states + np.pad(far, (0, 9))
    there = replace(one, road_map=RoadMap(moved, ()), now=now, ego_states=ego)
    here, away = (roll_out(prepare_traffic(of.scene, NAVSIM), of.ego_states).agents for of in (one, there))
    assert here.valid[-1].any() and np.array_equal(here.valid, away.valid)
    np.testing.assert_allclose(away.boxes[..., :2] - far, here.boxes[..., :2], rtol=0, atol=1e-7)


@pytest.mark.slow
@given(seeds, st.booleans())
@settings(max_examples=12)
def test_what_is_left_out_because_it_cannot_matter_does_not_matter(seed: int, crowded: bool) -> None:
    if crowded:
        one = crowd(worlds.fork(), seed, (5, 12))
        scene, ego = one.scene, one.ego_states
    else:
        scene = worlds.random_scene(seed)
        (ego,) = worlds.random_egos(scene, seed, 1)
    traffic = prepare_traffic(scene, NAVSIM)
    assert traffic.navsim is not None
    try:
        boxes, stays = slow_navsim.drive(traffic.navsim, NAVSIM, ego)
    except ValueError:
        with pytest.raises(ValueError, match="beyond the end of its lane's path"):
            roll_out(traffic, ego)
        return
    fast = roll_out(traffic, ego).agents
    np.testing.assert_allclose(fast.boxes[1:, [a.row for a in traffic.navsim.driven]], boxes[1:], rtol=0, atol=1e-9)
    assert np.array_equal(fast.valid[1:, list(traffic.navsim.staying)], stays[1:])


def test_a_scene_of_nobody_and_a_map_of_no_lanes_are_traffic_too() -> None:
    assert run(worlds.scene(worlds.straight_road())).agents.boxes.shape == (41, 0, 5)
    rollout = run(worlds.scene({}, Track(0.0, speed=5.0), Track(20.0), ego=BESIDE))
    assert rollout.agents.valid[1:].all(axis=0).tolist() == [False, True] and not rollout.simulated.any()


def test_alone_a_car_drives_its_lane_as_if_a_wall_stood_at_its_end_but_one_point() -> None:
    """50 m of lane that goes on: the gap is what is left of the path less half a car."""
    lanes = {
        "first": worlds.lane("first", [(-10.0, 0.0), (50.0, 0.0)], successors=("second",)),
        "second": worlds.lane("second", [(50.0, 0.0), (300.0, 0.0)], predecessors=("first",)),
    }
    rollout = run(worlds.scene(lanes, Track(20.0, speed=5.0), ego=BESIDE))
    left = 50.0 - 0.75 - 20.0 - CAR[0] / 2.0
    assert first_acceleration(rollout, 0) == pytest.approx(idm_acceleration(5.0, 10.0, left, 0.0, DRIVER), abs=1e-9)
    assert rollout.agents.boxes[-1, 0, 0] < 50.0 - 0.75 - CAR[0] / 2.0 and rollout.simulated.tolist() == [True]


def test_the_egos_box_stands_about_its_rear_axle() -> None:
    """As in the public code, 1.461 m too far back: the gap ends at the rear axle less half of the ego's length."""
    rollout = run(worlds.scene(worlds.straight_road(), Track(0.0, speed=8.0), ego=(30.0, 0.0, 0.0), ego_speed=3.0))
    gap = 30.0 - PACIFICA.half_length - CAR[0] / 2.0
    assert first_acceleration(rollout, 0) == pytest.approx(idm_acceleration(8.0, 10.0, gap, 3.0, DRIVER), abs=1e-9)


def test_who_drives_beside_a_car_and_reaches_into_its_way_is_its_leader() -> None:
    """Two lanes that overlap: middles 1.5 m apart, cars 1.9 m wide."""
    lanes = {name: worlds.lane(name, [(-100.0, y), (500.0, y)]) for name, y in (("right", 0.0), ("left", 1.5))}
    rollout = run(worlds.scene(lanes, Track(0.0, -0.5, speed=6.0), Track(20.0, 2.5, speed=2.0), ego=BESIDE))
    expected = idm_acceleration(6.0, 10.0, 20.0 - CAR[0], 2.0, DRIVER)
    assert first_acceleration(rollout, 0) == pytest.approx(expected, abs=1e-9)
    assert rollout.agents.boxes[1, :, 1].tolist() == [0.0, 1.5]


def test_a_limit_stays_for_those_after_it_that_have_none() -> None:
    lanes = {
        "free": worlds.lane("free", [(-100.0, 0.0), (900.0, 0.0)]),
        "slow": worlds.lane("slow", [(-100.0, 20.0), (900.0, 20.0)], speed_limit_mps=5.0),
    }
    before, slow, after = Track(0.0, speed=4.0), Track(0.0, 20.0, speed=4.0), Track(90.0, speed=4.0)
    rollout = run(worlds.scene(lanes, before, slow, after, ego=BESIDE))
    end = lambda x: 900.0 - 0.75 - x - CAR[0] / 2.0  # noqa: E731
    behind = idm_acceleration(4.0, 10.0, 90.0 - CAR[0], 4.0, DRIVER)
    assert first_acceleration(rollout, 0) == pytest.approx(behind, abs=1e-9)
    for i, x in ((1, 0.0), (2, 90.0)):
        expected = idm_acceleration(4.0, 5.0, end(x), 0.0, DRIVER)
        assert first_acceleration(rollout, i) == pytest.approx(expected, abs=1e-9)


def test_who_is_seen_again_after_the_first_frame() -> None:
    """On the lane an agent; beside all lanes who stands; far from its lane's middle whoever; the others are gone."""
    wide = replace(
        worlds.straight_road()["road"], ring=np.array([[-100, -9], [500, -9], [500, 9], [-100, 9], [-100, -9]])
    )
    members = {
        "agent": Track(0.0, 2.0, speed=5.0),
        "parked": Track(0.0, 20.0),
        "off road and driving": Track(40.0, 20.0, speed=6.0),
        "far from the middle": Track(60.0, 5.0, speed=6.0),
        "into an agent": Track(1.0, -1.0, speed=5.0),
        "into the ego": Track(120.0, 1.0, speed=5.0),
        "beyond 100 m": Track(330.0, 0.0, speed=5.0),
        "only later": Track(80.0, 0.0, speed=5.0, first=NOW + 5),
        "walks": Track(0.0, -30.0, speed=1.0, kind=AgentKind.PEDESTRIAN, size=(0.5, 0.5)),
    }
    scene = worlds.scene({"road": wide}, *members.values(), ego=(120.0, 0.0, 0.0))
    rollout = run(scene)
    seen = dict(zip(members, rollout.agents.valid.T))
    assert [name for name, there in seen.items() if there[1:].all()] == ["parked", "far from the middle", "walks"]
    assert rollout.simulated.tolist() == [name in ("agent", "beyond 100 m") for name in members]
    near = worlds.scene({"road": wide}, *members.values(), ego=(60.0, 0.0, 0.0))
    again = dict(zip(members, run(near).agents.valid.T))
    assert again["agent"].all() and not again["beyond 100 m"][1:].any() and again["into the ego"][1:].all()
    still = rollout.agents.boxes[:, list(members).index("far from the middle")]
    assert (still == still[0]).all()


def test_a_walker_follows_its_log_and_the_next_scene_goes_on_from_there() -> None:
    walker = Track(5.0, -8.0, np.pi / 2, 1.5, AgentKind.PEDESTRIAN, (0.6, 0.6))
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=6.0), walker, ego=BESIDE)
    first = run(scene)
    np.testing.assert_array_equal(first.agents.boxes[:, 1], scene.agents.boxes[NOW : NOW + 41, 1])
    second = run(next_scene(scene, first, scene.centerline))
    np.testing.assert_array_equal(second.agents.boxes[0, 0], first.agents.boxes[-1, 0])
    assert second.agents.velocities[1, 0, 0] > first.agents.velocities[-1, 0, 0]


def test_who_touches_the_ego_at_the_start_counts_in_the_public_reactive_evaluation() -> None:
    """Its log replay leaves such objects out, its reactive traffic does not."""
    barrier = Track(3.0, 0.9, kind=AgentKind.BARRIER, size=(1.0, 1.0))
    scene = worlds.scene(worlds.straight_road(), barrier, ego=(0.0, 0.0, 0.0), ego_speed=5.0)
    scene = replace(scene, centerline=worlds.straight_road()["road"].centerline)
    plan = Plan(worlds.straight_plan(scene))
    for mode, nc in (("idm", 1.0), ("navsim", 0.5)):
        traffic = TrafficSettings(mode=mode)  # type: ignore[arg-type]
        judged = drive_and_judge(scene, plan, traffic)
        assert judged.scores.nc[1] == nc, mode


def test_a_lane_of_two_points_is_refused_by_its_name() -> None:
    lanes = worlds.straight_road()
    lanes = {"road": replace(lanes["road"], centerline=lanes["road"].centerline[[0, -1]])}
    with pytest.raises(ValueError, match="the centreline of lane road has fewer than three points"):
        prepare_traffic(worlds.scene(lanes, Track(0.0, speed=5.0)), NAVSIM)


def test_an_agent_beyond_its_path_is_refused_as_the_public_code_fails_there() -> None:
    """A baseline loses its last point, so a long last segment leaves an agent beside its own way."""
    lanes = worlds.straight_road()
    points = np.concatenate([lanes["road"].centerline[:20], lanes["road"].centerline[-1:]])
    lanes = {"road": replace(lanes["road"], centerline=points)}
    with pytest.raises(ValueError, match="beyond the end of its lane's path"):
        run(worlds.scene(lanes, Track(-70.0, speed=5.0), ego=(-60.0, -50.0, 0.0)))

"""What is towed: as far behind as it was, on the way of what tows it, seen by others where it is."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from tasks.rollout.simulate import TrafficSettings, next_scene, prepare_traffic, roll_out, roll_out_longer, simulate
from tasks.world.clip import CLIP_STEPS, NOW, PER_STEP, STEP_S, AgentTracks, Rollout, Scene
from tasks.world.frames import box_corners, wrap_angle
from tests.tasks.rollout import worlds
from tests.tasks.rollout.test_policy import StraightOn, by
from tests.tasks.rollout.worlds import Track, lane

Array = NDArray[np.float64]
TIME = (np.arange(CLIP_STEPS) - NOW) * STEP_S
CAB, TRAILER = (8.0, 2.6), (7.0, 2.6)
BEHIND_M = 7.7
BOTH = pytest.mark.parametrize("yields", [False, True])
RADIUS = 20.0


def run(scene: Scene, settings: TrafficSettings | None = None) -> Rollout:
    return simulate(scene, worlds.straight_plan(scene), settings or TrafficSettings())


def along(way: Array, y: float = 0.0, turn: float = 0.0, **options: object) -> Track:
    poses = np.column_stack([way, np.full(CLIP_STEPS, y), np.full(CLIP_STEPS, turn)])
    return Track(0.0, poses=poses, **options)  # type: ignore[arg-type]


def train(speed: float = 6.0, behind: float = BEHIND_M, start: float = 0.0, **options: object) -> tuple[Track, Track]:
    """A cab and its trailer on the straight road."""
    way = start + speed * TIME
    return along(way, size=CAB, **options), along(way - behind, size=TRAILER, **options)


def apart(agents: AgentTracks, i: int = 0, j: int = 1) -> Array:
    between: Array = np.hypot(*(agents.boxes[:, i, :2] - agents.boxes[:, j, :2]).T)
    return between


@BOTH
def test_on_a_straight_road_the_distance_stays_what_it_was(yields: bool) -> None:
    scene = worlds.scene(worlds.straight_road(), *train(), Track(20.0, speed=2.0))
    rollout = run(scene, TrafficSettings(yields=yields))
    agents = rollout.agents
    assert rollout.simulated.tolist() == [True, True, True]
    assert apart(agents) == pytest.approx(BEHIND_M, abs=1e-9)
    assert agents.boxes[:, 1, 1:3] == pytest.approx(0.0, abs=1e-9)
    assert agents.velocities[1:, 1] == pytest.approx(agents.velocities[1:, 0], abs=1e-9)
    assert np.ptp(agents.velocities[:, 0, 0]) > 0.5, "it has reason to brake"


def ring() -> dict[str, object]:
    """A lane around (0, RADIUS), that begins at (0, 0)."""
    return {"ring": lane("ring", worlds.arc((0.0, RADIUS), RADIUS, -140.0, 215.0))}


def circling(behind: float, size: tuple[float, float], speed: float = 6.0) -> Track:
    angle = (speed * TIME - behind) / RADIUS
    poses = np.column_stack([RADIUS * np.sin(angle), RADIUS * (1.0 - np.cos(angle)), angle])
    return Track(0.0, poses=poses, size=size)


@BOTH
def test_on_a_circle_it_is_on_the_same_circle_behind(yields: bool) -> None:
    scene = worlds.scene(ring(), circling(0.0, CAB), circling(BEHIND_M, TRAILER))  # type: ignore[arg-type]
    rollout = run(scene, TrafficSettings(yields=yields))
    offset = rollout.agents.boxes[..., :2] - [0.0, RADIUS]
    angle = np.arctan2(offset[..., 1], offset[..., 0])
    assert rollout.simulated.all()
    assert np.hypot(*offset[:, 1].T) == pytest.approx(RADIUS, abs=0.1)
    assert RADIUS * wrap_angle(angle[:, 0] - angle[:, 1]) == pytest.approx(BEHIND_M, abs=0.03)
    tangent = wrap_angle(rollout.agents.boxes[:, 1, 2] - angle[:, 1] - np.pi / 2)
    assert tangent == pytest.approx(0.0, abs=0.03)


def test_two_trailers_keep_their_places_on_a_circle() -> None:
    parts = [circling(k * BEHIND_M, CAB if k == 0 else TRAILER) for k in (2, 0, 1)]
    rollout = run(worlds.scene(ring(), *parts))  # type: ignore[arg-type]
    offset = rollout.agents.boxes[..., :2] - [0.0, RADIUS]
    angle = np.arctan2(offset[..., 1], offset[..., 0])
    assert rollout.simulated.all() and np.hypot(*np.moveaxis(offset, -1, 0)) == pytest.approx(RADIUS, abs=0.1)
    for first, other in ((1, 2), (2, 0)):
        assert RADIUS * wrap_angle(angle[:, first] - angle[:, other]) == pytest.approx(BEHIND_M, abs=0.05)


def test_one_that_starts_beside_the_way_and_turned_comes_onto_it_without_a_jump() -> None:
    cab, _ = train(8.0)
    trailer = along(8.0 * TIME - BEHIND_M, y=0.5, turn=0.12, size=TRAILER)
    boxes = run(worlds.scene(worlds.straight_road(), cab, trailer)).agents.boxes[:, 1]
    assert boxes[0] == pytest.approx([-BEHIND_M, 0.5, 0.12, *TRAILER])
    assert np.abs(np.diff(boxes[:, 2])).max() < 0.03 and np.abs(np.diff(boxes[:, 1])).max() < 0.1
    assert boxes[-1, 1:3] == pytest.approx(0.0, abs=1e-9)
    assert (np.diff(boxes[:, 1]) <= 1e-12).all()


def test_one_that_is_faster_by_its_log_brakes_no_harder_than_tyres_can() -> None:
    """Labels of a far trailer wander along the road: now it is 1.7 m/s faster."""
    cab = along(7.0 * TIME, size=CAB)
    trailer = along(7.0 * TIME - 8.0 + 0.8 * np.sin(2.125 * TIME), size=TRAILER)
    agents = run(worlds.scene(worlds.straight_road(), cab, trailer)).agents
    assert -np.diff(agents.velocities[:, 1, 0]).min() <= 0.8 + 0.1
    assert apart(agents)[0] == pytest.approx(8.0)
    assert apart(agents)[3:] == pytest.approx(8.0 - 0.1 * (0.89 + 0.09), abs=0.01)
    assert np.ptp(apart(agents)[3:]) < 1e-9


def slow_place(scene: Scene, rollout: Rollout, t: int, away: float) -> shapely.Point:
    """Where the cab, agent 0, was `away` m before row t: on one line through its log, points 1 m apart, and rows."""
    past = scene.agents.boxes[: NOW + 1, 0, :2][scene.agents.valid[: NOW + 1, 0]]
    kept = [past[-1]]
    for point in past[::-1]:
        if np.hypot(*(point - kept[-1])) >= 1.0:
            kept.append(point)
    line = shapely.LineString(np.concatenate([kept[::-1], rollout.agents.boxes[1 : t + 1, 0, :2]]))
    return shapely.line_interpolate_point(line, line.length - away)


@BOTH
def test_it_goes_where_the_cab_has_been(yields: bool) -> None:
    """Through the bend of a fork, by the twin that lays the whole way as one line."""
    turn = np.column_stack([np.linspace(20.5, 60, 36), np.zeros(36), np.zeros(36)])
    arc = np.radians(np.linspace(0, 90, 20))
    bend = np.column_stack([60 + 12 * np.sin(arc), 12 - 12 * np.cos(arc), arc])
    out = np.column_stack([np.full(40, 72.0), np.linspace(13, 50, 40), np.full(40, np.pi / 2)])
    cab = np.concatenate([turn, bend, out])
    trailer = np.concatenate([np.column_stack([np.linspace(12.8, 19.4, 7), np.zeros((7, 2))]), cab[:-7]])
    scene = worlds.scene(worlds.fork(), Track(0.0, poses=cab, size=CAB), Track(0.0, poses=trailer, size=TRAILER))
    rollout = run(scene, TrafficSettings(yields=yields))
    boxes = rollout.agents.boxes
    assert rollout.simulated.all() and boxes[-1, 0, 1] > 6.0, "it is around the bend"
    away = np.hypot(*(boxes[0, 0, :2] - boxes[0, 1, :2]))
    for t in range(1, 41):
        place = slow_place(scene, rollout, t, away)
        assert boxes[t, 1, :2] == pytest.approx([place.x, place.y], abs=1e-9), t
    turned = np.abs(wrap_angle(np.diff(boxes[:, 1, 2])))
    assert turned.max() < 0.12 and 0.1 < boxes[-1, 1, 2] < boxes[-1, 0, 2]


def test_a_cab_that_waits_waits_with_its_trailer() -> None:
    """By its log it stands for another second."""
    way = 6.0 * np.maximum(TIME - 1.0, 0.0)
    cab, trailer = along(way, size=CAB), along(way - BEHIND_M, size=TRAILER)
    rollout = run(worlds.scene(worlds.straight_road(), cab, trailer))
    assert (rollout.agents.boxes[:10] == rollout.agents.boxes[0]).all()
    assert rollout.simulated.all() and rollout.agents.boxes[-1, 1, 0] > 0.0
    assert apart(rollout.agents) == pytest.approx(BEHIND_M, abs=1e-9)


def test_others_see_the_trailer_where_it_is() -> None:
    """The ego stands before the cab; who comes behind stops behind the trailer."""
    follower = Track(-40.0, speed=8.0)
    scene = worlds.scene(worlds.straight_road(), *train(8.0), follower, ego=(25.0, 0.0, 0.0))
    first = run(scene, TrafficSettings(yields=False))
    second = run(next_scene(scene, first, scene.centerline), TrafficSettings(yields=False))
    for rollout in (first, second):
        assert apart(rollout.agents) == pytest.approx(BEHIND_M, abs=1e-9)
        gap = rollout.agents.boxes[:, 1, 0] - rollout.agents.boxes[:, 2, 0] - 0.5 * (TRAILER[0] + worlds.CAR[0])
        assert gap.min() > 0.4
    assert np.hypot(*second.agents.velocities[-1].T).max() < 1.0


def test_a_second_rollout_goes_on_as_the_first_one_ended() -> None:
    scene = worlds.scene(ring(), circling(0.0, CAB), circling(BEHIND_M, TRAILER))  # type: ignore[arg-type]
    first = run(scene)
    after = next_scene(scene, first, scene.centerline)
    second = run(after)
    assert (second.agents.boxes[0] == first.agents.boxes[-1]).all() and after.ever_simulated is not None
    assert after.ever_simulated.all() and second.simulated.all()
    assert apart(second.agents) == pytest.approx(apart(first.agents)[-1], abs=0.05)
    steps = np.hypot(*np.moveaxis(np.diff(second.agents.boxes[:, :, :2], axis=0), -1, 0))
    assert steps[:, 1] == pytest.approx(steps[:, 0], abs=0.02)


def test_where_the_cab_replays_its_log_so_does_the_trailer() -> None:
    """Nobody is on a lane out there."""
    cab, trailer = (replace(part, poses=part.poses + np.array([0.0, 60.0, 0.0])) for part in train())
    scene = worlds.scene(worlds.straight_road(), cab, trailer, Track(0.0, speed=6.0))
    rollout = run(scene)
    assert rollout.simulated.tolist() == [False, False, True]
    for name in PER_STEP:
        logged = getattr(scene.agents, name)[NOW : NOW + 41, :2]
        np.testing.assert_array_equal(getattr(rollout.agents, name)[:, :2], logged, strict=True)


def test_a_cab_that_comes_onto_the_road_takes_its_trailer_over_from_the_log() -> None:
    """At 6 m/s down a slope of 1 : 4 beside the road: it is driven from the step on in which it is near enough."""
    y = np.maximum(6.0 - 1.5 * np.maximum(TIME, 0.0), 0.0)
    cab = np.column_stack([6.0 * TIME, y, np.zeros(CLIP_STEPS)])
    trailer = cab - [BEHIND_M, 0.0, 0.0]
    scene = worlds.scene(
        worlds.straight_road(), Track(0.0, poses=cab, size=CAB), Track(0.0, poses=trailer, size=TRAILER)
    )
    rollout = run(scene)
    boxes, logged = rollout.agents.boxes, scene.agents.boxes[NOW : NOW + 41]
    assert rollout.simulated.all()
    assert (boxes[:18, :2] == logged[:18, :2]).all(), "both by the log"
    assert not (boxes[30:, 1] == logged[30:, 1]).all()
    assert apart(rollout.agents) == pytest.approx(BEHIND_M, abs=0.3)
    assert np.abs(np.diff(boxes[:, 1, 1])).max() < 0.25, "nothing jumps"


@BOTH
@pytest.mark.parametrize(("start", "enters"), [(0.0, True), (-33.0, False)])
def test_a_train_enters_as_a_whole_or_not_at_all(yields: bool, start: float, enters: bool) -> None:
    """Both are seen from 1 s on; the ego stands 30 m before the cab, or between it and the trailer."""
    ego = (start + 50.0 if enters else start + 8.0, 0.0, 0.0)
    scene = worlds.scene(worlds.straight_road(), *train(start=start, first=NOW + 10), ego=ego)
    agents = run(scene, TrafficSettings(yields=yields)).agents
    assert (agents.valid[:, 0] == agents.valid[:, 1]).all() and agents.valid[20:, 0].all() == enters
    if enters:
        assert apart(agents)[10:] == pytest.approx(BEHIND_M, abs=1e-9)


def test_a_cab_does_not_come_before_its_trailer() -> None:
    """It is seen 0.5 s earlier."""
    cab, trailer = train(first=NOW + 10)
    scene = worlds.scene(worlds.straight_road(), cab, replace(trailer, first=NOW + 15), ego=(200.0, 0.0, 0.0))
    agents = run(scene).agents
    assert agents.valid.argmax(axis=0).tolist() == [15, 15]
    assert apart(agents)[15:] == pytest.approx(BEHIND_M, abs=1e-9)


def test_who_crosses_waits_for_the_whole_train() -> None:
    """It passes behind the trailer as far as it would behind a car: 1.0 m if it looked at the cab alone."""
    roads = worlds.straight_road() | {"cross": lane("cross", [(30.0, -150.0), (30.0, 150.0)])}
    north = np.column_stack([np.full(CLIP_STEPS, 30.0), 5.0 * TIME - 17.0, np.full(CLIP_STEPS, np.pi / 2)])
    scene = worlds.scene(roads, *train(8.0, start=12.0), Track(0.0, poses=north))
    traffic = prepare_traffic(scene, TrafficSettings())
    assert traffic.yielding is not None
    assert traffic.yielding.trailing == pytest.approx([BEHIND_M + 0.5 * (TRAILER[0] - CAB[0]), 0.0, 0.0])
    agents = roll_out(traffic, np.repeat(scene.ego_state[None], 41, axis=0)).agents
    _, trailer, other = (shapely.polygons(box_corners(agents.boxes[:, k])) for k in range(3))
    assert shapely.distance(other, trailer).min() > 1.2
    assert apart(agents) == pytest.approx(BEHIND_M, abs=1e-9)


def test_a_policy_drives_the_cab_alone_and_the_trailer_follows() -> None:
    scene = worlds.scene(worlds.straight_road(), *train(6.0))
    rollout = run(scene, by(StraightOn))
    assert rollout.simulated.all() and apart(rollout.agents) == pytest.approx(BEHIND_M, abs=1e-9)


def test_it_goes_on_after_the_log() -> None:
    scene = worlds.scene(worlds.straight_road(), *train(6.0))
    states = np.repeat(scene.ego_state[None], 101, axis=0)
    assert apart(roll_out_longer(prepare_traffic(scene, TrafficSettings()), states)) == pytest.approx(
        BEHIND_M, abs=1e-9
    )


@pytest.mark.parametrize("seed", range(6))
def test_a_train_that_nobody_meets_changes_nothing_for_others(seed: int) -> None:
    """To the last bit: who is no part of it moves as without."""
    one = worlds.random_scene(seed)
    far = [replace(part, poses=part.poses + np.array([0.0, 4000.0, 0.0])) for part in train()]
    other = worlds.with_members(one, *far)
    (ego,) = worlds.random_egos(one, seed, 1)
    for settings in (TrafficSettings(), TrafficSettings(yields=False)):
        without, beside = (roll_out(prepare_traffic(scene, settings), ego).agents for scene in (one, other))
        for name in PER_STEP:
            np.testing.assert_array_equal(getattr(beside, name)[:, :-2], getattr(without, name), strict=True)

"""The town's behaviour: a connected map, traffic that never touches, a lawful ego that scores as a human should."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.town import curves
from factory.datasets.town.drive import (
    GREEN,
    RED,
    SCENARIOS,
    YELLOW,
    DrivingStyle,
    Signals,
    TownPath,
    follow_path,
    overlaps,
)
from factory.datasets.town.settings import LOG_STEPS, TownSettings
from factory.datasets.town.streets import Streets, build_streets
from factory.datasets.town.town import WINDOWS_PER_LOG, plan_log, write_town
from tasks.trajectories import score_trajectories
from tasks.world.clip import NOW
from tasks.world.frames import PACIFICA, box_corners, ego_boxes, to_local
from tasks.world.road_map import arc_lengths

BLIND = TownSettings(cameras=(), lidar_beams=0)


@pytest.fixture(scope="module", params=[0, 5])
def streets(request: pytest.FixtureRequest) -> Streets:
    return build_streets(np.random.default_rng(request.param))


def test_every_connector_joins_the_ends_of_its_neighbours(streets: Streets) -> None:
    connectors = [lane for lane in streets.lanes.values() if lane.is_intersection]
    assert connectors
    for lane in connectors:
        assert len(lane.predecessors) == len(lane.successors) == 1
        before, after = streets.lanes[lane.predecessors[0]], streets.lanes[lane.successors[0]]
        assert np.hypot(*(lane.center[0] - before.center[-1])[:2]) < 1e-6
        assert np.hypot(*(lane.center[-1] - after.center[0])[:2]) < 1e-6
        assert np.cos(lane.center[-1, 2] - after.center[0, 2]) > 0.999


def test_boundaries_lie_on_their_sides_of_the_driving_direction(streets: Streets) -> None:
    for lane in streets.lanes.values():
        middle = len(lane.center) // 2
        x, y, heading = lane.center[middle]
        for line, sign in ((lane.left, 1.0), (lane.right, -1.0)):
            near = line[np.argmin(np.hypot(*(line - [x, y]).T))]
            assert sign * (np.cos(heading) * (near[1] - y) - np.sin(heading) * (near[0] - x)) > 0.5


def test_the_town_has_every_kind_of_street_that_it_promises(streets: Streets) -> None:
    kinds = {scenario.kind for scenario in SCENARIOS[:7]}
    assert kinds == {
        "straight multi-lane", "curve", "signalised straight", "signalised turn", "Y-branch", "narrow with parked cars",
        "roundabout",
    }  # fmt: skip
    assert {junction.name for junction in streets.junctions} == {"crossroads", "branch", "roundabout"}
    assert {lane.light_group for lane in streets.lanes.values()} == {-1, 0, 1}


def test_crossing_directions_are_never_green_together() -> None:
    signals = Signals(3.0)
    for time in np.arange(0.0, 64.0, 0.1):
        states = {signals.state(group, float(time)) for group in (0, 1)}
        assert RED in states
        assert states <= {GREEN, YELLOW, RED}


def test_a_driver_stops_at_a_red_light_before_the_line() -> None:
    line = curves.from_curvature(np.zeros(3), [(200.0, 0.0)])
    s = arc_lengths(line)
    path = TownPath(line, s, np.full(len(s), 12.0), ((100.0, 0),), ())
    times = np.arange(0.0, 15.0, 0.1)
    red_for_15_s = Signals(16.0)
    position, speed = follow_path(path, 10.0, 12.0, DrivingStyle(), np.zeros((len(times), 0, 5)), red_for_15_s, times)
    assert speed[-1] < 0.3
    assert 94.0 < position[-1] + DrivingStyle().front_m <= 100.0


def test_a_driver_keeps_its_distance_from_a_standing_car() -> None:
    line = curves.from_curvature(np.zeros(3), [(200.0, 0.0)])
    s = arc_lengths(line)
    path = TownPath(line, s, np.full(len(s), 12.0), (), ())
    times = np.arange(0.0, 20.0, 0.1)
    standing = np.broadcast_to([120.0, 0.0, 0.0, 4.0, 2.0], (len(times), 1, 5))
    position, speed = follow_path(path, 10.0, 12.0, DrivingStyle(), standing, Signals(0.0), times)
    assert speed[-1] < 0.3
    assert 1.0 < 118.0 - (position[-1] + DrivingStyle().front_m) < 5.0


@pytest.mark.slow
@pytest.mark.parametrize("index", [2, 3, 6])
def test_nobody_touches_anybody_and_the_ego_stays_on_the_road(index: int) -> None:
    town, log = plan_log(0, index)
    assert len(log.ego) == LOG_STEPS
    assert len(log.tracks) > 15
    ego = ego_boxes(log.ego, PACIFICA)
    everyone = np.stack([ego, *(track.boxes() for track in log.tracks)], axis=1)
    for k in range(everyone.shape[1] - 1):
        assert not overlaps(everyone[:, k], everyone[:, k + 1 :], 0.0).any()
    corners = box_corners(ego).reshape(-1, 2)
    assert shapely.contains_xy(town.streets.surface(), corners[:, 0], corners[:, 1]).all()
    assert log.ego_speed.min() > 1.0


@pytest.mark.slow
def test_the_logged_ego_scores_as_a_good_driver(tmp_path: Path) -> None:
    """Collision, drivable area, direction, lights, time to collision, lane keeping: all 1, in every window."""
    n = 3 * WINDOWS_PER_LOG
    write_town(tmp_path, n, 11, BLIND)
    reader = AV2Reader(tmp_path, name="synthetic")
    index = reader.index()
    assert len(index.refs) == n
    assert not index.dropped
    assert not index.broken
    for ref in index.refs:
        clip = reader.read(ref)
        future = to_local(clip.ego_states[NOW, :3], clip.ego_states[NOW + 1 : NOW + 41, :3])
        scores = score_trajectories(clip, future[None])
        for name in ("nc", "dac", "ddc", "tlc", "ttc", "lk"):
            assert getattr(scores, name)[0] == 1.0, (ref, name)

"""Where the ego drives: the scenario kinds, its route through the lanes, and its human-like motion."""

from collections import deque
from dataclasses import dataclass

import numpy as np
import shapely

from factory.readers.town.streets import Streets
from factory.readers.town.traffic import RED, STEP_S, DrivingStyle, Signals, TownPath, path_of_lanes
from tasks.rollout.lqr import track
from tasks.world.arrays import Array
from tasks.world.clip import HISTORY_STEPS, HORIZON_STEPS
from tasks.world.frames import box_corners
from tasks.world.polygons import arc_lengths
from tasks.world.vehicle import AX, AY, EGO_STATE_SIZE, VX

EGO_SMOOTH_M = 3.2  # rounds the lanes' joints: steering that a person would do
SLOWEST_MPS = 1.2  # a log whose ego is ever slower is drawn again: a standing ego makes no clip


@dataclass(frozen=True)
class Scenario:
    """One kind of drive: from a road (in or against its line's direction), towards another."""

    kind: str
    road: str
    forward: bool
    target: str | None
    to_junction_m: tuple[float, float] | None  # start this far before the road's end; None: near its beginning


APPROACH = (38.0, 80.0)
SCENARIOS = (  # in turn, log by log; every run of seven holds every kind once
    Scenario("straight multi-lane", "avenue", True, None, None),
    Scenario("signalised straight", "west street", False, "avenue", APPROACH),
    Scenario("roundabout", "west street", True, "ring road 1", APPROACH),
    Scenario("narrow with parked cars", "narrow street", True, None, None),
    Scenario("curve", "south avenue", True, None, None),
    Scenario("Y-branch", "avenue", True, "left branch", APPROACH),
    Scenario("signalised turn", "avenue", False, "narrow street", APPROACH),
    Scenario("curve", "south avenue", False, None, None),
    Scenario("signalised turn", "west street", False, "south avenue", APPROACH),
    Scenario("roundabout", "ring road 2", False, "west street", APPROACH),
    Scenario("straight multi-lane", "avenue", False, None, None),
    Scenario("narrow with parked cars", "narrow street", False, None, None),
    Scenario("Y-branch", "right branch", False, "avenue", APPROACH),
    Scenario("signalised straight", "avenue", False, "west street", APPROACH),
    Scenario("signalised turn", "south avenue", False, "avenue", APPROACH),
    Scenario("curve", "west street", False, None, None),
    Scenario("roundabout", "west street", True, "ring road 2", APPROACH),
    Scenario("Y-branch", "avenue", True, "right branch", APPROACH),
)


def chains(streets: Streets, road: str, forward: bool) -> list[list[int]]:
    """Lane ids of a road's VEHICLE lanes, one list per lane, inner lane first, in driving direction."""
    lanes, line = streets.lanes, next(r.line for r in streets.roads if r.name == road)
    out = []
    for lane in lanes.values():
        if lane.road != road or lane.kind != "VEHICLE" or any(lanes[p].road == road for p in lane.predecessors):
            continue
        beside = line[np.argmin(np.hypot(*(line[:, :2] - lane.center[0, :2]).T)), 2]
        if (np.cos(lane.center[0, 2] - beside) > 0) == forward:
            out.append([lane.lane_id])
            while after := [n for n in lanes[out[-1][-1]].successors if lanes[n].road == road]:
                out[-1].append(after[0])
    return out


def way_to(streets: Streets, lane_id: int, road: str) -> list[int] | None:
    """The lanes after `lane_id` on the way with the fewest lanes to `road`; None where there is none."""
    came_from: dict[int, int] = {lane_id: -1}
    queue = deque([lane_id])
    while queue and streets.lanes[queue[0]].road != road:
        here = queue.popleft()
        for following in streets.lanes[here].successors:
            if following not in came_from:
                came_from[following] = here
                queue.append(following)
    if not queue:
        return None
    way = [queue[0]]
    while came_from[way[-1]] != lane_id:
        way.append(came_from[way[-1]])
    return way[::-1]


def on_at_random(streets: Streets, lane_ids: list[int], rng: np.random.Generator) -> list[int]:
    """The same lanes and up to 14 more, turning at random."""
    out = list(lane_ids)
    while streets.lanes[out[-1]].successors and len(out) < len(lane_ids) + 14:
        out.append(int(rng.choice(streets.lanes[out[-1]].successors)))
    return out


def ego_path(
    streets: Streets, scenario: Scenario, style: DrivingStyle, rng: np.random.Generator
) -> tuple[TownPath, float]:
    """The ego's path and its start on it [m]."""
    near = scenario.to_junction_m
    starts = chains(streets, scenario.road, scenario.forward)
    for k in rng.permutation(len(starts)):
        chain = starts[k]
        way = [] if scenario.target is None else way_to(streets, chain[-1], scenario.target)
        if way is not None:
            length = sum(float(arc_lengths(streets.lanes[lane].center)[-1]) for lane in chain)
            start = float(rng.uniform(25.0, 55.0)) if near is None else length - float(rng.uniform(*near))
            return path_of_lanes(streets, on_at_random(streets, chain + way, rng), style, EGO_SMOOTH_M), start
    raise ValueError(f"no way from {scenario.road!r} to {scenario.target!r}")


def tracked(rear_axle: Array, speed: Array) -> list[tuple[int, Array]]:
    """What the factory's own tracker makes of the ego: (first step, states (41, 11)) for starts every second.

    A log is kept only if these, too, are lawful and safe: then its windows score well as human samples. (Comfort is not
    asked for: the public tracker starts with straight wheels, so a start in a tight turn always jerks.)
    """
    states = np.zeros((len(rear_axle), EGO_STATE_SIZE))
    states[:, :3] = rear_axle
    states[:, VX] = speed
    states[:, AX] = np.gradient(speed, STEP_S)
    states[:, AY] = speed * np.gradient(np.unwrap(rear_axle[:, 2]), STEP_S)
    starts = range(HISTORY_STEPS, len(states) - HORIZON_STEPS, 10)
    return [(a, track(states[a], states[None, a + 1 : a + 1 + HORIZON_STEPS, :3])[0]) for a in starts]


def is_lawful(streets: Streets, path: TownPath, boxes: Array, signals: Signals, times_s: Array) -> bool:
    """All corners on drivable surface at every step, and never on a connector of its way while that is red."""
    corners = box_corners(boxes)
    if not shapely.contains_xy(streets.surface(), *corners.reshape(-1, 2).T).all():
        return False
    body = shapely.polygons(corners)
    for lane in (streets.lanes[lane_id] for lane_id in path.lane_ids):
        if lane.light_group >= 0:
            ring = shapely.Polygon(np.vstack([lane.left, lane.right[::-1]])).buffer(0.3)
            red = np.array([signals.state(lane.light_group, float(t)) == RED for t in times_s])
            if shapely.intersects(body[red], ring).any():
                return False
    return True

"""The public evaluation's reactive traffic, to the letter: `traffic=navsim` (docs/reward.md 5)."""

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.kernels.compiled import hidden_kernel, kernel
from tasks.rollout.idm import IdmDriver
from tasks.rollout.outlines import (
    MOVED_M,
    QUADRANT,
    ROUNDING_M,
    SOFT_M,
    UNSURE,
    apart,
    bounds,
    box_ring,
    even_ends,
    is_firm,
    joined_ring,
    outlines_touch,
    soften,
    strip_ring,
    with_firm_corners,
)
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import STEP_S, AgentKind, AgentTracks, Scene
from tasks.world.frames import HEADING, PACIFICA, VX, VY, X, Y, ego_boxes
from tasks.world.geometry import wrapped
from tasks.world.road_map import Lane, RoadMap, with_headings

# The public traffic's paths: a lane's baseline, and where along it a vehicle is.
#
# As nuplan-devkit's `InterpolatedPath` is made of a baseline by `create_path_from_se2` and read by `trim_path`
# (nuplan/planning/simulation/path, nuplan/planning/simulation/observation/idm/utils.py): in the order of their
# operations, the point that is lost at the end included.

Pose = tuple[float, float, float]  # x, y [m], heading [rad]
LOOK_M = 0.5  # along a baseline, to tell its direction at a point (polyline_map_object.py)


@dataclass(frozen=True)
class BaselinePath:
    """P >= 2 points of a baseline, all but its last and those that stand twice."""

    at: Array  # (P,) path length [m]
    rows: Array  # (P, 3) x, y [m], heading [rad] of the segment that starts there, unwrapped along the path

    @property
    def end(self) -> float:
        return float(self.at[-1])

    def pose(self, progress: float) -> Pose:
        """x, y, heading in [-pi, pi) at a path length; linear between points, beyond the ends as there."""
        progress = self._clamped(progress)
        k = min(max(int(self.at.searchsorted(progress)), 1), len(self.at) - 1)
        low, high = self.rows[k - 1], self.rows[k]
        x, y, heading = (high - low) / (self.at[k] - self.at[k - 1]) * (progress - self.at[k - 1]) + low
        return float(x), float(y), float((heading + np.pi) % (2.0 * np.pi) - np.pi)

    def ahead(self, progress: float) -> Array:
        """(K >= 2, 2) the path from a path length on; from its end on its last two points."""
        progress = self._clamped(progress)
        first = int(self.at.searchsorted(progress, side="right"))
        if first == len(self.at):
            return self.rows[-2:, :2]
        return np.concatenate([[self.pose(progress)[:2]], self.rows[first:, :2]])

    def between(self, start: float, stop: float) -> Array:
        """(K >= 2, 2) the path between two path lengths; where both are at one of its ends, the two points there."""
        start, stop = self._clamped(start), self._clamped(stop)
        first, last = int(self.at.searchsorted(start, side="right")), int(self.at.searchsorted(stop))
        if first == len(self.at):
            return self.rows[-2:, :2]
        if last == 0:
            return self.rows[:2, :2]
        return np.concatenate([[self.pose(start)[:2]], self.rows[first:last, :2], [self.pose(stop)[:2]]])

    def _clamped(self, progress: float) -> float:
        return max(float(self.at[0]), min(progress, self.end))


def baseline_path(centerline: Array) -> BaselinePath | None:
    """The path along a baseline (P, >= 2); None where fewer than two points are left of it."""
    points = with_headings(centerline[:, :2])
    steps = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    at = np.cumsum(np.append(0.0, steps))
    kept = np.append(~np.isclose(np.diff(at), 0.0), False)  # the last has no step of its own and is lost
    rows = points[kept]
    if len(rows) < 2:
        return None
    rows[:, 2] = np.unwrap(rows[:, 2])
    return BaselinePath(at[kept], rows)


def nearest_pose(baseline: shapely.LineString, xy: Array) -> tuple[Pose, float]:
    """The pose of the point of a baseline nearest to `xy` (2,), and its path length [m]."""
    at = float(shapely.line_locate_point(baseline, shapely.Point(xy)))
    here, there = _point(baseline, at), _point(baseline, at + LOOK_M)
    start, stop = (here, there) if here != there else (_point(baseline, at - LOOK_M), here)
    return (*here, math.atan2(stop[1] - start[1], stop[0] - start[0])), at


def _point(line: shapely.LineString, at: float) -> tuple[float, float]:
    point = shapely.line_interpolate_point(line, at)
    return float(shapely.get_x(point)), float(shapely.get_y(point))


# Who takes part in the public traffic, and how it starts (autonomousvision/navsim @ 0a380a9, docs/reward.md 5).
#
# Vehicles of the current frame alone, in its order. Each is asked for the lane under its centre: of the lanes that hold
# it, or inside an intersection of the lane connectors, the one whose direction there is nearest to its heading as plain
# numbers. On it, at most SNAP_M beside the baseline, it becomes an agent where its box, moved onto the baseline,
# touches neither the ego nor an agent before it. Of the others those stay as they are that stand beside all lanes, and
# those farther than SNAP_M from the baseline of the lane under them; the rest is gone after the current frame.
# (build_idm_agents_on_map_rails, get_starting_segment, NavsimIDMAgents.get_observation)

SNAP_M = 3.0  # idm_snap_threshold
STANDS_BELOW_MPS = 0.1
MOST_SHAPES = 4096  # kept of a scene, some 2 kB each
FORWARD, LEFTWARD = np.array([1.0, -1.0, -1.0, 1.0]), np.array([1.0, 1.0, -1.0, -1.0])  # corners of a box, in order
WIDER = 1.05  # than half of what is as wide: GEOS simplifies a line before it widens it


@dataclass(frozen=True)
class IdmAgent:
    """A vehicle on the one lane it starts on."""

    row: int  # among the scene's agents
    path: BaselinePath
    progress: float  # [m] along the baseline, which is longer than the path
    speed: float  # [m/s]
    target_speed: float  # [m/s]
    length: float  # [m]
    width: float  # [m]
    pose: Pose  # of its box on the baseline
    body: shapely.Polygon  # that box


class Drivers(NamedTuple):
    """What A agents go by."""

    first: Ints  # (A + 1,) of each agent's path among the rows
    at: Array  # (R,) path length [m], path after path
    rows: Array  # (3, R) as BaselinePath's
    origin: Array  # (2,) x, y [m], of outlines: the maps' own is so far away that outlines there are rounded coarsely
    size: Array  # (A + 1, 2) length, width [m]; the last is the ego
    target_speed: Array  # (A,) [m/s]
    meet: Bools  # (A, A) as NavsimAgents'


@dataclass(frozen=True)
class NavsimAgents:
    """The public traffic of a scene before anybody has moved."""

    driven: tuple[IdmAgent, ...]  # in the order they move in
    drivers: Drivers  # the same for the kernel
    staying: tuple[int, ...]  # rows of the vehicles that stay unless somebody is in them, in their order
    staying_bodies: NDArray[np.object_]  # (F,) their boxes
    staying_touch: Bools  # (F, F) whether two of them touch
    staying_meet: Bools  # (F, A) whether an agent can ever touch one; False: surely not
    # What GEOS made of somebody in a place, each simplified once more, up to the first that stays as it was: whom the
    # ego does not disturb is in the same places around the next one.
    shapes: dict[tuple[float, ...], list[shapely.Geometry]] = field(default_factory=dict, compare=False)


@dataclass(frozen=True)
class _Layers:
    """The layers of a map that the public traffic asks for what holds a point."""

    lanes: tuple[Lane, ...]
    connectors: tuple[Lane, ...]
    lane_tree: shapely.STRtree
    connector_tree: shapely.STRtree
    intersection_tree: shapely.STRtree


def navsim_agents(scene: Scene, target_speed_mps: float) -> NavsimAgents:
    """The public traffic of a scene; target_speed_mps: where no lane so far has had a limit.

    Raises ValueError for a lane whose baseline has no path, on which the public code ends.
    """
    now, start = scene.agents, scene.step
    vehicles = [i for i in np.flatnonzero(now.valid[start]).tolist() if now.kinds[i] == AgentKind.VEHICLE]
    boxes = now.boxes[start]
    layers = _layers(scene.clip.road_map)
    taken = [*box_polygons(ego_boxes(scene.ego_state, PACIFICA)[None])]
    driven: list[IdmAgent] = []
    staying: list[int] = []
    for i in vehicles:
        speed = float(np.hypot(*now.velocities[start, i]))
        found, in_lanes = _starting_lane(layers, boxes[i])
        if found is None:
            if speed < STANDS_BELOW_MPS and not in_lanes:
                staying.append(i)
            continue
        pose, progress = nearest_pose(shapely.LineString(found.centerline[:, :2]), boxes[i, :2])
        if np.hypot(pose[0] - boxes[i, 0], pose[1] - boxes[i, 1]) > SNAP_M:
            staying.append(i)
            continue
        body = box_polygons(np.array([[*pose, *boxes[i, 3:]]]))[0]
        if shapely.intersects(body, taken).any():
            continue
        path = baseline_path(found.centerline)
        if path is None:
            problem = "fewer than three points that lie apart: the public traffic has no path along it"
            raise ValueError(f"traffic=navsim: the centreline of lane {found.lane_id} has {problem}")
        target_speed_mps = found.speed_limit_mps or target_speed_mps  # as there: it stays for those after it
        length, width = map(float, boxes[i, 3:])
        taken.append(body)
        driven.append(IdmAgent(i, path, progress, speed, target_speed_mps, length, width, pose, body))
    return _together(driven, staying, box_polygons(boxes[staying]))


def _together(driven: list[IdmAgent], staying: list[int], stay: NDArray[np.object_]) -> NavsimAgents:
    """With who can meet whom: an agent's box and footprint are never farther from its way than its corners reach."""
    ways = np.empty(len(driven), dtype=object)
    for k, agent in enumerate(driven):
        way = shapely.LineString(agent.path.between(agent.progress - agent.length / 2.0, agent.path.end))
        ways[k] = shapely.GeometryCollection([way, agent.body])
    ahead = np.array([shapely.LineString(agent.path.ahead(agent.progress)) for agent in driven], dtype=object)
    half_width = np.array([agent.width / 2.0 for agent in driven])
    corner = np.array([np.hypot(agent.length, agent.width) / 2.0 for agent in driven])
    meet = shapely.dwithin(ahead[:, None], ways[None], WIDER * (half_width[:, None] + corner[None]))
    np.fill_diagonal(meet, False)
    touch = shapely.intersects(stay[:, None], stay[None])
    rows = np.concatenate([np.zeros((0, 3)), *(agent.path.rows for agent in driven)])
    drivers = Drivers(
        first=np.cumsum([0, *(len(agent.path.at) for agent in driven)]),
        at=np.concatenate([np.zeros(0), *(agent.path.at for agent in driven)]),
        rows=rows.T.copy(),
        origin=np.round(rows[0, :2]) if driven else np.zeros(2),
        size=np.array([*((agent.length, agent.width) for agent in driven), (PACIFICA.length, PACIFICA.width)]),
        target_speed=np.array([agent.target_speed for agent in driven]),
        meet=meet,
    )
    staying_meet = shapely.dwithin(stay[:, None], ways[None], WIDER * corner)
    return NavsimAgents(tuple(driven), drivers, tuple(staying), stay, touch, staying_meet)


def box_polygons(boxes: Array) -> NDArray[np.object_]:
    """(N,) polygons of boxes (N, 5), corners as nuPlan's `OrientedBox` has them."""
    x, y, heading, length, width = boxes.T[..., None]
    turned = heading + np.pi / 2.0
    lon, lat = length / 2.0 * FORWARD, width / 2.0 * LEFTWARD
    corners = np.empty((len(boxes), 4, 2))
    corners[..., 0] = x + (lat * np.cos(turned) + lon * np.cos(heading))
    corners[..., 1] = y + (lat * np.sin(turned) + lon * np.sin(heading))
    return np.asarray(shapely.polygons(corners), dtype=object).reshape(len(boxes))


def _starting_lane(layers: _Layers, box: Array) -> tuple[Lane | None, bool]:
    """The lane a vehicle starts on, None where there is none; and whether it is on a lane or in an intersection."""
    point = shapely.Point(box[:2])
    on = _holding(layers.lane_tree, point)
    if on:
        lanes = [layers.lanes[k] for k in on]
    elif _holding(layers.intersection_tree, point):
        lanes = [layers.connectors[k] for k in _holding(layers.connector_tree, point)]
    else:
        return None, False
    if not lanes:
        return None, True
    turns = [abs(nearest_pose(shapely.LineString(lane.centerline[:, :2]), box[:2])[0][2] - box[2]) for lane in lanes]
    return lanes[int(np.argmin(turns))], True


def _holding(tree: shapely.STRtree, point: shapely.Point) -> list[int]:
    """Polygons that hold a point, in file order; on an edge it is outside."""
    return sorted(tree.query(point, predicate="within").tolist())


@lru_cache(maxsize=4)
def _layers(road_map: RoadMap) -> _Layers:
    lanes = tuple(lane for lane in road_map.lanes.values() if lane.drives_cars and not lane.is_intersection)
    connectors = tuple(lane for lane in road_map.lanes.values() if lane.drives_cars and lane.is_intersection)
    areas = road_map.intersections
    return _Layers(
        lanes,
        connectors,
        shapely.STRtree([shapely.Polygon(lane.ring) for lane in lanes]),
        shapely.STRtree([shapely.Polygon(lane.ring) for lane in connectors]),
        shapely.STRtree(
            [shapely.Polygon(lane.ring) for lane in connectors]
            if areas is None
            else [shapely.Polygon(area.ring, area.holes) for area in areas]
        ),
    )


# The public traffic's steps: one agent after the other, compiled (docs/reward.md 5).
#
# Step t answers to the ego of step t - 1, whose rear axle is taken for its centre. An agent looks along what is left of
# its path in a strip as wide as itself; of the footprints that reach into it the nearest to its own footprint leads. A
# footprint is the agent's box and the strip that it covers in the next headway. IDM moves it, and those after it see it
# there already. (NavsimIDMAgentManager.propagate_agents, IDMAgent.projected_footprint, IDMPolicy)
#
# The public code does this on GEOS's shapes. The kernel knows their outlines (tasks/rollout/outlines.py) and says where
# the answer depends on how GEOS rounds or simplifies them, or packs its tree: there GEOS itself is asked.

RADIUS_M = 100.0  # around the ego; agents beyond it are gone for good
SIMPLE_M = 1e-5  # all shapes are simplified by so much before each look
TIE_M = 1e-9
FEW = 10  # shapes that a tree has in one node
STRIDE_M = 0.1  # along a path at least, where nothing is near it
MOST_CORNERS = 64  # of a footprint, beside two a point
NOT_ASKED, NOBODY = -2, -1  # instead of a leader


class Driving(NamedTuple):
    """Where they are, and what the ego, who goes by the number after theirs, and they leave for others to see."""

    here: Bools  # (A + 1,)
    progress: Array  # (A,) [m], not bounded by the path's ends
    box: Array  # (A + 1, 5)
    speed: Array  # (A + 1,) [m/s]
    ring: Array  # (A + 1, 3, C) footprints: x, y [m], whether a corner is firm
    corners: Ints  # (A + 1,) of each ring, UNSURE where it is not known
    bounds: Array  # (A + 1, 4) of each ring
    off: Array  # (A + 1,) less than this [m] is a ring off
    firm: Bools  # (A + 1,) whether it is not off at all where that matters to the last look
    made_at: Ints  # (A + 1,) looks there had been when the footprint was made
    looks: Ints  # (1,) so far
    scratch: Array  # (4, 3, C)


@hidden_kernel
def _row_after(drivers: Drivers, k: int, progress: float, beyond: bool) -> int:
    """The first row of agent k's path that is at a path length or beyond; beyond: that is beyond it."""
    low, high = drivers.first[k], drivers.first[k + 1]
    while low < high:
        middle = (low + high) // 2
        if drivers.at[middle] < progress or (beyond and drivers.at[middle] == progress):
            low = middle + 1
        else:
            high = middle
    return low


@hidden_kernel
def _pose(drivers: Drivers, k: int, progress: float) -> tuple[float, float, float]:
    """As BaselinePath.pose."""
    start, stop = drivers.first[k], drivers.first[k + 1] - 1
    progress = max(drivers.at[start], min(progress, drivers.at[stop]))
    row = min(max(_row_after(drivers, k, progress, False), start + 1), stop)
    rows, low, high = drivers.rows, row - 1, row
    long, on = drivers.at[high] - drivers.at[low], progress - drivers.at[low]
    x = (rows[0, high] - rows[0, low]) / long * on + rows[0, low]
    y = (rows[1, high] - rows[1, low]) / long * on + rows[1, low]
    return x, y, wrapped((rows[2, high] - rows[2, low]) / long * on + rows[2, low])


@hidden_kernel
def _stretch(drivers: Drivers, k: int, start: float, stop: float, line: Array) -> int:
    """Fills a line (2, C) with agent k's path between two path lengths, as BaselinePath.between, seen from the origin.

    How many points it has.
    """
    low, high = drivers.first[k], drivers.first[k + 1]
    start = max(drivers.at[low], min(start, drivers.at[high - 1]))
    stop = max(drivers.at[low], min(stop, drivers.at[high - 1]))
    first, last = _row_after(drivers, k, start, True), _row_after(drivers, k, stop, False)
    inside = first < high and last > low
    if first == high:
        first, last = high - 2, high
    elif last == low:
        first, last = low, low + 2
    n = 0
    if inside:
        line[0, n], line[1, n], _ = _pose(drivers, k, start)
        n += 1
    for row in range(first, last):
        line[0, n], line[1, n] = drivers.rows[0, row], drivers.rows[1, row]
        n += 1
    if inside:
        line[0, n], line[1, n], _ = _pose(drivers, k, stop)
        n += 1
    for i in range(n):
        line[0, i], line[1, i] = line[0, i] - drivers.origin[0], line[1, i] - drivers.origin[1]
    return n


@hidden_kernel
def _leave_box(drivers: Drivers, now: Driving, j: int) -> None:
    """What others see of j is its box."""
    now.corners[j] = with_firm_corners(now.ring[j], box_ring(now.box[j], drivers.origin, 0.0, now.ring[j]))
    bounds(now.ring[j], 4, now.bounds[j])
    now.off[j] = MOVED_M
    now.made_at[j] = now.looks[0]


@hidden_kernel
def _leave_footprint(drivers: Drivers, now: Driving, k: int, headway_s: float) -> None:
    """What others see of agent k is its box and the strip that it covers in the next headway."""
    line, strip, box, inner = now.scratch[0], now.scratch[1], now.scratch[2], now.scratch[3]
    half = 0.5 * drivers.size[k, 0]
    n = _stretch(drivers, k, now.progress[k] - half, now.progress[k] + half + now.speed[k] * headway_s, line)
    half_width = 0.5 * drivers.size[k, 1]
    n, soft_start, soft_end = even_ends(line, n, half_width)
    n_strip = strip_ring(line, n, half_width, strip) if n > 0 else UNSURE
    box_ring(now.box[k], drivers.origin, 0.0, box)
    box_ring(now.box[k], drivers.origin, ROUNDING_M, inner)
    now.corners[k] = joined_ring(strip, n_strip, box, inner, now.ring[k]) if n_strip > 0 else UNSURE
    now.off[k] = np.inf if now.corners[k] == UNSURE else SOFT_M if soft_start or soft_end else MOVED_M
    if soft_start:
        soften(now.ring[k], now.corners[k], line[0, 0], line[1, 0], half_width)
    if soft_end:
        soften(now.ring[k], now.corners[k], line[0, n - 1], line[1, n - 1], half_width)
    bounds(now.ring[k], now.corners[k], now.bounds[k])
    now.made_at[k] = now.looks[0]


@hidden_kernel
def _reaches_in(drivers: Drivers, now: Driving, k: int, j: int) -> int:
    """Whether the footprint of j is in the strip ahead of agent k: 1, 0 or UNSURE.

    Only stretches of the path near the footprint are looked at: a path is never longer away than as the crow flies.
    """
    if now.corners[j] == UNSURE:
        return UNSURE
    line, strip, around = now.scratch[0], now.scratch[1], now.bounds[j]
    end, half_width = drivers.at[drivers.first[k + 1] - 1], 0.5 * drivers.size[k, 1]
    mid_x = drivers.origin[0] + 0.5 * (around[0] + around[2])
    mid_y = drivers.origin[1] + 0.5 * (around[1] + around[3])
    reach = 0.5 * math.hypot(around[2] - around[0], around[3] - around[1]) + half_width + 2.0 * STRIDE_M
    s = max(drivers.at[drivers.first[k]], min(now.progress[k], end))
    last, found = max(s, end - STRIDE_M), 0
    while True:
        x, y, _ = _pose(drivers, k, s)
        away = math.hypot(x - mid_x, y - mid_y)
        if away > reach:
            if s >= last:
                return found
            s = min(s + (away - reach) + STRIDE_M, last)
            continue
        row = min(_row_after(drivers, k, s, True), drivers.first[k + 1] - 1)
        while drivers.at[row] < end and math.hypot(drivers.rows[0, row] - mid_x, drivers.rows[1, row] - mid_y) <= reach:
            row += 1
        whole = max(_row_after(drivers, k, s, True) - 1, drivers.first[k])  # no short segment by a cut
        for side in (1.0, -1.0):
            n = _stretch(drivers, k, max(drivers.at[whole], now.progress[k]), drivers.at[row], line)
            n, soft_start, soft_end = even_ends(line, n, half_width)
            wider = side * (SOFT_M if soft_start or soft_end else now.off[j])
            if n > 0:
                _lengthen(line, n, wider)
                n = strip_ring(line, n, half_width + wider, strip) if half_width + wider > 0.0 else UNSURE
            if n == UNSURE:
                found = UNSURE
                break
            if not outlines_touch(strip, n, now.ring[j], now.corners[j], around):
                break
            if wider < 0.0:
                return 1
            found = UNSURE
        if drivers.at[row] >= end:
            return found
        s = drivers.at[row]


@hidden_kernel
def _lengthen(line: Array, n: int, by: float) -> None:
    """Moves both ends of a line of n points outwards [m]."""
    for end, beside in ((0, 1), (n - 1, n - 2)):
        dx, dy = line[0, end] - line[0, beside], line[1, end] - line[1, beside]
        length = math.hypot(dx, dy)
        if length > 0.0:
            line[0, end], line[1, end] = line[0, end] + dx * by / length, line[1, end] + dy * by / length


@hidden_kernel
def _answer(drivers: Drivers, now: Driving, k: int, j: int, gap: float, driver: IdmDriver) -> float:
    """[m/s2] of agent k with j as its leader, at a gap [m] between their footprints; NOBODY: to its path's end."""
    speed, target = now.speed[k], drivers.target_speed[k]
    if j == NOBODY:
        left = drivers.at[drivers.first[k + 1] - 1] - now.progress[k]
        return idm_acceleration(speed, target, left - 0.5 * drivers.size[k, 0], 0.0, driver)
    lead_speed = now.speed[j] * math.cos(wrapped(now.box[j, 2] - now.box[k, 2]))
    return idm_acceleration(speed, target, gap, lead_speed, driver)


@hidden_kernel
def _look(drivers: Drivers, now: Driving, k: int, driver: IdmDriver, away: Array) -> tuple[bool, float]:
    """Whether agent k's acceleration is sure, and what it is [m/s2].

    away (A + 1,): filled with how far the footprints in its way are from its own, of use where all are known [m]; inf:
    it is not in the way, NaN: that is not sure.
    """
    mine, n, ego = now.ring[k], now.corners[k], len(drivers.target_speed)
    nearest, leader, off, known = np.inf, NOBODY, now.off[k], True
    for j in range(ego + 1):
        away[j], now.firm[j] = np.inf, False
        if not now.here[j] or (j < ego and not drivers.meet[k, j]):
            continue
        reaches = _reaches_in(drivers, now, k, j)
        if reaches == 0:
            continue
        known = known and reaches == 1 and n != UNSURE
        if not known:
            away[j] = np.nan if reaches == UNSURE else 0.0
            continue
        if not outlines_touch(mine, n, now.ring[j], now.corners[j], now.bounds[j]):
            away[j] = apart(mine, n, now.ring[j], now.corners[j], now.bounds[j])
        else:
            away[j] = 0.0
        off = max(off, now.off[j])
        if away[j] < nearest:
            nearest, leader = away[j], j
    if not known:
        return False, 0.0
    if leader == NOBODY:
        return True, _answer(drivers, now, k, NOBODY, 0.0, driver)
    found, as_near, same = _answer(drivers, now, k, leader, nearest, driver), 0, True
    for j in range(ego + 1):
        if away[j] <= nearest + 4.0 * off:  # whichever of them leads, at whatever gap it may be
            as_near += 1
            for gap in (max(nearest - 2.0 * off, 0.0), nearest + 6.0 * off):
                same = same and found == _answer(drivers, now, k, j, gap, driver)
    if same or as_near > 1 or nearest == 0.0:
        return same, found
    other, m = now.ring[leader], now.corners[leader]
    now.firm[k] = is_firm(mine, n, other, m, now.bounds[leader], nearest)
    now.firm[leader] = is_firm(other, m, mine, n, now.bounds[k], nearest)
    return now.firm[k] and now.firm[leader], found


@kernel
def drive_on(
    drivers: Drivers, now: Driving, driver: IdmDriver, ego_states: Array, tracks: Array, away: Array, step: int, k: int,
    leader: int, gap: float,
) -> tuple[int, int]:  # fmt: skip
    """Moves all agents until one's answer is not sure: its step and number; or (T, 0) behind the last step.

    tracks (T, A, 4): x, y, heading, speed of who is there, NaN elsewhere. step, k: where to go on, with the leader and
    gap [m] that GEOS has for that agent, or NOT_ASKED.
    """
    ego = len(drivers.target_speed)
    for t in range(step, len(ego_states)):
        if leader == NOT_ASKED:
            k = 0
            now.box[ego, 0], now.box[ego, 1] = ego_states[t - 1, X], ego_states[t - 1, Y]
            now.box[ego, 2] = ego_states[t - 1, HEADING]
            now.speed[ego] = math.hypot(ego_states[t - 1, VX], ego_states[t - 1, VY])
            _leave_box(drivers, now, ego)
            for j in range(ego):
                if t == 1:  # still as it stands on its baseline
                    _leave_box(drivers, now, j)
                    now.box[j, 0], now.box[j, 1], now.box[j, 2] = _pose(drivers, j, now.progress[j])
                dx, dy = now.box[j, 0] - now.box[ego, 0], now.box[j, 1] - now.box[ego, 1]
                now.here[j] = now.here[j] and math.hypot(dx, dy) <= RADIUS_M
        while k < ego:
            if now.here[k]:
                if leader == NOT_ASKED:
                    now.looks[0] += 1
                    sure, acceleration = _look(drivers, now, k, driver, away)
                    stands_on_path = t > 1 or drivers.at[drivers.first[k + 1] - 1] - now.progress[k] > TIE_M
                    if not (sure and stands_on_path):
                        return t, k
                else:
                    acceleration = _answer(drivers, now, k, leader, gap, driver)
                    leader = NOT_ASKED
                now.progress[k] += STEP_S * now.speed[k]
                now.speed[k] = max(now.speed[k] + STEP_S * acceleration, 0.0)
                now.box[k, 0], now.box[k, 1], now.box[k, 2] = _pose(drivers, k, now.progress[k])
                _leave_footprint(drivers, now, k, driver.headway_s)
                for c in range(3):
                    tracks[t, k, c] = now.box[k, c]
                tracks[t, k, 3] = now.speed[k]
            k += 1
    return len(ego_states), 0


@kernel
def idm_acceleration(speed: float, target_speed: float, gap: float, lead_speed: float, driver: IdmDriver) -> float:
    """[m/s2] of IDM `gap` m behind a leader, clipped to what is comfortable (idm_policy.py)."""
    closing = speed * (speed - lead_speed) / (2.0 * math.sqrt(driver.accel_max * driver.decel_max))
    wanted = driver.min_gap_m + speed * driver.headway_s + closing
    free = 1.0 - (speed / target_speed) ** driver.exponent
    wish = driver.accel_max * (free - (wanted / max(gap, driver.min_gap_m)) ** 2)
    return min(max(-driver.decel_max, wish), driver.accel_max)


def roll_out_navsim(
    agents: NavsimAgents, driver: IdmDriver, window: AgentTracks, ego_states: Array
) -> tuple[AgentTracks, Bools]:
    """The tracks of T rows around one ego with states (T, 11), and who is driven (N,).

    window: the log's tracks over the same steps, row 0 as the scene has them. Boxes keep the height that they have now:
    the public traffic lives in the plane. Raises ValueError where an agent's path begins beyond its own body, at which
    the public code ends.
    """
    vehicle = np.array([kind == AgentKind.VEHICLE for kind in window.kinds], dtype=bool)
    boxes, velocities, valid = window.boxes.copy(), window.velocities.copy(), window.valid.copy()
    boxes[1:, vehicle], velocities[1:, vehicle], valid[1:, vehicle] = np.nan, np.nan, False
    tracks, _ = drive_agents(agents, driver, ego_states)
    rows = np.array([agent.row for agent in agents.driven], dtype=np.int64)
    heading, speed = tracks[1:, :, 2], tracks[1:, :, 3]
    boxes[1:, rows, :3], valid[1:, rows] = tracks[1:, :, :3], ~np.isnan(speed)
    boxes[1:, rows, 3:] = np.where(valid[1:, rows, None], agents.drivers.size[:-1], np.nan)
    velocities[1:, rows] = np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=-1)
    for i, there in zip(agents.staying, _staying_present(agents, boxes[:, rows], valid[:, rows]).T):
        boxes[1:, i][there], velocities[1:, i][there], valid[1:, i] = window.boxes[0, i], window.velocities[0, i], there
    center_z = np.where(vehicle, np.where(valid, window.center_z[0], np.nan), window.center_z)
    driven = np.zeros(len(window), dtype=bool)
    driven[rows] = True
    return replace(window, boxes=boxes, velocities=velocities, valid=valid, center_z=center_z), driven


def _staying_present(agents: NavsimAgents, boxes: Array, valid: Bools) -> Bools:
    """(T - 1, F) which of the staying are there: in nobody that moves, and in none of the staying before them.

    boxes (T, A, 5), valid (T, A): the agents.
    """
    stays: Bools = np.zeros((len(boxes) - 1, len(agents.staying)), dtype=bool)
    for i, body in enumerate(agents.staying_bodies):
        met = valid[1:] & agents.staying_meet[i]
        met[met] = shapely.intersects(body, box_polygons(boxes[1:][met]))
        stays[:, i] = ~(met.any(axis=1) | (stays & agents.staying_touch[i]).any(axis=1))
    return stays


def drive_agents(agents: NavsimAgents, driver: IdmDriver, ego_states: Array) -> tuple[Array, int]:
    """(T, A, 4) x, y, heading, speed of the agents in all rows but the first, NaN where one is gone.

    And how many of their looks GEOS has been asked about. Raises ValueError as `roll_out_navsim`.
    """
    n, drivers = len(agents.driven), agents.drivers
    tracks = np.full((len(ego_states), n, 4), np.nan)
    most = 2 * max((len(agent.path.at) for agent in agents.driven), default=0) + MOST_CORNERS
    now = Driving(
        here=np.ones(n + 1, dtype=bool),
        progress=np.array([agent.progress for agent in agents.driven]),
        box=np.column_stack([np.array([*(agent.pose for agent in agents.driven), (0.0, 0.0, 0.0)]), drivers.size]),
        speed=np.array([*(agent.speed for agent in agents.driven), 0.0]),
        ring=np.empty((n + 1, 3, most)),
        corners=np.zeros(n + 1, dtype=np.int64),
        bounds=np.zeros((n + 1, 4)),
        off=np.zeros(n + 1),
        firm=np.zeros(n + 1, dtype=bool),
        made_at=np.zeros(n + 1, dtype=np.int64),
        looks=np.zeros(1, dtype=np.int64),
        scratch=np.empty((4, 3, most)),
    )
    geos, away, asked = _AskedOfGeos(agents, now, driver.headway_s), np.empty(n + 1), 0
    ego_states = np.array(ego_states)  # may be read-only, which is another type to numba
    step, k = drive_on(drivers, now, driver, ego_states, tracks, away, 1, 0, NOT_ASKED, 0.0)
    while step < len(ego_states):
        answer, asked = geos.leader_and_gap(k, away), asked + 1
        step, k = drive_on(drivers, now, driver, ego_states, tracks, away, step, k, *answer)
    return tracks, asked


class _AskedOfGeos:
    """What others see of everybody as GEOS has it: shapes that are simplified before each look, so again and again."""

    def __init__(self, agents: NavsimAgents, now: Driving, headway_s: float) -> None:
        self.agents, self.now, self.headway_s = agents, now, headway_s

    def leader_and_gap(self, k: int, away: Array) -> tuple[int, float]:
        """Whose footprint in the strip ahead of agent k is the nearest to its own, or NOBODY; and how far that is [m].

        away: as `_look` leaves it. Raises ValueError where an agent is not in its own way, as at the start it must be.
        """
        unsure = np.isnan(away)
        most = np.inf if unsure.any() else away.min() + 5.0 * SOFT_M
        near = np.flatnonzero(~np.isinf(away) & ~(away > most)).tolist()
        own = self._shape(k)
        if self.now.made_at[k] == 0 or unsure.any():
            strip = self._strip_ahead(k)
            if self.now.made_at[k] == 0 and not shapely.intersects(own, strip):
                problem = "stands beyond the end of its lane's path, where the public traffic looks for its leader"
                about = f"traffic=navsim: agent {self.agents.driven[k].row}"
                raise ValueError(f"{about} {problem}: its centreline has too few points")
            near = [j for j in near if not unsure[j] or shapely.intersects(self._shape(j), strip)]
        if not near:
            return NOBODY, 0.0
        gaps = shapely.distance([self._shape(j) for j in near], own)
        leader = near[int(gaps.argmin())]
        if np.count_nonzero(gaps <= gaps.min() + TIE_M) > 1:
            leader = self._first_of_equals(k, near)
        return leader, float(shapely.length(shapely.shortest_line(own, self._shape(leader))))

    def _strip_ahead(self, k: int) -> shapely.Geometry:
        about = self.agents.driven[k]
        return _strip(about.path.ahead(self.now.progress[k]), about.width / 2.0)

    def _shape(self, j: int) -> shapely.Geometry:
        """Of agent j or the ego, in this look."""
        if self.now.firm[j]:
            return shapely.polygons(self.now.ring[j, :2, : self.now.corners[j]].T + self.agents.drivers.origin)
        at_start = self.now.made_at[j] == 0
        at = *self.now.box[j].tolist(), self.now.progress[j] if j < len(self.agents.driven) else 0.0, self.now.speed[j]
        key = (j, at_start, *map(float, at))
        if key not in (shapes := self.agents.shapes):
            if len(shapes) >= MOST_SHAPES:
                shapes.clear()
            shapes[key] = [self._footprint(j, at_start)]
        made, looks = shapes[key], int(self.now.looks[0] - self.now.made_at[j])
        while len(made) <= looks and not (len(made) > 1 and made[-1] is made[-2]):
            simpler = shapely.simplify(made[-1], SIMPLE_M, preserve_topology=True)
            fewer = shapely.get_num_coordinates(simpler) < shapely.get_num_coordinates(made[-1])
            made.append(simpler if fewer else made[-1])
        return made[min(looks, len(made) - 1)]

    def _footprint(self, j: int, at_start: bool) -> shapely.Geometry:
        """The body and the strip that is covered in the next headway; of the ego, and of all at first, the body."""
        if at_start and j < len(self.agents.driven):
            return self.agents.driven[j].body
        body = box_polygons(self.now.box[j : j + 1])[0]
        if j == len(self.agents.driven):
            return body
        about, progress, half = self.agents.driven[j], self.now.progress[j], self.agents.driven[j].length / 2.0
        stretch = about.path.between(progress - half, progress + half + self.now.speed[j] * self.headway_s)
        return shapely.union_all([_strip(stretch, about.width / 2.0), body])

    def _first_of_equals(self, k: int, near: list[int]) -> int:
        """Of several that are as near, which the public code's trees come to first (STRTreeOccupancyMap).

        A tree of a few is packed by the middles of their bounds; only among equals by the order that its items are
        given in, which is that of a tree of everybody.
        """
        shapes = np.array([self._shape(j) for j in near], dtype=object)
        if len(near) > FEW or _beside(shapes, TIE_M).any():
            here = np.flatnonzero(self.now.here)
            every = shapely.box(*(self.now.bounds[here] + np.tile(self.agents.drivers.origin, 2)).T)
            exact = np.isin(here, near) | (self.now.off[here] > MOVED_M)
            every[exact] = [self._shape(j) for j in here[exact].tolist()]
            exact = _beside(every, 4.0 * MOVED_M)
            every[exact] = [self._shape(j) for j in here[exact].tolist()]
            near = [j for j in here[shapely.STRtree(every).query(self._strip_ahead(k))].tolist() if j in near]
            shapes = np.array([self._shape(j) for j in near], dtype=object)
        return near[int(shapely.STRtree(shapes).nearest(self._shape(k)))]


def _beside(shapes: NDArray[np.object_], within_m: float) -> Bools:
    """(N,) of which shapes the middle of the bounds is so near to another's along one of the axes."""
    around = shapely.bounds(shapes)
    beside: Bools = np.zeros(len(shapes), dtype=bool)
    for middles in ((around[:, :2] + around[:, 2:]) / 2.0).T:
        order = middles.argsort()
        close = np.diff(middles[order]) < within_m
        beside[order[1:]] |= close
        beside[order[:-1]] |= close
    return beside


def _strip(line: Array, half_width: float) -> shapely.Geometry:
    return shapely.buffer(shapely.LineString(line), half_width, quad_segs=QUADRANT, cap_style="flat")

"""The vector map around a clip: lanes with their graph, drivable areas, crossings, lights."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from tasks.world.arrays import Array, Bools, Ints
from tasks.world.frames import PACIFICA, SLACK_M, to_local, wrap_angle


@dataclass(frozen=True)
class Lane:
    """One lane segment; polylines run in driving direction, world frame, metres."""

    lane_id: str
    ring: Array  # (M, 2) closed exterior ring of the lane polygon
    centerline: Array  # (P, 3) x, y, heading [rad]
    is_intersection: bool  # True: a lane connector inside a junction
    drives_cars: bool  # VEHICLE and BUS lanes; bicycle lanes are kept for drawing only
    successors: tuple[str, ...] = ()
    predecessors: tuple[str, ...] = ()
    left_neighbor: str | None = None  # may name a lane outside the map, or one of the opposite direction
    right_neighbor: str | None = None
    speed_limit_mps: float | None = None
    left_boundary: Array | None = None  # (B, 3) x, y, z; None where the source has none
    right_boundary: Array | None = None
    left_mark: str = "NONE"  # AV2 lane mark type
    right_mark: str = "NONE"

    @property
    def length_m(self) -> float:
        return float(np.hypot(*np.diff(self.centerline[:, :2], axis=0).T).sum())


class MapLayer(StrEnum):
    """Polygon layers the reward looks at (docs/reward.md 2a)."""

    LANE = "LANE"
    LANE_CONNECTOR = "LANE_CONNECTOR"
    INTERSECTION = "INTERSECTION"
    DRIVABLE_AREA = "DRIVABLE_AREA"
    ROADBLOCK = "ROADBLOCK"
    CARPARK_AREA = "CARPARK_AREA"


@dataclass(frozen=True, eq=False)
class MapPolygon:
    """One polygon of the drivable map; its identity is the object's, so that what is made of it can be kept."""

    token: str  # lane id, "int_" + lane id, "da_" + area id
    layer: MapLayer
    ring: Array  # (M, 2) closed exterior ring
    holes: tuple[Array, ...] = ()  # closed rings


@dataclass(frozen=True, eq=False)
class RoadMap:
    """The map a log carries, in file order; its identity is the object's, so that what is made of it can be kept."""

    lanes: Mapping[str, Lane]
    drivable_areas: tuple[MapPolygon, ...]  # of layers DRIVABLE_AREA, ROADBLOCK, CARPARK_AREA
    crossings: tuple[Array, ...] = ()  # closed rings (M, 2)
    roadblock_of: Mapping[str, str] = field(default_factory=dict)  # lane id -> roadblock (connector) id
    location: str = ""
    intersections: tuple[MapPolygon, ...] | None = None  # None: every intersection lane's own polygon is one

    @property
    def road_rings(self) -> tuple[Array, ...]:
        """Closed exterior rings of all that may be driven on, lanes not named again."""
        return tuple(area.ring for area in (*self.drivable_areas, *(self.intersections or ())))


@dataclass(frozen=True)
class Route:
    """Where the ego is going (docs/reward.md 0, route of a log that has no planner's route)."""

    lane_path: tuple[str, ...]  # lanes driven, in order
    roadblock_ids: tuple[str, ...]  # roadblocks passed, in order
    lane_ids: frozenset[str]  # all lanes of the roadblocks passed ("on route")
    lit_lane_ids: frozenset[str] | None = None  # lanes whose red lights the reward sees; None: those on route


class LightState(IntEnum):
    UNKNOWN = 0
    GREEN = 1
    YELLOW = 2
    RED = 3


@dataclass(frozen=True)
class TrafficLights:
    """State of the light that governs each listed lane connector, per 0.1 s step of the clip."""

    lane_ids: tuple[str, ...] = ()  # (L,)
    states: NDArray[np.int8] = field(default_factory=lambda: np.zeros((0, 0), np.int8))  # (S, L) LightState


NO_LIGHTS = TrafficLights()


# Lane geometry from boundaries, point queries on many rings at once, and the map layers near a point.
#
# Plain numpy: a query on a route's dozen lanes costs less than one shapely call per lane, and importing stays light.

CENTERLINE_SPACING_M = 0.75  # docs/reward.md 0
MAX_LANE_M = 20_000.0  # longer is a broken coordinate, and would ask for any amount of points
PLACES_KEPT = 8  # of each map
MAP_RADIUS_M = 100.0  # docs/reward.md 0


def arc_lengths(polyline: Array) -> Array:
    """Arc length [m] at each point of a polyline (P, 2+), measured in x, y; starts at 0."""
    along = np.zeros(len(polyline))
    x, y = polyline[:, 0], polyline[:, 1]
    np.cumsum(np.hypot(x[1:] - x[:-1], y[1:] - y[:-1]), out=along[1:])
    return along


def resample(polyline: Array, n_points: int, along: Array | None = None) -> Array:
    """A polyline (P, C) resampled uniformly by arc length in x, y to (n_points, C); along: arc lengths, if known."""
    along = arc_lengths(polyline) if along is None else along
    at = np.linspace(0.0, along[-1], n_points)
    resampled = np.empty((n_points, polyline.shape[1]))
    for column in range(polyline.shape[1]):
        resampled[:, column] = np.interp(at, along, polyline[:, column])
    return resampled


def n_spaced(length_m: float) -> int:
    """Points of a centreline of that length. Raises ValueError beyond MAX_LANE_M."""
    if not length_m <= MAX_LANE_M:
        raise ValueError(f"a lane of {length_m:.0f} m")
    return max(2, int(np.ceil(length_m / CENTERLINE_SPACING_M)) + 1)


def with_headings(points: Array) -> Array:
    """Points (P, 2), P >= 2, with the direction [rad] of the segment that starts there; the last repeats: (P, 3)."""
    steps = np.diff(points, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    return np.column_stack([points, np.append(heading, heading[-1])])


def centerline_from_boundaries(left: Array, right: Array) -> Array:
    """Centreline (P, 3) x, y, heading: mean of the two boundaries (B, 2+), P = max(2, ceil(L / 0.75) + 1).

    L is the mean of the two lengths; each boundary is resampled uniformly by arc length (docs/reward.md 0). Raises
    ValueError where L is beyond MAX_LANE_M.
    """
    along = arc_lengths(left), arc_lengths(right)
    n_points = n_spaced((along[0][-1] + along[1][-1]) / 2.0)
    sides = resample(left[:, :2], n_points, along[0]), resample(right[:, :2], n_points, along[1])
    return with_headings((sides[0] + sides[1]) / 2.0)


def ring_from_boundaries(left: Array, right: Array) -> Array:
    """Closed ring (M, 2): left boundary, reversed right boundary; made valid if it is not, largest part kept."""
    ring = np.concatenate([left[:, :2], right[::-1, :2], left[:1, :2]])
    return valid_ring(ring)


def valid_ring(ring: Array) -> Array:
    """The closed ring (M, 2) itself when it bounds a valid polygon, else the largest part of the repaired one.

    Raises ValueError where nothing of any area is left.
    """
    import shapely  # here alone: importing the map types must stay cheap

    polygon = shapely.Polygon(ring)
    if polygon.is_valid and not polygon.is_empty:
        return ring
    repaired = shapely.make_valid(polygon)
    parts = [part for part in shapely.get_parts(shapely.get_parts(repaired)) if part.geom_type == "Polygon"]
    if not parts:
        raise ValueError("the ring bounds no area")
    return np.asarray(max(parts, key=lambda part: part.area).exterior.coords, dtype=np.float64)[:, :2]


class Rings:
    """Point queries against N closed rings at once; a point on an edge may count as inside or outside."""

    def __init__(self, rings: Sequence[Array]) -> None:
        """rings: N >= 1 arrays (M_i, 2), M_i >= 2, closed."""
        self._start = np.concatenate([ring[:-1] for ring in rings])
        self._step = np.concatenate([np.diff(ring, axis=0) for ring in rings])
        self._square = np.maximum((self._step**2).sum(axis=1), 1e-300)  # a repeated point is a segment of length 0
        self._count = np.array([len(ring) - 1 for ring in rings])
        self._low = np.array([ring.min(axis=0) for ring in rings])
        self._high = np.array([ring.max(axis=0) for ring in rings])

    def contains(self, point: Array) -> Bools:
        """(N,) whether the point (2,) is inside each ring, by the even-odd rule."""
        return _inside(point, self._start, self._step, self._count)

    def distances(self, point: Array, within_m: float = np.inf) -> Array:
        """(N,) distance [m] from the point (2,) to each polygon; 0 inside, or inf where it is more than `within_m`."""
        near = (np.maximum(self._low - point, point - self._high) <= within_m + SLACK_M).all(axis=1)
        found = np.full(len(near), np.inf)
        if not near.any():
            return found
        on, count = np.repeat(near, self._count), self._count[near]
        start, step = self._start[on], self._step[on]
        x, y = (point - start).T
        along = np.clip((x * step[:, 0] + y * step[:, 1]) / self._square[on], 0.0, 1.0)
        to_edge = np.hypot(x - along * step[:, 0], y - along * step[:, 1])
        nearest = np.minimum.reduceat(to_edge, _firsts(count))
        found[near] = np.where(_inside(point, start, step, count), 0.0, nearest)
        return np.where(found <= within_m, found, np.inf)


def _inside(point: Array, start: Array, step: Array, count: Ints) -> Bools:
    """(N,) whether the point (2,) is inside each ring; their edges, `count` (N,) each, stand one after another."""
    y0 = start[:, 1] - point[1]
    y1 = y0 + step[:, 1]
    crosses = (y0 > 0.0) != (y1 > 0.0)
    rise = np.where(crosses, step[:, 1], 1.0)
    right_of_point = start[:, 0] - point[0] - y0 * step[:, 0] / rise > 0.0
    crossed = np.add.reduceat((crosses & right_of_point).astype(np.int64), _firsts(count))
    return crossed % 2 == 1


def _firsts(count: Ints) -> Ints:
    """(N,) where each of the groups begins."""
    return np.cumsum(count) - count


def polygons_near(road_map: RoadMap, center_xy: Array, radius_m: float = MAP_RADIUS_M) -> tuple[MapPolygon, ...]:
    """Every polygon of the drivable map within `radius_m` of a point (2,), in the reference's order.

    LANE, LANE_CONNECTOR, INTERSECTION (the map's own, else one per intersection lane), drivable areas, each in file
    order; only lanes that cars drive (docs/reward.md 0). The same map gives the same objects again.
    """
    if road_map not in _DRIVABLE:
        every = _drivable_map(road_map)
        _DRIVABLE[road_map] = every, Rings([polygon.ring for polygon in every]) if every else None, {}
    every, rings, known = _DRIVABLE[road_map]
    if rings is None:
        return ()
    around = float(center_xy[0]), float(center_xy[1]), float(radius_m)
    found = known.get(around)
    if found is None:
        near = rings.distances(np.array(around[:2]), radius_m) <= radius_m
        found = tuple(polygon for polygon, is_near in zip(every, near, strict=True) if is_near)
        if len(known) >= PLACES_KEPT:
            known.clear()
        known[around] = found
    return found


# Laid out once per map; and an attempt asks for the same place several times: its planner and its score.
_Known = dict[tuple[float, float, float], tuple[MapPolygon, ...]]
_DRIVABLE: WeakKeyDictionary[RoadMap, tuple[tuple[MapPolygon, ...], Rings | None, _Known]] = WeakKeyDictionary()


def _drivable_map(road_map: RoadMap) -> tuple[MapPolygon, ...]:
    lanes = [lane for lane in road_map.lanes.values() if lane.drives_cars]
    connectors = [lane for lane in lanes if lane.is_intersection]
    own = road_map.intersections
    each = (MapPolygon(f"int_{lane.lane_id}", MapLayer.INTERSECTION, lane.ring) for lane in connectors)
    return (
        *(MapPolygon(lane.lane_id, MapLayer.LANE, lane.ring) for lane in lanes if not lane.is_intersection),
        *(MapPolygon(lane.lane_id, MapLayer.LANE_CONNECTOR, lane.ring) for lane in connectors),
        *(each if own is None else own),
        *road_map.drivable_areas,
    )


# Where a log was going: roadblocks, the lanes driven, and the centreline ahead of any pose.
#
# docs/reward.md 0, "Route and map of a log that has no planner's route". Works for any map with a lane graph.

MAX_LANE_DISTANCE_M = 1.0
MAX_HEADING_ERROR_RAD = 1.2
COST_PER_M_TO_LANE, COST_PER_RAD, COST_PER_M_TO_CENTERLINE = 2.0, 2.0, 0.5
COST_SAME_LANE, COST_SUCCESSOR, COST_SAME_ROADBLOCK, COST_JUMP = 0.0, 0.2, 5.0, 50.0
EXTENSION_M = 150.0
SEARCH_DEPTH = 30  # roadblocks looked ahead for the centreline
SAME_DIRECTION_DOT = 0.5


class NoRoute(ValueError):
    """The log has no route: the ego is never on a lane of the map, or the map does not say what is beside what."""


def roadblocks_of(lanes: Mapping[str, Lane]) -> dict[str, str]:
    """Lane id -> roadblock id, for every lane that cars drive.

    Lanes outside junctions that are neighbours and run the same way (dot of their unit directions > 0.5) share
    "rb_<lane>"; junction lanes between the same two roadblocks share "rbc_<from>><to>", and one whose first
    predecessor or successor is no such lane stands alone as "rbc_<lane>".
    """
    drivable = {lane_id: lane for lane_id, lane in lanes.items() if lane.drives_cars}
    parent = {lane_id: lane_id for lane_id, lane in drivable.items() if not lane.is_intersection}

    def root(lane_id: str) -> str:
        while parent[lane_id] != lane_id:
            lane_id = parent[lane_id]
        return lane_id

    for lane_id in parent:
        lane = drivable[lane_id]
        for neighbor in (lane.left_neighbor, lane.right_neighbor):  # left first: it decides the group's name
            if neighbor in parent and _direction(lane) @ _direction(drivable[neighbor]) > SAME_DIRECTION_DOT:
                parent[root(lane_id)] = root(neighbor)

    blocks = {}
    for lane_id, lane in drivable.items():
        if not lane.is_intersection:
            blocks[lane_id] = f"rb_{root(lane_id)}"
            continue
        before = [f"rb_{root(other)}" for other in lane.predecessors if other in parent]
        after = [f"rb_{root(other)}" for other in lane.successors if other in parent]
        blocks[lane_id] = f"rbc_{before[0]}>{after[0]}" if before and after else f"rbc_{lane_id}"
    return blocks


def route_of_log(road_map: RoadMap, poses: Array) -> Route:
    """The route of a whole log from its rear-axle poses (T, 3) every 0.2 s.

    The driven lanes, extended past the log's end by EXTENSION_M along the straightest successors, and all lanes of
    the roadblocks they pass. Raises NoRoute.
    """
    path = list(driven_lanes(road_map, poses))
    path += _straight_on(road_map, path, EXTENSION_M)
    roadblock_ids = tuple(dict.fromkeys(road_map.roadblock_of[lane_id] for lane_id in path))
    passed = frozenset(roadblock_ids)
    on_route = frozenset(lane_id for lane_id, block in road_map.roadblock_of.items() if block in passed)
    return Route(tuple(path), roadblock_ids, on_route)


def driven_lanes(road_map: RoadMap, poses: Array) -> tuple[str, ...]:
    """Lanes driven in order: the Viterbi path of the poses (T, 3), every 0.2 s, over the lanes near each.

    A pose's candidates lie within 1 m and 1.2 rad; poses without a candidate are passed over. Raises NoRoute.
    """
    lanes = [lane for lane in road_map.lanes.values() if lane.drives_cars]
    if not lanes:
        raise NoRoute("the map has no lane that cars drive")
    _refuse_without_roadblock(road_map, [lane.lane_id for lane in lanes])
    rings = Rings([lane.ring for lane in lanes])
    cost: dict[str, float] = {}
    came_from: list[dict[str, str | None]] = []
    for pose in poses:
        here = _candidate_costs(lanes, rings.distances(pose[:2], MAX_LANE_DISTANCE_M), pose)
        if not here:
            continue
        total: dict[str, float] = {}
        source: dict[str, str | None] = {}
        for lane_id, own_cost in here.items():
            reach = {old: spent + _transition_cost(road_map, old, lane_id) for old, spent in cost.items()}
            best = min(reach, key=reach.__getitem__) if reach else None
            total[lane_id] = own_cost + (reach[best] if best is not None else 0.0)
            source[lane_id] = best
        cost = total
        came_from.append(source)
    if not cost:
        raise NoRoute("the ego is never within 1 m and 1.2 rad of a lane that cars drive")

    lane_at: str | None = min(cost, key=cost.__getitem__)
    backwards: list[str] = []
    for source in reversed(came_from):
        assert lane_at is not None
        if not backwards or backwards[-1] != lane_at:
            backwards.append(lane_at)
        lane_at = source[lane_at]
    return tuple(reversed(backwards))


class CenterlineFinder:
    """The centreline ahead of many poses on one route: prepared once, then well under a millisecond per pose."""

    def __init__(self, road_map: RoadMap, route: Route) -> None:
        """Raises NoRoute where the map has none of the route's lanes."""
        self._lanes = {lane_id: lane for lane_id, lane in road_map.lanes.items() if lane_id in route.lane_ids}
        if not self._lanes:
            raise NoRoute("the route names no lane of the map")
        _refuse_without_roadblock(road_map, self._lanes)
        self._ids = list(self._lanes)
        self._rings = Rings([lane.ring for lane in self._lanes.values()])
        self._block_of = road_map.roadblock_of
        self._blocks = route.roadblock_ids
        self._lengths = {lane_id: lane.length_m for lane_id, lane in self._lanes.items()}
        self._centerlines: dict[str, Array] = {}

    def centerline_from(self, pose: Array) -> Array:
        """(P, 3) x, y, heading: centreline of the route's lanes from the one the rear-axle pose (3,) is on.

        Where two lanes join, the point they share stands twice. The array is shared between calls: read-only.
        """
        start = self.starting_lane(pose)
        if start not in self._centerlines:
            path = self.lane_path_from(start)
            centerline = np.concatenate([self._lanes[lane_id].centerline for lane_id in path])
            centerline.setflags(write=False)
            self._centerlines[start] = centerline
        return self._centerlines[start]

    def starting_lane(self, pose: Array) -> str:
        """The on-route lane that contains the rear axle with the smallest heading error at its nearest centreline pose.

        If none does: the first that contains the ego's centre, else the one nearest to that centre.
        """
        inside = np.flatnonzero(self._rings.contains(pose[:2]))
        if inside.size:
            errors = [abs(_nearest_centerline_pose(self._lanes[self._ids[i]], pose)[1]) for i in inside]
            return self._ids[inside[int(np.argmin(errors))]]
        forward = np.array([np.cos(pose[2]), np.sin(pose[2])])
        center = pose[:2] + PACIFICA.rear_axle_to_center * forward
        return self._ids[int(np.argmin(self._rings.distances(center)))]

    def metres_ahead(self, pose: Array, within_m: float, within_rad: float, enough_m: float) -> float | None:
        """Metres that lanes of the route lead on from a rear-axle pose (3,), along the longest way; inf: to its end.

        None where no lane of the route lies within `within_m` of the pose and runs within `within_rad` of its heading.
        Of a way that is `enough_m` long no more is looked at. Lanes are not changed on it.
        """
        waiting: list[tuple[str, float]] = []  # a lane, and the way up to its end
        for index in np.flatnonzero(self._rings.distances(pose[:2], within_m) <= within_m).tolist():
            line = self._lanes[self._ids[index]].centerline
            at = int(np.argmin(np.hypot(*(line[:, :2] - pose[:2]).T)))
            if abs(float(wrap_angle(line[at, 2] - pose[2]))) <= within_rad:
                waiting.append((self._ids[index], float(np.hypot(*np.diff(line[at:, :2], axis=0).T).sum())))
        longest: dict[str, float] = {}
        while waiting:
            lane_id, metres = waiting.pop()
            if self._block_of[lane_id] == self._blocks[-1]:
                return np.inf
            if metres > longest.get(lane_id, -1.0):
                longest[lane_id] = metres
                if metres < enough_m:
                    following = (other for other in self._lanes[lane_id].successors if other in self._lanes)
                    waiting += [(other, metres + self._lengths[other]) for other in following]
        return max(longest.values(), default=None)

    def lane_path_from(self, start: str) -> list[str]:
        """Cheapest lane path (cost: lane length) to the last of the next 30 route roadblocks.

        Only on-route lanes are entered. Where that roadblock cannot be reached: to the deepest lane, the cheapest of
        those.
        """
        first = self._blocks.index(self._block_of[start])
        goal = self._blocks[min(first + SEARCH_DEPTH, len(self._blocks)) - 1]
        frontier = {start: (self._lengths[start], 1)}  # lane id -> (length driven at its end, lanes passed)
        expanded: dict[str, tuple[float, int]] = {}
        came_from: dict[str, str] = {}
        while frontier:
            lane_id = min(frontier, key=lambda key: frontier[key][0])
            driven, depth = expanded[lane_id] = frontier.pop(lane_id)
            if self._block_of[lane_id] == goal:
                return _backtrack(came_from, lane_id)
            for successor in self._lanes[lane_id].successors:
                if successor not in self._lanes or successor in expanded:
                    continue
                length = driven + self._lengths[successor]
                if successor not in frontier or length < frontier[successor][0]:
                    frontier[successor] = (length, depth + 1)
                    came_from[successor] = lane_id
        deepest = min(expanded, key=lambda key: (-expanded[key][1], expanded[key][0]))
        return _backtrack(came_from, deepest)


@lru_cache(maxsize=4)
def centerline_finder(road_map: RoadMap, route: Route) -> CenterlineFinder:
    """The same one again for the map and route of the last few clips: every attempt on a clip asks twice."""
    return CenterlineFinder(road_map, route)


def _refuse_without_roadblock(road_map: RoadMap, lane_ids: Iterable[str]) -> None:
    without = [lane_id for lane_id in lane_ids if lane_id not in road_map.roadblock_of]
    if without:
        raise NoRoute(
            f"road_map.roadblock_of has no roadblock of lane {without[0]}: fill it with "
            "tasks.world.road_map.roadblocks_of(lanes)"
        )


def _direction(lane: Lane) -> Array:
    """Unit vector from the first to the last centreline point; zeros for a closed loop."""
    vector: Array = lane.centerline[-1, :2] - lane.centerline[0, :2]
    return vector / max(float(np.hypot(*vector)), 1e-12)


def _nearest_centerline_pose(lane: Lane, pose: Array) -> tuple[float, float]:
    """Distance [m] to the nearest centreline pose and the heading difference [rad] to it."""
    distances = np.hypot(*(lane.centerline[:, :2] - pose[:2]).T)
    nearest = int(np.argmin(distances))
    return float(distances[nearest]), float(wrap_angle(lane.centerline[nearest, 2] - pose[2]))


def _candidate_costs(lanes: Sequence[Lane], distances: Array, pose: Array) -> dict[str, float]:
    """Cost of each lane that the pose (3,) may be on."""
    costs = {}
    for index in np.flatnonzero(distances <= MAX_LANE_DISTANCE_M).tolist():
        to_centerline, heading_error = _nearest_centerline_pose(lanes[index], pose)
        if abs(heading_error) <= MAX_HEADING_ERROR_RAD:
            costs[lanes[index].lane_id] = (
                COST_PER_M_TO_LANE * float(distances[index])
                + COST_PER_RAD * abs(heading_error)
                + COST_PER_M_TO_CENTERLINE * to_centerline
            )
    return costs


def _transition_cost(road_map: RoadMap, before: str, after: str) -> float:
    if after == before:
        return COST_SAME_LANE
    if after in road_map.lanes[before].successors:
        return COST_SUCCESSOR
    return COST_SAME_ROADBLOCK if road_map.roadblock_of[before] == road_map.roadblock_of[after] else COST_JUMP


def _straight_on(road_map: RoadMap, path: Sequence[str], length_m: float) -> list[str]:
    """Lanes after the path's last one, straightest successor first, until `length_m` are added or the map ends."""
    added: list[str] = []
    lane, remaining = road_map.lanes[path[-1]], length_m
    while remaining > 0.0:
        ahead = [
            road_map.lanes[lane_id]
            for lane_id in lane.successors
            if lane_id in road_map.roadblock_of and lane_id not in path and lane_id not in added
        ]
        if not ahead:
            break
        heading = lane.centerline[-1, 2]
        lane = min(ahead, key=lambda other: abs(float(wrap_angle(other.centerline[-1, 2] - heading))))
        added.append(lane.lane_id)
        remaining -= lane.length_m
    return added


def _backtrack(came_from: Mapping[str, str], end: str) -> list[str]:
    path = [end]
    while path[-1] in came_from:
        path.append(came_from[path[-1]])
    return path[::-1]


# The driving command a planner is given: which way the route goes next.

LOOKAHEAD_M = 20.0  # NAVSIM: the route 20 m ahead decides ...
LATERAL_M = 2.0  # ... left or right where it lies 2 m or more to a side
SPACING_M = 0.5  # the route is looked at this densely, however few points it came with


def driving_command(centerline: Array, pose: Array) -> str:
    """left, straight, right, or unknown where less than 20 m of route are left ahead of the rear axle's `pose` (3,).

    NAVSIM's command: the side offset of the route's point 20 m ahead, in the frame of the route at the ego.
    centerline: (P, 3) the route ahead, x, y [m], heading [rad].
    """
    steps = np.hypot(*np.diff(centerline[:, :2], axis=0).T)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    columns = (centerline[:, 0], centerline[:, 1], np.unwrap(centerline[:, 2]))

    def at(lengths: Array) -> Array:
        return np.stack([np.interp(lengths, arc, column) for column in columns], axis=-1)

    along = np.append(np.arange(0.0, arc[-1], SPACING_M), arc[-1])
    route = at(along)
    gaps = np.hypot(*(route[:, :2] - pose[:2]).T) + np.abs(wrap_angle(route[:, 2] - pose[2]))
    nearest = int(np.argmin(gaps))
    ahead = along[nearest] + LOOKAHEAD_M
    if ahead > arc[-1]:
        return "unknown"
    side = float(to_local(route[nearest], at(ahead))[1])
    return "left" if side >= LATERAL_M else "right" if side <= -LATERAL_M else "straight"

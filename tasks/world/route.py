"""Where a log was going: roadblocks, the lanes driven, and the centreline ahead of any pose.

docs/reward.md 0, "Route and map of a log that has no planner's route". Works for any map with a lane graph.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from tasks.world.arrays import Array
from tasks.world.frames import to_local, wrap_angle
from tasks.world.lanes import Lane, RoadMap, Route
from tasks.world.polygons import Rings
from tasks.world.vehicle import PACIFICA

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
        here = _candidate_costs(lanes, rings.distances(pose[:2]), pose)
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


class RouteFinder:
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
        for index in np.flatnonzero(self._rings.distances(pose[:2]) <= within_m).tolist():
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


def centerline_from(road_map: RoadMap, route: Route, pose: Array) -> Array:
    """(P, 3) centreline of the route ahead of one rear-axle pose (3,); for many poses keep a RouteFinder."""
    return RouteFinder(road_map, route).centerline_from(pose)


def _refuse_without_roadblock(road_map: RoadMap, lane_ids: Iterable[str]) -> None:
    without = [lane_id for lane_id in lane_ids if lane_id not in road_map.roadblock_of]
    if without:
        raise NoRoute(
            f"road_map.roadblock_of has no roadblock of lane {without[0]}: fill it with "
            "tasks.world.route.roadblocks_of(lanes)"
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

"""The route of a log that carries one: its roadblocks mended around the ego's pose, as the public planner mends them.

navsim, pdm_planner: utils/route_utils.py (`route_roadblock_correction`), utils/graph_search, abstract_pdm_planner.py.
"""

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from tasks.world.arrays import Array
from tasks.world.frames import PACIFICA, wrap_angle
from tasks.world.road_map import CenterlineFinder, MapLayer, NoRoute, RoadMap, Route

SEARCH_M = 1.0  # half side of the square in which roadblocks are candidates
MAX_HEADING_ERROR_RAD, MAX_DISPLACEMENT_M = np.pi / 4, 3.0
DEPTH_BACK, DEPTH_AHEAD = 15, 30  # roadblocks searched
AHEAD_TARGETS = 3  # of the route, when it is searched ahead of the ego
LOOP_AREA_M2 = 1.0  # roadblock connectors of one route that share more form a loop


@dataclass(frozen=True)
class Roadblocks:
    """The graph of roadblocks: groups of parallel lanes, and the connectors between two of them."""

    shapes: Mapping[str, Any]  # shapely polygon of each, groups first [m]
    lanes_of: Mapping[str, tuple[str, ...]]  # in file order
    joins: Mapping[str, tuple[str, str]]  # connector -> the groups it leaves and enters
    centerline: Callable[[str], Array]  # of a lane: (P, 3) x, y, heading

    @cached_property
    def _tree(self) -> Any:
        import shapely

        return shapely.STRtree(list(self.shapes.values()))

    @cached_property
    def _connectors(self) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
        """That begin at a group, and that end there."""
        out, into = defaultdict(list), defaultdict(list)
        for connector, (before, after) in self.joins.items():
            out[before].append(connector)
            into[after].append(connector)
        return out, into

    def outgoing(self, block: str) -> Sequence[str]:
        """Groups or connectors after one, in file order."""
        return self.joins[block][1:] if block in self.joins else self._connectors[0].get(block, ())

    def incoming(self, block: str) -> Sequence[str]:
        """Groups or connectors before one, in file order."""
        return self.joins[block][:1] if block in self.joins else self._connectors[1].get(block, ())

    def around(self, xy: Array) -> list[str]:
        """Those that meet the square of 1 m around a point (2,), else the nearest group and the nearest connector."""
        import shapely

        names = list(self.shapes)
        square = shapely.box(*(xy - SEARCH_M), *(xy + SEARCH_M))
        found = [names[i] for i in sorted(self._tree.query(square, predicate="intersects").tolist())]
        if found or not names:
            return found
        distances = shapely.distance(shapely.Point(xy), list(self.shapes.values()))
        is_connector = np.array([name in self.joins for name in names])
        kinds = [np.flatnonzero(is_connector == kind) for kind in (False, True)]
        return [names[kind[int(np.argmin(distances[kind]))]] for kind in kinds if kind.size]


def roadblocks_of_map(road_map: RoadMap) -> Roadblocks:
    """From a map's lanes: a group's polygon is the map's own where it has one, else the union of its lanes'."""
    import shapely

    lanes_of: dict[str, list[str]] = defaultdict(list)
    for lane_id, block in road_map.roadblock_of.items():
        lanes_of[block].append(lane_id)
    own = {
        area.token: shapely.Polygon(area.ring, area.holes)
        for area in road_map.drivable_areas
        if area.layer == MapLayer.ROADBLOCK
    }
    joins: dict[str, tuple[str, str]] = {}
    for block, lane_ids in lanes_of.items():
        lanes = [road_map.lanes[lane_id] for lane_id in lane_ids]
        if not lanes[0].is_intersection:
            continue
        before = _first_block(road_map, [lane for other in lanes for lane in other.predecessors])
        after = _first_block(road_map, [lane for other in lanes for lane in other.successors])
        joins[block] = before, after
    shapes = {
        block: own.get(block) or shapely.union_all([shapely.Polygon(road_map.lanes[lane].ring) for lane in lane_ids])
        for block, lane_ids in sorted(lanes_of.items(), key=lambda item: item[0] in joins)
    }
    held = {block: tuple(ids) for block, ids in lanes_of.items()}
    return Roadblocks(shapes, held, joins, lambda lane_id: road_map.lanes[lane_id].centerline)


def _first_block(road_map: RoadMap, lane_ids: Iterable[str]) -> str:
    """Roadblock of the first lane that the map has; "" for none, which no roadblock is called."""
    return next((road_map.roadblock_of[lane] for lane in lane_ids if lane in road_map.roadblock_of), "")


def route_of_roadblocks(
    road_map: RoadMap, roadblock_ids: Sequence[str], pose: Array, blocks: Roadblocks | None = None
) -> Route:
    """The route through a log's roadblocks, mended at the rear-axle pose (3,), as the public planner drives it.

    `blocks`: the whole city's graph, where the reader has it; without it the search ends at the map's edge.
    Roadblocks beyond the map's edge are left out of the route. Raises NoRoute where none is on the map.
    """
    graph = blocks or roadblocks_of_map(road_map)
    corrected = corrected_roadblocks(graph, roadblock_ids, pose)
    held: dict[str, list[str]] = defaultdict(list)
    for lane_id, block in road_map.roadblock_of.items():
        held[block].append(lane_id)
    passed = [block for block in corrected if block in held]
    lane_ids = [lane_id for block in passed for lane_id in held[block]]
    if not lane_ids:
        raise NoRoute(f"none of the route's roadblocks {list(roadblock_ids)[:5]} is on the map around the ego")
    route = Route((), tuple(passed), frozenset(lane_ids))
    finder = CenterlineFinder(road_map, route)
    start = starting_lane(road_map, lane_ids, pose)
    return Route(tuple(finder.lane_path_from(start)), route.roadblock_ids, route.lane_ids)


def starting_lane(road_map: RoadMap, lane_ids: Sequence[str], pose: Array) -> str:
    """Of lanes in the route's order: the one that holds the rear axle with the least heading error.

    If none does: the first that holds the ego's centre, else the one nearest to the ego's outline.
    """
    import shapely

    polygons = np.array([shapely.Polygon(road_map.lanes[lane_id].ring) for lane_id in lane_ids])
    inside = np.flatnonzero(shapely.intersects(polygons, shapely.Point(pose[:2])))
    if inside.size:
        lines = [road_map.lanes[lane_ids[i]].centerline for i in inside.tolist()]
        return lane_ids[int(inside[np.argmin([_nearest(line, pose)[1] for line in lines])])]
    forward, left = np.array([np.cos(pose[2]), np.sin(pose[2])]), np.array([-np.sin(pose[2]), np.cos(pose[2])])
    center = pose[:2] + PACIFICA.rear_axle_to_center * forward
    holds = np.flatnonzero(shapely.contains(polygons, shapely.Point(center)))
    if holds.size:
        return lane_ids[int(holds[0])]
    along, aside = PACIFICA.half_length * forward, PACIFICA.half_width * left
    outline = shapely.Polygon(
        [center + along + aside, center - along + aside, center - along - aside, center + along - aside]
    )
    return lane_ids[int(np.argmin(shapely.distance(polygons, outline)))]


def corrected_roadblocks(blocks: Roadblocks, roadblock_ids: Sequence[str], pose: Array) -> list[str]:
    """The route's roadblocks, with a way from the ego's own, gaps filled and loops cut off. Raises NoRoute.

    Ids that are no roadblock of `blocks` are left out.
    """
    route = [block for block in dict.fromkeys(roadblock_ids) if block in blocks.shapes]
    if not route:
        raise NoRoute(f"none of the route's roadblocks {list(roadblock_ids)[:5]} is on the map")
    start, candidates = roadblocks_at_pose(blocks, route, pose)
    if start not in route:
        back = _search(blocks.incoming, route[0], candidates, DEPTH_BACK)
        if back:
            route[:0] = back[:0:-1]
        else:
            ahead = _search(blocks.outgoing, start, route[:AHEAD_TARGETS], DEPTH_AHEAD)
            if ahead:
                route = ahead + route[route.index(ahead[-1]) + 1 :]
    linked = route[:1]
    for before, after in itertools.pairwise(route):
        if before not in blocks.incoming(after):
            linked += _search(blocks.outgoing, before, [after], DEPTH_AHEAD)[1:-1]
        linked.append(after)
    return _without_loop(blocks, linked)


def roadblocks_at_pose(blocks: Roadblocks, route: Sequence[str], pose: Array) -> tuple[str, list[str]]:
    """The roadblock that the pose (3,) is on, one of the route's before others, and all that it may be on."""
    found = blocks.around(pose[:2])
    on_route: list[tuple[float, str]] = []
    off_route: list[tuple[float, str]] = []
    nearest: list[float] = []
    for block in found:
        errors = [_nearest(blocks.centerline(lane_id), pose) for lane_id in blocks.lanes_of.get(block, ())]
        nearest.append(min((displacement for displacement, _ in errors), default=np.inf))
        fitting = [(d, block) for d, h in errors if h < MAX_HEADING_ERROR_RAD and d < MAX_DISPLACEMENT_M]
        (on_route if block in route else off_route).extend(fitting)
    for candidates in (on_route, off_route):
        if candidates:
            best = int(np.argmin([displacement for displacement, _ in candidates]))
            return candidates[best][1], [block for _, block in candidates]
    return found[int(np.argmin(nearest))], found


def _nearest(centerline: Array, pose: Array) -> tuple[float, float]:
    """Distance [m] from a pose (3,) to the nearest centreline point, and the heading error [rad] there, >= 0."""
    distances = np.hypot(*(centerline[:, :2] - pose[:2]).T)
    at = int(np.argmin(distances))
    return float(distances[at]), abs(float(wrap_angle(centerline[at, 2] - pose[2])))


def _search(beyond: Callable[[str], Sequence[str]], start: str, targets: Sequence[str], max_depth: int) -> list[str]:
    """The public breadth-first path from `start` to the first target it meets; empty: there is none within the depth.

    The public search keeps every way to a roadblock in its queue and the last one it saw as the way there, so that the
    queue grows with every fork. Kept here of each depth: the order of first sights, which decides the target, and the
    order of last sights, which decides the way.
    """
    first, last = [start], [start]
    parents: list[dict[str, str]] = []
    for _ in range(max_depth):
        goal = next((block for block in first if block in targets), None)
        if goal is not None:
            path = [goal]
            for parent in reversed(parents):
                path.append(parent[path[-1]])
            return path[::-1]
        first = list(dict.fromkeys(after for block in first for after in beyond(block)))
        seen = [(after, block) for block in last for after in beyond(block)]
        parents.append(dict(seen))
        last = list(dict.fromkeys(after for after, _ in reversed(seen)))[::-1]
        if not first:
            break
    return []


def _without_loop(blocks: Roadblocks, route: list[str]) -> list[str]:
    """Cut before the first connector that shares over 1 m2 with an earlier one."""
    import shapely

    earlier: list[Any] = []
    for i, block in enumerate(route):
        if block in blocks.joins:
            shape = blocks.shapes[block]
            if earlier and (shapely.area(shapely.intersection(np.array(earlier), shape)) > LOOP_AREA_M2).any():
                return route[:i]
            earlier.append(shape)
    return route

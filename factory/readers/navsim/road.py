"""The road around a drive in NAVSIM's frames, from nuPlan's maps."""

from dataclasses import dataclass, replace
from pathlib import Path

from factory.readers.base import BadClip
from factory.readers.navsim.log import Frame
from factory.readers.nuplan_maps.city import open_city
from tasks.world.arrays import Array
from tasks.world.lanes import RoadMap, Route
from tasks.world.roadblocks import corrected_roadblocks, route_of_roadblocks
from tasks.world.route import NoRoute, RouteFinder

MAP_RADIUS_M = 150.0  # around the drive: the reward's 100 m, and room for one that strays


@dataclass(frozen=True)
class RoadAhead:
    """The map around a drive and the way through it."""

    road_map: RoadMap
    route: Route
    centerline: Array  # (P, 3) from the lane of the pose at T along the route


def road_around(maps: Path, frame: Frame, along_xy: Array, pose: Array, file: str, number: int) -> RoadAhead:
    """The map around the drive (S, 2) and along its route; the route and its centre line from `pose` (3,) at `frame`.

    Lights count on the lanes of the log's own roadblocks, before the route is mended: the public metric cache
    gathers the one and the other so (metric_cache_processor.py, `_load_route_dicts` and `_build_pdm_observation`).
    file, number: of the frame there. Raises BadClip, which names both.
    """
    city = open_city(maps, frame.map_location)
    blocks = city.roadblocks
    try:
        passed = corrected_roadblocks(blocks, frame.roadblock_ids, pose)
        own = [block for block in frame.roadblock_ids if block in blocks.lanes_of]
        lit = frozenset(lane_id for block in own for lane_id in blocks.lanes_of[block])
        along = [lane_id for block in passed for lane_id in blocks.lanes_of.get(block, ())]
        road_map = city.road_map(along_xy, MAP_RADIUS_M, along)
        route = replace(route_of_roadblocks(road_map, frame.roadblock_ids, pose, blocks), lit_lane_ids=lit)
        return RoadAhead(road_map, route, RouteFinder(road_map, route).centerline_from(pose))
    except NoRoute as error:
        raise BadClip(file, f"frames[{number}].roadblock_ids", str(error)) from error

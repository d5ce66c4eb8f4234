"""The road around NAVSIM's frames, from nuPlan's maps as `clips=navsim` takes it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from factory.imports.scenes import RoadAhead
from factory.readers.base import BadClip
from factory.readers.navsim.log import Frame
from factory.readers.navsim.tracks import ego_states
from factory.readers.nuplan_maps.city import open_city
from tasks.world.roadblocks import corrected_roadblocks, route_of_roadblocks
from tasks.world.route import NoRoute, RouteFinder

MAP_RADIUS_M = 150.0  # around the drive, as in clips=navsim


def road_around(maps: Path, driven: Sequence[Frame], now: int, file: str) -> RoadAhead:
    """Map, route and centre line at frame `now` of frames whose ego is known. Raises BadClip."""
    frame = driven[now]
    city = open_city(maps, frame.map_location)
    blocks = city.roadblocks
    try:
        passed = corrected_roadblocks(blocks, frame.roadblock_ids, frame.pose)
        own = [block for block in frame.roadblock_ids if block in blocks.lanes_of]
        lit = frozenset(lane_id for block in own for lane_id in blocks.lanes_of[block])
        along = [lane_id for block in passed for lane_id in blocks.lanes_of.get(block, ())]
        road_map = city.road_map(ego_states(driven)[:, :2], MAP_RADIUS_M, along)
        route = replace(route_of_roadblocks(road_map, frame.roadblock_ids, frame.pose, blocks), lit_lane_ids=lit)
        return RoadAhead(road_map, route, RouteFinder(road_map, route).centerline_from(frame.pose))
    except NoRoute as error:
        raise BadClip(file, f"frames[{now}].roadblock_ids", str(error)) from error

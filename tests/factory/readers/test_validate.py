"""What a reader leaves out or gets wrong is told at the door, by clip and field, not deep in the science."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from factory.readers.base import BadClip, ClipIndex, ClipRef, read_clip
from factory.readers.logs import route_of_drive
from tasks.world.clip import Clip, SensorFile
from tasks.world.road_map import CenterlineFinder, NoRoute, RoadMap, roadblocks_of
from tests.tasks.streets import street_clip

REF = ClipRef("street", "street", 2000)


def a_clip() -> Clip:
    return replace(street_clip(), clip_id=REF.clip_id, dataset=REF.dataset)


@dataclass
class OneClip:
    """A reader of whatever it is given."""

    clip: Any
    name: str = REF.dataset

    def index(self) -> ClipIndex:
        return ClipIndex((REF,))

    def read(self, ref: ClipRef) -> Any:
        return self.clip


def with_map(**changes: Any) -> Callable[[Clip], Clip]:
    return lambda clip: replace(clip, road_map=replace(clip.road_map, **changes))


def with_lane(**changes: Any) -> Callable[[Clip], Clip]:
    """The lane "in", changed."""

    def changed(clip: Clip) -> Clip:
        lanes = {**clip.road_map.lanes, "in": replace(clip.road_map.lanes["in"], **changes)}
        return replace(clip, road_map=replace(clip.road_map, lanes=lanes))

    return changed


def with_agents(**changes: Any) -> Callable[[Clip], Clip]:
    return lambda clip: replace(clip, agents=replace(clip.agents, **changes))


def with_route(**changes: Any) -> Callable[[Clip], Clip]:
    return lambda clip: replace(clip, route=replace(clip.route, **changes))


POSELESS = SensorFile("lidar", "0.feather", 0.0, np.eye(3))
FAULTS: dict[str, tuple[Callable[[Clip], Any], str]] = {
    "no roadblocks": (with_map(roadblock_of={}), "road_map.roadblock_of: has no roadblock of on-route cross"),
    "a roadblock of nothing": (
        lambda c: with_map(roadblock_of={**c.road_map.roadblock_of, "gone": "rb"})(c),
        "road_map.roadblock_of: names lanes that are not on the map: gone",
    ),
    "a route beside its roadblocks": (with_route(roadblock_ids=("rb_in",)), "route.roadblock_ids: lacks .* rb_cross"),
    "a route off the map": (with_route(lane_ids=frozenset({"nowhere"})), "route.lane_ids: not on the map: nowhere"),
    "a path off the map": (with_route(lane_path=("nowhere",)), "route.lane_path: not on the map: nowhere"),
    "no route": (with_route(lane_ids=frozenset()), "route.lane_ids: empty"),
    "a ring in space": (with_lane(ring=np.zeros((5, 3))), r"lanes\['in'\].ring: shape \(5, 3\), expected \(any, 2\)"),
    "a triangle left open": (with_lane(ring=np.eye(3, 2)), r"lanes\['in'\].ring: 3 points"),
    "a centreline without headings": (with_lane(centerline=np.zeros((9, 2))), r"lanes\['in'\].centerline: shape"),
    "a centreline of a point": (with_lane(centerline=np.zeros((1, 3))), r"lanes\['in'\].centerline: 1 points"),
    "a lane under another name": (with_lane(lane_id="inn"), r"lanes\['in'\]: its lane_id is 'inn'"),
    "a flat boundary": (with_lane(left_boundary=np.zeros((4, 2))), r"lanes\['in'\].left_boundary: shape"),
    "no lane for cars": (with_map(lanes={}), "road_map.lanes: no lane for cars"),
    "a crossing as a list": (with_map(crossings=([[0, 0]],)), r"road_map.crossings\[0\]: is a list"),
    "no map": (lambda c: replace(c, road_map=None), r"road_map: is a NoneType, expected .*\.RoadMap"),
    "agents as a list": (lambda c: replace(c, agents=[]), "agents: is a list, expected .*AgentTracks"),
    "lanes as mappings": (with_map(lanes={"in": {}}), r"lanes\['in'\]: is a dict, expected .*Lane"),
    "no licence": (lambda c: replace(c, licence=None), "licence: is a NoneType, expected text"),
    "another clip": (lambda c: replace(c, clip_id="mine"), "clip_id: is 'mine', expected the ref's"),
    "another log": (lambda c: replace(c, log_id="other"), "log_id: is 'other'"),
    "no clip": (lambda c: None, "read: gave a NoneType"),
    "an own split": (lambda c: replace(c, split="training"), "split: 'training' is none of train, val, test"),
    "short states": (lambda c: replace(c, ego_states=c.ego_states[:95]), r"ego_states: shape .*expected \(96, 11\)"),
    "states as a list": (lambda c: replace(c, ego_states=c.ego_states.tolist()), "ego_states: is a list"),
    "NaN in a pose": (lambda c: replace(c, world_from_ego=c.world_from_ego * np.nan), "world_from_ego: not finite"),
    "kinds as words": (with_agents(kinds=("VEHICLE", "car", "PEDESTRIAN", "cone")), "agents.kinds: 'PEDESTRIAN', "),
    "presence as numbers": (
        lambda c: with_agents(valid=c.agents.valid.astype(int))(c),
        "agents.valid: dtype int64, expected bool",
    ),
    "boxes without size": (
        lambda c: with_agents(boxes=c.agents.boxes * np.array([1.0, 1.0, 1.0, 0.0, 1.0]))(c),
        "agents.boxes: a length or width is not positive",
    ),
    "lights of other steps": (
        lambda c: replace(c, lights=replace(c.lights, states=c.lights.states[:40])),
        r"lights.states: shape \(40, 1\), expected \(96, 1\)",
    ),
    "lights of another code": (
        lambda c: replace(c, lights=replace(c.lights, states=c.lights.states + 7)),
        "lights.states: 8: expected tasks.world.road_map.LightState",
    ),
    "a line as the route ahead": (lambda c: replace(c, centerline=c.centerline[:1]), "centerline: 1 points"),
    "a photo of no camera": (
        lambda c: replace(c, images=(SensorFile("front", "0.jpg", 0.0, np.eye(4)),)),
        r"images: no calibration of camera \['front'\]",
    ),
    "a sweep without a pose": (lambda c: replace(c, sweeps=(POSELESS,)), r"sweeps\[0\].world_from_ego: shape \(3, 3\)"),
}


def test_a_whole_clip_passes_as_it_is() -> None:
    clip = a_clip()
    assert read_clip(OneClip(clip), REF) is clip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told_by_clip_and_field(fault: str) -> None:
    spoil, told = FAULTS[fault]
    with pytest.raises(BadClip, match=rf"clip {REF.clip_id} \(street street at 2 s\): .*{told}"):
        read_clip(OneClip(spoil(a_clip())), REF)


def test_a_map_without_roadblocks_has_no_route_and_says_what_fills_them() -> None:
    clip = a_clip()
    bare = RoadMap(clip.road_map.lanes, clip.road_map.drivable_areas)
    with pytest.raises(
        BadClip, match=r"map\.json: lanes: road_map\.roadblock_of has no roadblock of lane .*roadblocks_of"
    ):
        route_of_drive(bare, clip.ego_states[:, :3], "map.json", "lanes")
    with pytest.raises(NoRoute, match="roadblock_of"):
        CenterlineFinder(bare, clip.route)
    filled = replace(bare, roadblock_of=roadblocks_of(bare.lanes))
    assert route_of_drive(filled, clip.ego_states[:, :3], "map.json", "lanes").lane_path == clip.route.lane_path

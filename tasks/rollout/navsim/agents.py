"""Who takes part in the public traffic, and how it starts (autonomousvision/navsim @ 0a380a9, docs/reward.md 5).

Vehicles of the current frame alone, in its order. Each is asked for the lane under its centre: of the lanes that hold
it, or inside an intersection of the lane connectors, the one whose direction there is nearest to its heading as plain
numbers. On it, at most SNAP_M beside the baseline, it becomes an agent where its box, moved onto the baseline, touches
neither the ego nor an agent before it. Of the others those stay as they are that stand beside all lanes, and those
farther than SNAP_M from the baseline of the lane under them; the rest is gone after the current frame.
(build_idm_agents_on_map_rails, get_starting_segment, NavsimIDMAgents.get_observation)
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.rollout.navsim.baseline_path import BaselinePath, baseline_path, nearest_pose
from tasks.world.agents import AgentKind
from tasks.world.arrays import Array, Bools
from tasks.world.boxes import ego_boxes
from tasks.world.clip import Scene
from tasks.world.lanes import Lane, RoadMap
from tasks.world.vehicle import PACIFICA

SNAP_M = 3.0  # idm_snap_threshold
STANDS_BELOW_MPS = 0.1
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
    body: shapely.Polygon  # its box on the baseline


@dataclass(frozen=True)
class NavsimAgents:
    """The public traffic of a scene before anybody has moved."""

    driven: tuple[IdmAgent, ...]  # in the order they move in
    meet: Bools  # (A, A) whether the second's footprint can ever be in the first's way; False: surely not
    staying: tuple[int, ...]  # rows of the vehicles that stay unless somebody is in them, in their order
    staying_bodies: NDArray[np.object_]  # (F,) their boxes
    staying_touch: Bools  # (F, F) whether two of them touch
    staying_meet: Bools  # (F, A) whether an agent can ever touch one; False: surely not


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
    taken = [*bodies(ego_boxes(scene.ego_state, PACIFICA)[None])]
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
        body = bodies(np.array([[*pose, *boxes[i, 3:]]]))[0]
        if shapely.intersects(body, taken).any():
            continue
        path = baseline_path(found.centerline)
        if path is None:
            problem = "fewer than three points that lie apart: the public traffic has no path along it"
            raise ValueError(f"traffic=navsim: the centreline of lane {found.lane_id} has {problem}")
        target_speed_mps = found.speed_limit_mps or target_speed_mps  # as there: it stays for those after it
        length, width = map(float, boxes[i, 3:])
        taken.append(body)
        driven.append(IdmAgent(i, path, progress, speed, target_speed_mps, length, width, body))
    return _together(driven, staying, bodies(boxes[staying]))


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
    return NavsimAgents(
        tuple(driven), meet, tuple(staying), stay, touch, shapely.dwithin(stay[:, None], ways[None], WIDER * corner)
    )


def bodies(boxes: Array) -> NDArray[np.object_]:
    """(N,) polygons of boxes (N, 5), corners as nuPlan's `OrientedBox` has them."""
    x, y, heading, length, width = boxes.T
    quarter = np.pi / 2.0
    cos, sin, across_x, across_y = (
        np.cos(heading),
        np.sin(heading),
        np.cos(heading + quarter),
        np.sin(heading + quarter),
    )
    corners = [
        np.stack([x + (lat * across_x + lon * cos), y + (lat * across_y + lon * sin)], axis=-1)
        for lon, lat in ((length, width), (-length, width), (-length, -width), (length, -width))
        for lon, lat in ((lon / 2.0, lat / 2.0),)
    ]
    return np.asarray(shapely.polygons(np.stack(corners, axis=-2)), dtype=object).reshape(len(boxes))


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

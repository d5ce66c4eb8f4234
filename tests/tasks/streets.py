"""A whole clip in a few numbers: a straight two-lane street through a junction, with traffic; and any clip moved."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tasks.perturb import Perturbation, PerturbSettings, perturb
from tasks.rollout.simulate import TrafficSettings
from tasks.world.clip import CLIP_STEPS, NOW, STEP_S, AgentKind, AgentTracks, Clip, random_stream
from tasks.world.frames import EGO_STATE_SIZE, VX, X, to_world
from tasks.world.road_map import Lane, LightState, MapLayer, MapPolygon, RoadMap, Route, TrafficLights
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories

Array = NDArray[np.float64]
SPEED_MPS = 8.0
LANE_M = 4.0  # width; the ego's lane lies along y = 0, the lane to its left along y = 4
PIECES = {"in": (-100.0, 60.0), "cross": (60.0, 80.0), "out": (80.0, 300.0)}
EGO_HEIGHT_M = 1.5


def rectangle(low: tuple[float, float], high: tuple[float, float]) -> Array:
    """Closed ring (5, 2)."""
    (x0, y0), (x1, y1) = low, high
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])


def _lane(name: str, side: int) -> Lane:
    start, stop = PIECES[name]
    names = list(PIECES)
    place, y = names.index(name), LANE_M * side
    x = np.arange(start, stop + 0.5)
    suffix = "_left" if side else ""
    return Lane(
        lane_id=name + suffix,
        ring=rectangle((start, y - LANE_M / 2), (stop, y + LANE_M / 2)),
        centerline=np.column_stack([x, np.full_like(x, y), np.zeros_like(x)]),
        is_intersection=name == "cross",
        drives_cars=True,
        successors=tuple(n + suffix for n in names[place + 1 : place + 2]),
        predecessors=tuple(n + suffix for n in names[place - 1 : place] if place),
        left_neighbor=None if side else f"{name}_left",
        right_neighbor=name if side else None,
    )


def _tracks() -> AgentTracks:
    """A car 30 m ahead and one behind to the left, a pedestrian beside the street, a cone that is seen late."""
    starts = np.array([[30.0, 0.0], [-15.0, 4.0], [10.0, -5.0], [70.0, 7.5]])
    velocity = np.array([[8.0, 0.0], [9.0, 0.0], [0.8, 0.0], [0.0, 0.0]])
    sizes = np.array([[4.6, 1.9], [4.4, 1.8], [0.7, 0.7], [0.4, 0.4]])
    time = (np.arange(CLIP_STEPS) - NOW)[:, None, None] * STEP_S
    boxes = np.zeros((CLIP_STEPS, 4, 5))
    boxes[..., :2], boxes[..., 3:] = starts + time * velocity, sizes
    valid = np.ones((CLIP_STEPS, 4), bool)
    valid[:30, 3] = False
    boxes[~valid] = np.nan
    return AgentTracks(
        track_ids=("ahead", "left", "walker", "cone"),
        kinds=(AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.TRAFFIC_CONE),
        boxes=boxes,
        velocities=np.where(valid[..., None], velocity, np.nan),
        valid=valid,
        center_z=np.where(valid, 0.8, np.nan),
        heights=np.array([1.6, 1.5, 1.8, 0.7]),
    )


def street_clip() -> Clip:
    """The ego drives along y = 0 at 8 m/s and is at the origin at T; the light of the junction is green."""
    lanes = {lane.lane_id: lane for lane in (_lane(name, side) for name in PIECES for side in (0, 1))}
    area = MapPolygon("da_1", MapLayer.DRIVABLE_AREA, rectangle((-100.0, -3.5), (300.0, 7.0)))
    states = np.zeros((CLIP_STEPS, EGO_STATE_SIZE))
    states[:, X] = (np.arange(CLIP_STEPS) - NOW) * STEP_S * SPEED_MPS
    states[:, VX] = SPEED_MPS
    world_from_ego = np.tile(np.eye(4), (CLIP_STEPS, 1, 1))
    world_from_ego[:, 0, 3], world_from_ego[:, 2, 3] = states[:, X], EGO_HEIGHT_M
    return Clip(
        clip_id="street",
        dataset="hand-made",
        log_id="street",
        split="train",
        start_s=2.0,
        ego_states=states,
        world_from_ego=world_from_ego,
        agents=_tracks(),
        road_map=RoadMap(
            lanes=lanes,
            drivable_areas=(area,),
            crossings=(rectangle((82.0, -2.0), (85.0, 6.0)),),
            roadblock_of={lane_id: f"rb_{lane_id.removesuffix('_left')}" for lane_id in lanes},
        ),
        route=Route(tuple(PIECES), tuple(f"rb_{name}" for name in PIECES), frozenset(lanes)),
        centerline=np.concatenate([lanes[name].centerline for name in PIECES]),
        lights=TrafficLights(("cross",), np.full((CLIP_STEPS, 1), LightState.GREEN, np.int8)),
        licence="none",
        content_digest="0" * 16,
    )


def moved(clip: Clip, origin: Array) -> Clip:
    """The clip with its whole world shifted by origin[:2] and turned by origin[2]."""

    def points(ring: Array) -> Array:
        return to_world(origin, np.column_stack([ring[:, :2], np.zeros(len(ring))]))[:, :2]

    def poses(values: Array) -> Array:
        return np.concatenate([to_world(origin, values[..., :3]), values[..., 3:]], axis=-1)

    c, s = np.cos(origin[2]), np.sin(origin[2])
    turn = np.array([[c, -s, 0.0, origin[0]], [s, c, 0.0, origin[1]], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    agents, road_map = clip.agents, clip.road_map
    return replace(
        clip,
        ego_states=poses(clip.ego_states),
        world_from_ego=turn @ clip.world_from_ego,
        agents=replace(agents, boxes=poses(agents.boxes), velocities=agents.velocities @ turn[:2, :2].T),
        road_map=replace(
            road_map,
            lanes={
                key: replace(lane, ring=points(lane.ring), centerline=poses(lane.centerline))
                for key, lane in road_map.lanes.items()
            },
            drivable_areas=tuple(
                replace(area, ring=points(area.ring), holes=tuple(map(points, area.holes)))
                for area in road_map.drivable_areas
            ),
            crossings=tuple(map(points, road_map.crossings)),
        ),
        centerline=poses(clip.centerline),
    )


def same_poses(a: Array, b: Array, tolerance: float = 1e-6) -> bool:
    """Equal up to `tolerance`, headings (column 2) around the circle."""
    difference = np.asarray(a, float) - np.asarray(b, float)
    difference[..., 2] = (difference[..., 2] + np.pi) % (2.0 * np.pi) - np.pi
    return bool(np.nanmax(np.abs(difference), initial=0.0) <= tolerance)


def perturbed(clip: Clip, size: int = 150) -> Perturbation:
    """The clip's list of candidates, from so many trajectories."""
    listed = perturb(
        clip, Vocabulary(kinematic_trajectories(size, 0)), PerturbSettings(), TrafficSettings(),
        random_stream(0, clip.clip_id, "perturb"),
    )  # fmt: skip
    assert isinstance(listed, Perturbation)
    return listed

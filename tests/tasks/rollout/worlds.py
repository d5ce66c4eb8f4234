"""Small hand-made worlds: lanes, tracks and clips written as a few numbers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tasks.world.agents import AgentKind, AgentTracks
from tasks.world.clip import CLIP_STEPS, NOW, STEP_S, Clip, Scene, scene_of_clip
from tasks.world.lanes import NO_LIGHTS, Lane, RoadMap, Route, TrafficLights
from tasks.world.vehicle import EGO_STATE_SIZE, HEADING, VX, X, Y

CAR = (4.6, 1.9)  # length, width [m]
FAR_EGO = (0.0, 500.0, 0.0)  # a standing ego out of everyone's way


def lane(lane_id: str, points: list[tuple[float, float]], **options: object) -> Lane:
    """A lane along a polyline, resampled every 0.75 m, 3.5 m wide."""
    corners = np.array(points, dtype=float)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    at = np.linspace(0.0, length[-1], max(2, int(np.ceil(length[-1] / 0.75)) + 1))
    xy = np.stack([np.interp(at, length, corners[:, k]) for k in (0, 1)], axis=1)
    edge = np.gradient(xy, axis=0)
    heading = np.arctan2(edge[:, 1], edge[:, 0])
    side = 1.75 * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    ring = np.concatenate([xy + side, (xy - side)[::-1], (xy + side)[:1]])
    defaults = {"is_intersection": False, "drives_cars": True}
    return Lane(lane_id, ring, np.column_stack([xy, heading]), **{**defaults, **options})  # type: ignore[arg-type]


def arc(center: tuple[float, float], radius: float, start_deg: float, stop_deg: float) -> list[tuple[float, float]]:
    """Points of a circular arc."""
    angles = np.radians(np.linspace(start_deg, stop_deg, 40))
    return [(center[0] + radius * np.cos(a), center[1] + radius * np.sin(a)) for a in angles]


def straight_road() -> dict[str, Lane]:
    """One lane of 600 m along +x."""
    return {"road": lane("road", [(-100.0, 0.0), (500.0, 0.0)])}


def fork() -> dict[str, Lane]:
    """A lane along +x that goes straight on or turns left at x = 60 within 12 m."""
    turn = arc((60.0, 12.0), 12.0, -90.0, 0.0)
    return {
        "in": lane("in", [(-100.0, 0.0), (60.0, 0.0)], successors=("left", "ahead")),
        "left": lane("left", turn, predecessors=("in",), successors=("north",), is_intersection=True),
        "ahead": lane(
            "ahead", [(60.0, 0.0), (85.0, 0.0)], predecessors=("in",), successors=("east",), is_intersection=True
        ),
        "north": lane("north", [(72.0, 12.0), (72.0, 300.0)]),
        "east": lane("east", [(85.0, 0.0), (400.0, 0.0)]),
    }


@dataclass(frozen=True)
class Track:
    """One agent that moves straight at a constant speed, in the log from `first` to `last`."""

    x: float  # at NOW
    y: float = 0.0
    heading: float = 0.0
    speed: float = 0.0
    kind: AgentKind = AgentKind.VEHICLE
    size: tuple[float, float] = CAR
    first: int = 0
    last: int = CLIP_STEPS - 1
    poses: NDArray[np.float64] | None = None  # (96, 3) instead of a straight line


def tracks(*members: Track) -> AgentTracks:
    """The members as tracks over a clip; names are their order."""
    n = len(members)
    boxes = np.full((CLIP_STEPS, n, 5), np.nan)
    velocities = np.full((CLIP_STEPS, n, 2), np.nan)
    valid = np.zeros((CLIP_STEPS, n), dtype=bool)
    time = (np.arange(CLIP_STEPS) - NOW) * STEP_S
    for i, m in enumerate(members):
        seen = slice(m.first, m.last + 1)
        if m.poses is None:
            direction = np.array([np.cos(m.heading), np.sin(m.heading)])
            xy = np.array([m.x, m.y]) + time[:, None] * m.speed * direction
            poses = np.column_stack([xy, np.full(CLIP_STEPS, m.heading)])
        else:
            poses = m.poses
        boxes[seen, i, :3] = poses[seen]
        boxes[seen, i, 3:] = m.size
        velocities[seen, i] = np.gradient(poses[:, :2], STEP_S, axis=0)[seen]
        valid[seen, i] = True
    return AgentTracks(
        track_ids=tuple(f"a{i}" for i in range(n)),
        kinds=tuple(m.kind for m in members),
        boxes=boxes,
        velocities=velocities,
        valid=valid,
        center_z=np.where(valid, 0.8, np.nan),
        heights=np.full(n, 1.6),
    )


def clip(
    lanes: dict[str, Lane], agents: AgentTracks, ego: tuple[float, float, float] = FAR_EGO, ego_speed: float = 0.0,
    lights: TrafficLights = NO_LIGHTS,
) -> Clip:  # fmt: skip
    """A clip whose ego's rear axle is at `ego` at NOW and drives straight at `ego_speed`."""
    states = np.zeros((CLIP_STEPS, EGO_STATE_SIZE))
    way = (np.arange(CLIP_STEPS) - NOW) * STEP_S * ego_speed
    states[:, X] = ego[0] + way * np.cos(ego[2])
    states[:, Y] = ego[1] + way * np.sin(ego[2])
    states[:, HEADING], states[:, VX] = ego[2], ego_speed
    return Clip(
        clip_id="hand-made",
        dataset="hand-made",
        log_id="hand-made",
        split="train",
        start_s=0.0,
        ego_states=states,
        world_from_ego=np.tile(np.eye(4), (CLIP_STEPS, 1, 1)),
        agents=agents,
        road_map=RoadMap(lanes=lanes, drivable_areas=()),
        route=Route((), (), frozenset()),
        centerline=np.zeros((2, 3)),
        lights=lights,
    )


def scene(lanes: dict[str, Lane], *members: Track, **options: object) -> Scene:
    """The scene at NOW of a clip with these tracks."""
    return scene_of_clip(clip(lanes, tracks(*members), **options))  # type: ignore[arg-type]


def straight_plan(of: Scene, speed: float | None = None) -> NDArray[np.float64]:
    """(40, 3) poses straight on from the scene's ego at `speed` (default: its own)."""
    state = of.ego_state
    v = state[VX] if speed is None else speed
    way = v * STEP_S * np.arange(1, 41)
    h = state[HEADING]
    return np.column_stack([state[X] + way * np.cos(h), state[Y] + way * np.sin(h), np.full(40, h)])

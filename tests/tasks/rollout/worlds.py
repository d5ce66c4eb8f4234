"""Small hand-made worlds: lanes, tracks and clips written as a few numbers."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tasks.world.clip import CLIP_STEPS, NOW, PER_STEP, STEP_S, AgentKind, AgentTracks, Clip, Scene, scene_of_clip
from tasks.world.frames import EGO_STATE_SIZE, HEADING, VX, X, Y
from tasks.world.road_map import NO_LIGHTS, Lane, RoadMap, Route, TrafficLights

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


def with_members(of: Scene, *members: Track) -> Scene:
    """The same scene with more agents behind those that it has."""
    one, other = of.clip.agents, tracks(*members)
    parts = (np.concatenate([getattr(one, name), getattr(other, name)], axis=1) for name in PER_STEP)
    names = (*one.track_ids, *(f"more {name}" for name in other.track_ids))
    agents = AgentTracks(names, (*one.kinds, *other.kinds), *parts, np.concatenate([one.heights, other.heights]))
    return replace(of, clip=replace(of.clip, agents=agents), agents=agents)


def straight_plan(of: Scene, speed: float | None = None) -> NDArray[np.float64]:
    """(40, 3) poses straight on from the scene's ego at `speed` (default: its own)."""
    state = of.ego_state
    v = state[VX] if speed is None else speed
    way = v * STEP_S * np.arange(1, 41)
    h = state[HEADING]
    return np.column_stack([state[X] + way * np.cos(h), state[Y] + way * np.sin(h), np.full(40, h)])


def random_scene(seed: int) -> Scene:
    """A fork with a lane beside it and up to 16 agents that get in each other's way; an ego among them."""
    rng = np.random.default_rng(seed)
    lanes = fork() | {"beside": lane("beside", [(-100.0, 3.5), (55.0, 3.5), (150.0, 30.0)])}
    makers = (_on_lane, _on_lane, _crossing, _walking, _parked, _reversing, _starting)
    members = [makers[rng.integers(len(makers))](rng) for _ in range(rng.integers(1, 17))]
    ego = (float(rng.uniform(-60.0, 70.0)), float(rng.choice([0.0, 0.4, 3.5, 60.0])), float(rng.normal(0.0, 0.05)))
    return scene(lanes, *members, ego=ego, ego_speed=float(rng.choice([0.0, 4.0, 10.0])))


def random_egos(of: Scene, seed: int, n: int) -> NDArray[np.float64]:
    """States (n, 41, 11) of egos from the scene's pose on, each at a speed and a yaw rate of its own."""
    rng = np.random.default_rng(seed)
    out = np.zeros((n, 41, EGO_STATE_SIZE))
    out[:, 0] = of.ego_state
    out[:, :, VX] = rng.choice([0.0, 2.0, 6.0, 12.0], (n, 1))
    out[:, :, HEADING] = of.ego_state[HEADING] + rng.choice([0.0, 0.1, -0.3], (n, 1)) * STEP_S * np.arange(41)
    way = STEP_S * out[:, 1:, VX]
    out[:, 1:, X] = of.ego_state[X] + np.cumsum(way * np.cos(out[:, 1:, HEADING]), axis=1)
    out[:, 1:, Y] = of.ego_state[Y] + np.cumsum(way * np.sin(out[:, 1:, HEADING]), axis=1)
    return out


def _seen(rng: np.random.Generator) -> dict[str, int]:
    """Half of all are there from the start; the others come later, and some leave."""
    first = int(rng.choice([0, 0, 0, rng.integers(NOW, NOW + 40)]))
    return {"first": first, "last": int(rng.choice([CLIP_STEPS - 1, CLIP_STEPS - 1, first + 25]))}


def _on_lane(rng: np.random.Generator) -> Track:
    size = CAR if rng.random() < 0.8 else (12.0, 2.6)
    y = float(rng.choice([0.0, 3.5])) + float(rng.normal(0.0, 0.4))
    return Track(
        float(rng.uniform(-80.0, 70.0)), y, float(rng.normal(0.0, 0.05)), float(rng.uniform(0.0, 12.0)), size=size,
        **_seen(rng),
    )  # fmt: skip


def _crossing(rng: np.random.Generator) -> Track:
    speed = float(rng.uniform(2.0, 10.0))
    return Track(float(rng.uniform(-20.0, 80.0)), -float(rng.uniform(4.0, 35.0)), np.pi / 2, speed, **_seen(rng))


def _walking(rng: np.random.Generator) -> Track:
    kind, size = (
        (AgentKind.PEDESTRIAN, (0.6, 0.6)) if rng.random() < 0.7 else (AgentKind.BICYCLE, (1.8, 0.6))
    )  # fmt: skip
    heading = float(rng.choice([np.pi / 2, 0.0]))
    return Track(
        float(rng.uniform(-20.0, 70.0)), float(rng.uniform(-4.0, 1.0)), heading, float(rng.uniform(0.3, 2.0)),
        kind, size, **_seen(rng),
    )  # fmt: skip


def _parked(rng: np.random.Generator) -> Track:
    kind = AgentKind.VEHICLE if rng.random() < 0.7 else AgentKind.BARRIER
    return Track(float(rng.uniform(-60.0, 80.0)), float(rng.choice([-1.9, 1.7, 5.6])), kind=kind, **_seen(rng))


def _reversing(rng: np.random.Generator) -> Track:
    way = STEP_S * (np.arange(CLIP_STEPS) - NOW) * float(rng.uniform(1.0, 3.0))
    poses = np.column_stack(
        [np.full(CLIP_STEPS, float(rng.uniform(0.0, 60.0))), way - 6.0, np.full(CLIP_STEPS, -np.pi / 2)]
    )
    return Track(0.0, poses=poses, **_seen(rng))


def _starting(rng: np.random.Generator) -> Track:
    way = float(rng.uniform(-60.0, 50.0)) + np.maximum(0.0, STEP_S * (np.arange(CLIP_STEPS) - NOW - 15) * 6.0)
    return Track(0.0, poses=np.column_stack([way, 0.0 * way, 0.0 * way]), **_seen(rng))

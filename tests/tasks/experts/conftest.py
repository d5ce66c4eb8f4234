"""A straight two-lane road, driven along +x, on which expected plans are known in closed form."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from tasks.world.clip import CLIP_STEPS, HISTORY_STEPS, HORIZON_STEPS, NOW, AgentKind, AgentTracks, Clip, Scene
from tasks.world.frames import EGO_STATE_SIZE, VX, X, Y
from tasks.world.road_map import Lane, LightState, MapLayer, MapPolygon, RoadMap, Route, TrafficLights

LANE_M, ROAD_M = 4.0, 400.0


def lane(
    lane_id: str, start: float, stop: float, y: float = 0.0, is_intersection: bool = False, **more: object
) -> Lane:
    x = np.linspace(start, stop, int(stop - start) + 1)
    half = LANE_M / 2.0
    ring = [[start, y - half], [stop, y - half], [stop, y + half], [start, y + half], [start, y - half]]
    centerline = np.stack([x, np.full_like(x, y), np.zeros_like(x)], axis=1)
    return Lane(lane_id, np.array(ring), centerline, is_intersection, drives_cars=True, **more)  # type: ignore[arg-type]


def tracks(boxes: Sequence[Sequence[float]], speeds: Sequence[float], kinds: Sequence[AgentKind]) -> AgentTracks:
    """Objects that keep their speed along their heading over a clip; `boxes` are those at T."""
    now = np.array(boxes, dtype=float).reshape(-1, 5)
    n = len(now)
    velocity = np.array(speeds, dtype=float)[:, None] * np.stack([np.cos(now[:, 2]), np.sin(now[:, 2])], axis=1)
    all_boxes = np.repeat(now[None], CLIP_STEPS, axis=0)
    all_boxes[..., :2] += 0.1 * (np.arange(CLIP_STEPS) - NOW)[:, None, None] * velocity
    return AgentTracks(
        tuple(f"track{i}" for i in range(n)),
        tuple(kinds),
        all_boxes,
        np.repeat(velocity[None], CLIP_STEPS, axis=0),
        np.ones((CLIP_STEPS, n), bool),
        np.zeros((CLIP_STEPS, n)),
        np.ones(n),
    )


def straight_scene(
    speed: float = 10.0,
    y: float = 0.0,
    agents: AgentTracks | None = None,
    step: int = NOW,
    red: bool = False,
    limit: float | None = None,
) -> Scene:
    """The log drives along y = 0; the scene's ego stands `y` beside it, at the log's x, with the log's speed.

    Lanes: "in" 0..100, "cross" 100..120 (a junction), "out" 120..400 m; the ego is at x = 50 m at T.
    """
    lanes = {
        "in": lane("in", 0.0, 100.0, successors=("cross",), speed_limit_mps=limit),
        "cross": lane("cross", 100.0, 120.0, is_intersection=True, predecessors=("in",), successors=("out",)),
        "out": lane("out", 120.0, ROAD_M, predecessors=("cross",)),
    }
    area = MapPolygon("da_1", MapLayer.DRIVABLE_AREA, np.array([[0, -10], [400, -10], [400, 10], [0, 10], [0, -10.0]]))
    road_map = RoadMap(lanes, (area,), roadblock_of={name: f"rb_{name}" for name in lanes})
    states = np.zeros((CLIP_STEPS, EGO_STATE_SIZE))
    states[:, X] = 50.0 + 0.1 * speed * (np.arange(CLIP_STEPS) - NOW)
    states[:, VX] = speed
    centerline = np.concatenate([lanes[name].centerline for name in lanes])
    state = LightState.RED if red else LightState.GREEN
    clip = Clip(
        clip_id="straight",
        dataset="test",
        log_id="test",
        split="train",
        start_s=0.0,
        ego_states=states,
        world_from_ego=np.repeat(np.eye(4)[None], CLIP_STEPS, axis=0),
        agents=tracks([], [], []) if agents is None else agents,
        road_map=road_map,
        route=Route(tuple(lanes), tuple(f"rb_{name}" for name in lanes), frozenset(lanes)),
        centerline=centerline,
        lights=TrafficLights(("cross",), np.full((CLIP_STEPS, 1), state, np.int8)),
    )
    history = states[step - HISTORY_STEPS : step + 1].copy()
    history[:, Y] = y
    assert step + HORIZON_STEPS < CLIP_STEPS
    return Scene(clip, step, history, clip.agents, centerline)


@pytest.fixture
def road() -> Callable[..., Scene]:
    """Makes a scene on the straight road."""
    return straight_scene


@pytest.fixture
def objects() -> Callable[..., AgentTracks]:
    """Makes objects that keep their speed."""
    return tracks

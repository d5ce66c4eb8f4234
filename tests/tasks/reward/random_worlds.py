"""Small random worlds to score in, as keyword arguments of `prepare`, and drives through them."""

from typing import Any

import numpy as np

from tasks.world.clip import AgentKind, AgentTracks
from tasks.world.road_map import MapLayer, MapPolygon

N_TIMES = 41
KINDS = tuple(AgentKind)


def random_world(seed: int) -> dict[str, Any]:
    """A few crossing streets, an odd drivable area with a hole, objects of all kinds that come and go, a red lane."""
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-3000.0, 3000.0, 2)
    polygons, route, red = _map(rng, origin)
    past = np.zeros((4, 11))
    past[:, :2] = origin + rng.uniform(-2.0, 2.0, 2) + np.linspace(-1.5, 0.0, 4)[:, None] * rng.normal(0.0, 4.0, 2)
    past[:, 2] = rng.uniform(-np.pi, np.pi) + np.linspace(0.0, rng.normal(0.0, 0.2), 4)
    past[:, 3], past[:, 5:7] = rng.uniform(0.0, 12.0), rng.normal(0.0, 1.0, (4, 2))
    turns = np.cumsum(rng.normal(0.0, 0.2, 60))
    if rng.random() < 0.5:  # along the drive
        turns = np.full(60, past[-1, 2])
    line = (
        past[-1, :2]
        - 3.0 * np.array([np.cos(turns[0]), np.sin(turns[0])])
        + np.cumsum(rng.uniform(0.0, 2.0, (60, 1)) * np.column_stack([np.cos(turns), np.sin(turns)]), axis=0)
    )
    line[20:22] = line[19]  # joints stand twice
    return {
        "past_states": past,
        "centerline": np.column_stack([line, turns]),
        "polygons": polygons,
        "route_lane_ids": frozenset(route),
        "objects": _objects(rng, origin, int(rng.integers(0, 12))),
        "red_lanes": (tuple(red), rng.random((N_TIMES, len(red))) < 0.7),
    }


def random_drives(seed: int, past: np.ndarray, count: int) -> np.ndarray:
    """Ego states (K, 41, 11) from the last past state on: standing, creeping, reversing, swerving."""
    rng = np.random.default_rng([seed, 1])
    times = 0.1 * np.arange(N_TIMES)
    speed = past[-1, 3] + rng.normal(0.0, 2.0, (count, 1)) * times
    speed[rng.random(count) < 0.2] *= rng.choice([0.0, 0.004, -0.3])
    rate = rng.normal(0.0, 0.3, (count, 1)) * np.sin(rng.uniform(0.2, 3.0, (count, 1)) * times)
    states = np.zeros((count, N_TIMES, 11))
    states[..., 2] = past[-1, 2] + np.cumsum(rate, axis=1) * 0.1
    step = 0.1 * speed * np.exp(1j * states[..., 2])
    states[..., 0], states[..., 1] = past[-1, 0] + np.cumsum(step.real, 1), past[-1, 1] + np.cumsum(step.imag, 1)
    states[..., 3], states[..., 9] = speed, rate
    states[..., 5], states[..., 10] = np.gradient(speed, 0.1, axis=1), np.gradient(rate, 0.1, axis=1)
    states[:, 0] = past[-1]
    states[..., 2] = (states[..., 2] + np.pi) % (2.0 * np.pi) - np.pi
    return states


def _map(rng: np.random.Generator, origin: np.ndarray) -> tuple[list[MapPolygon], list[str], list[str]]:
    polygons: list[MapPolygon] = []
    route, red = [], []
    for i in range(int(rng.integers(1, 6))):
        ring = _street(rng, origin + rng.uniform(-15.0, 15.0, 2))
        layer = MapLayer.LANE_CONNECTOR if rng.random() < 0.4 else MapLayer.LANE
        polygons.append(MapPolygon(f"l{i}", layer, ring))
        if layer is MapLayer.LANE_CONNECTOR:
            polygons.append(MapPolygon(f"int_l{i}", MapLayer.INTERSECTION, ring))
            red += [f"l{i}"] * int(rng.random() < 0.5)
        route += [f"l{i}"] * int(rng.random() < 0.6)
    around = np.sort(rng.uniform(0.0, 2.0 * np.pi, int(rng.integers(3, 12))))
    area = (
        np.column_stack([np.cos(around), np.sin(around)])
        * rng.uniform(5.0, 60.0)
        * rng.uniform(0.5, 1.5, (len(around), 1))
    )
    hole = 0.3 * area[::-1] if rng.random() < 0.5 and np.diff(around).max(initial=0.0) < 2.0 else None
    if len(around) >= 5 and np.diff(np.append(around, around[0] + 2.0 * np.pi)).max() < 2.8:
        holes = () if hole is None else (origin + np.concatenate([hole, hole[:1]]),)
        polygons.append(MapPolygon("da", MapLayer.DRIVABLE_AREA, origin + np.concatenate([area, area[:1]]), holes))
    return polygons, route, red


def _street(rng: np.random.Generator, start: np.ndarray) -> np.ndarray:
    heading = rng.uniform(-np.pi, np.pi)
    bend, length = rng.normal(0.0, 0.01), rng.uniform(5.0, 70.0)
    along = np.linspace(-0.5 * length, 0.5 * length, int(rng.integers(2, 12)))
    turn = heading + bend * along
    middle = (
        start
        + np.column_stack([np.cos(heading + 0.5 * bend * along), np.sin(heading + 0.5 * bend * along)])
        * (along[:, None])
    )
    side = np.column_stack([-np.sin(turn), np.cos(turn)]) * rng.uniform(0.05, 3.0)  # slivers too
    ring = np.concatenate([middle + side, (middle - side)[::-1]])
    return np.concatenate([ring, ring[:1]])


def _objects(rng: np.random.Generator, origin: np.ndarray, count: int) -> AgentTracks:
    times = 0.1 * np.arange(N_TIMES)[:, None]
    velocity = rng.normal(0.0, 4.0, (count, 2)) * (rng.random((count, 1)) < 0.7)
    boxes = np.zeros((N_TIMES, count, 5))
    boxes[..., :2] = origin + rng.uniform(-20.0, 20.0, (count, 2)) + times[:, :, None] * velocity
    boxes[..., 2] = rng.uniform(-np.pi, np.pi, count)
    boxes[..., 3] = rng.uniform(0.0, 9.0, count)
    boxes[..., 4] = rng.uniform(0.0, 3.0, count)
    first, last = rng.integers(-10, 30, count), rng.integers(10, 60, count)
    seen = (np.arange(N_TIMES)[:, None] >= first) & (np.arange(N_TIMES)[:, None] <= last)
    boxes[~seen] = np.nan
    velocities = np.broadcast_to(velocity, (N_TIMES, count, 2)).copy()
    velocities[~seen] = np.nan
    return AgentTracks(
        track_ids=tuple(f"t{i}" for i in range(count)),
        kinds=tuple(KINDS[i] for i in rng.integers(0, len(KINDS), count)),
        boxes=boxes,
        velocities=velocities,
        valid=seen,
        center_z=np.zeros((N_TIMES, count)),
        heights=np.ones(count),
    )

"""Crowds of vehicles on a map's lanes and an ego among them, and such a scene as arrays for another Python."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tasks.rollout.lqr import track
from tasks.world.clip import CLIP_STEPS, AgentKind, AgentTracks, Scene, scene_of_clip
from tasks.world.frames import EGO_STATE_SIZE, HEADING, VX, X, to_world, wrap_angle
from tasks.world.road_map import Lane, MapLayer, MapPolygon, RoadMap
from tests.tasks.rollout import worlds

Array = NDArray[np.float64]
NEAR_M = 70.0
LIMITS = (None, None, 4.0, 7.0, 11.2, 13.4)  # of lanes [m/s]


@dataclass(frozen=True)
class Crowd:
    """Vehicles on a map, and an ego that drives past them."""

    road_map: RoadMap
    now: Array  # (N, 7) x, y, heading, length, width, vx, vy
    ego_states: Array  # (41, 11)

    @property
    def scene(self) -> Scene:
        """At NOW; the vehicles' logs stand still."""
        n = len(self.now)
        agents = AgentTracks(
            track_ids=tuple(f"{i:016x}" for i in range(n)),
            kinds=(AgentKind.VEHICLE,) * n,
            boxes=np.tile(self.now[:, :5], (CLIP_STEPS, 1, 1)),
            velocities=np.tile(self.now[:, 5:], (CLIP_STEPS, 1, 1)),
            valid=np.ones((CLIP_STEPS, n), dtype=bool),
            center_z=np.full((CLIP_STEPS, n), 0.75),
            heights=np.full(n, 1.5),
        )
        ego_states = np.tile(self.ego_states[0], (CLIP_STEPS, 1))
        clip = replace(worlds.clip({}, agents), road_map=self.road_map, ego_states=ego_states)
        return scene_of_clip(clip)


def limited(road_map: RoadMap, seed: int) -> dict[str, Lane]:
    """The map's lanes with speed limits by chance, some without."""
    rng = np.random.default_rng(seed)
    return {
        lane_id: Lane(
            lane_id, lane.ring, lane.centerline, lane.is_intersection, lane.drives_cars,
            speed_limit_mps=LIMITS[rng.integers(len(LIMITS))],
        )
        for lane_id, lane in road_map.lanes.items()
    }  # fmt: skip


def crowd(lanes: Mapping[str, Lane], seed: int, groups: tuple[int, int] = (15, 60)) -> Crowd:
    """Queues and single cars on and beside the lanes around a place by chance, some against them, some standing."""
    rng = np.random.default_rng(seed)
    every = np.concatenate([lane.centerline for lane in lanes.values()])
    center = every[rng.integers(len(every)), :2]
    near = [lane for lane in lanes.values() if np.hypot(*(lane.centerline[:, :2] - center).T).min() < NEAR_M]
    rows = [row for _ in range(rng.integers(*groups)) for row in _queue(near[rng.integers(len(near))], rng)]
    rng.shuffle(rows)
    boxes, speed = np.array(rows)[:, :5], np.array(rows)[:, 5]
    now = np.column_stack([boxes, speed * np.cos(boxes[:, 2]), speed * np.sin(boxes[:, 2])])
    start = np.zeros(EGO_STATE_SIZE)
    way = near[rng.integers(len(near))].centerline
    start[X : HEADING + 1], start[VX] = way[rng.integers(len(way))], rng.uniform(0.0, 12.0)
    ahead = start[VX] * 0.1 * np.arange(1, 41) * rng.uniform(0.5, 1.3)
    bend = rng.normal(0.0, 0.02)
    plan = to_world(start[X : HEADING + 1], np.column_stack([ahead, 0.5 * bend * ahead**2, bend * ahead]))
    ego_states = track(start, plan[None])[0]
    return Crowd(RoadMap(dict(lanes), ()), now, ego_states)


def _queue(lane: Lane, rng: np.random.Generator) -> list[list[float]]:
    """One to four cars behind each other: x, y, heading, length, width, speed."""
    x, y, heading = lane.centerline[rng.integers(len(lane.centerline))]
    rows = []
    for place in range(rng.integers(1, 5) if rng.random() < 0.4 else 1):
        left = rng.normal(0.0, 0.6 if rng.random() < 0.8 else 4.0)
        back = place * rng.uniform(5.2, 8.0)
        length = rng.uniform(3.6, 5.2) if rng.random() < 0.9 else rng.uniform(7.0, 12.0)
        turn = rng.normal(0.0, 0.1) + (np.pi if rng.random() < 0.1 else 0.0)
        speed = 0.0 if rng.random() < 0.3 else rng.uniform(0.0, 14.0)
        c, s = np.cos(heading), np.sin(heading)
        at = [x - c * back - s * left, y - s * back + c * left, float(wrap_angle(heading + turn))]
        rows.append([*at, length, rng.uniform(1.6, 2.5), speed])
    return rows


def relevant(of: Crowd, margin_m: float = 5.0) -> Crowd:
    """The same with only the lanes near a vehicle: no other is ever looked at."""
    points = of.now[:, :2]
    near = {
        lane_id: lane
        for lane_id, lane in of.road_map.lanes.items()
        if min(np.hypot(*(points[:, None] - lane.centerline[None, :, :2]).transpose(2, 0, 1)).min(axis=1)) < margin_m
    }
    return Crowd(RoadMap(near, ()), of.now, of.ego_states)


def arrays_of(of: Crowd) -> dict[str, NDArray[np.generic]]:
    """All of a crowd. Lanes come first, then connectors; intersections are the connectors'."""
    lanes = sorted(of.road_map.lanes.values(), key=lambda lane: lane.is_intersection)
    limits = [np.nan if lane.speed_limit_mps is None else lane.speed_limit_mps for lane in lanes]
    return {
        "is_connector": np.array([lane.is_intersection for lane in lanes]),
        "limits": np.array(limits),
        **_joined("ring", [lane.ring[:, :2] for lane in lanes]),
        **_joined("line", [lane.centerline[:, :2] for lane in lanes]),
        "now": of.now,
        "ego_states": of.ego_states,
    }


def crowd_of(arrays: Mapping[str, NDArray[np.generic]]) -> Crowd:
    """The opposite of `arrays_of`; lanes are numbered, and intersections given as areas of their own."""
    rings, lines = (_split(arrays, name) for name in ("ring", "line"))
    lanes = {}
    for i, (ring, line) in enumerate(zip(rings, lines)):
        limit = float(arrays["limits"][i])  # type: ignore[arg-type]
        headless = np.column_stack([line, np.zeros(len(line))])  # headings are the traffic's own
        lanes[str(i)] = Lane(
            str(i), ring, headless, bool(arrays["is_connector"][i]), True,
            speed_limit_mps=None if np.isnan(limit) else limit,
        )  # fmt: skip
    areas = [lane for lane in lanes.values() if lane.is_intersection]
    intersections = tuple(MapPolygon(lane.lane_id, MapLayer.INTERSECTION, lane.ring) for lane in areas)
    now, ego_states = (np.asarray(arrays[name], dtype=np.float64) for name in ("now", "ego_states"))
    return Crowd(RoadMap(lanes, (), intersections=intersections), now, ego_states)


def _joined(name: str, parts: Sequence[Array]) -> dict[str, NDArray[np.generic]]:
    return {f"{name}_xy": np.concatenate(parts), f"{name}_ends": np.cumsum([len(part) for part in parts])}


def _split(arrays: Mapping[str, NDArray[np.generic]], name: str) -> list[Array]:
    return np.split(np.asarray(arrays[f"{name}_xy"], dtype=np.float64), arrays[f"{name}_ends"][:-1])

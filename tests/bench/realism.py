"""How like its log a rollout is: the features and likelihoods of the public sim-agents challenge, and what goes wrong.

From the public definition (waymo-research/waymo-open-dataset, `wdl_limited/sim_agents_metrics`: `metrics.py`,
`trajectory_features.py`, `interaction_features.py`, `map_metric_features.py`, and of 2025
`challenge_2025_sim_agents_config.textproto`). Every vehicle's simulated values make a histogram over the rollout's
steps; the likelihood of the logged values under it is averaged as logarithm over a scenario's vehicles and steps, and
its exponential over scenarios. What differs: one rollout of 4 s in place of 32 of 8 s, in the plane, no lights, and a
difference of two headings is taken the shorter way round where times to collision are asked for, too. A vehicle that a
simulator takes away has no values: the pseudocounts alone, so every bin is as likely.
`PEER=<python> python -m tests.bench.bench_realism` holds features and likelihoods against that code.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.world.clip import STEP_S, AgentKind, AgentTracks
from tasks.world.frames import box_corners, wrap_angle
from tasks.world.road_map import RoadMap

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
FAR_M = 1e10
MOST_TTC_S = 5.0
GRAZE_M, DEEP_M = 0.1, 0.5  # boxes are annotated by hand to a decimetre
ROLLS_M, STANDS_M = 1.0, 0.5
ROUNDED = 0.7  # of half a box's shorter side: the radius of its corners


@dataclass(frozen=True)
class Feature:
    """A feature's histogram and its weight among all."""

    group: str
    low: float
    high: float
    bins: int
    weight: float
    pseudocount: float = 0.1


FEATURES = {
    "speed": Feature("kinematic", 0.0, 25.0, 10, 0.05),
    "acceleration": Feature("kinematic", -12.0, 12.0, 11, 0.05),
    "yaw rate": Feature("kinematic", -0.628, 0.628, 11, 0.05),
    "yaw acceleration": Feature("kinematic", -3.14, 3.14, 11, 0.05),
    "distance to nearest": Feature("interactive", -5.0, 40.0, 10, 0.1),
    "collision": Feature("interactive", -0.5, 1.5, 2, 0.25, 0.001),
    "time to collision": Feature("interactive", 0.0, 5.0, 10, 0.1),
    "distance to road edge": Feature("map-based", -20.0, 40.0, 10, 0.05),
    "off-road": Feature("map-based", -0.5, 1.5, 2, 0.25, 0.001),
}
GROUPS = ("kinematic", "interactive", "map-based")


class RoadEdge:
    """The drivable area's outline."""

    def __init__(self, road_map: RoadMap) -> None:
        areas = [shapely.Polygon(area.ring, area.holes).buffer(0.0) for area in road_map.drivable_areas]
        self._area = shapely.union_all(areas)
        shapely.prepare(self._area)
        lines = [np.asarray(line.coords) for line in shapely.get_parts(self._area.boundary)]
        self._edges = shapely.STRtree(
            [edge for line in lines for edge in shapely.linestrings(np.stack([line[:-1], line[1:]], axis=1))]
        )

    def rings(self) -> list[Array]:
        """The outline (P, 2) [m], closed, the road to its left."""
        polygons = [shapely.geometry.polygon.orient(area) for area in shapely.get_parts(self._area)]
        return [np.asarray(ring.coords) for area in polygons for ring in (area.exterior, *area.interiors)]

    def signed_distance(self, xy: Array) -> Array:
        """(...,) [m] of points (..., 2), above 0 off the road."""
        flat = xy.reshape(-1, 2)
        out = np.full(len(flat), np.nan)
        here = np.flatnonzero(np.isfinite(flat).all(axis=1))
        points = shapely.points(flat[here])
        which, away = self._edges.query_nearest(points, return_distance=True, all_matches=False)
        inside = shapely.contains(self._area, points)
        out[here[which[0]]] = np.where(inside[which[0]], -away, away)
        return out.reshape(xy.shape[:-1])


def box_distance(boxes: Array, others: Array) -> Array:
    """(...,) [m] between boxes (..., 5); below 0 by how far one must be moved for them to part; NaN where absent."""
    dx, dy = others[..., 0] - boxes[..., 0], others[..., 1] - boxes[..., 1]
    turn = others[..., 2] - boxes[..., 2]
    c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    apart = np.full(dx.shape, -np.inf)
    for of, to in ((boxes, others), (others, boxes)):
        cos, sin = np.cos(of[..., 2]), np.sin(of[..., 2])
        along, across = np.abs(dx * cos + dy * sin), np.abs(dy * cos - dx * sin)
        apart = np.maximum(apart, along - 0.5 * (of[..., 3] + to[..., 3] * c + to[..., 4] * s))
        apart = np.maximum(apart, across - 0.5 * (of[..., 4] + to[..., 3] * s + to[..., 4] * c))
    free = apart > 0.0
    if free.any():
        shapes = [shapely.polygons(box_corners(b[free])) for b in (boxes, others)]
        apart[free] = shapely.distance(*shapes)
    return apart


def with_ego(agents: AgentTracks, ego_boxes: Array) -> tuple[Array, Bools]:
    """Boxes (S, N + 1, 5) and presence (S, N + 1) of the agents that can move and, in the last place, the ego."""
    boxes = np.concatenate([agents.boxes, ego_boxes[:, None]], axis=1)
    return boxes, np.concatenate([agents.valid, np.ones((len(ego_boxes), 1), bool)], axis=1)


def nearest(boxes: Array, valid: Bools, rows: NDArray[np.intp]) -> Array:
    """(S, R) [m] from vehicles to the nearest other, between boxes whose corners are round."""
    out = np.full((len(boxes), len(rows)), np.nan)
    radius = 0.5 * ROUNDED * boxes[..., 3:].min(axis=-1)
    cores = boxes.copy()
    cores[..., 3:] -= 2.0 * radius[..., None]
    for r, i in enumerate(rows.tolist()):
        apart = np.hypot(boxes[..., 0] - boxes[:, i : i + 1, 0], boxes[..., 1] - boxes[:, i : i + 1, 1])
        reach = 0.5 * np.hypot(boxes[..., 3], boxes[..., 4])  # of a box from its middle
        others = valid & valid[:, i : i + 1]
        others[:, i] = False
        no_farther = np.where(others, apart, np.inf).min(axis=1)  # than the nearest one's middle
        near = others & (apart - reach - reach[:, i : i + 1] <= no_farther[:, None])
        distance = np.full(apart.shape, FAR_M)
        own = np.broadcast_to(cores[:, i : i + 1], boxes.shape)
        distance[near] = box_distance(own[near], cores[near]) - (radius + radius[:, i : i + 1])[near]
        out[:, r] = np.where(valid[:, i], distance.min(axis=1), np.nan)
    return out


def speeds_of(boxes: Array) -> Array:
    """(S, N) [m/s] central differences, NaN at the ends."""
    out = np.full(boxes.shape[:2], np.nan)
    out[1:-1] = np.hypot(*np.moveaxis(boxes[2:, :, :2] - boxes[:-2, :, :2], -1, 0)) / (2.0 * STEP_S)
    return out


def time_to_collision(boxes: Array, valid: Bools, rows: NDArray[np.intp]) -> Array:
    """(S, R) [s] until a vehicle, at its speed, meets whom it follows at theirs; MOST_TTC_S where it follows nobody."""
    speed, out = speeds_of(boxes), np.full((len(boxes), len(rows)), np.nan)
    for r, i in enumerate(rows.tolist()):
        own = boxes[:, i : i + 1]
        turn = np.abs(wrap_angle(boxes[..., 2] - own[..., 2]))
        c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
        dx, dy = boxes[..., 0] - own[..., 0], boxes[..., 1] - own[..., 1]
        cos, sin = np.cos(own[..., 2]), np.sin(own[..., 2])
        ahead = dx * cos + dy * sin - 0.5 * (own[..., 3] + boxes[..., 3] * c + boxes[..., 4] * s)
        beside = np.abs(dy * cos - dx * sin) - 0.5 * (own[..., 4] + boxes[..., 3] * s + boxes[..., 4] * c)
        follows = valid & (ahead > 0.0) & (turn <= np.radians(75.0)) & (beside < 0.0)
        follows &= (beside < -0.5) | (turn <= np.radians(10.0))
        gap = np.where(follows, ahead, FAR_M)
        leader = gap.argmin(axis=1)
        steps = np.arange(len(boxes))
        closing = speed[:, i] - speed[steps, leader]
        with np.errstate(divide="ignore", invalid="ignore"):
            ttc = np.where(closing > 0.0, np.minimum(gap[steps, leader] / closing, MOST_TTC_S), MOST_TTC_S)
        out[:, r] = np.where(valid[:, i], ttc, np.nan)
    return out


def features_of(agents: AgentTracks, ego_boxes: Array, rows: NDArray[np.intp], edge: RoadEdge) -> dict[str, Array]:
    """Name -> (S, R), or (1, R) for what happens or not in a whole rollout; NaN where there is none."""
    boxes, valid = with_ego(agents, ego_boxes)
    own = np.where(valid[:, rows, None], boxes[:, rows], np.nan)
    speed = speeds_of(own)
    yaw_rate, acceleration, yaw_acceleration = (np.full(speed.shape, np.nan) for _ in range(3))
    # Doubled before it is wrapped and halved after: the difference over two steps takes the shorter way round.
    yaw_rate[1:-1] = wrap_angle(own[2:, :, 2] - own[:-2, :, 2]) / 2.0 / STEP_S
    acceleration[1:-1] = (speed[2:] - speed[:-2]) / (2.0 * STEP_S)
    yaw_acceleration[1:-1] = (yaw_rate[2:] - yaw_rate[:-2]) / (2.0 * STEP_S)
    distance = nearest(boxes, valid, rows)
    road = edge.signed_distance(box_corners(own)).max(axis=-1)
    there = np.isfinite(distance).any(axis=0)
    with np.errstate(invalid="ignore"):
        collision = np.where(there, (distance < 0.0).any(axis=0), np.nan)
        off_road = np.where(there, (road > 0.0).any(axis=0), np.nan)
    return {
        "speed": speed,
        "acceleration": acceleration,
        "yaw rate": yaw_rate,
        "yaw acceleration": yaw_acceleration,
        "distance to nearest": distance,
        "collision": collision[None].astype(float),
        "time to collision": time_to_collision(boxes, valid, rows),
        "distance to road edge": road,
        "off-road": off_road[None].astype(float),
    }


def likelihood(feature: Feature, logged: Array, simulated: Array) -> float:
    """exp of the mean log-likelihood of logged values (S, R) under each vehicle's simulated ones (S, R)."""
    width = (feature.high - feature.low) / feature.bins

    def bin_of(values: Array) -> NDArray[np.intp]:
        return np.clip(((values - feature.low) / width).astype(int), 0, feature.bins - 1)

    logs = []
    for r in range(logged.shape[1]):
        seen, values = logged[:, r], simulated[:, r]
        counts = np.bincount(bin_of(values[np.isfinite(values)]), minlength=feature.bins) + feature.pseudocount
        logs.append(np.log(counts / counts.sum())[bin_of(seen[np.isfinite(seen)])])
    return float(np.exp(np.concatenate(logs).mean()))


def by_group(likelihoods: Mapping[str, float]) -> dict[str, float]:
    """Each group's mean, its features weighted as the challenge weights them."""
    out = {}
    for group in GROUPS:
        of = {name: feature.weight for name, feature in FEATURES.items() if feature.group == group}
        out[group] = sum(weight * likelihoods[name] for name, weight in of.items()) / sum(of.values())
    return out


@dataclass(frozen=True)
class Faults:
    """What a rollout does that its log does not."""

    overlaps: int  # pairs with a vehicle in them, apart in the log, that come to overlap by more than GRAZE_M
    deep: int  # of them, by more than DEEP_M
    with_ego: int  # of the overlaps: those with the logged ego, which answers to nobody
    hard_brakes: int  # vehicles that lose speed faster than 8 m/s2
    rolling: int  # vehicles that stand in the log and roll more than ROLLS_M
    standing: int  # vehicles that stand in the log
    vehicles: int

    def __add__(self, other: "Faults") -> "Faults":
        return Faults(*(a + b for a, b in zip(vars(self).values(), vars(other).values())))


def depths(agents: AgentTracks, ego_boxes: Array) -> dict[tuple[int, int], float]:
    """Pair, one of it a vehicle or the ego (the last number) -> how far they overlap at most [m], where they do."""
    boxes, valid = with_ego(agents, ego_boxes)
    drives = np.array([kind == AgentKind.VEHICLE for kind in agents.kinds] + [True])
    radius = 0.5 * np.hypot(boxes[..., 3], boxes[..., 4])
    out = {}
    for i, j in combinations(range(len(drives)), 2):
        if not (drives[i] or drives[j]):
            continue
        away = np.hypot(boxes[:, i, 0] - boxes[:, j, 0], boxes[:, i, 1] - boxes[:, j, 1])
        near = valid[:, i] & valid[:, j]
        near[near] = away[near] < (radius[:, i] + radius[:, j])[near]
        if near.any() and (least := float(box_distance(boxes[near, i], boxes[near, j]).min())) < 0.0:
            out[i, j] = -least
    return out


def faults_of(logged: AgentTracks, simulated: AgentTracks, ego_boxes: Array) -> Faults:
    """logged, simulated: the same tracks over the same steps."""
    before, after = depths(logged, ego_boxes), depths(simulated, ego_boxes)
    new = {pair: depth for pair, depth in after.items() if depth > GRAZE_M and before.get(pair, 0.0) <= GRAZE_M}
    vehicle = np.array([kind == AgentKind.VEHICLE for kind in logged.kinds])
    speed = np.hypot(*np.moveaxis(simulated.velocities, -1, 0))
    both = simulated.valid[1:] & simulated.valid[:-1]
    lost = np.where(both, -np.diff(speed, axis=0) / STEP_S, 0.0).max(axis=0)
    whole = vehicle & logged.valid.all(axis=0)
    stands = whole & (_way(logged) < STANDS_M)
    rolls = stands & simulated.valid.any(axis=0) & (_way(simulated) > ROLLS_M)
    return Faults(
        overlaps=len(new),
        deep=sum(depth > DEEP_M for depth in new.values()),
        with_ego=sum(pair[1] == len(vehicle) for pair in new),
        hard_brakes=int((vehicle & (lost > 8.0 + 1e-6)).sum()),
        rolling=int(rolls.sum()),
        standing=int(stands.sum()),
        vehicles=int((vehicle & simulated.valid.any(axis=0)).sum()),
    )


def _way(agents: AgentTracks) -> Array:
    """(N,) [m] farthest from where it is first."""
    xy = agents.boxes[..., :2]
    first = np.take_along_axis(xy, agents.valid.argmax(axis=0)[None, :, None], axis=0)
    return np.where(agents.valid, np.nan_to_num(np.hypot(*np.moveaxis(xy - first, -1, 0))), 0.0).max(axis=0)

"""The lanes cars drive on, as flat arrays: which are near a pose, and what follows each."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.rollout.polylines import extent, interpolated, lengths_along
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.frames import wrap_angle
from tasks.world.geometry import to_line, wrapped
from tasks.world.lanes import Lane, RoadMap

SNAP_M, SNAP_HEADING_RAD = 3.0, math.radians(60.0)  # of a lane that a vehicle can be said to drive on
COST_CAP_M = 6.0  # a logged point farther than this from a way says no more against it
ABOVE_ROUNDING = 1.0 + 1e-9


@dataclass(frozen=True)
class LaneIndex:
    """All lanes cars drive on; lanes of a single point are left out."""

    lanes: tuple[Lane, ...]
    number: Mapping[str, int]  # lane id -> index
    points: Array  # (Q, 3) all centreline poses
    first: Ints  # (L + 1,) lane l has points first[l]..first[l + 1] - 1
    discs: Array  # (L, 3) centre and radius of a disc around each centreline [m]
    heights: Array  # (Q,) of the centrelines' points, from the boundaries [m]; 0 where the map has none
    speed_limits: Array  # (L,) [m/s], NaN where unknown
    steps: Array  # (Q - 1,) from each point to the next [m]
    known_lengths: dict[int, float] = field(default_factory=dict)  # of the lanes asked for
    known_successors: dict[int, list[int]] = field(default_factory=dict)  # of the lanes asked for

    def length(self, lane: int) -> float:
        """[m]"""
        if lane not in self.known_lengths:
            self.known_lengths[lane] = self.length_from(lane, 0)
        return self.known_lengths[lane]

    def length_from(self, lane: int, point: int) -> float:
        """[m] from its n-th point on."""
        return float(self.steps[self.first[lane] + point : self.first[lane + 1] - 1].sum())

    def successors(self, lane: int) -> list[int]:
        """Following lanes, straightest first."""
        if lane not in self.known_successors:
            self.known_successors[lane] = _straightest_first(self, lane)
        return self.known_successors[lane]


def index_lanes(road_map: RoadMap) -> LaneIndex:
    """Flat arrays of a map; once per scene."""
    lanes = tuple(lane for lane in road_map.lanes.values() if lane.drives_cars and len(lane.centerline) >= 2)
    points, first = _flat([lane.centerline for lane in lanes])
    known = [lane.left_boundary is not None and lane.right_boundary is not None for lane in lanes]
    heights = np.zeros(len(points))
    for side in ("left_boundary", "right_boundary"):
        _add_heights(first, *_flat([getattr(lane, side) if k else None for lane, k in zip(lanes, known)]), heights)
    return LaneIndex(
        lanes=lanes,
        number={lane.lane_id: k for k, lane in enumerate(lanes)},
        points=points,
        first=first,
        discs=_discs_around(points, first),
        heights=np.nan_to_num(heights),
        speed_limits=np.array([lane.speed_limit_mps or np.nan for lane in lanes], dtype=np.float64),
        steps=np.hypot(*np.diff(points[:, :2], axis=0).T),
    )


def _flat(lines: Sequence[Array | None]) -> tuple[Array, Ints]:
    """Polylines (P, 3) as one array (Q, 3), and where each begins (L + 1,)."""
    first = np.zeros(len(lines) + 1, dtype=np.int64)
    np.cumsum([0 if line is None else len(line) for line in lines], out=first[1:])
    there = [line for line in lines if line is not None]
    return np.ascontiguousarray(np.concatenate([np.zeros((0, 3)), *there])), first


@kernel
def _discs_around(points: Array, first: Ints) -> Array:
    """(L, 3) centre and radius."""
    out = np.zeros((len(first) - 1, 3))
    for lane in range(len(out)):
        xy = points[first[lane] : first[lane + 1]]
        (left, right), (low, high) = extent(xy[:, 0]), extent(xy[:, 1])
        x, y, square = 0.5 * (left + right), 0.5 * (low + high), 0.0
        for k in range(len(xy)):
            square = max(square, (xy[k, 0] - x) ** 2 + (xy[k, 1] - y) ** 2)
        out[lane, 0], out[lane, 1], out[lane, 2] = x, y, math.sqrt(square)
    return out


@kernel
def _add_heights(first: Ints, boundary: Array, boundary_first: Ints, heights: Array) -> None:
    """Adds half the height a boundary has beside each point of its lane's centreline."""
    for lane in range(len(first) - 1):
        line = boundary[boundary_first[lane] : boundary_first[lane + 1]]
        n = first[lane + 1] - first[lane]
        if len(line) == 0:
            continue
        length = lengths_along(line)
        length = length / max(length[-1], 1e-9)
        z = np.ascontiguousarray(line[:, 2])
        for k in range(n):
            along = k * (1.0 / (n - 1)) if k < n - 1 else 1.0
            heights[first[lane] + k] += 0.5 * interpolated(along, length, z)


@kernel
def _distances(poses: Array, points: Array, first: Ints, discs: Array, lanes: Ints) -> tuple[Array, Array]:
    """Distance to and heading difference at the nearest point of each lane, (K, L) each; inf beyond COST_CAP_M."""
    n_poses, n_lanes = poses.shape[0], lanes.shape[0]
    distance = np.full((n_poses, n_lanes), np.inf)
    difference = np.full((n_poses, n_lanes), np.inf)
    for i in range(n_poses):
        x, y, h = poses[i, 0], poses[i, 1], poses[i, 2]
        for column in range(n_lanes):
            lane = lanes[column]
            dx, dy, far = x - discs[lane, 0], y - discs[lane, 1], discs[lane, 2] + COST_CAP_M
            if dx * dx + dy * dy > far * far * ABOVE_ROUNDING:
                continue
            best, best_k = np.inf, 0
            for k in range(first[lane], first[lane + 1] - 1):
                ex, ey = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
                dx, dy = x - points[k, 0], y - points[k, 1]
                square = to_line(dx, dy, ex, ey, (dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-12))[1]
                if square < best:
                    best, best_k = square, k
            if best <= COST_CAP_M * COST_CAP_M:
                distance[i, column] = math.sqrt(best)
                difference[i, column] = abs(wrapped(h - points[best_k, 2]))
    return distance, difference


def lane_costs(index: LaneIndex, poses: Array, lanes: Sequence[int] | None = None) -> tuple[Array, Array]:
    """(distance [m], |heading difference| [rad]) of poses (K, 3) to lanes, (K, L); inf beyond COST_CAP_M.

    lanes: which; None: all.
    """
    chosen = np.arange(len(index.lanes)) if lanes is None else np.array(lanes)
    return _distances(np.ascontiguousarray(poses), index.points, index.first, index.discs, chosen)


def on_a_lane(distance: Array, difference: Array) -> Bools:
    """(..., L) lanes a vehicle can be said to drive on."""
    return (distance <= SNAP_M) & (difference <= SNAP_HEADING_RAD)


def _straightest_first(index: LaneIndex, lane: int) -> list[int]:
    following = [index.number[name] for name in index.lanes[lane].successors if name in index.number]
    if len(following) < 2:
        return following
    heading = index.lanes[lane].centerline[-1, 2]
    turns = {k: round(abs(float(wrap_angle(index.lanes[k].centerline[-1, 2] - heading))), 6) for k in following}
    return sorted(following, key=lambda k: (turns[k], k))

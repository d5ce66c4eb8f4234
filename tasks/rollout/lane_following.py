"""The path a vehicle drives: a way through the lane graph, shifted sideways as its log shows.

At every fork the log decides: of all ways that start at the vehicle and are long enough, the one nearest to the logged
track wins, the straightest where the log does not tell. Along it the vehicle keeps the lateral offset its log has there
(people do not drive on the centreline, and pass parked cars with room), fading to the centre where the log ends; beyond
the last lane (the map's crop) the path goes straight on. Off the lanes a vehicle's own log is its path.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tasks.kernels import kernel
from tasks.rollout.corridor import PATH_SPACING_M
from tasks.world.frames import wrap_angle
from tasks.world.lanes import Lane, RoadMap

Array = NDArray[np.float64]

SNAP_HEADING_RAD = math.radians(60.0)
HEADING_COST_M = 2.0  # metres of distance one radian is worth, as in the route matching (METRIC.md section 0)
COST_CAP_M = 6.0  # a logged point farther than this from a way says no more against it
START_COST_WEIGHT = 0.3  # of the distance at the start, against the mean distance of the log
MAX_WAYS = 48  # ways compared at most, straightest first
BEHIND_M = 15.0  # of path kept behind the vehicle
LOG_POINT_SPACING_M = 2.0  # of the logged points the offset is taken from
MAX_LOG_OFFSET_M = 4.5  # a log farther than this from the way is not followed sideways
FADE_M = 30.0  # from the log's last offset to the centre
SMOOTHING_POINTS = 7  # 3 m
END_CHORD_M = 5.0  # a lane's last few points may be noise
LOGGED_PATH_SPACING_M = 1.0  # of the logged points that make a path: boxes jitter by decimetres


@dataclass(frozen=True)
class LaneIndex:
    """All lanes cars drive on, as flat arrays."""

    lanes: tuple[Lane, ...]
    number: Mapping[str, int]  # lane id -> index
    points: Array  # (Q, 3) all centreline poses
    first: NDArray[np.int64]  # (L + 1,) lane l has points first[l]..first[l + 1] - 1
    discs: Array  # (L, 3) centre and radius of a disc around each centreline


@dataclass(frozen=True)
class LanePath:
    """A way through the lane graph, or over no lanes, as points every PATH_SPACING_M."""

    xy: Array  # (P, 2) [m]
    heading: Array  # (P,) [rad], unwrapped
    height: Array  # (P,) of the lane's boundaries [m], 0 where the map has none
    speed_limit_mps: Array  # (P,) NaN where unknown
    lane_entries: tuple[
        tuple[str, float], ...
    ]  # (lane id, path length of its start, negative behind the path), in driving order


def index_lanes(road_map: RoadMap) -> LaneIndex:
    """Flat arrays of the lanes cars drive on; lanes of a single point are left out."""
    lanes = tuple(lane for lane in road_map.lanes.values() if lane.drives_cars and len(lane.centerline) >= 2)
    points = np.concatenate([lane.centerline for lane in lanes]) if lanes else np.zeros((0, 3))
    first = np.concatenate([[0], np.cumsum([len(lane.centerline) for lane in lanes])]).astype(np.int64)
    discs = np.zeros((len(lanes), 3))
    for k, lane in enumerate(lanes):
        xy = lane.centerline[:, :2]
        middle = 0.5 * (xy.min(axis=0) + xy.max(axis=0))
        discs[k] = *middle, np.sqrt(((xy - middle) ** 2).sum(axis=1).max())
    return LaneIndex(
        lanes, {lane.lane_id: k for k, lane in enumerate(lanes)}, np.ascontiguousarray(points), first, discs
    )


@kernel
def _distances(
    poses: Array, points: Array, first: NDArray[np.int64], discs: Array, reach: float
) -> tuple[Array, Array]:
    """Distance to and heading difference at the nearest point of every lane, (K, L) each; inf beyond `reach`."""
    n_poses, n_lanes = poses.shape[0], discs.shape[0]
    distance = np.full((n_poses, n_lanes), np.inf)
    difference = np.full((n_poses, n_lanes), np.inf)
    for i in range(n_poses):
        x, y, h = poses[i]
        for lane in range(n_lanes):
            if math.hypot(x - discs[lane, 0], y - discs[lane, 1]) > discs[lane, 2] + reach:
                continue
            best, best_k = np.inf, 0
            for k in range(first[lane], first[lane + 1] - 1):
                ex, ey = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
                dx, dy = x - points[k, 0], y - points[k, 1]
                f = (dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-12)
                f = min(max(f, 0.0), 1.0)
                square = (dx - f * ex) ** 2 + (dy - f * ey) ** 2
                if square < best:
                    best, best_k = square, k
            if best <= reach * reach:
                distance[i, lane] = math.sqrt(best)
                turned = h - points[best_k, 2]
                difference[i, lane] = abs((turned + math.pi) % (2.0 * math.pi) - math.pi)
    return distance, difference


def lane_costs(index: LaneIndex, poses: Array) -> tuple[Array, Array]:
    """(distance [m], |heading difference| [rad]) of poses (K, 3) to every lane, (K, L); inf beyond COST_CAP_M."""
    return _distances(np.ascontiguousarray(poses), index.points, index.first, index.discs, COST_CAP_M)


def on_a_lane(distance: Array, difference: Array, snap_distance_m: float) -> NDArray[np.bool_]:
    """(..., L) lanes a vehicle can be said to drive on."""
    return (distance <= snap_distance_m) & (difference <= SNAP_HEADING_RAD)


def find_path(
    index: LaneIndex, pose: Array, log_poses: Array, snap_distance_m: float, ahead_m: float
) -> LanePath | None:
    """The path of the vehicle at `pose` (3,), `ahead_m` long ahead of it; None where it is on no lane.

    log_poses (K, 3): where its log is over the whole clip, before and after.
    """
    distance, difference = lane_costs(index, pose[None])
    starts: list[int] = np.flatnonzero(on_a_lane(distance[0], difference[0], snap_distance_m)).tolist()
    if not starts:
        return None
    starts = _with_neighbors(index, starts, distance[0], difference[0])
    reach = _log_reach(pose, log_poses)
    ways = _ways(index, starts, pose, reach)
    if len(ways) > 1:
        costs = _point_costs(*lane_costs(index, log_poses))
        start_costs = _point_costs(distance, difference)[0]
        scores = [costs[:, way].min(axis=1).mean() + START_COST_WEIGHT * start_costs[way[0]] for way in ways]
        way = ways[int(np.argmin(np.round(scores, 6)))]  # rounded: a turned world must not change a tie
    else:
        way = ways[0]
    return _path_of(index, _extended(index, way, pose, ahead_m), pose, log_poses, ahead_m)


def logged_path(track: Array, ahead_m: float) -> LanePath | None:
    """The path along a vehicle's own log, straight on past its end.

    track (K, 5): x, y, heading, height, speed where it is and then step by step; its speeds are the path's limits.
    None where it hardly moves, or not the way it faces (reversing).
    """
    chosen: list[int] = []
    for k, point in enumerate(track):
        if not chosen or np.hypot(*(point[:2] - track[chosen[-1], :2])) >= LOGGED_PATH_SPACING_M:
            chosen.append(k)
    if len(chosen) < 2:
        return None
    points = track[chosen]
    edge = np.diff(points[:, :2], axis=0)
    if (np.abs(wrap_angle(np.arctan2(edge[:, 1], edge[:, 0]) - points[:-1, 2])) > SNAP_HEADING_RAD).any():
        return None
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*edge.T))])
    n_points = math.ceil((BEHIND_M + ahead_m) / PATH_SPACING_M) + 1
    grid = PATH_SPACING_M * np.arange(n_points, dtype=np.float64) - BEHIND_M
    xy = _at(points[:, :2], length, grid)
    return LanePath(
        xy=xy,
        heading=_chord_headings(xy),
        height=np.interp(grid, length, points[:, 3]),
        speed_limit_mps=np.interp(grid, length, points[:, 4]),
        lane_entries=(),
    )


def straight_path(pose: Array, ahead_m: float) -> LanePath:
    """A path straight on, for a car that has left the map and its log."""
    along = np.arange(math.ceil((BEHIND_M + ahead_m) / PATH_SPACING_M) + 1) * PATH_SPACING_M - BEHIND_M
    direction = np.array([np.cos(pose[2]), np.sin(pose[2])])
    return LanePath(
        xy=pose[:2] + along[:, None] * direction,
        heading=np.full(len(along), pose[2]),
        height=np.zeros(len(along)),
        speed_limit_mps=np.full(len(along), np.nan),
        lane_entries=(),
    )


def _point_costs(distance: Array, difference: Array) -> Array:
    return np.minimum(distance + HEADING_COST_M * difference, COST_CAP_M)


def _with_neighbors(index: LaneIndex, starts: list[int], distance: Array, difference: Array) -> list[int]:
    """Starts, nearest first, and the lanes beside them in the same direction: the log may change lanes."""
    starts = sorted(starts, key=lambda k: (round(float(distance[k] + HEADING_COST_M * difference[k]), 6), k))
    beside = []
    for k in starts:
        for neighbor in (index.lanes[k].left_neighbor, index.lanes[k].right_neighbor):
            other = index.number.get(neighbor) if neighbor is not None else None
            if other is not None and other not in starts and difference[other] <= SNAP_HEADING_RAD:
                beside.append(other)
    return list(dict.fromkeys(starts + beside))


def _log_reach(pose: Array, log_poses: Array) -> float:
    """How far ways must go to be told apart: as far as the log gets from here."""
    return float(np.hypot(*(log_poses[:, :2] - pose[:2]).T).max(initial=0.0)) * 1.2 + 10.0


def _left_of_lane(lane: Lane, pose: Array) -> float:
    """Length of the lane still ahead of a pose."""
    xy = lane.centerline[:, :2]
    nearest = int(np.argmin(((xy - pose[:2]) ** 2).sum(axis=1)))
    return float(np.hypot(*np.diff(xy[nearest:], axis=0).T).sum())


def _successors(index: LaneIndex, lane: int) -> list[int]:
    """Following lanes, straightest first."""
    heading = index.lanes[lane].centerline[-1, 2]
    following = [index.number[name] for name in index.lanes[lane].successors if name in index.number]
    turns = {k: round(abs(float(wrap_angle(index.lanes[k].centerline[-1, 2] - heading))), 6) for k in following}
    return sorted(following, key=lambda k: (turns[k], k))


def _ways(index: LaneIndex, starts: list[int], pose: Array, reach: float) -> list[list[int]]:
    """Lane sequences from each start that are `reach` long or end with the map; straightest first, MAX_WAYS at most."""
    ways: list[list[int]] = []
    for start in starts:
        stack = [([start], _left_of_lane(index.lanes[start], pose))]
        while stack and len(ways) < MAX_WAYS:
            way, length = stack.pop()
            following = [k for k in _successors(index, way[-1]) if k not in way] if length < reach else []
            if not following:
                ways.append(way)
            for k in reversed(following):
                stack.append(([*way, k], length + index.lanes[k].length_m))
    return ways


def _extended(index: LaneIndex, way: list[int], pose: Array, ahead_m: float) -> list[int]:
    """The way, straight on until it is `ahead_m` long."""
    way = list(way)
    length = _left_of_lane(index.lanes[way[0]], pose) + sum(index.lanes[k].length_m for k in way[1:])
    while length < ahead_m:
        following = [k for k in _successors(index, way[-1]) if k not in way]
        if not following:
            break
        way.append(following[0])
        length += index.lanes[way[-1]].length_m
    return way


def _lane_height(lane: Lane) -> Array:
    """(P,) height of the centreline's points, from the boundaries; 0 where the map has none."""
    if lane.left_boundary is None or lane.right_boundary is None:
        return np.zeros(len(lane.centerline))
    along = np.linspace(0.0, 1.0, len(lane.centerline))
    heights = np.zeros(len(along))
    for boundary in (lane.left_boundary, lane.right_boundary):
        length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(boundary[:, :2], axis=0).T))])
        heights += 0.5 * np.interp(along, length / max(length[-1], 1e-9), boundary[:, 2])
    return np.nan_to_num(heights)


def _path_of(index: LaneIndex, way: list[int], pose: Array, log_poses: Array, ahead_m: float) -> LanePath:
    lanes = [index.lanes[k] for k in way]
    xy = np.concatenate([lane.centerline[:, :2] for lane in lanes])
    height = np.concatenate([_lane_height(lane) for lane in lanes])
    limit = np.concatenate(
        [np.full(len(lane.centerline), lane.speed_limit_mps or np.nan, dtype=np.float64) for lane in lanes]
    )
    owner = np.repeat(np.arange(len(lanes)), [len(lane.centerline) for lane in lanes])
    keep = np.concatenate([[True], np.hypot(*np.diff(xy, axis=0).T) > 0.05])  # joints' points stand twice
    xy, height, limit, owner = xy[keep], height[keep], limit[keep], owner[keep]
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])

    # A window around the vehicle, straight on where the lanes end.
    here = float(_frenet(xy, length, pose[None])[0, 0])
    n_points = math.ceil((BEHIND_M + ahead_m) / PATH_SPACING_M) + 1
    grid = here - BEHIND_M + PATH_SPACING_M * np.arange(n_points, dtype=np.float64)
    center = _at(xy, length, grid)
    left = _normals(center)
    offset = _log_offset(center, log_poses)
    shifted = center + offset[:, None] * left

    # The shift changes lengths a little: even spacing again, everything else carried along.
    shifted_length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(shifted, axis=0).T))])
    even = PATH_SPACING_M * np.arange(n_points, dtype=np.float64)
    points = _at(shifted, shifted_length, even)
    source = np.interp(even, shifted_length, grid)  # lane length of each even point
    nearest = np.clip(np.searchsorted(length, source, side="right") - 1, 0, len(length) - 1)
    starts = {int(k): float(length[np.argmax(owner == k)]) for k in np.unique(owner)}
    entries = tuple(
        (lanes[k].lane_id, float(np.interp(at, grid, shifted_length)) + min(at - grid[0], 0.0))
        for k, at in starts.items()
        if at < grid[-1]
    )
    return LanePath(
        xy=points,
        heading=_chord_headings(points),
        height=np.interp(source, length, height),
        speed_limit_mps=limit[nearest],
        lane_entries=entries,
    )


def _at(xy: Array, length: Array, at: Array) -> Array:
    """Points of a polyline at path lengths, straight on past both ends (as its last END_CHORD_M point)."""
    out = np.stack([np.interp(at, length, xy[:, 0]), np.interp(at, length, xy[:, 1])], axis=-1)
    chord = min(END_CHORD_M, float(length[-1]))
    before, after = at < 0.0, at > length[-1]
    inner = [np.array([np.interp(s, length, xy[:, k]) for k in (0, 1)]) for s in (chord, float(length[-1]) - chord)]
    out[before] = xy[0] + (inner[0] - xy[0]) / np.hypot(*(inner[0] - xy[0])) * at[before, None]
    out[after] = xy[-1] + (xy[-1] - inner[1]) / np.hypot(*(xy[-1] - inner[1])) * (at[after, None] - length[-1])
    return out


def _chord_headings(points: Array, reach: int = 3) -> Array:
    """Headings (P,) of chords 2 * reach points long, unwrapped: what a body as long as a car does at a kink."""
    n = len(points)
    ahead, behind = np.minimum(np.arange(n) + reach, n - 1), np.maximum(np.arange(n) - reach, 0)
    chord = points[ahead] - points[behind]
    return np.unwrap(np.arctan2(chord[:, 1], chord[:, 0]))


def _normals(points: Array) -> Array:
    """(P, 2) unit vectors to the left."""
    heading = _chord_headings(points)
    return np.stack([-np.sin(heading), np.cos(heading)], axis=-1)


@kernel
def _frenet(xy: Array, length: Array, poses: Array) -> Array:
    """(K, 2) path length and offset to the left of the polyline's points nearest to poses (K, >= 2)."""
    out = np.empty((poses.shape[0], 2))
    for i in range(poses.shape[0]):
        best = np.inf
        for k in range(xy.shape[0] - 1):
            ex, ey = xy[k + 1, 0] - xy[k, 0], xy[k + 1, 1] - xy[k, 1]
            dx, dy = poses[i, 0] - xy[k, 0], poses[i, 1] - xy[k, 1]
            f = (dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-12)
            f = min(max(f, 0.0), 1.0)
            square = (dx - f * ex) ** 2 + (dy - f * ey) ** 2
            if square < best:
                best = square
                out[i, 0] = length[k] + f * (length[k + 1] - length[k])
                out[i, 1] = math.copysign(math.sqrt(square), ex * dy - ey * dx)
    return out


def _log_offset(center: Array, log_poses: Array) -> Array:
    """(P,) lateral offset of the log from the lane centre at every path point; 0 where the log is elsewhere."""
    grid = PATH_SPACING_M * np.arange(len(center), dtype=np.float64)
    heading = _chord_headings(center)
    frenet = _frenet(center, grid, log_poses)
    at, offset = frenet[:, 0], frenet[:, 1]
    turned = np.abs(wrap_angle(log_poses[:, 2] - np.interp(at, grid, heading)))
    usable = (np.abs(offset) <= MAX_LOG_OFFSET_M) & (turned <= SNAP_HEADING_RAD) & (at > 0.0) & (at < grid[-1])
    if not usable.any():
        return np.zeros(len(center))  # the start's own offset fades as the vehicle drives
    order = np.argsort(at[usable], kind="stable")
    at, offset = at[usable][order], offset[usable][order]
    chosen = [0]
    for k in range(1, len(at)):
        if at[k] - at[chosen[-1]] >= LOG_POINT_SPACING_M:
            chosen.append(k)
    profile = np.interp(grid, at[chosen], offset[chosen])
    u = np.clip((grid - at[chosen[-1]]) / FADE_M, 0.0, 1.0)
    profile *= 1.0 - u * u * (3.0 - 2.0 * u)
    padded = np.pad(profile, SMOOTHING_POINTS // 2, mode="edge")
    return np.convolve(padded, np.full(SMOOTHING_POINTS, 1.0 / SMOOTHING_POINTS), mode="valid")

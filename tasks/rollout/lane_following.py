"""The path a vehicle drives: a way through the lane graph, shifted sideways as its log shows.

At every fork the log decides: of all ways that start at the vehicle and are long enough, the one nearest to the logged
track wins, the straightest where the log does not tell. Along it the vehicle keeps the lateral offset its log has there
(people do not drive on the centreline, and keep clear of parked cars), fading to the centre where the log ends; beyond
the last lane (the map's crop) the path goes straight on. Off the lanes a vehicle's own log is its path.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.rollout.lane_index import COST_CAP_M, SNAP_HEADING_RAD, LaneIndex, lane_costs, on_a_lane
from tasks.rollout.polylines import chord_headings, frenet, interpolated, lengths_along, points_at
from tasks.rollout.stretches import PATH_SPACING_M
from tasks.world.arrays import Array, Ints
from tasks.world.geometry import wrapped

HEADING_COST_M = 2.0  # metres of distance one radian is worth, as in the route matching (docs/reward.md 0)
START_COST_WEIGHT = 0.3  # of the distance at the start, against the mean distance of the log
MAX_WAYS = 48  # ways compared at most, straightest first
BEHIND_M = 15.0  # of path kept behind the vehicle
JOINT_M = 0.05  # points nearer than this to the one before are left out: lanes' joints stand twice
LOG_POINT_SPACING_M = 2.0  # of the logged points the offset is taken from
MAX_LOG_OFFSET_M = 4.5  # a log farther than this from the way is not followed sideways
FADE_M = 30.0  # from the log's last offset to the centre
SMOOTHING_POINTS = 7  # 3 m
LOGGED_PATH_SPACING_M = 1.0  # of the logged points that make a path: boxes jitter by decimetres


@dataclass(frozen=True)
class LanePath:
    """A way through the lane graph, or over no lanes, as points every PATH_SPACING_M."""

    xy: Array  # (P, 2) [m]
    heading: Array  # (P,) [rad], unwrapped
    height: Array  # (P,) of the lane's boundaries [m], 0 where the map has none
    speed_limit_mps: Array  # (P,) NaN where unknown
    lane_entries: tuple[tuple[str, float], ...]  # (lane id, path length of its start, < 0 behind it), as driven


def find_path(index: LaneIndex, pose: Array, log_poses: Array, ahead_m: float) -> LanePath | None:
    """The path of the vehicle at `pose` (3,), `ahead_m` long ahead of it; None where it is on no lane.

    log_poses (K, 3): where its log is over the whole clip, before and after.
    """
    distance, difference = lane_costs(index, pose[None])
    starts: list[int] = np.flatnonzero(on_a_lane(distance[0], difference[0])).tolist()
    if not starts:
        return None
    starts = _with_neighbors(index, starts, distance[0], difference[0])
    ahead = {k: _left_of_lane(index, k, pose) for k in starts}
    # To be told apart ways must go as far as the log gets from here.
    reach = float(np.hypot(*(log_poses[:, :2] - pose[:2]).T).max(initial=0.0)) * 1.2 + 10.0
    ways = _ways(index, ahead, reach)
    way = ways[0]
    if len(ways) > 1:
        start_costs = _point_costs(distance, difference)[0]
        scores = _log_costs(index, ways, log_poses) + START_COST_WEIGHT * start_costs[[way[0] for way in ways]]
        way = ways[int(np.argmin(np.round(scores, 6)))]  # rounded: a turned world must not change a tie
    return _path_of(index, _extended(index, way, ahead[way[0]], ahead_m), pose, log_poses, ahead_m)


def logged_path(track: Array, ahead_m: float) -> LanePath | None:
    """The path along a vehicle's own log, straight on past its end.

    track (K, 5): x, y, heading, height, speed where it is and then step by step; its speeds are the path's limits.
    None where it hardly moves, or not the way it faces (reversing).
    """
    laid = _lay_log(np.ascontiguousarray(track), n_points(ahead_m))
    return None if laid is None else LanePath(*laid, lane_entries=())


def n_points(ahead_m: float) -> int:
    """Of a path that long ahead."""
    return math.ceil((BEHIND_M + ahead_m) / PATH_SPACING_M) + 1


@kernel
def _lay_log(track: Array, n_points: int) -> tuple[Array, Array, Array, Array] | None:
    """Points (P, 2), headings, heights and speeds (P,) along a track (K, 5); None where there is none."""
    chosen, n = np.empty_like(track), 0
    for k in range(len(track)):
        if n == 0 or (
            math.hypot(track[k, 0] - chosen[n - 1, 0], track[k, 1] - chosen[n - 1, 1]) >= LOGGED_PATH_SPACING_M
        ):
            for c in range(track.shape[1]):
                chosen[n, c] = track[k, c]
            n += 1
    if n < 2:
        return None
    for k in range(n - 1):
        edge = math.atan2(chosen[k + 1, 1] - chosen[k, 1], chosen[k + 1, 0] - chosen[k, 0])
        if abs(wrapped(edge - chosen[k, 2])) > SNAP_HEADING_RAD:
            return None
    xy, z, v = chosen[:n, :2], np.ascontiguousarray(chosen[:n, 3]), np.ascontiguousarray(chosen[:n, 4])
    length = lengths_along(xy)
    grid = PATH_SPACING_M * np.arange(float(n_points)) - BEHIND_M
    points = points_at(xy, length, grid)
    height, speed = np.empty(n_points), np.empty(n_points)
    for k in range(n_points):
        height[k], speed[k] = interpolated(grid[k], length, z), interpolated(grid[k], length, v)
    return points, chord_headings(points), height, speed


def straight_path(pose: Array, ahead_m: float) -> LanePath:
    """A path straight on, for a car that has left the map and its log."""
    along = np.arange(n_points(ahead_m)) * PATH_SPACING_M - BEHIND_M
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


def _left_of_lane(index: LaneIndex, lane: int, pose: Array) -> float:
    """Length of the lane still ahead of a pose."""
    xy = index.points[index.first[lane] : index.first[lane + 1], :2]
    return index.length_from(lane, int(((xy - pose[:2]) ** 2).sum(axis=1).argmin()))


def _ways(index: LaneIndex, starts: Mapping[int, float], reach: float) -> list[list[int]]:
    """Lane sequences from each start that are `reach` long or end with the map; straightest first, MAX_WAYS at most.

    starts: the lanes to start on, and what is ahead of each [m].
    """
    ways: list[list[int]] = []
    for start, ahead in starts.items():
        stack = [([start], ahead)]
        while stack and len(ways) < MAX_WAYS:
            way, length = stack.pop()
            following = [k for k in index.successors(way[-1]) if k not in way] if length < reach else []
            if not following:
                ways.append(way)
            for k in reversed(following):
                stack.append(([*way, k], length + index.length(k)))
    return ways


def _log_costs(index: LaneIndex, ways: list[list[int]], log_poses: Array) -> Array:
    """(W,) mean cost of a log's poses (K, 3) to the nearest lane of each way."""
    lanes = sorted(set().union(*ways))
    costs = _point_costs(*lane_costs(index, log_poses, lanes))
    place = {lane: k for k, lane in enumerate(lanes)}
    nearest = [costs[:, [place[lane] for lane in way]].min(axis=1) for way in ways]
    mean: Array = np.array(nearest).mean(axis=1)
    return mean


def _extended(index: LaneIndex, way: list[int], ahead: float, ahead_m: float) -> list[int]:
    """The way, `ahead` of its first lane before it, straight on until it is `ahead_m` long."""
    way = list(way)
    length = ahead + sum(index.length(k) for k in way[1:])
    while length < ahead_m:
        following = [k for k in index.successors(way[-1]) if k not in way]
        if not following:
            break
        way.append(following[0])
        length += index.length(way[-1])
    return way


def _path_of(index: LaneIndex, way: list[int], pose: Array, log_poses: Array, ahead_m: float) -> LanePath:
    """The path along a way, shifted to where the log is beside it."""
    lanes = np.array(way)
    logged = np.ascontiguousarray(log_poses)
    xy, heading, height, limit, entries = _lay_way(
        index.points, index.first, index.heights, index.speed_limits, lanes, pose[0], pose[1], logged, n_points(ahead_m)
    )
    named = ((index.lanes[k].lane_id, at) for k, at in zip(way, entries.tolist()) if not math.isnan(at))
    return LanePath(xy, heading, height, limit, lane_entries=tuple(named))


@kernel
def _lay_way(
    points: Array, first: Ints, heights: Array, limits: Array, way: Ints,
    x: float, y: float, log_poses: Array, n_points: int,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """Points (P, 2), headings, heights, speed limits (P,) around (x, y) along a way, and where its lanes begin (W,).

    A lane that begins beyond the path, or has no point of its own, begins at NaN.
    """
    rows, begins = _joined(points, first, way)
    line, owner = points[rows[:, 0]], rows[:, 1]
    length = lengths_along(line)

    # A window around the vehicle, straight on where the lanes end.
    here = frenet(line, length, np.array([[x, y]]))[0, 0]
    grid = here - BEHIND_M + PATH_SPACING_M * np.arange(float(n_points))
    center = points_at(line, length, grid)
    heading = chord_headings(center)
    offset = _log_offset(center, heading, log_poses)
    shifted = np.empty((n_points, 2))
    for k in range(n_points):
        shifted[k, 0] = center[k, 0] + offset[k] * -math.sin(heading[k])
        shifted[k, 1] = center[k, 1] + offset[k] * math.cos(heading[k])

    # The shift changes lengths a little: even spacing again, everything else carried along.
    shifted_length = lengths_along(shifted)
    even = PATH_SPACING_M * np.arange(float(n_points))
    xy = points_at(shifted, shifted_length, even)
    z, height, limit = heights[rows[:, 0]], np.empty(n_points), np.empty(n_points)
    for k in range(n_points):
        source = interpolated(even[k], shifted_length, grid)  # lane length of the even point
        height[k] = interpolated(source, length, z)
        nearest = min(max(int(np.searchsorted(length, source, side="right")) - 1, 0), len(length) - 1)
        limit[k] = limits[way[owner[nearest]]]
    entries = np.full(len(way), np.nan)
    for w in range(len(way)):
        if begins[w] >= 0 and length[begins[w]] < grid[-1]:
            at = length[begins[w]]
            entries[w] = interpolated(at, grid, shifted_length) + min(at - grid[0], 0.0)
    return xy, chord_headings(xy), height, limit, entries


@kernel
def _joined(points: Array, first: Ints, way: Ints) -> tuple[Ints, Ints]:
    """(point, place in the way) of the points of a way's lanes (R, 2), and each lane's first of them (W,), or -1."""
    rows, begins, n = np.empty((len(points), 2), np.int64), np.full(len(way), -1), 0
    before = -1
    for w in range(len(way)):
        for k in range(first[way[w]], first[way[w] + 1]):
            if before < 0 or math.hypot(points[k, 0] - points[before, 0], points[k, 1] - points[before, 1]) > JOINT_M:
                if begins[w] < 0:
                    begins[w] = n
                rows[n, 0], rows[n, 1] = k, w
                n += 1
            before = k
    return rows[:n].copy(), begins


@kernel
def _log_offset(center: Array, heading: Array, log_poses: Array) -> Array:
    """(P,) lateral offset of the log from the lane centre at every path point; 0 where the log is elsewhere."""
    n = len(center)
    grid = PATH_SPACING_M * np.arange(float(n))
    beside = frenet(center, grid, log_poses)
    at, offset, m = np.empty(len(beside)), np.empty(len(beside)), 0
    for i in _order_along(beside):
        s, left = beside[i, 0], beside[i, 1]
        turned = abs(wrapped(log_poses[i, 2] - interpolated(s, grid, heading)))
        usable = abs(left) <= MAX_LOG_OFFSET_M and turned <= SNAP_HEADING_RAD and s > 0.0 and s < grid[-1]
        if usable and (m == 0 or s - at[m - 1] >= LOG_POINT_SPACING_M):
            at[m], offset[m] = s, left
            m += 1
    if m == 0:
        return np.zeros(n)  # the start's own offset fades as the vehicle drives
    at, offset = at[:m], offset[:m]
    profile = np.empty(n)
    for k in range(n):
        u = min(max((grid[k] - at[-1]) / FADE_M, 0.0), 1.0)
        profile[k] = interpolated(grid[k], at, offset) * (1.0 - u * u * (3.0 - 2.0 * u))
    return _smoothed(profile)


@kernel
def _order_along(beside: Array) -> Ints:
    """(R,) rows (R, 2) by their first column, equals as they come: a log drives on, so few places are exchanged."""
    order = np.empty(len(beside), np.int64)
    for i in range(len(beside)):
        k = i
        while k > 0 and beside[order[k - 1], 0] > beside[i, 0]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = i
    return order


@kernel
def _smoothed(profile: Array) -> Array:
    """Mean over SMOOTHING_POINTS around each value, the ends repeated."""
    n, weight = len(profile), 1.0 / SMOOTHING_POINTS
    out = np.zeros(n)
    for k in range(n):
        for j in range(k - SMOOTHING_POINTS // 2, k + SMOOTHING_POINTS // 2 + 1):
            out[k] += profile[min(max(j, 0), n - 1)] * weight
    return out

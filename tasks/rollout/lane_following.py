"""The path a vehicle drives: a way through the lane graph, shifted sideways as its log shows.

At every fork the log decides: of all ways that start at the vehicle and are long enough, the one nearest to the logged
track wins, the straightest where the log does not tell. Along it the vehicle keeps the lateral offset its log has there
(people do not drive on the centreline, and keep clear of parked cars), fading to the centre where the log ends; beyond
the last lane (the map's crop) the path goes straight on. Off the lanes a vehicle's own log is its path. What it tows
goes where it has been.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tasks.kernels.compiled import hidden_kernel, kernel
from tasks.rollout.corridor import (
    CLOSED,
    CLOSED_IF_STOPPABLE,
    OPEN,
    PATH_SPACING_M,
    Paths,
    arc_length_and_offset,
    chord_headings,
    fade,
    interpolated,
    least_and_largest,
    lengths_along,
    points_at,
    stretch_rectangles,
)
from tasks.world.arrays import Array, Bools, Bytes, Ints
from tasks.world.clip import HORIZON_STEPS, STEP_S, AgentTracks, Scene
from tasks.world.frames import wrap_angle
from tasks.world.geometry import nearest_on_edge, wrapped
from tasks.world.road_map import Lane, LightState, RoadMap

# The lanes cars drive on, as flat arrays: which are near a pose, and what follows each.

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
    known_paths: dict[tuple[bytes, bytes, float], "LanePath | None"] = field(default_factory=dict)  # the newest found

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
            after = [self.number[name] for name in self.lanes[lane].successors if name in self.number]
            ends = self.lanes[lane].centerline[-1, 2] if len(after) > 1 else 0.0
            turns = {k: abs(float(wrap_angle(self.lanes[k].centerline[-1, 2] - ends))) for k in after}
            self.known_successors[lane] = sorted(after, key=lambda k: (round(turns[k], 6), k))
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
        (left, right), (low, high) = least_and_largest(xy[:, 0]), least_and_largest(xy[:, 1])
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
                square = nearest_on_edge(dx, dy, ex, ey, (dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-12))[1]
                if square < best:
                    best, best_k = square, k
            if best <= COST_CAP_M * COST_CAP_M:
                distance[i, column] = math.sqrt(best)
                difference[i, column] = abs(wrapped(h - points[best_k, 2]))
    return distance, difference


def lane_distances_and_turns(index: LaneIndex, poses: Array, lanes: Sequence[int] | None = None) -> tuple[Array, Array]:
    """(distance [m], |heading difference| [rad]) of poses (K, 3) to lanes, (K, L); inf beyond COST_CAP_M.

    lanes: which; None: all.
    """
    chosen = np.arange(len(index.lanes)) if lanes is None else np.array(lanes)
    return _distances(np.ascontiguousarray(poses), index.points, index.first, index.discs, chosen)


def on_a_lane(distance: Array, difference: Array) -> Bools:
    """(..., L) lanes a vehicle can be said to drive on."""
    return (distance <= SNAP_M) & (difference <= SNAP_HEADING_RAD)


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


KNOWN_PATHS = 1024  # kept, of some 15 kB


def find_path(index: LaneIndex, pose: Array, log_poses: Array, ahead_m: float) -> LanePath | None:
    """The path of the vehicle at `pose` (3,), `ahead_m` long ahead of it; None where it is on no lane.

    log_poses (K, 3): where its log is over the whole clip, before and after. The attempts of a clip begin among the
    same traffic and ask the same again; what is found once is handed out again, to be read only.
    """
    key = pose.tobytes(), log_poses.tobytes(), ahead_m
    if key not in index.known_paths:
        if len(index.known_paths) >= KNOWN_PATHS:
            index.known_paths.clear()
        index.known_paths[key] = _find_path(index, pose, log_poses, ahead_m)
    return index.known_paths[key]


def _find_path(index: LaneIndex, pose: Array, log_poses: Array, ahead_m: float) -> LanePath | None:
    distance, difference = lane_distances_and_turns(index, pose[None])
    starts: list[int] = np.flatnonzero(on_a_lane(distance[0], difference[0])).tolist()
    if not starts:
        return None
    starts = _with_neighbors(index, starts, distance[0], difference[0])
    lines = {k: index.points[index.first[k] : index.first[k + 1], :2] for k in starts}
    nearest = {k: int(((line - pose[:2]) ** 2).sum(axis=1).argmin()) for k, line in lines.items()}
    ahead = {k: index.length_from(k, point) for k, point in nearest.items()}
    # To be told apart ways must go as far as the log gets from here.
    reach = float(np.hypot(*(log_poses[:, :2] - pose[:2]).T).max(initial=0.0)) * 1.2 + 10.0
    ways = _ways(index, ahead, reach)
    way = ways[0]
    if len(ways) > 1:
        start_costs = _point_costs(distance, difference)[0]
        lanes = sorted(set().union(*ways))
        costs = _point_costs(*lane_distances_and_turns(index, log_poses, lanes))
        place = {lane: k for k, lane in enumerate(lanes)}
        nearest_costs = [costs[:, [place[lane] for lane in way]].min(axis=1) for way in ways]
        scores = np.array(nearest_costs).mean(axis=1) + START_COST_WEIGHT * start_costs[[way[0] for way in ways]]
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
    here = arc_length_and_offset(line, length, np.array([[x, y]]))[0, 0]
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
    beside = arc_length_and_offset(center, grid, log_poses)
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


# The agents' roles and paths, as a scene's log gives them: who stands, who joins the lanes when, who starts when.

NEVER = 1_000_000  # a step no clip has
STANDS_WITHIN_M, STANDS_BELOW_MPS = 1.0, 0.3  # over a whole log: boxes of parked cars jitter by decimetres
STARTED_AFTER_M = 0.5  # a car that stood has started


def stands_always(log: AgentTracks) -> Bools:
    """(N,) tracks that never leave their place."""
    seen = log.valid.sum(axis=0)
    first = np.take_along_axis(log.boxes[..., :2], log.valid.argmax(axis=0)[None, :, None], axis=0)
    away = np.hypot(*np.moveaxis(log.boxes[..., :2] - first, -1, 0))
    way = np.where(log.valid, away, 0.0).max(axis=0)
    stands: Bools = (way < STANDS_WITHIN_M) & (way < STANDS_BELOW_MPS * STEP_S * (seen - 1) + 0.1)
    return stands & (seen >= 2)


def first_later_step_on_lane(index: LaneIndex, scene: Scene, i: int) -> int:
    """First later step at which agent i is on a lane; NEVER if it never is."""
    log, start = scene.clip.agents, scene.step
    steps = start + 1 + np.flatnonzero(log.valid[start + 1 : start + HORIZON_STEPS + 1, i])
    on = on_a_lane(*lane_distances_and_turns(index, log.boxes[steps, i, :3])).any(axis=1)
    return int(steps[on.argmax()]) if on.any() else NEVER


def start_step(log: AgentTracks, i: int, step: int) -> int:
    """When a vehicle that stands at `step` starts in its log: 0 if it moves at `step`, NEVER if it does not start."""
    if not log.valid[step, i] or np.hypot(*log.velocities[step, i]) >= STANDS_BELOW_MPS:
        return 0
    away = np.hypot(*(log.boxes[step:, i, :2] - log.boxes[step, i, :2]).T)
    started = log.valid[step:, i] & (np.nan_to_num(away) > STARTED_AFTER_M)
    return step + int(np.argmax(started)) if started.any() else NEVER


def log_steps(scene: Scene) -> Ints:
    """(N,) the step of its log each agent is at: the scene's, or earlier for one that an earlier rollout made wait."""
    log, start = scene.clip.agents, scene.step
    here = scene.agents.boxes[start, :, :2]
    away = np.where(log.valid[: start + 1], np.hypot(*np.moveaxis(log.boxes[: start + 1, :, :2] - here, -1, 0)), np.inf)
    backwards = np.where(np.isnan(away), np.inf, away)[::-1]  # the latest of equal ones
    clock: Ints = start - np.argmin(backwards, axis=0)
    return clock


def logged_track(scene: Scene, i: int, clock: int) -> Array:
    """(K, 5) x, y, heading, height, speed of agent i: where it is, if it is there, then its log after step `clock`."""
    parts = []
    for agents, steps in (
        (scene.agents, slice(scene.step, scene.step + 1)),
        (scene.clip.agents, slice(clock + 1, None)),
    ):
        seen = agents.valid[steps, i]
        speed = np.hypot(*agents.velocities[steps, i].T)
        parts.append(np.column_stack([agents.boxes[steps, i, :3], agents.center_z[steps, i], speed])[seen])
    return np.concatenate(parts)


# A scene's paths as the traffic's kernels take them: how fast one may drive where, and where one must stop when.

StopLine = tuple[float, Bytes]  # path length [m], states (41,) at every step of the rollout

LATERAL_ACCEL_MAX = 3.0  # m/s2, slows down in curves
STOP_STEPS = 5  # a logged stop lasts at least this long
STOP_BEFORE_ENTRY_M, STOP_BEHIND_ENTRY_M = 12.0, 2.0  # where, around a junction's entry, a stop belongs to it


def stack_paths(
    scene: Scene,
    found: list[LanePath | None],
    logged_ways: list[LanePath | None],
    target_speed_mps: float,
    decel_max: float,
    logged_stops: bool = True,
) -> Paths:
    """The agents' paths and logged ways (N,), as `path_numbers` counts them; a logged way's own speeds tell it to stop.

    logged_stops: whether a stop of a log at a junction makes a stop line.
    """
    chosen = [path for path in found + logged_ways if path is not None]
    n_points = len(chosen[0].xy) if chosen else 2
    xy = np.array([path.xy for path in chosen]).reshape(-1, n_points, 2)
    heading = np.array([path.heading for path in chosen]).reshape(-1, n_points)
    limit = np.array([path.speed_limit_mps for path in chosen]).reshape(-1, n_points)
    log = scene.clip.agents
    stopped = log.valid & (np.hypot(*np.moveaxis(log.velocities, -1, 0)) < STANDS_BELOW_MPS)
    lines = [
        [*_light_lines(scene, path), *(_logged_stops(scene, path, i, stopped[:, i]) if logged_stops else ())]
        for i, path in enumerate(found)
        if path is not None
    ]
    counts = [len(of_path) for of_path in lines] + [0] * (len(chosen) - len(lines))
    states = [state for of_path in lines for _, state in of_path]
    return Paths(
        xy=xy,
        heading=heading,
        height=np.array([path.height for path in chosen]).reshape(-1, n_points),
        target_speed=_target_speeds(limit, heading, target_speed_mps, decel_max),
        stretches=stretch_rectangles(xy, heading),
        line_start=np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]),
        line_at=np.array([at for of_path in lines for at, _ in of_path], dtype=np.float64),
        line_state=np.array(states, dtype=np.uint8).reshape(-1, HORIZON_STEPS + 1).T.copy(),
    )


def _target_speeds(limit: Array, heading: Array, default: float, decel_max: float) -> Array:
    """(M, P) [m/s] the limit or the default, less in curves, and in time before them at comfortable deceleration."""
    target = np.where(np.isnan(limit), default, limit)
    curvature = np.abs(np.gradient(heading, PATH_SPACING_M, axis=1))
    square = np.minimum(target**2, LATERAL_ACCEL_MAX / np.maximum(curvature, 1e-6))
    # v^2 falls by at most 2 b per metre towards a slower place: a running minimum from the far end.
    fall = 2.0 * decel_max * PATH_SPACING_M * np.arange(limit.shape[1])
    square = np.minimum.accumulate((square + fall)[:, ::-1], axis=1)[:, ::-1] - fall
    speeds: Array = np.sqrt(np.maximum(square, 1.0))
    return speeds


def _light_lines(scene: Scene, path: LanePath) -> list[StopLine]:
    lights, lines = scene.clip.lights, []
    for lane_id, at in path.lane_entries:
        if lane_id in lights.lane_ids:
            column = lights.lane_ids.index(lane_id)
            steps = np.minimum(np.arange(scene.step, scene.step + HORIZON_STEPS + 1), len(lights.states) - 1)
            light = lights.states[steps, column]
            state = np.full(len(light), OPEN, dtype=np.uint8)
            state[light == LightState.YELLOW] = CLOSED_IF_STOPPABLE
            state[light == LightState.RED] = CLOSED
            lines.append((at, state))
    return lines


def _logged_stops(scene: Scene, path: LanePath, i: int, stopped: Bools) -> list[StopLine]:
    """Stop lines agent i's own log, `stopped` (S,), implies: at a junction's entry, where it stops, until it leaves."""
    inside = [scene.clip.road_map.lanes[lane_id].is_intersection for lane_id, _ in path.lane_entries]
    entries = [at for (_, at), here, before in zip(path.lane_entries, inside, [False, *inside]) if here and not before]
    if not entries or np.count_nonzero(stopped) < STOP_STEPS:
        return []
    log = scene.clip.agents
    edges = np.flatnonzero(np.diff(np.concatenate([[0], stopped.astype(np.int8), [0]])))
    lines = []
    for first, last in zip(edges[::2], edges[1::2]):
        if last - first < STOP_STEPS or last <= scene.step:
            continue
        distance = np.hypot(*(path.xy - log.boxes[first, i, :2]).T)
        nearest = int(np.argmin(distance))
        if distance[nearest] > 3.0:
            continue
        nose = nearest * PATH_SPACING_M + 0.5 * log.boxes[first, i, 3]
        near = [at for at in entries if nose - STOP_BEHIND_ENTRY_M <= at <= nose + STOP_BEFORE_ENTRY_M]
        if near:
            until = NEVER if last >= log.n_steps or not log.valid[last, i] else last
            steps = np.arange(scene.step, scene.step + HORIZON_STEPS + 1)
            lines.append((max(near[0], nose), np.where(steps < until, CLOSED, OPEN).astype(np.uint8)))
    return lines


# Parts of an articulated vehicle behind its first one: each on the way that one has come, as far behind as it was.
#
# Where the first part drives by IDM or a policy, the others have no drive of their own. A part's centre keeps its path
# length behind the first one's, along where that has been: in the rollout, and before in the log or an earlier rollout;
# farther back, where the parts in between and itself have been. It is headed as the chord of that way under its middle.
# How far beside that way it starts, and turned against it, fades as it goes; how much faster it is by its log, whose
# boxes wander along the road, is braked away as hard as tyres can.

CHORD = 0.25  # of a part's length, before and behind its middle: about where its wheels are
ROUNDS = 20  # to find the place of the way that a part is beside


def trails_behind(scene: Scene, first_part: Ints, front_of: dict[int, int]) -> Array:
    """(N, K, 2) where the ways behind the first parts led before the scene, for each towed agent, newest first.

    Filled up with NaN; K = 0 where nothing is towed. first_part (N,), front_of: towed agent -> what tows it.
    """
    trails = {towed: _trail_behind(scene, int(first_part[towed]), towed, front_of) for towed in front_of}
    out = np.full((len(first_part), max(map(len, trails.values()), default=0), 2), np.nan)
    for towed, trail in trails.items():
        out[towed, : len(trail)] = trail
    return out


def _trail_behind(scene: Scene, first: int, towed: int, front_of: dict[int, int]) -> Array:
    chain = [towed]
    while front_of[chain[0]] != first:
        chain.insert(0, front_of[chain[0]])
    way = _been(scene, first, scene.step)[:, :2]
    for part in chain:
        been = _been(scene, part, scene.step + 1)
        end = way[-1] if len(way) else scene.agents.boxes[scene.step, first, :2]
        if np.isfinite(end).all():  # what lies behind its end
            behind = (end[0] - been[:, 0]) * np.cos(been[:, 2]) + (end[1] - been[:, 1]) * np.sin(been[:, 2])
            been = been[behind >= LOGGED_PATH_SPACING_M]
        way = np.concatenate([way, been[:, :2]])
    return way


def _been(scene: Scene, i: int, stop: int) -> Array:
    """(K, 3) poses of agent i before step `stop`, newest first."""
    poses: Array = scene.agents.boxes[:stop, i, :3][scene.agents.valid[:stop, i]][::-1]
    return poses


@hidden_kernel
def point_behind(
    boxes: Array, valid: Bools, first: int, t: int, since: int, trails: Array, i: int, away: float
) -> tuple[float, float]:
    """The place `away` [m] behind agent `first` in row t, along the way it has come; straight on past that way's end.

    boxes (T, >= N, 5), valid (T, >= N): the rollout's rows. Boxes of logs jitter: of the rows before `since`, and of
    trails[i], only those count that lie apart.
    """
    x, y, heading = boxes[t, first, 0], boxes[t, first, 1], boxes[t, first, 2]
    back_x, back_y, left = -math.cos(heading), -math.sin(heading), away
    for k in range(t - 1, -1 - trails.shape[1], -1):
        if k >= 0:
            if not valid[k, first]:
                continue
            px, py = boxes[k, first, 0], boxes[k, first, 1]
        else:
            px, py = trails[i, -1 - k, 0], trails[i, -1 - k, 1]
            if math.isnan(px):
                break
        step = math.hypot(px - x, py - y)
        if step == 0.0 or (k < since and step < LOGGED_PATH_SPACING_M):
            continue
        back_x, back_y = (px - x) / step, (py - y) / step
        if step >= left:
            break
        left -= step
        x, y = px, py
    return x + left * back_x, y + left * back_y


@hidden_kernel
def _pose_behind(
    boxes: Array, valid: Bools, first: int, t: int, since: int, trails: Array, i: int, away: float
) -> tuple[float, float, float]:
    """x, y, heading of a part that is exactly on the way, `away` [m] behind agent `first` in row t."""
    half = CHORD * boxes[since, i, 3]
    x, y = point_behind(boxes, valid, first, t, since, trails, i, away)
    front_x, front_y = point_behind(boxes, valid, first, t, since, trails, i, max(away - half, 0.0))
    rear_x, rear_y = point_behind(boxes, valid, first, t, since, trails, i, away + half)
    return x, y, math.atan2(front_y - rear_y, front_x - rear_x)


@hidden_kernel
def hitch(boxes: Array, valid: Bools, first: int, t: int, trails: Array, i: int) -> tuple[float, float, float]:
    """(path length behind agent `first` [m], offset to the left [m], turn [rad]) of agent i, coupled in row t."""
    away = math.hypot(boxes[t, i, 0] - boxes[t, first, 0], boxes[t, i, 1] - boxes[t, first, 1])
    for _ in range(ROUNDS):
        x, y, h = _pose_behind(boxes, valid, first, t, t, trails, i, away)
        away = max(away - (boxes[t, i, 0] - x) * math.cos(h) - (boxes[t, i, 1] - y) * math.sin(h), 0.0)
    x, y, h = _pose_behind(boxes, valid, first, t, t, trails, i, away)
    left = (boxes[t, i, 1] - y) * math.cos(h) - (boxes[t, i, 0] - x) * math.sin(h)
    return away, left, wrapped(boxes[t, i, 2] - h)


@hidden_kernel
def faster_than_first(speed: float, hardest: float) -> float:
    """[m/s] above the first part's, below 0: slower, a step later, at `hardest` [m/s2]."""
    return math.copysign(max(abs(speed) - hardest * STEP_S, 0.0), speed)


@hidden_kernel
def towed_pose(
    boxes: Array, valid: Bools, first: int, t: int, since: int, trails: Array, i: int,
    away: float, offset: float, turn: float, travelled: float, blend_length: float,
) -> tuple[float, float, float]:  # fmt: skip
    """x, y, heading in row t of agent i, coupled in row `since` as `hitch` says, `travelled` [m] since then."""
    x, y, h = _pose_behind(boxes, valid, first, t, since, trails, i, away)
    keep, slope = fade(travelled, blend_length)
    heading = wrapped(h + turn * keep + math.atan(offset * slope))
    return x - math.sin(h) * offset * keep, y + math.cos(h) * offset * keep, heading

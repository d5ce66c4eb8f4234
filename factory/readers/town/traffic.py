"""Agents that drive: lights with phases, lane paths, and a driver that follows its path, its leader and the lights.

Road users are planned one after another; each sees the finished tracks of those before it and yields to them. One
that would still touch an earlier one is left out, so nobody collides, whatever the seed.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from factory.readers.town import curves
from factory.readers.town.streets import Streets
from tasks.world.arrays import Array, Bools
from tasks.world.geometry import touching
from tasks.world.polygons import arc_lengths

STEP_S = 0.1
GREEN, YELLOW, RED = 1, 2, 3
GREEN_S, YELLOW_S, CLEAR_S = 11.0, 3.0, 2.0
CYCLE_S = 2 * (GREEN_S + YELLOW_S + CLEAR_S)


@dataclass(frozen=True)
class Signals:
    """Two-phase lights: group 0 and group 1 are green in turn."""

    offset_s: float

    def state(self, group: int, time_s: float) -> int:
        """GREEN, YELLOW or RED."""
        phase = (time_s + self.offset_s - group * CYCLE_S / 2) % CYCLE_S
        return GREEN if phase < GREEN_S else YELLOW if phase < GREEN_S + YELLOW_S else RED


@dataclass(frozen=True)
class TownPath:
    """What one road user follows."""

    poses: Array  # (N, 3) every metre
    s: Array  # (N,) arc length [m]
    limit: Array  # (N,) speed [m/s] that bends and limits allow, braking ahead of them included
    stops: tuple[tuple[float, int], ...]  # (arc length of the stop line, signal group); group -1: always stop
    lane_ids: tuple[int, ...]


@dataclass(frozen=True)
class TownTrack:
    """One road user or parked car over the log; absent steps are NaN."""

    track_id: str
    category: str  # AV2 category
    size: tuple[float, float, float]  # length, width, height [m]
    poses: Array  # (S, 3) box centre
    look: int  # seed of its colour and shape

    def boxes(self) -> Array:
        """(S, 5) centre x, y, heading, length, width."""
        return np.column_stack([self.poses, np.broadcast_to(self.size[:2], (len(self.poses), 2))])


@dataclass(frozen=True)
class DrivingStyle:
    """How somebody drives; accelerations in m/s2."""

    speed_factor: float = 1.0
    accel: float = 1.3
    brake: float = 1.8
    jerk: float = 2.5
    headway_s: float = 1.4
    gap_m: float = 2.5
    lateral_accel: float = 2.0
    yaw_accel: float = 1.2  # rad/s2
    front_m: float = 2.3  # path point to front bumper
    half_width_m: float = 0.95


def path_of_lanes(streets: Streets, lane_ids: list[int], style: DrivingStyle, smooth_m: float = 2.5) -> TownPath:
    """The centre line of consecutive lanes, rounded so that curvature is continuous."""
    parts, stops, limits, length = [], [], [], 0.0
    for i, lane_id in enumerate(lane_ids):
        lane = streets.lanes[lane_id]
        parts.append(lane.center if i == 0 else lane.center[1:])
        limits.append(np.full(len(parts[-1]), lane.speed_mps))
        length += float(arc_lengths(lane.center)[-1])
        following = streets.lanes[lane_ids[i + 1]] if i + 1 < len(lane_ids) else None
        if following is not None and following.light_group >= 0:
            stops.append((length - lane.stop_before_end, following.light_group))
        if following is None and lane.kind == "BIKE":
            stops.append((length - lane.stop_before_end, -1))
    line = np.vstack(parts)
    s_raw = arc_lengths(line)
    even = np.linspace(0.0, s_raw[-1], int(np.ceil(s_raw[-1])) + 1)
    xy = curves.at(line, even)[:, :2]
    xy = xy + gaussian_filter1d(xy - _chord(xy), smooth_m / (even[1]), axis=0, mode="nearest") - (xy - _chord(xy))
    poses = curves.resample(xy, float(line[0, 2]))
    s = arc_lengths(poses)
    curvature = gaussian_filter1d(np.gradient(np.unwrap(poses[:, 2]), s), 2.0)
    winding = np.abs(gaussian_filter1d(np.gradient(curvature, s), 2.0))
    posted = np.interp(s, s_raw, np.concatenate(limits)) * style.speed_factor
    limit = np.minimum(posted, np.sqrt(style.lateral_accel / np.maximum(np.abs(curvature), 1e-6)))
    limit = np.minimum(limit, np.sqrt(style.yaw_accel / np.maximum(winding, 1e-6)))
    for i in range(len(limit) - 2, -1, -1):
        limit[i] = min(limit[i], np.sqrt(limit[i + 1] ** 2 + 2 * 0.8 * style.brake * (s[i + 1] - s[i])))
    return TownPath(poses, s, limit, tuple(stops), tuple(lane_ids))


def _chord(xy: Array) -> Array:
    """The straight line between the ends: smoothing the difference to it keeps both ends in place."""
    t = np.linspace(0.0, 1.0, len(xy))[:, None]
    return xy[0] * (1 - t) + xy[-1] * t


def drive(
    path: TownPath, start_s: float, speed: float, style: DrivingStyle, others: Array, signals: Signals, times_s: Array
) -> tuple[Array, Array]:
    """Arc length (S,) [m] and speed (S,) [m/s] of a driver that sees `others` (S, J, 5): IDM with bounded jerk."""
    rear, along_speed = _on_path(path, style, others)
    s_out, v_out = np.empty(len(times_s)), np.empty(len(times_s))
    s, v, a = start_s, speed, 0.0
    for i, time in enumerate(times_s):
        s_out[i], v_out[i] = s, v
        front = s + style.front_m
        wanted = float(np.interp(s + 0.6 * v, path.s, path.limit))
        command = min(max((wanted - v) / 0.9, -style.brake), style.accel)
        gaps = rear[i] - front
        ahead = gaps > -1.0
        if ahead.any():
            nearest = int(np.argmin(np.where(ahead, gaps, np.inf)))
            command = min(command, _follow(float(gaps[nearest]), v, float(along_speed[i, nearest]), style))
        for line, group in path.stops:
            state = RED if group < 0 else signals.state(group, float(time))
            distance = line - front
            can_stop = v * v / (2 * max(distance, 0.1)) < 2.6
            if distance > -1.0 and (state == RED or (state == YELLOW and can_stop)) and (distance > 0 or v < 1.0):
                command = min(command, _follow(distance + style.gap_m - 0.6, v, 0.0, style))
        a += float(np.clip(np.clip(command, -4.5, style.accel) - a, -style.jerk * STEP_S, style.jerk * STEP_S))
        if command < -2.5:
            a = min(a, command * 0.6)
        v_next = max(0.0, v + a * STEP_S)
        if v_next == 0.0:
            a = max(a, 0.0)
        s += (v + v_next) / 2 * STEP_S
        v = v_next
    return s_out, v_out


def _follow(gap: float, v: float, lead_v: float, style: DrivingStyle) -> float:
    """IDM's interaction term (Treiber et al. 2000)."""
    closing = v * (v - lead_v) / (2 * np.sqrt(style.accel * style.brake))
    wanted = style.gap_m + max(0.0, v * style.headway_s + closing)
    return style.accel * (1.0 - (wanted / max(gap, 0.3)) ** 2)


def _on_path(path: TownPath, style: DrivingStyle, others: Array) -> tuple[Array, Array]:
    """Where along the path everybody in the driver's corridor ends (S, J) (inf: not in it), and speeds along it."""
    if others.shape[1] == 0:
        return np.full((len(others), 1), np.inf), np.zeros((len(others), 1))
    rear, along = np.full(others.shape[:2], np.inf), np.zeros(others.shape[:2])
    present = ~np.isnan(others[..., 0])
    box = others[present]
    _, nearest = cKDTree(path.poses[:, :2]).query(box[:, :2])
    pose = path.poses[nearest]
    dx, dy = (box[:, :2] - pose[:, :2]).T
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turn = box[:, 2] - pose[:, 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    across = box[:, 3] / 2 * sin + box[:, 4] / 2 * cos
    along[present] = position = path.s[nearest] + c * dx + s * dy
    inside = np.abs(-s * dx + c * dy) < across + style.half_width_m + 0.25
    rear[present] = np.where(inside, position - box[:, 3] / 2 * cos - box[:, 4] / 2 * sin, np.inf)
    return rear, np.nan_to_num(np.clip(np.gradient(along, STEP_S, axis=0), 0.0, 30.0))


def overlaps(boxes: Array, others: Array, margin_m: float) -> Bools:
    """(S, J): does `boxes` (S, 5), grown by `margin_m` on every side, touch `others` (S, J, 5)? NaN touches nothing."""
    return touching((boxes + 2 * margin_m * np.array([0.0, 0.0, 0.0, 1.0, 1.0]))[:, None], others)


def endangers(ego: Array, speeds: Array, others: Array, margin_m: float = 0.15) -> Bools:
    """(J,): would the ego (S, 5), straight on for up to 0.9 s, touch that track? Stricter than docs/reward.md 2g."""
    danger = np.zeros(others.shape[1], bool)
    for ahead in (0, 3, 6, 9):
        moved = ego[: len(ego) - ahead].copy()
        travel = speeds[: len(moved)] * ahead * STEP_S
        moved[:, 0] += travel * np.cos(moved[:, 2])
        moved[:, 1] += travel * np.sin(moved[:, 2])
        danger |= overlaps(moved, others[ahead:], margin_m).any(axis=0)
    return danger

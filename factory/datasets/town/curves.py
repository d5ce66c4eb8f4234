"""Plane curves as arrays of poses (N, 3): x [m], y [m], heading [rad], about one metre apart."""

import numpy as np

from tasks.world.arrays import Array
from tasks.world.road_map import arc_lengths

RAMP_M = 12.0  # curvature is averaged over it, so that a car can follow without a jump of the steering wheel


def from_curvature(start: Array, pieces: list[tuple[float, float]]) -> Array:
    """Poses (N, 3) that start at pose `start` and follow (length [m], curvature [1/m]) pieces."""
    length = sum(p[0] for p in pieces)
    n = max(2, round(length))
    step = length / n
    at = (np.arange(n) + 0.5) * step
    edges = np.cumsum([0.0] + [p[0] for p in pieces])
    area = np.concatenate([[0.0], np.cumsum([p[0] * p[1] for p in pieces])])
    ahead = np.interp(np.clip(at + RAMP_M / 2, 0, length), edges, area)
    behind = np.interp(np.clip(at - RAMP_M / 2, 0, length), edges, area)
    heading = start[2] + np.concatenate([[0.0], np.cumsum((ahead - behind) / RAMP_M * step)])
    middle = (heading[:-1] + heading[1:]) / 2
    x = start[0] + np.concatenate([[0.0], np.cumsum(np.cos(middle) * step)])
    y = start[1] + np.concatenate([[0.0], np.cumsum(np.sin(middle) * step)])
    return np.column_stack([x, y, heading])


def bezier(start: Array, end: Array, reach: float = 0.39) -> Array:
    """Cubic from pose `start` to pose `end`, tangent to both; `reach` = handle length / (chord + lateral detour)."""
    chord = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    turn = abs(float(np.angle(np.exp(1j * (end[2] - start[2])))))
    handle = reach * chord * (1.0 + 0.12 * turn)
    p0, p3 = start[:2], end[:2]
    p1 = p0 + handle * np.array([np.cos(start[2]), np.sin(start[2])])
    p2 = p3 - handle * np.array([np.cos(end[2]), np.sin(end[2])])
    t = np.linspace(0.0, 1.0, 200)[:, None]
    points = (1 - t) ** 3 * p0 + 3 * (1 - t) ** 2 * t * p1 + 3 * (1 - t) * t**2 * p2 + t**3 * p3
    return resample(points, start[2], end[2])


def resample(points: Array, first_heading: float, last_heading: float | None = None) -> Array:
    """Poses about a metre apart along a polyline (N, 2); headings are those of the chords, but for given ends."""
    s = arc_lengths(points)
    even = np.linspace(0.0, s[-1], max(2, int(np.ceil(s[-1])) + 1))
    x, y = np.interp(even, s, points[:, 0]), np.interp(even, s, points[:, 1])
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    heading[0] = first_heading
    if last_heading is not None:
        heading[-1] = last_heading
    return np.column_stack([x, y, np.unwrap(heading)])


def offset(poses: Array, left_m: Array | float) -> Array:
    """The curve moved to its left by `left_m` (scalar or (N,)); headings kept."""
    out = poses.copy()
    out[:, 0] -= left_m * np.sin(poses[:, 2])
    out[:, 1] += left_m * np.cos(poses[:, 2])
    return out


def reverse(poses: Array) -> Array:
    """The same curve driven the other way."""
    out = poses[::-1].copy()
    out[:, 2] += np.pi
    return out


def poses_at(poses: Array, query: Array | float) -> Array:
    """Poses at arc lengths `query` (scalar or (Q,)), linear in x, y and unwrapped heading."""
    s = arc_lengths(poses)
    return np.stack([np.interp(query, s, column) for column in (*poses[:, :2].T, np.unwrap(poses[:, 2]))], axis=-1)


def advance(pose: Array, ahead_m: float, left_m: float = 0.0, turn: float = 0.0) -> Array:
    """The pose `ahead_m` further and `left_m` to the left, turned by `turn` [rad]."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([pose[0] + ahead_m * c - left_m * s, pose[1] + ahead_m * s + left_m * c, pose[2] + turn])


def pose_beside(poses: Array, s: float, right_m: float, turn: float = 0.0) -> Array:
    """The pose `right_m` to the right of the curve at arc length `s`, turned by `turn` [rad]."""
    return advance(poses_at(poses, s), 0.0, -right_m, turn)

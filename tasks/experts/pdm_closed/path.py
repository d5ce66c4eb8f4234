"""Parallel polylines that can be driven by arc length (docs/reward.md 4). Compiled."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import Array
from tasks.world.geometry import to_line, to_segment, wrapped

MIN_PROGRESS_M = 1e-5  # interpolation never asks for the very first point: joints may repeat it
_REPEATED_M2 = 1e-300  # below it the inverse of a squared length would overflow
_TIE_M2 = 1e-6  # segments whose squared distance is this near the least are looked at again, in the exact arithmetic


class DrivePaths(NamedTuple):
    """L parallel paths of P points, world frame."""

    x: Array  # (L, P) [m]
    y: Array  # (L, P) [m]
    heading: Array  # (L, P) [rad], unwrapped along the path
    progress: Array  # (L, P) arc length [m], not decreasing (lane joints repeat a point)
    inverse_square: Array  # (L, P - 1) 1 / squared length of each segment [1/m2], 0 where a point is repeated


def path_length_m(poses: Array) -> float:
    """Length [m] of the polyline through `poses` (P, >= 2)."""
    return float(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum())


def drive_paths(centerline: Array, offsets_m: Sequence[float]) -> DrivePaths:
    """`centerline` (P >= 2, 3) moved sideways by each of the L offsets, to the left where positive; headings stay.

    Raises ValueError where the centerline is no such array, is not finite, or one of the paths has no length.
    """
    centerline = np.array(centerline, dtype=np.float64)  # a copy: kernels compile once more for read-only arrays
    if centerline.ndim != 2 or centerline.shape[1] != 3 or len(centerline) < 2:
        raise ValueError(f"centerline must be (P >= 2, 3) x, y, heading, got {centerline.shape}")
    if not np.isfinite(centerline).all():
        raise ValueError("centerline holds NaN or infinite values; leave such points out")
    paths = _moved_sideways(centerline, np.asarray(offsets_m, dtype=np.float64))
    if paths.progress[:, -1].min() <= MIN_PROGRESS_M:
        raise ValueError("centerline needs a length: all its points are one")
    return paths


@kernel
def _moved_sideways(centerline: Array, offsets_m: Array) -> DrivePaths:
    n_paths, n_points = offsets_m.shape[0], centerline.shape[0]
    x, y, heading, progress = np.empty((4, n_paths, n_points))
    inverse_square = np.zeros((n_paths, n_points - 1))
    for path in range(n_paths):
        unwrap = 0.0
        for k in range(n_points):
            side = centerline[k, 2] + math.pi / 2.0
            x[path, k] = centerline[k, 0] + math.cos(side) * offsets_m[path]
            y[path, k] = centerline[k, 1] + math.sin(side) * offsets_m[path]
            here = wrapped(centerline[k, 2])
            if k == 0:
                heading[path, k], progress[path, k] = here, 0.0
                continue
            turn = here - wrapped(centerline[k - 1, 2])
            if abs(turn) >= math.pi:
                unwrap += wrapped(turn) - turn
            heading[path, k] = here + unwrap
            dx, dy = x[path, k] - x[path, k - 1], y[path, k] - y[path, k - 1]
            square = dx * dx + dy * dy
            progress[path, k] = progress[path, k - 1] + math.sqrt(square)
            if square > _REPEATED_M2:
                inverse_square[path, k - 1] = 1.0 / square
    return DrivePaths(x, y, heading, progress, inverse_square)


@kernel
def pose_at(paths: DrivePaths, path: int, progress: float) -> tuple[float, float, float]:
    """x, y, heading at an arc length [m]: linear in x, y and unwrapped heading, clipped to the path's ends."""
    along = paths.progress[path]
    last = along.shape[0] - 1
    distance = min(max(progress, MIN_PROGRESS_M), along[last])
    # the segment found starts strictly before the distance, so a repeated point divides by nothing
    k = min(max(np.searchsorted(along, distance), 1), last) - 1
    length, rest = along[k + 1] - along[k], distance - along[k]
    x, y, heading = paths.x[path], paths.y[path], paths.heading[path]
    h = (heading[k + 1] - heading[k]) / length * rest + heading[k]
    return (
        (x[k + 1] - x[k]) / length * rest + x[k],
        (y[k + 1] - y[k]) / length * rest + y[k],
        math.atan2(math.sin(h), math.cos(h)),
    )


@kernel
def project(paths: DrivePaths, path: int, px: float, py: float) -> float:
    """Arc length [m] of the point of a path nearest to (px, py), the first of several.

    The least squared distance is found over all segments, then the few that come near it are compared with the
    arithmetic of GEOS, so that ties between segments fall as they do for the public planner.
    """
    x, y, along, inverse = paths.x[path], paths.y[path], paths.progress[path], paths.inverse_square[path]
    squares, bound = np.empty(inverse.shape[0]), np.inf
    next_x, next_y = x[1:], y[1:]
    for k in range(inverse.shape[0]):
        ex, ey = next_x[k] - x[k], next_y[k] - y[k]
        ux, uy = px - x[k], py - y[k]
        squares[k] = to_line(ux, uy, ex, ey, (ux * ex + uy * ey) * inverse[k])[1]
        bound = min(bound, squares[k])
    bound += _TIE_M2 * (1.0 + bound)
    nearest, found = np.inf, 0.0
    for k in range(inverse.shape[0]):
        if squares[k] <= bound:
            ex, ey = x[k + 1] - x[k], y[k + 1] - y[k]
            distance, fraction = to_segment(px, py, x[k], y[k], x[k + 1], y[k + 1])
            if distance < nearest:
                nearest, found = distance, along[k] + fraction * math.sqrt(ex * ex + ey * ey)
    return found

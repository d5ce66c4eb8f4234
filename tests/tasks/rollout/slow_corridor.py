"""Slow twin of the paths and corridors: walks every corridor cell by cell, scans every path whole.

A path is points every PATH_SPACING_M. A vehicle that joins beside its path, or turned against it, keeps that offset at
first and fades onto the path with the distance it travels, so that no box jumps and no standing car slides.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel

Array = NDArray[np.float64]

PATH_SPACING_M = 0.5  # of every path's points


class Paths(NamedTuple):
    """M paths of P points every PATH_SPACING_M, and Q stop lines across them."""

    xy: Array  # (M, P, 2) world [m]
    heading: Array  # (M, P) [rad], unwrapped along the path
    height: Array  # (M, P) ground relative to anything constant [m]
    target_speed: Array  # (M, P) v0 [m/s]
    line_start: NDArray[np.int64]  # (M + 1,) lines of path m: line_start[m]..line_start[m + 1] - 1
    line_at: Array  # (Q,) path length of the line [m]
    line_state: NDArray[np.uint8]  # (41, Q) OPEN, CLOSED_IF_STOPPABLE, CLOSED at every step of the rollout


@kernel
def _fade(travelled: float, length: float) -> tuple[float, float]:
    """(value, slope) of a smooth step from 1 down to 0 over `length`."""
    u = travelled / length
    if u >= 1.0:
        return 0.0, 0.0
    u = max(u, 0.0)
    return 1.0 - u * u * u * (10.0 + u * (6.0 * u - 15.0)), -30.0 * u * u * (1.0 - u) * (1.0 - u) / length


@kernel
def pose_on_path(
    paths: Paths, m: int, s: float, travelled: float, offset: float, turn: float, blend_length: float
) -> tuple[float, float, float]:
    """x, y, heading at path length s of one that joined `offset` m left of path m, turned by `turn`, fading onto it."""
    xy, heading = paths.xy[m], paths.heading[m]
    last = heading.shape[0] - 1
    cell = s / PATH_SPACING_M
    k = min(max(math.floor(cell), 0), last - 1)
    f = cell - k  # beyond 0..1 past the ends: straight on
    x = xy[k, 0] + f * (xy[k + 1, 0] - xy[k, 0])
    y = xy[k, 1] + f * (xy[k + 1, 1] - xy[k, 1])
    g = min(max(f, 0.0), 1.0)
    h = heading[k] + g * (heading[k + 1] - heading[k])
    keep, slope = _fade(travelled, blend_length)
    x -= math.sin(h) * offset * keep
    y += math.cos(h) * offset * keep
    return x, y, h + turn * keep + math.atan(offset * slope)


@kernel
def project_on_path(paths: Paths, m: int, x: float, y: float) -> tuple[float, float]:
    """(path length, offset to the left) of the point of path m nearest to (x, y)."""
    xy = paths.xy[m]
    best, best_s, best_offset = np.inf, 0.0, 0.0
    for k in range(xy.shape[0] - 1):
        ex, ey = xy[k + 1, 0] - xy[k, 0], xy[k + 1, 1] - xy[k, 1]
        dx, dy = x - xy[k, 0], y - xy[k, 1]
        f = (dx * ex + dy * ey) / (ex * ex + ey * ey)
        f = min(max(f, 0.0), 1.0)
        rx, ry = dx - f * ex, dy - f * ey
        square = rx * rx + ry * ry
        if square < best:
            best = square
            best_s = (k + f) * PATH_SPACING_M
            best_offset = math.copysign(math.sqrt(square), ex * dy - ey * dx)
    return best_s, best_offset


@kernel
def corners_of(box: Array, out: Array) -> None:
    """Corners (4, 2) of a box, in turn around it."""
    c, s = math.cos(box[2]), math.sin(box[2])
    for i in range(4):
        u = 0.5 * box[3] * (1.0 if i == 0 or i == 3 else -1.0)
        v = 0.5 * box[4] * (1.0 if i < 2 else -1.0)
        out[i, 0] = box[0] + c * u - s * v
        out[i, 1] = box[1] + s * u + c * v


@kernel
def boxes_overlap(a: Array, b: Array) -> bool:
    """Do two boxes share area (separating axis test; touching is not overlapping)?"""
    dx, dy = b[0] - a[0], b[1] - a[1]
    reach = 0.5 * (math.hypot(a[3], a[4]) + math.hypot(b[3], b[4]))
    if not dx * dx + dy * dy <= reach * reach:  # also where a box is absent (NaN)
        return False
    c, s = abs(math.cos(b[2] - a[2])), abs(math.sin(b[2] - a[2]))
    for box, other in ((a, b), (b, a)):
        along = dx * math.cos(box[2]) + dy * math.sin(box[2])
        across = -dx * math.sin(box[2]) + dy * math.cos(box[2])
        if abs(along) >= 0.5 * (box[3] + other[3] * c + other[4] * s):
            return False
        if abs(across) >= 0.5 * (box[4] + other[3] * s + other[4] * c):
            return False
    return True


@kernel
def _range_in_strip(corners: Array, x: float, y: float, heading: float, half_width: float) -> tuple[float, float]:
    """Nearest and farthest distance along `heading` of what a box has inside the strip |across| <= half_width."""
    c, s = math.cos(heading), math.sin(heading)
    low, high = np.inf, -np.inf
    for i in range(4):
        j = (i + 1) % 4
        ux, uy = corners[i, 0] - x, corners[i, 1] - y
        vx, vy = corners[j, 0] - x, corners[j, 1] - y
        u0, w0 = c * ux + s * uy, -s * ux + c * uy
        u1, w1 = c * vx + s * vy, -s * vx + c * vy
        if abs(w0) <= half_width:
            low, high = min(low, u0), max(high, u0)
        for edge in (-half_width, half_width):
            if (w0 - edge) * (w1 - edge) < 0.0:
                u = u0 + (u1 - u0) * (edge - w0) / (w1 - w0)
                low, high = min(low, u), max(high, u)
    return low, high


@kernel
def corridor_gap(
    paths: Paths,
    m: int,
    s: float,
    travelled: float,
    offset: float,
    turn: float,
    front: float,
    half_width: float,
    corners: Array,
    center: Array,
    radius: float,
    blend_length: float,
    lookahead: float,
) -> tuple[float, float]:
    """(gap [m] from the bumper along the path to a box, path heading there); gap = inf where the corridor is free.

    The corridor is walked in cells of PATH_SPACING_M; where the box is far, by that distance at once.
    """
    ahead = 0.0
    cell_radius = math.hypot(half_width, PATH_SPACING_M)
    while ahead < lookahead:
        x, y, h = pose_on_path(paths, m, s + front + ahead, travelled + front + ahead, offset, turn, blend_length)
        clearance = math.hypot(center[0] - x, center[1] - y) - radius - cell_radius
        if clearance > 0.0:
            ahead += max(0.8 * clearance, PATH_SPACING_M)  # 0.8: a blended path is a little longer than its own length
            continue
        low, high = _range_in_strip(corners, x, y, h, half_width)
        if low <= PATH_SPACING_M and high >= 0.0:
            return ahead + max(low, 0.0), h
        ahead += PATH_SPACING_M
    return np.inf, 0.0

"""Paths as arrays, and what a body finds in the corridor it will sweep along one. Compiled.

A path is points every PATH_SPACING_M. A vehicle that joins beside its path, or turned against it, keeps that offset at
first and fades onto the path with the distance it travels, so that no box jumps and no standing car slides.
"""

import math
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import inner_kernel
from tasks.rollout.stretches import CELLS, PATH_SPACING_M, SLACK_M, Box, CorridorAhead, view_along
from tasks.world.arrays import Array, Bytes, Ints
from tasks.world.geometry import to_line

STEEPEST_FADE = 1.876  # no slope of the fade over a unit length is steeper (30 / 16)


class Paths(NamedTuple):
    """M paths of P points every PATH_SPACING_M in S stretches, and Q stop lines across them."""

    xy: Array  # (M, P, 2) world [m]
    heading: Array  # (M, P) [rad], unwrapped along the path
    height: Array  # (M, P) ground relative to anything constant [m]
    target_speed: Array  # (M, P) v0 [m/s]
    stretches: Array  # (M, S, 8) rectangles around them: stretches_of(xy, heading)
    line_start: Ints  # (M + 1,) lines of path m: line_start[m]..line_start[m + 1] - 1
    line_at: Array  # (Q,) path length of the line [m]
    line_state: Bytes  # (41, Q) OPEN, CLOSED_IF_STOPPABLE, CLOSED at every step of the rollout


class Way(NamedTuple):
    """A body on its way along a path."""

    path: int
    s: float  # [m] path length of its centre
    travelled: float  # [m] since it joined
    offset: float  # [m] to the left of the path, when it joined
    turn: float  # [rad] against the path, when it joined
    front: float  # [m] from the centre to the bumper
    half_width: float  # [m] of the corridor it needs


@inner_kernel
def _fade(travelled: float, length: float) -> tuple[float, float]:
    """(value, slope) of a smooth step from 1 down to 0 over `length`."""
    u = travelled / length
    if u >= 1.0:
        return 0.0, 0.0
    u = max(u, 0.0)
    return 1.0 - u * u * u * (10.0 + u * (6.0 * u - 15.0)), -30.0 * u * u * (1.0 - u) * (1.0 - u) / length


@inner_kernel
def _point_on_path(paths: Paths, m: int, s: float) -> tuple[float, float, float]:
    """x, y, heading of path m at path length s, straight on past its ends."""
    last = paths.heading.shape[1] - 1
    cell = s / PATH_SPACING_M
    k = min(max(math.floor(cell), 0), last - 1)
    f = cell - k  # beyond 0..1 past the ends
    x = paths.xy[m, k, 0] + f * (paths.xy[m, k + 1, 0] - paths.xy[m, k, 0])
    y = paths.xy[m, k, 1] + f * (paths.xy[m, k + 1, 1] - paths.xy[m, k, 1])
    g = min(max(f, 0.0), 1.0)
    return x, y, paths.heading[m, k] + g * (paths.heading[m, k + 1] - paths.heading[m, k])


@inner_kernel
def pose_on_path(
    paths: Paths, m: int, s: float, travelled: float, offset: float, turn: float, blend_length: float
) -> tuple[float, float, float]:
    """x, y, heading at path length s of one that joined `offset` m left of path m, turned by `turn`, fading onto it."""
    x, y, h = _point_on_path(paths, m, s)
    if travelled >= blend_length:
        return x, y, h
    keep, slope = _fade(travelled, blend_length)
    return x - math.sin(h) * offset * keep, y + math.cos(h) * offset * keep, h + turn * keep + math.atan(offset * slope)


@inner_kernel
def project_on_path(paths: Paths, m: int, x: float, y: float) -> tuple[float, float]:
    """(path length, offset to the left) of the point of path m nearest to (x, y); of equal ones the first."""
    rectangles = paths.stretches
    near = np.inf  # the nearest point is no farther than this
    for b in range(rectangles.shape[1]):
        near = min(near, math.hypot(x - rectangles[m, b, 0], y - rectangles[m, b, 1]) + rectangles[m, b, 6])
    best, best_s, best_offset = np.inf, 0.0, 0.0
    for b in range(rectangles.shape[1]):
        away = math.hypot(x - rectangles[m, b, 0], y - rectangles[m, b, 1]) - rectangles[m, b, 6]
        if away > near + SLACK_M:
            continue
        for k in range(b * CELLS, min((b + 1) * CELLS, paths.heading.shape[1] - 1)):
            px, py = paths.xy[m, k, 0], paths.xy[m, k, 1]
            ex, ey = paths.xy[m, k + 1, 0] - px, paths.xy[m, k + 1, 1] - py
            dx, dy = x - px, y - py
            f, square = to_line(dx, dy, ex, ey, (dx * ex + dy * ey) / (ex * ex + ey * ey))
            if square < best:
                best = square
                best_s = (k + f) * PATH_SPACING_M
                best_offset = math.copysign(math.sqrt(square), ex * dy - ey * dx)
    return best_s, best_offset


@inner_kernel
def boxes_overlap(a: Box, b: Box) -> bool:
    """Do two boxes share area (separating axis test; touching is not overlapping)?"""
    dx, dy = b[0] - a[0], b[1] - a[1]
    reach = 0.5 * (math.hypot(a[3], a[4]) + math.hypot(b[3], b[4]))
    if not dx * dx + dy * dy <= reach * reach:  # also where a box is absent (NaN)
        return False
    c, s = abs(math.cos(b[2] - a[2])), abs(math.sin(b[2] - a[2]))
    return not (_is_beside(a, b, dx, dy, c, s) or _is_beside(b, a, dx, dy, c, s))


@inner_kernel
def _is_beside(box: Box, other: Box, dx: float, dy: float, c: float, s: float) -> bool:
    """Does an axis of `box` separate it from one whose centre is at +-(dx, dy), turned by |cos| = c, |sin| = s?"""
    along = dx * math.cos(box[2]) + dy * math.sin(box[2])
    across = -dx * math.sin(box[2]) + dy * math.cos(box[2])
    return (
        abs(along) >= 0.5 * (box[3] + other[3] * c + other[4] * s)
        or abs(across) >= 0.5 * (box[4] + other[3] * s + other[4] * c)
    )  # fmt: skip


@inner_kernel
def _widened(
    low: float, high: float, half_width: float, u0: float, w0: float, u1: float, w1: float
) -> tuple[float, float]:
    """A range along a strip, widened by what the edge (u0, w0)-(u1, w1) has inside |w| <= half_width."""
    if abs(w0) <= half_width:
        low, high = min(low, u0), max(high, u0)
    for edge in (-half_width, half_width):
        if (w0 - edge) * (w1 - edge) < 0.0:
            u = u0 + (u1 - u0) * (edge - w0) / (w1 - w0)
            low, high = min(low, u), max(high, u)
    return low, high


@inner_kernel
def _range_in_strip(box: Box, x: float, y: float, heading: float, half_width: float) -> tuple[float, float]:
    """Nearest and farthest distance along `heading` of what a box has inside the strip |across| <= half_width."""
    c, s = math.cos(heading), math.sin(heading)
    bc, bs = math.cos(box[2]), math.sin(box[2])
    u, v = 0.5 * box[3], 0.5 * box[4]
    ax, ay = box[0] + bc * u - bs * v - x, box[1] + bs * u + bc * v - y
    bx, by = box[0] + bc * -u - bs * v - x, box[1] + bs * -u + bc * v - y
    cx, cy = box[0] + bc * -u - bs * -v - x, box[1] + bs * -u + bc * -v - y
    dx, dy = box[0] + bc * u - bs * -v - x, box[1] + bs * u + bc * -v - y
    au, aw = c * ax + s * ay, -s * ax + c * ay
    bu, bw = c * bx + s * by, -s * bx + c * by
    cu, cw = c * cx + s * cy, -s * cx + c * cy
    du, dw = c * dx + s * dy, -s * dx + c * dy
    low, high = _widened(np.inf, -np.inf, half_width, au, aw, bu, bw)
    low, high = _widened(low, high, half_width, bu, bw, cu, cw)
    low, high = _widened(low, high, half_width, cu, cw, du, dw)
    return _widened(low, high, half_width, du, dw, au, aw)


@inner_kernel
def look_ahead(paths: Paths, way: Way, blend_length: float, lookahead: float) -> CorridorAhead:
    """Where the corridor ahead of a body is."""
    keep, _ = _fade(way.travelled + way.front, blend_length)
    offset, turn = abs(way.offset) * keep, abs(way.turn) * keep
    if keep > 0.0:
        turn += abs(way.offset) * STEEPEST_FADE / blend_length
    length = (paths.heading.shape[1] - 1) * PATH_SPACING_M
    begin = way.s + way.front
    return view_along(paths.stretches, length, way.path, begin, begin + lookahead, offset, turn, way.half_width)


@inner_kernel
def corridor_gap(
    paths: Paths, way: Way, box: Box, radius: float, blend_length: float, lookahead: float
) -> tuple[float, float]:
    """(gap [m] from the bumper along the path to a box, path heading there); gap = inf where the corridor is free.

    The corridor is walked in cells of PATH_SPACING_M; where the box is far, by that distance at once. radius: around
    the box.
    """
    ahead = 0.0
    cell_radius = math.hypot(way.half_width, PATH_SPACING_M)
    while ahead < lookahead:
        s, travelled = way.s + way.front + ahead, way.travelled + way.front + ahead
        x, y, h = pose_on_path(paths, way.path, s, travelled, way.offset, way.turn, blend_length)
        clearance = math.hypot(box[0] - x, box[1] - y) - radius - cell_radius
        if clearance > 0.0:
            ahead += max(0.8 * clearance, PATH_SPACING_M)  # 0.8: a blended path is a little longer than its own length
            continue
        low, high = _range_in_strip(box, x, y, h, way.half_width)
        if low <= PATH_SPACING_M and high >= 0.0:
            return ahead + max(low, 0.0), h
        ahead += PATH_SPACING_M
    return np.inf, 0.0

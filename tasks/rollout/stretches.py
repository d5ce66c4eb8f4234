"""Rectangles around stretches of a path: what is beside all of them cannot be in a corridor along the path. Compiled.

A corridor is walked cell by cell (corridor.py), and most boxes of a street are in nobody's way. Each path is cut into
stretches of CELLS cells; around the points of each lies a rectangle turned as the path is there. Grown by all that a
body can reach from a point of its way (its offset to the path, its half width, a cell, the angle its heading can have
to the rectangle) and set apart from a box, a stretch holds no cell that meets the box: no walk would find it.
"""

import math
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import inner_kernel, kernel
from tasks.rollout.polylines import extent
from tasks.world.arrays import Array

Box = Array | tuple[float, float, float, float, float]  # centre x, y [m], heading [rad], length, width [m]

PATH_SPACING_M = 0.5  # of every path's points
CELLS = 16  # of a stretch: 8 m
STRETCH_M = CELLS * PATH_SPACING_M
SLACK_M = 1e-6  # above what rounding can do to a coordinate of a city


class CorridorAhead(NamedTuple):
    """A corridor along a path: a rectangle around all of it, and the stretches it lies along."""

    x: float  # [m] the rectangle's centre
    y: float
    ux: float  # unit vector along it
    uy: float
    half_u: float  # [m] half its length
    half_v: float  # [m] half its width
    first: int  # stretch
    last: int  # stretch; none: what lies in the rectangle may be in the corridor
    offset: float  # [m] the largest its middle has to the path
    turn: float  # [rad] the largest it has to the path
    half_width: float  # [m] of the corridor


@kernel
def stretches_of(xy: Array, heading: Array) -> Array:
    """(M, S, 8) of paths xy (M, P, 2), heading (M, P): a rectangle around every CELLS cells.

    Columns: centre x, y [m]; unit vector along it; half its length and half its width [m]; radius around it [m];
    largest difference of a heading in it to its own [rad].
    """
    n_paths, n_points = heading.shape
    n = (n_points - 2) // CELLS + 1
    out = np.empty((n_paths, n, 8))
    for m in range(n_paths):
        for b in range(n):
            first, last = b * CELLS, min((b + 1) * CELLS, n_points - 1)
            least, largest = extent(heading[m, first : last + 1])
            middle = 0.5 * (least + largest)
            ux, uy = math.cos(middle), math.sin(middle)
            along = xy[m, first : last + 1, 0] * ux + xy[m, first : last + 1, 1] * uy
            across = xy[m, first : last + 1, 1] * ux - xy[m, first : last + 1, 0] * uy
            (back, front), (right, left) = extent(along), extent(across)
            u, v = 0.5 * (back + front), 0.5 * (right + left)
            half_u, half_v = 0.5 * (front - back), 0.5 * (left - right)
            out[m, b, 0], out[m, b, 1] = u * ux - v * uy, u * uy + v * ux
            out[m, b, 2], out[m, b, 3] = ux, uy
            out[m, b, 4], out[m, b, 5] = half_u, half_v
            out[m, b, 6] = math.hypot(half_u, half_v)
            out[m, b, 7] = largest - middle
    return out


@inner_kernel
def view_along(
    stretches: Array, length: float, m: int, begin: float, end: float, offset: float, turn: float, half_width: float
) -> CorridorAhead:
    """The corridor from path length `begin` to `end` of path m, which is `length` long.

    offset, turn: the largest lateral offset and turn the body has to its path in there; half_width: of the corridor.
    """
    if begin < 0.0 or end > length:  # beyond the path's ends there are no stretches
        return CorridorAhead(0.0, 0.0, 1.0, 0.0, np.inf, np.inf, 0, -1, offset, turn, half_width)
    first, last = int(begin / STRETCH_M), min(int(end / STRETCH_M), stretches.shape[1] - 1)
    x, y = stretches[m, first, 0], stretches[m, first, 1]
    dx, dy = stretches[m, last, 0] - x, stretches[m, last, 1] - y
    chord = math.hypot(dx, dy)
    ux, uy = (dx / chord, dy / chord) if chord > 0.0 else (stretches[m, first, 2], stretches[m, first, 3])
    low_u, high_u, low_v, high_v = np.inf, -np.inf, np.inf, -np.inf
    for b in range(first, last + 1):
        dx, dy = stretches[m, b, 0] - x, stretches[m, b, 1] - y
        cos = abs(stretches[m, b, 2] * ux + stretches[m, b, 3] * uy)
        sin = abs(stretches[m, b, 3] * ux - stretches[m, b, 2] * uy)
        u, v = dx * ux + dy * uy, dy * ux - dx * uy
        half_u = stretches[m, b, 4] * cos + stretches[m, b, 5] * sin
        half_v = stretches[m, b, 4] * sin + stretches[m, b, 5] * cos
        low_u, high_u = min(low_u, u - half_u), max(high_u, u + half_u)
        low_v, high_v = min(low_v, v - half_v), max(high_v, v + half_v)
    u, v = 0.5 * (low_u + high_u), 0.5 * (low_v + high_v)
    x, y = x + u * ux - v * uy, y + u * uy + v * ux
    grown = offset + half_width + PATH_SPACING_M + SLACK_M
    half_u, half_v = 0.5 * (high_u - low_u) + grown, 0.5 * (high_v - low_v) + grown
    return CorridorAhead(x, y, ux, uy, half_u, half_v, first, last, offset, turn, half_width)


@inner_kernel
def in_view(view: CorridorAhead, x: float, y: float, radius: float) -> bool:
    """Can something within `radius` of (x, y) be in the corridor? False: surely not."""
    dx, dy = x - view.x, y - view.y
    return (
        abs(dx * view.ux + dy * view.uy) <= view.half_u + radius
        and abs(dy * view.ux - dx * view.uy) <= view.half_v + radius
    )  # fmt: skip


@inner_kernel
def may_meet(stretches: Array, m: int, view: CorridorAhead, box: Box, radius: float) -> bool:
    """Can a box, `radius` around it, be in the corridor? False: surely not."""
    if view.last < view.first:
        return True
    turned, c, s = False, 1.0, 0.0
    around = view.offset + view.half_width + PATH_SPACING_M + radius + SLACK_M
    half_length, half_across = 0.5 * box[3], 0.5 * box[4]
    for b in range(view.first, view.last + 1):
        dx, dy = box[0] - stretches[m, b, 0], box[1] - stretches[m, b, 1]
        reach = stretches[m, b, 6] + around
        if dx * dx + dy * dy > reach * reach:
            continue
        if not turned:
            turned, c, s = True, math.cos(box[2]), math.sin(box[2])
        ux, uy = stretches[m, b, 2], stretches[m, b, 3]
        bend = min(stretches[m, b, 7] + view.turn, 1.0)
        half_u = stretches[m, b, 4] + PATH_SPACING_M + (view.offset + view.half_width) * bend + SLACK_M
        half_v = stretches[m, b, 5] + view.offset + view.half_width + PATH_SPACING_M * bend + SLACK_M
        cos, sin = abs(c * ux + s * uy), abs(s * ux - c * uy)
        if (
            abs(dx * ux + dy * uy) <= half_u + half_length * cos + half_across * sin
            and abs(dy * ux - dx * uy) <= half_v + half_length * sin + half_across * cos
            and abs(dx * c + dy * s) <= half_length + half_u * cos + half_v * sin
            and abs(dy * c - dx * s) <= half_across + half_u * sin + half_v * cos
        ):
            return True
    return False

"""Angles, segments and closed rings in the plane, one at a time. Compiled; many at once in numpy: frames.py.

A ring is its vertices x (V,) and y (V,) [m], the first not repeated at the end. Distances are computed in the order of
operations of GEOS, so that they equal shapely's.
"""

import math

import numpy as np

from tasks.kernels.compiled import inlined, kernel
from tasks.world.arrays import Array


@inlined
def wrapped(angle: float) -> float:
    """An angle [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@inlined
def nearest_on_edge(dx: float, dy: float, ex: float, ey: float, along: float) -> tuple[float, float]:
    """The fraction 0..1 of an edge (ex, ey) nearest to a point (dx, dy) from its start, and the squared distance to it.

    along: the point's projection onto the line, in lengths of the edge.
    """
    fraction = min(max(along, 0.0), 1.0)
    rx, ry = dx - fraction * ex, dy - fraction * ey
    return fraction, rx * rx + ry * ry


@kernel
def to_segment(px: float, py: float, ax: float, ay: float, bx: float, by: float) -> tuple[float, float]:
    """Distance [m] from a point to the segment a-b, and the fraction 0..1 of it at which it is nearest."""
    ex, ey = bx - ax, by - ay
    square = ex * ex + ey * ey
    fraction = ((px - ax) * ex + (py - ay) * ey) / square if square > 0.0 else 0.0
    if fraction <= 0.0:
        return math.sqrt((px - ax) * (px - ax) + (py - ay) * (py - ay)), 0.0
    if fraction >= 1.0:
        return math.sqrt((px - bx) * (px - bx) + (py - by) * (py - by)), 1.0
    return abs(((ay - py) * ex - (ax - px) * ey) / square) * math.sqrt(square), fraction


@kernel
def segments_touch(ax: float, ay: float, bx: float, by: float, cx: float, cy: float, dx: float, dy: float) -> bool:
    """Whether the segments a-b and c-d have a point in common, ends included."""
    if max(ax, bx) < min(cx, dx) or max(cx, dx) < min(ax, bx) or max(ay, by) < min(cy, dy) or max(cy, dy) < min(ay, by):
        return False
    a = (dx - cx) * (ay - cy) - (dy - cy) * (ax - cx)  # on which side of c-d
    b = (dx - cx) * (by - cy) - (dy - cy) * (bx - cx)
    c = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    d = (bx - ax) * (dy - ay) - (by - ay) * (dx - ax)
    apart = (a > 0.0 and b > 0.0) or (a < 0.0 and b < 0.0) or (c > 0.0 and d > 0.0) or (c < 0.0 and d < 0.0)
    return not apart


@kernel
def ring_contains(x: Array, y: Array, px: float, py: float) -> bool:
    """Whether (px, py) is inside the ring, by the even-odd rule; on the ring itself it may be either."""
    inside = False
    j = x.shape[0] - 1
    for i in range(x.shape[0]):
        if (y[i] > py) != (y[j] > py) and ((px - x[i]) * (y[j] - y[i]) < (py - y[i]) * (x[j] - x[i])) == (y[j] > y[i]):
            inside = not inside
        j = i
    return inside


@kernel
def rings_touch(ax: Array, ay: Array, bx: Array, by: Array) -> bool:
    """Whether the areas of two rings have a point in common."""
    i0 = ax.shape[0] - 1
    for i in range(ax.shape[0]):
        j0 = bx.shape[0] - 1
        for j in range(bx.shape[0]):
            if segments_touch(ax[i0], ay[i0], ax[i], ay[i], bx[j0], by[j0], bx[j], by[j]):
                return True
            j0 = j
        i0 = i
    return ring_contains(ax, ay, bx[0], by[0]) or ring_contains(bx, by, ax[0], ay[0])


@kernel
def rings_distance(ax: Array, ay: Array, bx: Array, by: Array) -> float:
    """Distance [m] between the areas of two rings; 0 where they touch."""
    if rings_touch(ax, ay, bx, by):
        return 0.0
    nearest = np.inf
    i0 = ax.shape[0] - 1
    for i in range(ax.shape[0]):
        j0 = bx.shape[0] - 1
        for j in range(bx.shape[0]):
            nearest = min(nearest, to_segment(ax[i], ay[i], bx[j0], by[j0], bx[j], by[j])[0])
            nearest = min(nearest, to_segment(bx[j], by[j], ax[i0], ay[i0], ax[i], ay[i])[0])
            j0 = j
        i0 = i
    return nearest

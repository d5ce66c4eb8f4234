"""Polylines in kernels: between their points, past their ends, how they are headed, and what is nearest on them."""

import math

import numpy as np

from tasks.kernels.compiled import inner_kernel, kernel
from tasks.world.arrays import Array
from tasks.world.geometry import to_line, wrapped

END_CHORD_M = 5.0  # a line's last few points may be noise
CHORD_POINTS = 3  # each way, of the chord a heading is taken from


@inner_kernel
def interpolated(x: float, at: Array, values: Array) -> float:
    """Value at x of a line through `values` (P,) at increasing `at` (P,), constant past both ends; as numpy.interp."""
    last = at.shape[0] - 1
    if x >= at[last]:
        return values[last]
    if x < at[0]:
        return values[0]
    low, high = 0, last  # at[low] <= x < at[high]
    while high - low > 1:
        middle = (low + high) // 2
        if at[middle] <= x:
            low = middle
        else:
            high = middle
    slope = (values[low + 1] - values[low]) / (at[low + 1] - at[low])
    return slope * (x - at[low]) + values[low]


@inner_kernel
def extent(values: Array) -> tuple[float, float]:
    """Least and largest of values (P,); a fraction of what numpy's own two take to compile."""
    low, high = np.inf, -np.inf
    for value in values:
        low, high = min(low, value), max(high, value)
    return low, high


@kernel
def lengths_along(xy: Array) -> Array:
    """(P,) path length [m] of each point of a polyline (P, >= 2)."""
    out = np.zeros(len(xy))
    for k in range(1, len(xy)):
        out[k] = out[k - 1] + math.hypot(xy[k, 0] - xy[k - 1, 0], xy[k, 1] - xy[k - 1, 1])
    return out


@kernel
def points_at(xy: Array, length: Array, at: Array) -> Array:
    """(K, 2) points of a polyline (P, 2) at path lengths, straight on past both ends, as its last END_CHORD_M point.

    Past the ends of a line of length 0, which points nowhere: NaN.
    """
    x, y = np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1])
    end = length[-1]
    chord = min(END_CHORD_M, end)
    ax, ay = interpolated(chord, length, x) - x[0], interpolated(chord, length, y) - y[0]
    bx, by = x[-1] - interpolated(end - chord, length, x), y[-1] - interpolated(end - chord, length, y)
    a, b = math.hypot(ax, ay), math.hypot(bx, by)
    ax, ay = (ax / a, ay / a) if a > 0.0 else (np.nan, np.nan)
    bx, by = (bx / b, by / b) if b > 0.0 else (np.nan, np.nan)
    out = np.empty((len(at), 2))
    for k in range(len(at)):
        if at[k] < 0.0:
            out[k, 0], out[k, 1] = x[0] + ax * at[k], y[0] + ay * at[k]
        elif at[k] > end:
            out[k, 0], out[k, 1] = x[-1] + bx * (at[k] - end), y[-1] + by * (at[k] - end)
        else:
            out[k, 0], out[k, 1] = interpolated(at[k], length, x), interpolated(at[k], length, y)
    return out


@kernel
def chord_headings(points: Array) -> Array:
    """Headings (P,) of chords 2 CHORD_POINTS long, unwrapped: what a body as long as a car does at a kink."""
    n = len(points)
    out = np.empty(n)
    before, turns = 0.0, 0.0
    for k in range(n):
        a, b = max(k - CHORD_POINTS, 0), min(k + CHORD_POINTS, n - 1)
        h = math.atan2(points[b, 1] - points[a, 1], points[b, 0] - points[a, 0])
        turn = h - before
        if k > 0 and abs(turn) >= math.pi:
            short = wrapped(turn)  # the shorter way round; half a turn keeps its sign
            turns += (math.pi if short == -math.pi and turn > 0.0 else short) - turn
        before = h
        out[k] = h + turns
    return out


@kernel
def frenet(xy: Array, length: Array, poses: Array) -> Array:
    """(K, 2) path length and offset to the left of the polyline's points nearest to poses (K, >= 2)."""
    out = np.zeros((poses.shape[0], 2))
    for i in range(poses.shape[0]):
        best = np.inf
        for k in range(xy.shape[0] - 1):
            ex, ey = xy[k + 1, 0] - xy[k, 0], xy[k + 1, 1] - xy[k, 1]
            dx, dy = poses[i, 0] - xy[k, 0], poses[i, 1] - xy[k, 1]
            f, square = to_line(dx, dy, ex, ey, (dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-12))
            if square < best:
                best = square
                out[i, 0] = length[k] + f * (length[k + 1] - length[k])
                out[i, 1] = math.copysign(math.sqrt(square), ex * dy - ey * dx)
    return out

"""Paths as arrays, and what a body finds in the corridor it will sweep along one. Compiled.

A path is points every PATH_SPACING_M. A vehicle that joins beside its path, or turned against it, keeps that offset at
first and fades onto the path with the distance it travels, so that no box jumps and no standing car slides.
"""

import math
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import hidden_kernel, inner_kernel, kernel
from tasks.world.arrays import Array, Bytes, Ints
from tasks.world.frames import SLACK_M
from tasks.world.geometry import nearest_on_edge, wrapped

# Polylines in kernels: between their points, past their ends, how they are headed, and what is nearest on them.

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
def least_and_largest(values: Array) -> tuple[float, float]:
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
def arc_length_and_offset(xy: Array, length: Array, poses: Array) -> Array:
    """(K, 2) path length and offset to the left of the polyline's points nearest to poses (K, >= 2)."""
    out = np.zeros((poses.shape[0], 2))
    for i in range(poses.shape[0]):
        best = np.inf
        for k in range(xy.shape[0] - 1):
            ex, ey = xy[k + 1, 0] - xy[k, 0], xy[k + 1, 1] - xy[k, 1]
            dx, dy = poses[i, 0] - xy[k, 0], poses[i, 1] - xy[k, 1]
            f, square = nearest_on_edge(dx, dy, ex, ey, (dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-12))
            if square < best:
                best = square
                out[i, 0] = length[k] + f * (length[k + 1] - length[k])
                out[i, 1] = math.copysign(math.sqrt(square), ex * dy - ey * dx)
    return out


# Rectangles around stretches of a path: what is beside all of them cannot be in a corridor along the path.
#
# A corridor is walked cell by cell, and most boxes of a street are in nobody's way. Each path is cut into
# stretches of CELLS cells; around the points of each lies a rectangle turned as the path is there. Grown by all that a
# body can reach from a point of its way (its offset to the path, its half width, a cell, the angle its heading can have
# to the rectangle) and set apart from a box, a stretch holds no cell that meets the box: no walk would find it.

Box = Array | tuple[float, float, float, float, float]  # centre x, y [m], heading [rad], length, width [m]

PATH_SPACING_M = 0.5  # of every path's points
CELLS = 16  # of a stretch: 8 m
STRETCH_M = CELLS * PATH_SPACING_M


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
def stretch_rectangles(xy: Array, heading: Array) -> Array:
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
            least, largest = least_and_largest(heading[m, first : last + 1])
            middle = 0.5 * (least + largest)
            ux, uy = math.cos(middle), math.sin(middle)
            along = xy[m, first : last + 1, 0] * ux + xy[m, first : last + 1, 1] * uy
            across = xy[m, first : last + 1, 1] * ux - xy[m, first : last + 1, 0] * uy
            (back, front), (right, left) = least_and_largest(along), least_and_largest(across)
            u, v = 0.5 * (back + front), 0.5 * (right + left)
            half_u, half_v = 0.5 * (front - back), 0.5 * (left - right)
            out[m, b, 0], out[m, b, 1] = u * ux - v * uy, u * uy + v * ux
            out[m, b, 2], out[m, b, 3] = ux, uy
            out[m, b, 4], out[m, b, 5] = half_u, half_v
            out[m, b, 6] = math.hypot(half_u, half_v)
            out[m, b, 7] = largest - middle
    return out


@hidden_kernel
def corridor_between(
    stretches: Array, length: float, m: int, begin: float, end: float, offset: float, turn: float, half_width: float
) -> CorridorAhead:
    """The corridor from path length `begin` to `end` of path m, which is `length` long.

    offset, turn: the largest lateral offset and turn the body has to its path in there; half_width: of the corridor.
    """
    if not (begin >= 0.0 and end <= length):  # beyond the path's ends there are no stretches
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


@hidden_kernel
def near_corridor(view: CorridorAhead, x: float, y: float, radius: float) -> bool:
    """Can something within `radius` of (x, y) be in the corridor? False: surely not."""
    dx, dy = x - view.x, y - view.y
    return (
        abs(dx * view.ux + dy * view.uy) <= view.half_u + radius
        and abs(dy * view.ux - dx * view.uy) <= view.half_v + radius
    )  # fmt: skip


@hidden_kernel
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


OPEN, CLOSED_IF_STOPPABLE, CLOSED = 0, 1, 2  # a stop line's state: green, yellow, red
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


@hidden_kernel
def fade(travelled: float, length: float) -> tuple[float, float]:
    """(value, slope) of a smooth step from 1 down to 0 over `length`."""
    u = travelled / length
    if u >= 1.0:
        return 0.0, 0.0
    u = max(u, 0.0)
    return 1.0 - u * u * u * (10.0 + u * (6.0 * u - 15.0)), -30.0 * u * u * (1.0 - u) * (1.0 - u) / length


@hidden_kernel
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
    keep, slope = fade(travelled, blend_length)
    return x - math.sin(h) * offset * keep, y + math.cos(h) * offset * keep, h + turn * keep + math.atan(offset * slope)


@inner_kernel
def project_on_path(paths: Paths, m: int, x: float, y: float) -> tuple[float, float]:
    """(path length, offset to the left) of the point of path m nearest to (x, y); of equal ones the first."""
    rectangles = paths.stretches
    near = np.inf  # the nearest point is no farther than this
    for b in range(rectangles.shape[1]):
        dx, dy = x - rectangles[m, b, 0], y - rectangles[m, b, 1]
        near = min(near, math.sqrt(dx * dx + dy * dy) + rectangles[m, b, 6])
    best, best_s, best_offset = np.inf, 0.0, 0.0
    for b in range(rectangles.shape[1]):
        dx, dy, reach = x - rectangles[m, b, 0], y - rectangles[m, b, 1], near + rectangles[m, b, 6] + SLACK_M
        if dx * dx + dy * dy > reach * reach:
            continue
        for k in range(b * CELLS, min((b + 1) * CELLS, paths.heading.shape[1] - 1)):
            px, py = paths.xy[m, k, 0], paths.xy[m, k, 1]
            ex, ey = paths.xy[m, k + 1, 0] - px, paths.xy[m, k + 1, 1] - py
            dx, dy = x - px, y - py
            f, square = nearest_on_edge(dx, dy, ex, ey, (dx * ex + dy * ey) / (ex * ex + ey * ey))
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
    return not (_axis_separates(a, b, dx, dy, c, s) or _axis_separates(b, a, dx, dy, c, s))


@hidden_kernel
def _axis_separates(box: Box, other: Box, dx: float, dy: float, c: float, s: float) -> bool:
    """Does an axis of `box` separate it from one whose centre is at +-(dx, dy), turned by |cos| = c, |sin| = s?"""
    along = dx * math.cos(box[2]) + dy * math.sin(box[2])
    across = -dx * math.sin(box[2]) + dy * math.cos(box[2])
    return (
        abs(along) >= 0.5 * (box[3] + other[3] * c + other[4] * s)
        or abs(across) >= 0.5 * (box[4] + other[3] * s + other[4] * c)
    )  # fmt: skip


@hidden_kernel
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


@hidden_kernel
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


@hidden_kernel
def corridor_ahead(paths: Paths, way: Way, blend_length: float, lookahead: float) -> CorridorAhead:
    """Where the corridor ahead of a body is."""
    keep, _ = fade(way.travelled + way.front, blend_length)
    offset, turn = abs(way.offset) * keep, abs(way.turn) * keep
    if keep > 0.0:
        turn += abs(way.offset) * STEEPEST_FADE / blend_length
    length = (paths.heading.shape[1] - 1) * PATH_SPACING_M
    begin = way.s + way.front
    return corridor_between(paths.stretches, length, way.path, begin, begin + lookahead, offset, turn, way.half_width)


@hidden_kernel
def free_way(x: float, y: float, cell_radius: float, box: Box, radius: float) -> float:
    """[m] of a way that are free of a box, `radius` around it, from its point (x, y) on; below 0: perhaps none.

    cell_radius: around a cell of the corridor.
    """
    clearance = math.hypot(box[0] - x, box[1] - y) - radius - cell_radius
    return 0.8 * clearance  # a blended path is a little longer than its own length


@inner_kernel
def corridor_gap(
    paths: Paths, way: Way, box: Box, radius: float, blend_length: float, lookahead: float
) -> tuple[float, float]:
    """(gap [m] from the bumper along the path to a box, path heading there); gap = inf where the corridor is free.

    The corridor is walked in cells of PATH_SPACING_M; where the box is far, by that distance at once. radius: around
    the box.
    """
    ahead, cell_radius = 0.0, math.hypot(way.half_width, PATH_SPACING_M)
    while ahead < lookahead:
        s, travelled = way.s + way.front + ahead, way.travelled + way.front + ahead
        x, y, h = pose_on_path(paths, way.path, s, travelled, way.offset, way.turn, blend_length)
        free = free_way(x, y, cell_radius, box, radius)
        if free > 0.0:
            ahead += max(free, PATH_SPACING_M)
            continue
        low, high = _range_in_strip(box, x, y, h, way.half_width)
        if low <= PATH_SPACING_M and high >= 0.0:
            return ahead + max(low, 0.0), h
        ahead += PATH_SPACING_M
    return np.inf, 0.0

"""Outlines of strips and boxes as GEOS makes them, whether they touch and how far apart they are. Compiled.

A strip is `shapely.buffer(line, half_width, quad_segs=QUADRANT, cap_style="flat")`, of the offset segments that
geos/operation/buffer/OffsetSegmentGenerator.cpp joins: at a turn's outer side by an arc's chords, at its inner side
where they cross. A ring is x and y [m] (2, n) of its corners, clockwise, the first not repeated. All is within rounding
of GEOS's answer or says that it is not sure of it: GEOS simplifies shapes again and again, which moves a corner where
the outline turns by little; what it cannot have moved by more than MOVED_M does not depend on how it goes about that.
"""

import math

import numpy as np

from tasks.kernels.compiled import hidden_kernel
from tasks.world.arrays import Array
from tasks.world.geometry import ring_contains, segments_touch, to_segment

QUADRANT = 16  # segments of a quarter of a round corner
MOVED_M = 5e-5  # more than simplifying by 1e-5 m a few times moves an outline
SOFT_M = 0.2  # more than an outline is off where a line ends with a very short segment
ROUNDING_M = 1e-11  # of a corner's place
COINCIDES_M = 1e-8  # edges so near to each other cross where rounding has them cross
UNSURE = -1
SAME_CORNER, SHORT_JOIN = 1e-6, 1e-3  # of the half width: corners so near are one, a turn's offsets so near meet
SIMPLIFIED = 0.02  # of the half width: of points of a line that are nearer to each other GEOS leaves some out
RECEDES_M = 0.01  # an edge that recedes is farther away by MOVED_M after so much of it


@hidden_kernel
def box_ring(box: Array, origin: Array, narrower: float, ring: Array) -> int:
    """The ring of a box (5,) seen from an origin (2,), and how many corners it has; narrower: all around [m]."""
    for k in range(4):
        along = (0.5 * box[3] - narrower) * (1.0 if k == 0 or k == 3 else -1.0)
        left = (0.5 * box[4] - narrower) * (1.0 if k > 1 else -1.0)
        cos, sin = math.cos(box[2]), math.sin(box[2])
        across_x, across_y = math.cos(box[2] + 0.5 * math.pi), math.sin(box[2] + 0.5 * math.pi)
        ring[0, k] = (box[0] - origin[0]) + (left * across_x + along * cos)
        ring[1, k] = (box[1] - origin[1]) + (left * across_y + along * sin)
        ring[2, k] = 1.0
    return 4


@hidden_kernel
def even_ends(line: Array, n: int, half_width: float) -> tuple[int, bool, bool]:
    """Leaves out the points beside a line's ends where GEOS's outline depends on how short a segment ends it.

    How many points are left of n, and which of its ends is soft: there the outline is off, by less than SOFT_M; UNSURE
    where it may be more.
    """
    soft_start = _is_short(line, 0, 1, 2, half_width) if n > 2 else 0
    if soft_start == 1:
        for k in range(1, n - 1):
            line[0, k], line[1, k] = line[0, k + 1], line[1, k + 1]
        n -= 1
    soft_end = _is_short(line, n - 1, n - 2, n - 3, half_width) if n > 2 else 0
    if soft_end == 1:
        line[0, n - 2], line[1, n - 2] = line[0, n - 1], line[1, n - 1]
        n -= 1
    return UNSURE if UNSURE in (soft_start, soft_end) else n, soft_start == 1, soft_end == 1


@hidden_kernel
def _is_short(line: Array, end: int, beside: int, beyond: int, half_width: float) -> int:
    """1 where the segment from a line's end is too short for the turn after it, 0 where it is not, or UNSURE."""
    ax, ay = line[0, beside] - line[0, end], line[1, beside] - line[1, end]
    bx, by = line[0, beyond] - line[0, beside], line[1, beyond] - line[1, beside]
    length = math.hypot(ax, ay)
    turn = abs(math.atan2(ax * by - ay * bx, ax * bx + ay * by))
    if length > half_width * max(SIMPLIFIED, turn):
        return 0
    return 1 if max(turn * half_width, length) < 0.5 * SOFT_M else UNSURE


@hidden_kernel
def strip_ring(line: Array, n: int, half_width: float, ring: Array) -> int:
    """The ring of the strip along n points of a line (2, >= n), and how many corners it has, or UNSURE."""
    count, near = 0, half_width * SAME_CORNER
    bx, by, ex, ey = 0.0, 0.0, 0.0, 0.0
    for side in range(2):  # left of the line, and of the line reversed
        for i in range(n - 1):
            k = i if side == 0 else n - 1 - i
            m = k + 1 - 2 * side
            dx, dy = line[0, m] - line[0, k], line[1, m] - line[1, k]
            length = math.sqrt(dx * dx + dy * dy)
            if length <= SIMPLIFIED * half_width:
                return UNSURE
            ux, uy = half_width * dx / length, half_width * dy / length
            ax, ay = line[0, k] - uy, line[1, k] + ux  # where the offset segment starts; b is where the last one ended
            if i > 0:
                turn = ex * dy - ey * dx
                if ex * dx + ey * dy <= 0.0:
                    return UNSURE
                apart = math.hypot(ax - bx, ay - by)
                if abs(turn) <= 1e-13 * length * math.hypot(ex, ey):
                    pass
                elif turn > 0.0:  # to the inner side
                    back, ahead = ((bx - ax) * dy - (by - ay) * dx) / turn, (ex * (by - ay) - ey * (bx - ax)) / turn
                    if 0.0 <= back <= 1.0 and 0.0 <= ahead <= 1.0:
                        count = _with_corner(ring, count, bx - back * ex, by - back * ey, near)
                    elif apart < half_width * SHORT_JOIN:
                        count = _with_corner(ring, count, bx, by, near)
                    else:
                        return UNSURE
                else:
                    count = _with_corner(ring, count, bx, by, near)
                    if apart >= half_width * SHORT_JOIN:
                        start = math.atan2(by - line[1, k], bx - line[0, k])
                        total = start - math.atan2(ay - line[1, k], ax - line[0, k])
                        total += 2.0 * math.pi if total <= 0.0 else 0.0
                        chords = int(total / (0.5 * math.pi / QUADRANT) + 0.5)
                        for c in range(chords):
                            angle = start - c * (total / chords)
                            x = line[0, k] + half_width * math.cos(angle)
                            y = line[1, k] + half_width * math.sin(angle)
                            count = _with_corner(ring, count, x, y, near)
                        count = _with_corner(ring, count, ax, ay, near)
            else:
                count = _with_corner(ring, count, ax, ay, near)
            bx, by, ex, ey = line[0, m] - uy, line[1, m] + ux, dx, dy
            if count == UNSURE:
                return UNSURE
        count = _with_corner(ring, count, bx, by, near)
    return count


@hidden_kernel
def _with_corner(ring: Array, count: int, x: float, y: float, near: float) -> int:
    """Corners of a ring with one more, but for one that is as good as the last; UNSURE where they are too many."""
    if count > 0 and math.hypot(x - ring[0, count - 1], y - ring[1, count - 1]) < near:
        return count
    if count == UNSURE or count == ring.shape[1]:
        return UNSURE
    ring[0, count], ring[1, count] = x, y
    return count + 1


@hidden_kernel
def joined_ring(strip: Array, n: int, box: Array, inner: Array, out: Array) -> int:
    """The ring around a strip's n corners and a box's 4, and how many corners it has, or UNSURE.

    inner: the box narrower by ROUNDING_M, which crosses the strip where the box does, but no more where their edges
    are one; what is farther out than that is outside. Along the one ring to where it enters the other, and on.
    """
    first = 0
    for k in range(1, n):
        first = k if strip[0, k] < strip[0, first] else first
    on_box = False
    for k in range(4):
        if inner[0, k] < (inner[0, first] if on_box else strip[0, first]):
            first, on_box = k, True
    count, at, start, start_box = 0, first, first, on_box
    done = 0.0  # of the edge that starts at `at`
    for _ in range(2 * (n + 4)):
        ring, m, other, m_other = (inner, 4, strip, n) if on_box else (strip, n, inner, 4)
        to = at + 1 if at + 1 < m else 0
        ex, ey = ring[0, to] - ring[0, at], ring[1, to] - ring[1, at]
        best, best_j, best_u = 2.0, -1, 0.0
        j = m_other - 1
        for i in range(m_other):
            fx, fy = other[0, i] - other[0, j], other[1, i] - other[1, j]
            cross = ex * fy - ey * fx
            if cross > 0.0:  # into it
                dx, dy = other[0, j] - ring[0, at], other[1, j] - ring[1, at]
                t, u = (dx * fy - dy * fx) / cross, (dx * ey - dy * ex) / cross
                if done < t <= 1.0 and 0.0 <= u <= 1.0 and t < best:
                    best, best_j, best_u = t, j, u
            j = i
        if best_j >= 0:
            x, y = ring[0, at] + best * ex, ring[1, at] + best * ey
            on_box, at, done = not on_box, best_j, best_u
        else:
            at, done = to, 0.0
            x, y = (box[0, at], box[1, at]) if on_box else (strip[0, at], strip[1, at])
        count = _with_corner(out, count, x, y, 0.0)
        out[2, count - 1] = 1.0 if best_j >= 0 or not _on_outline(other, m_other, x, y) else 0.0
        if count == UNSURE or (done == 0.0 and at == start and on_box == start_box):
            return _without_rounding(out, count)
    return UNSURE


@hidden_kernel
def _on_outline(ring: Array, n: int, x: float, y: float) -> bool:
    """Whether a corner is so near to another ring that rounding says where their edges cross."""
    j = n - 1
    for i in range(n):
        if to_segment(x, y, ring[0, j], ring[1, j], ring[0, i], ring[1, i])[0] < COINCIDES_M:
            return True
        j = i
    return False


@hidden_kernel
def _without_rounding(ring: Array, count: int) -> int:
    """The ring without corners that stand on the line of those beside them; ring[2]: which corners are firm.

    One that all but stands on another stays: simplifying may leave either.
    """
    if count == UNSURE:
        return UNSURE
    kept, px, py = 0, ring[0, count - 1], ring[1, count - 1]
    for k in range(count):
        x, y, to = ring[0, k], ring[1, k], k + 1 if k + 1 < count else 0
        qx, qy = ring[0, to], ring[1, to]
        if to == 0 and kept > 0:
            qx, qy = ring[0, 0], ring[1, 0]
        beside = min(math.hypot(x - px, y - py), math.hypot(x - qx, y - qy))
        if to_segment(x, y, px, py, qx, qy)[0] > 2.0 * ROUNDING_M or 2.0 * ROUNDING_M < beside < MOVED_M:
            ring[0, kept], ring[1, kept], ring[2, kept] = x, y, ring[2, k]
            kept, px, py = kept + 1, x, y
    return with_firm_corners(ring, kept)


@hidden_kernel
def with_firm_corners(ring: Array, count: int) -> int:
    """Leaves 1 in ring[2] where no simplification takes a corner away, as no line passes near it and its neighbours.

    Between two firm corners an outline's edge stays as it is.
    """
    j = count - 1
    for k in range(count):
        to = k + 1 if k + 1 < count else 0
        ax, ay = ring[0, k] - ring[0, j], ring[1, k] - ring[1, j]
        bx, by = ring[0, to] - ring[0, k], ring[1, to] - ring[1, k]
        longest = max(max(math.hypot(ax, ay), math.hypot(bx, by)), math.hypot(ax + bx, ay + by))
        ring[2, k] = ring[2, k] if abs(ax * by - ay * bx) > MOVED_M * longest else 0.0
        j = k
    return count


@hidden_kernel
def soften(ring: Array, count: int, x: float, y: float, half_width: float) -> None:
    """Marks the corners at a line's soft end x, y with -1 in ring[2]."""
    for k in range(count):
        if math.hypot(ring[0, k] - x, ring[1, k] - y) < half_width + 2.0 * SOFT_M:
            ring[2, k] = -1.0


@hidden_kernel
def bounds(ring: Array, n: int, out: Array) -> None:
    """out (4,): least x and y, largest x and y of a ring's corners."""
    out[0], out[1], out[2], out[3] = np.inf, np.inf, -np.inf, -np.inf
    for k in range(n):
        out[0], out[1] = min(out[0], ring[0, k]), min(out[1], ring[1, k])
        out[2], out[3] = max(out[2], ring[0, k]), max(out[3], ring[1, k])


@hidden_kernel
def outlines_touch(a: Array, n: int, b: Array, m: int, b_bounds: Array) -> bool:
    """Whether the areas of two rings have a point in common."""
    i0 = n - 1
    for i in range(n):
        ax, ay, bx, by = a[0, i0], a[1, i0], a[0, i], a[1, i]
        i0 = i
        if _box_apart(ax, ay, bx, by, b_bounds[0], b_bounds[1], b_bounds[2], b_bounds[3]) > 0.0:
            continue
        j0 = m - 1
        for j in range(m):
            if segments_touch(ax, ay, bx, by, b[0, j0], b[1, j0], b[0, j], b[1, j]):
                return True
            j0 = j
    return ring_contains(a[0, :n], a[1, :n], b[0, 0], b[1, 0]) or ring_contains(b[0, :m], b[1, :m], a[0, 0], a[1, 0])


@hidden_kernel
def _box_apart(
    ax: float, ay: float, bx: float, by: float, low_x: float, low_y: float, high_x: float, high_y: float
) -> float:
    """No more than the distance [m] from the segment a-b to what lies within bounds, squared."""
    dx = max(max(low_x - max(ax, bx), min(ax, bx) - high_x), 0.0)
    dy = max(max(low_y - max(ay, by), min(ay, by) - high_y), 0.0)
    return dx * dx + dy * dy


@hidden_kernel
def apart(a: Array, n: int, b: Array, m: int, b_bounds: Array) -> float:
    """Distance [m] between the edges of two rings."""
    nearest = np.inf
    for i in range(n):
        x, y = a[0, i] - b[0, 0], a[1, i] - b[1, 0]
        nearest = min(nearest, x * x + y * y)
    nearest = math.sqrt(nearest)
    i0 = n - 1
    for i in range(n):
        nearest = _edge_apart(a[0, i0], a[1, i0], a[0, i], a[1, i], b, m, b_bounds, nearest)
        i0 = i
    return nearest


@hidden_kernel
def _edge_apart(
    ax: float, ay: float, bx: float, by: float, ring: Array, m: int, ring_bounds: Array, most: float
) -> float:
    """Distance [m] from the segment a-b to the edges of a ring, where that is less than `most`; else that."""
    if _box_apart(ax, ay, bx, by, ring_bounds[0], ring_bounds[1], ring_bounds[2], ring_bounds[3]) >= most * most:
        return most
    j0 = m - 1
    for j in range(m):
        cx, cy, dx, dy = ring[0, j0], ring[1, j0], ring[0, j], ring[1, j]
        j0 = j
        if _box_apart(ax, ay, bx, by, min(cx, dx), min(cy, dy), max(cx, dx), max(cy, dy)) < most * most:
            most = min(most, to_segment(ax, ay, cx, cy, dx, dy)[0])
            most = min(most, to_segment(bx, by, cx, cy, dx, dy)[0])
            most = min(most, to_segment(cx, cy, ax, ay, bx, by)[0])
            most = min(most, to_segment(dx, dy, ax, ay, bx, by)[0])
    return most


@hidden_kernel
def is_firm(a: Array, n: int, b: Array, m: int, b_bounds: Array, distance: float) -> bool:
    """Whether all edges of ring a that are as near to ring b, which is `distance` away, end at firm corners.

    Of an edge that recedes from its firm corner only the far part counts: a line that replaces it starts there too.
    """
    i0 = n - 1
    for i in range(n):
        ax, ay, bx, by = a[0, i0], a[1, i0], a[0, i], a[1, i]
        firm_a, firm_b, soft = a[2, i0] > 0.0, a[2, i] > 0.0, a[2, i0] < 0.0 or a[2, i] < 0.0
        i0 = i
        if firm_a and firm_b:
            continue
        ex, ey = bx - ax, by - ay
        length = math.hypot(ex, ey)
        if length > 2.0 * RECEDES_M and not soft:
            ex, ey = ex * RECEDES_M / length, ey * RECEDES_M / length
            if firm_a:
                ax, ay = ax + ex, ay + ey
            if firm_b:
                bx, by = bx - ex, by - ey
        most = distance + (SOFT_M if soft else MOVED_M)
        if _edge_apart(ax, ay, bx, by, b, m, b_bounds, most) < most:
            return False
    return True

"""Which parts of the map, red lanes among them, the ego's body is on (docs/reward.md 2a, 2d)."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from tasks.kernels.compiled import hidden_kernel, inlined, kernel
from tasks.reward.centerline import (
    CENTER_IN_INTERSECTION,
    LANES_KNOWN,
    MULTIPLE_LANES,
    NON_DRIVABLE,
    OFF_LANE,
    ONCOMING,
    Body,
)
from tasks.reward.map_index import (
    DRIVABLE,
    EDGE,
    FIRST,
    INTERSECTION,
    LANE,
    LAST,
    LEFT,
    NEAR,
    ON_ROUTE,
    THROUGH,
    WAY,
    Bits,
    MapIndex,
    cell_middle,
    line_splits_edge,
    outlines,
    side_of_edge,
)
from tasks.world.arrays import Array, Bools, Bytes, Ints, ShortInts
from tasks.world.road_map import MapPolygon

# The flags of a body. What can run many points wide is a loop of its own over all points of a trajectory; one by one go
# those in crossed cells, which are listed first: branches that nobody can foresee cost more than the work. Corners are
# looked up where the centre's cell does not say that the body is on the road.


CORNERS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))  # FL, RL, RR, FR: half lengths ahead, half widths aside
N_CORNERS = len(CORNERS)


class Places(NamedTuple):
    """Scratch for P points and the regions that hold them."""

    x: Array  # (P,) [m]
    y: Array  # (P,)
    number: ShortInts  # (P,) n >= 0: set n of the map index; else row -1 - n of `others`
    others: Bits  # (P, W) sets without a number; used up to as many as there are
    parts: Bytes  # (P,) bits of the parts that these regions play
    listed: ShortInts  # (P,) points that are yet to be looked at
    instants: ShortInts  # (P,) those whose corners are looked up


@register_jitable
def empty_places(index: MapIndex, n_points: int) -> Places:
    """Scratch for that many points of a map."""
    number, listed, instants = np.empty(n_points, np.int32), np.empty(n_points, np.int32), np.empty(n_points, np.int32)
    others, parts = np.empty((n_points, index.sets.shape[1]), np.uint64), np.empty(n_points, np.uint8)
    return Places(np.empty(n_points), np.empty(n_points), number, others, parts, listed, instants)


@hidden_kernel
def set_area_flags(index: MapIndex, body: Body, half_length: float, half_width: float, places: Places) -> None:
    """Fill the flags of a placed body but for its lanes', see `is_off_lane`.

    A point on a region's boundary is outside of it, up to rounding.

    places: scratch for N_CORNERS times as many points as the body has instants.
    """
    centers, n, flags = _first(places, body.x.size), 0, body.flags
    for t in range(body.x.size):
        centers.x[t], centers.y[t] = body.x[t], body.y[t]
    _set_cells(index, centers)
    for t in range(flags.size):
        places.instants[n] = t
        n += index.clear.size == 0 or index.clear[centers.number[t]] == 0
    find_regions(index, centers)
    for t in range(flags.size):
        flags[t] = 0 if _plays(centers.parts[t], ON_ROUTE) else ONCOMING
        flags[t] |= CENTER_IN_INTERSECTION if _plays(centers.parts[t], INTERSECTION) else 0

    corners = _first(places, N_CORNERS * n)
    for k, (ahead, aside) in enumerate(CORNERS):
        for i in range(n):
            t = places.instants[i]
            corners.x[k * n + i], corners.y[k * n + i] = _corner(body, t, ahead * half_length, aside * half_width)
    find_regions(index, corners)
    parts = corners.parts
    for i in range(n):
        at_corners = parts[i] & parts[n + i] & parts[2 * n + i] & parts[3 * n + i]
        flags[places.instants[i]] |= 0 if _plays(at_corners, DRIVABLE) else NON_DRIVABLE


@hidden_kernel
def is_off_lane(index: MapIndex, body: Body, t: int, half_length: float, half_width: float, places: Places) -> bool:
    """Whether a body is not on the road or in more than one lane at an instant; its lanes are looked up when needed.

    places: scratch for N_CORNERS points.
    """
    if body.flags[t] & (NON_DRIVABLE | LANES_KNOWN) == 0:
        corners = _first(places, N_CORNERS)
        for k, (ahead, aside) in enumerate(CORNERS):
            corners.x[k], corners.y[k] = _corner(body, t, ahead * half_length, aside * half_width)
        find_regions(index, corners)
        body.flags[t] |= LANES_KNOWN | (MULTIPLE_LANES if _in_several_lanes(index, corners) else 0)
    return body.flags[t] & OFF_LANE != 0


@inlined
def _first(places: Places, n: int) -> Places:
    """The scratch for the first n points."""
    x, y, number, parts = places.x[:n], places.y[:n], places.number[:n], places.parts[:n]
    return Places(x, y, number, places.others, parts, places.listed, places.instants)


@hidden_kernel
def in_intersection(index: MapIndex, x: float, y: float, places: Places) -> bool:
    """Whether a point is in an intersection. places: scratch."""
    one = _first(places, 1)
    one.x[0], one.y[0] = x, y
    find_regions(index, one)
    return _plays(one.parts[0], INTERSECTION)


@inlined
def _plays(parts: int, part: int) -> bool:
    return parts & 1 << part != 0


@inlined
def _corner(body: Body, t: int, along: float, across: float) -> tuple[float, float]:
    cos, sin = body.cos[t], body.sin[t]
    return body.x[t] + cos * along - sin * across, body.y[t] + sin * along + cos * across


@hidden_kernel
def find_regions(index: MapIndex, places: Places) -> None:
    """Find the regions that hold the points of `places`."""
    low_x, low_y, cell_m = index.low_x, index.low_y, index.cell_m
    crossed, entry, edges = index.crossed, index.entry, index.edges
    x, y, number, parts, listed = places.x, places.y, places.number, places.parts, places.listed
    _set_cells(index, places)
    cells = index.cells.reshape(-1)
    for p in range(x.size):
        number[p] = cells[number[p]]
    n_listed = n_left = 0
    for p in range(x.size):
        listed[n_listed] = p
        n_listed += number[p] < 0
    for k in range(n_listed):
        p = listed[k]
        q = -1 - number[p]
        way, is_left = 0, crossed[q, 1] < 0
        for i in range(crossed[q, FIRST], crossed[q, LAST]):
            ax, ay, bx, by = edges[entry[i] >> EDGE]
            side = side_of_edge(ax, ay, bx, by, x[p], y[p])
            is_left |= side == 0.0
            is_passed = (side > 0.0) != (entry[i] & LEFT != 0)
            if entry[i] & THROUGH == 0:
                from_x = cell_middle(low_x, cell_m, int((x[p] - low_x) / cell_m))
                from_y = cell_middle(low_y, cell_m, int((y[p] - low_y) / cell_m))
                is_passed &= line_splits_edge(ax, ay, bx, by, from_x, from_y, x[p], y[p])
            way ^= (entry[i] >> WAY & 3) * is_passed
        listed[n_left] = p
        n_left += is_left
        number[p] = number[p] if is_left else crossed[q, way]
    for k in range(n_left):
        _find_apart(index, listed[k], k, places)
    for p in range(x.size):
        if number[p] >= 0:
            parts[p] = index.parts[number[p]]


@inlined
def _set_cells(index: MapIndex, places: Places) -> None:
    """The points' cells, as numbers; the outermost cells, which are empty, stand for all beyond."""
    x, y, found = places.x, places.y, places.number
    low_x, low_y, cell_m = index.low_x, index.low_y, index.cell_m
    first_row, first_column, (n_rows, n_columns) = index.first_row, index.first_column, index.cells.shape
    last_row, last_column = first_row + n_rows - 1.0, first_column + n_columns - 1.0
    first = np.int32(first_row * n_columns + first_column)
    for p in range(x.size):
        column = np.int32(min(max((x[p] - low_x) / cell_m, first_column), last_column))
        row = np.int32(min(max((y[p] - low_y) / cell_m, first_row), last_row))
        found[p] = row * np.int32(n_columns) + column - first


@inlined
def _find_apart(index: MapIndex, p: int, new: int, places: Places) -> None:
    """Find the set around a point whose crossed cell does not name it, or on an edge's line: row `new` of `others`."""
    x, y, q, others = places.x[p], places.y[p], -1 - places.number[p], places.others
    from_x = cell_middle(index.low_x, index.cell_m, int((x - index.low_x) / index.cell_m))
    from_y = cell_middle(index.low_y, index.cell_m, int((y - index.low_y) / index.cell_m))
    for w in range(others.shape[1]):
        others[new, w] = index.sets[index.crossed[q, NEAR], w]
    for i in range(index.crossed[q, FIRST], index.crossed[q, LAST]):
        ax, ay, bx, by = index.edges[index.entry[i] >> EDGE]
        is_across = (side_of_edge(ax, ay, bx, by, x, y) > 0.0) != (index.entry[i] & LEFT != 0)
        if is_across and line_splits_edge(ax, ay, bx, by, from_x, from_y, x, y):
            for w in range(others.shape[1]):
                others[new, w] ^= index.bounded[index.entry[i] >> EDGE, w]
    for i in range(index.crossed[q, FIRST], index.crossed[q, LAST]):  # no region holds a point on its boundary
        ax, ay, bx, by = index.edges[index.entry[i] >> EDGE]
        in_x, in_y = min(ax, bx) <= x <= max(ax, bx), min(ay, by) <= y <= max(ay, by)
        if side_of_edge(ax, ay, bx, by, x, y) == 0.0 and in_x and in_y:
            for w in range(others.shape[1]):
                others[new, w] &= ~index.bounded[index.entry[i] >> EDGE, w]
    parts = 0
    for w in range(others.shape[1]):
        for part in range(index.playing.shape[0]):
            parts |= (others[new, w] & index.playing[part, w] != 0) << part
    places.parts[p], places.number[p] = parts, -1 - new


@inlined
def _in_several_lanes(index: MapIndex, corners: Places) -> bool:
    """Whether the four points are in more than one lane, none of which holds all."""
    sets, lanes, others = index.sets, index.playing[LANE], corners.others
    fl, rl, rr, fr = corners.number[0], corners.number[1], corners.number[2], corners.number[3]
    n_touched = 0
    holds_all = False
    for w in range(index.n_lane_words):
        a = sets[fl, w] if fl >= 0 else others[-1 - fl, w]
        b = sets[rl, w] if rl >= 0 else others[-1 - rl, w]
        c = sets[rr, w] if rr >= 0 else others[-1 - rr, w]
        d = sets[fr, w] if fr >= 0 else others[-1 - fr, w]
        touched = (a | b | c | d) & lanes[w]
        n_touched += (touched != 0) + (touched & (touched - np.uint64(1)) != 0)
        holds_all |= a & b & c & d & lanes[w] != 0
    return n_touched > 1 and not holds_all


# Whether the ego's body is on a lane connector whose light is red (docs/reward.md 2d).


class RedLanes(NamedTuple):
    """L lanes that are red at some time, with E edges. Few arrays, as compiled calls pay for each."""

    is_red: Bools  # (T, L)
    bounds: Array  # (L, 4) min x, min y, max x, max y [m]
    first: Ints  # (L + 1,) where the edges of a lane begin
    edges: Array  # (4, E) start x, start y, end x, end y [m]


NEVER_RED = RedLanes(np.empty((0, 0), np.bool_), np.empty((0, 4)), np.zeros(1, np.int64), np.empty((4, 0)))


def index_red_lanes(polygons: Sequence[MapPolygon], is_red: Bools) -> RedLanes:
    """Lanes laid out for `first_red`; is_red: (T, L) whether each of the L polygons is red at each instant.

    Raises ValueError for a mask that has another number of columns, or a ring that is no ring.
    """
    if is_red.ndim != 2 or is_red.shape[1] != len(polygons):
        raise ValueError(f"the mask of red lanes must be (T, {len(polygons)}), got {is_red.shape}")
    columns = np.flatnonzero(is_red.any(axis=0)).tolist()
    if not columns:
        return NEVER_RED
    edges, first, owner = outlines([polygons[i] for i in columns])
    lane = np.repeat(owner, np.diff(first))
    bounds = [[*edges[lane == i, :2].min(axis=0), *edges[lane == i, :2].max(axis=0)] for i in range(len(columns))]
    return RedLanes(
        np.ascontiguousarray(is_red[:, columns]),
        np.array(bounds, dtype=np.float64).reshape(-1, 4),
        np.searchsorted(lane, np.arange(len(columns) + 1)),
        np.ascontiguousarray(edges.T),
    )


@kernel
def first_red(red: RedLanes, body: Body, half_length: float, half_width: float) -> float:
    """The first instant at which a placed body touches a lane that is red then, inf: never. Standing on it counts."""
    radius = math.hypot(half_length, half_width)
    for t in range(red.is_red.shape[0]):
        x, y = body.x[t], body.y[t]
        for lane in range(red.is_red.shape[1]):
            low_x, low_y, high_x, high_y = red.bounds[lane]
            if not red.is_red[t, lane] or x + radius < low_x or x - radius > high_x:
                continue
            if y + radius < low_y or y - radius > high_y:
                continue
            if _on_lane(red, lane, x, y, body.cos[t], body.sin[t], half_length, half_width):
                return float(t)
    return math.inf


@kernel
def _on_lane(
    red: RedLanes, lane: int, x: float, y: float, cos: float, sin: float, half_length: float, half_width: float
) -> bool:
    """Whether a box and a lane share a point: an edge touches the box, or else the box's centre is in the lane."""
    ax, ay, bx, by = red.edges[0], red.edges[1], red.edges[2], red.edges[3]
    n_touching = 0
    n_right_of_center = 0
    for e in range(red.first[lane], red.first[lane + 1]):
        # the edge in the box's frame
        au, av = cos * (ax[e] - x) + sin * (ay[e] - y), cos * (ay[e] - y) - sin * (ax[e] - x)
        bu, bv = cos * (bx[e] - x) + sin * (by[e] - y), cos * (by[e] - y) - sin * (bx[e] - x)
        du, dv = bu - au, bv - av
        turn = au * bv - av * bu
        apart = abs(au + bu) > 2.0 * half_length + abs(du)
        apart |= abs(av + bv) > 2.0 * half_width + abs(dv)
        apart |= abs(turn) > half_length * abs(dv) + half_width * abs(du)
        n_touching += not apart
        n_right_of_center += ((av > 0.0) != (bv > 0.0)) & ((turn > 0.0) == (dv > 0.0))
    return n_touching > 0 or n_right_of_center % 2 == 1

"""Which parts of the map the ego's body is on (docs/reward.md 2a).

Each step is one loop over all points of a trajectory. Calls with arrays inside of these loops would cost more than
the work: numba counts references to every one of them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel
from tasks.reward.rules.ego import CENTER_IN_INTERSECTION, MULTIPLE_LANES, NON_DRIVABLE, ONCOMING, Body
from tasks.reward.rules.map_index import (
    DRIVABLE,
    FAR,
    FIRST,
    INTERSECTION,
    LANE,
    LAST,
    NEAR,
    ON_ROUTE,
    MapIndex,
    beside,
    middle,
    passes_between,
)
from tasks.world.arrays import Array, Bytes, ShortInts

Bits = NDArray[np.uint64]


class Held(NamedTuple):
    """The regions that hold each of P points."""

    number: ShortInts  # (P,) n >= 0: set n of the map index; else row -1 - n of `others`
    others: Bits  # (P, W) sets without a number; used up to as many as there are
    parts: Bytes  # (P,) bits of the parts that these regions play


@kernel
def areas_along(index: MapIndex, body: Body, half_length: float, half_width: float) -> None:
    """Fill the flags of a placed body. A point on a region's boundary is outside of it, up to rounding."""
    x, y = _points(body, half_length, half_width)
    _set_flags(index, regions_at(index, x, y), body.flags)


@kernel
def in_intersection(index: MapIndex, x: float, y: float) -> bool:
    """Whether a point is in an intersection."""
    return _plays(regions_at(index, np.full(1, x), np.full(1, y)).parts[0], INTERSECTION)


@kernel
def regions_at(index: MapIndex, x: Array, y: Array) -> Held:
    """Which regions hold the points x, y (P,) [m]."""
    held = Held(
        np.empty(x.size, np.int32), np.empty((x.size, index.sets.shape[1]), np.uint64), np.empty(x.size, np.uint8)
    )
    _look_up(index, x, y, held.number)
    _pass_edges(index, x, y, held.number)
    _collect_others(index, x, y, held)
    return held


@kernel
def _plays(parts: int, part: int) -> bool:
    return parts & 1 << part != 0


@kernel
def _points(body: Body, half_length: float, half_width: float) -> tuple[Array, Array]:
    """x, y (5 T,) of the corners FL, RL, RR, FR and of the centre; those of one kind follow each other."""
    n = body.x.size
    x, y = np.empty(5 * n), np.empty(5 * n)
    for t in range(n):
        along_x, along_y = body.cos[t] * half_length, body.sin[t] * half_length
        across_x, across_y = body.sin[t] * half_width, body.cos[t] * half_width
        front_x, front_y = body.x[t] + along_x, body.y[t] + along_y
        rear_x, rear_y = body.x[t] - along_x, body.y[t] - along_y
        x[t], y[t] = front_x - across_x, front_y + across_y
        x[n + t], y[n + t] = rear_x - across_x, rear_y + across_y
        x[2 * n + t], y[2 * n + t] = rear_x + across_x, rear_y - across_y
        x[3 * n + t], y[3 * n + t] = front_x + across_x, front_y - across_y
        x[4 * n + t], y[4 * n + t] = body.x[t], body.y[t]
    return x, y


@kernel
def _look_up(index: MapIndex, x: Array, y: Array, found: ShortInts) -> None:
    """What the index says of the points' cells; its outermost cells, which are empty, stand for all beyond."""
    low_x, low_y, cell_m = index.low_x, index.low_y, index.cell_m
    n_rows, n_columns = index.cells.shape
    for p in range(x.size):
        column = np.int32(min(max((x[p] - low_x) / cell_m, 0.0), n_columns - 1.0))
        row = np.int32(min(max((y[p] - low_y) / cell_m, 0.0), n_rows - 1.0))
        found[p] = row * np.int32(n_columns) + column
    cells = index.cells.reshape(-1)
    for p in range(x.size):
        found[p] = cells[found[p]]


@kernel
def _pass_edges(index: MapIndex, x: Array, y: Array, found: ShortInts) -> None:
    """Turn crossed cells that know their far set into the set around the point, unless an edge's line is on it."""
    low_x, low_y, cell_m = index.low_x, index.low_y, index.cell_m
    crossed, entry, edges = index.crossed, index.entry, index.edges
    for p in range(x.size):
        q = -1 - found[p]
        if q >= 0 and crossed[q, FAR] >= 0:
            from_x = middle(low_x, cell_m, int((x[p] - low_x) / cell_m))
            from_y = middle(low_y, cell_m, int((y[p] - low_y) / cell_m))
            is_far = on_line = False
            for i in range(crossed[q, FIRST], crossed[q, LAST]):
                ax, ay, bx, by = edges[entry[i] >> 1]
                side = beside(ax, ay, bx, by, x[p], y[p])
                on_line |= side == 0.0
                if (side > 0.0) != (entry[i] & 1 == 1):
                    is_far ^= passes_between(ax, ay, bx, by, from_x, from_y, x[p], y[p])
            if not on_line:
                found[p] = crossed[q, FAR if is_far else NEAR]


@kernel
def _collect_others(index: MapIndex, x: Array, y: Array, held: Held) -> None:
    """Fill in the other sets, and all parts."""
    low_x, low_y, cell_m = index.low_x, index.low_y, index.cell_m
    crossed, entry, edges = index.crossed, index.entry, index.edges
    sets, bounded, parts_of_set, playing = index.sets, index.bounded, index.parts, index.playing
    found, others, parts = held
    n = 0
    for p in range(x.size):
        if found[p] >= 0:
            parts[p] = parts_of_set[found[p]]
            continue
        q = -1 - found[p]
        from_x = middle(low_x, cell_m, int((x[p] - low_x) / cell_m))
        from_y = middle(low_y, cell_m, int((y[p] - low_y) / cell_m))
        for w in range(others.shape[1]):
            others[n, w] = sets[crossed[q, NEAR], w]
        on_line = False
        for i in range(crossed[q, FIRST], crossed[q, LAST]):
            ax, ay, bx, by = edges[entry[i] >> 1]
            side = beside(ax, ay, bx, by, x[p], y[p])
            on_line |= side == 0.0
            if (side > 0.0) != (entry[i] & 1 == 1) and passes_between(ax, ay, bx, by, from_x, from_y, x[p], y[p]):
                for w in range(others.shape[1]):
                    others[n, w] ^= bounded[entry[i] >> 1, w]
        if on_line:
            _leave_edges(index, q, x[p], y[p], others, n)
        parts[p] = 0
        for w in range(others.shape[1]):
            for part in range(playing.shape[0]):
                parts[p] |= (others[n, w] & playing[part, w] != 0) << part
        n += 1
        found[p] = -n


@kernel
def _leave_edges(index: MapIndex, q: int, x: float, y: float, others: Bits, n: int) -> None:
    """Take the regions on whose boundary a point of crossed cell q lies out of row n of `others`."""
    for i in range(index.crossed[q, FIRST], index.crossed[q, LAST]):
        e = index.entry[i] >> 1
        ax, ay, bx, by = index.edges[e]
        if beside(ax, ay, bx, by, x, y) == 0.0 and min(ax, bx) <= x <= max(ax, bx) and min(ay, by) <= y <= max(ay, by):
            for w in range(others.shape[1]):
                others[n, w] &= ~index.bounded[e, w]


@kernel
def _set_flags(index: MapIndex, held: Held, flags: Bytes) -> None:
    sets, lanes, n_words = index.sets, index.playing[LANE], index.n_lane_words
    number, others, parts = held
    n = flags.size
    for t in range(n):
        at_center = parts[4 * n + t]
        at_corners = parts[t] & parts[n + t] & parts[2 * n + t] & parts[3 * n + t]
        flag = 0 if _plays(at_center, ON_ROUTE) else ONCOMING
        flag |= CENTER_IN_INTERSECTION if _plays(at_center, INTERSECTION) else 0
        flag |= 0 if _plays(at_corners, DRIVABLE) else NON_DRIVABLE
        fl, rl, rr, fr = number[t], number[n + t], number[2 * n + t], number[3 * n + t]
        if fl != rl or fl != rr or fl != fr:
            n_touched = 0
            holds_all = False
            for w in range(n_words):
                a = sets[fl, w] if fl >= 0 else others[-1 - fl, w]
                b = sets[rl, w] if rl >= 0 else others[-1 - rl, w]
                c = sets[rr, w] if rr >= 0 else others[-1 - rr, w]
                d = sets[fr, w] if fr >= 0 else others[-1 - fr, w]
                touched = (a | b | c | d) & lanes[w]
                n_touched += (touched != 0) + (touched & (touched - np.uint64(1)) != 0)
                holds_all |= a & b & c & d & lanes[w] != 0
            flag |= MULTIPLE_LANES if n_touched > 1 and not holds_all else 0
        flags[t] = flag

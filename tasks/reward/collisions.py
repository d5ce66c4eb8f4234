"""No at-fault collision and time to collision of one trajectory (docs/reward.md 2b, 2g).

Both rules walk through the contacts of the ego's body in time and stop looking at an object once a contact with it was
harmless. They walk together, for time to collision also looks at where the ego is.
"""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from tasks.kernels.compiled import hidden_kernel, inlined, kernel
from tasks.kernels.simd import prefetch
from tasks.reward.areas import Places, in_intersection, is_off_lane
from tasks.reward.centerline import Body
from tasks.reward.map_index import MapIndex
from tasks.world.arrays import Array, Bools, Bytes, Rows, ShortInts
from tasks.world.clip import HORIZON_STEPS
from tasks.world.frames import HALF_LENGTH, HALF_WIDTH, HEADING, X, Y

# Oriented boxes in the plane, one pair at a time: whether they touch, and where their centroid is.

ROUNDING_M = 1e-6  # rounding moves the gap between two boxes by less, for coordinates below a million kilometres


class Box(NamedTuple):
    """A rectangle."""

    x: float  # of its centre [m]
    y: float
    heading: float  # [rad]
    cos: float  # of the heading
    sin: float
    length: float  # along the heading [m]
    width: float


@inlined
def gap_m(first: Box, second: Box) -> float:
    """How far two boxes are apart [m] along the axis of theirs where they are farthest, < 0 where they overlap; without
    trigonometry.

    Above ROUNDING_M they are not `touching`, below -ROUNDING_M they are; in between `touching` alone can say.
    """
    dx, dy = second.x - first.x, second.y - first.y
    c = abs(first.cos * second.cos + first.sin * second.sin)
    s = abs(first.cos * second.sin - first.sin * second.cos)
    along1 = 2.0 * abs(first.cos * dx + first.sin * dy) - (first.length + second.length * c + second.width * s)
    across1 = 2.0 * abs(first.cos * dy - first.sin * dx) - (first.width + second.length * s + second.width * c)
    along2 = 2.0 * abs(second.cos * dx + second.sin * dy) - (second.length + first.length * c + first.width * s)
    across2 = 2.0 * abs(second.cos * dy - second.sin * dx) - (second.width + first.length * s + first.width * c)
    return max(max(along1, across1), max(along2, across2))


@kernel
def touching(first: Box, second: Box) -> bool:
    """Whether two boxes intersect, touching included (separating axes); False where one holds a NaN."""
    dx, dy = second.x - first.x, second.y - first.y
    turn = second.heading - first.heading  # not from the cosines: boxes that share an edge touch to the last bit
    c, s = abs(math.cos(turn)), abs(math.sin(turn))
    return (
        2.0 * abs(first.cos * dx + first.sin * dy) <= first.length + second.length * c + second.width * s
        and 2.0 * abs(first.cos * dy - first.sin * dx) <= first.width + second.length * s + second.width * c
        and 2.0 * abs(second.cos * dx + second.sin * dy) <= second.length + first.length * c + first.width * s
        and 2.0 * abs(second.cos * dy - second.sin * dx) <= second.width + first.length * s + first.width * c
    )


@kernel
def centroid(box: Box) -> tuple[float, float]:
    """Centroid of the box's polygon as GEOS computes it, rounding included.

    A fan of triangles from the first corner (FL, RL, RR, FR), each weighted by twice its area; a box without area has
    the mean of its edges weighted by their length, one without extent its centre.
    """
    half_length, half_width = box.length / 2.0, box.width / 2.0
    front_x, front_y = box.cos * half_length, box.sin * half_length
    left_x, left_y = -box.sin * half_width, box.cos * half_width
    xs = (box.x + front_x + left_x, box.x - front_x + left_x, box.x - front_x - left_x, box.x + front_x - left_x)
    ys = (box.y + front_y + left_y, box.y - front_y + left_y, box.y - front_y - left_y, box.y + front_y - left_y)
    total = sum_x = sum_y = 0.0
    for b, c in ((1, 2), (2, 3)):
        area = (xs[b] - xs[0]) * (ys[c] - ys[0]) - (xs[c] - xs[0]) * (ys[b] - ys[0])
        total += area
        sum_x += area * (xs[0] + xs[b] + xs[c])
        sum_y += area * (ys[0] + ys[b] + ys[c])
    if total != 0.0:
        return sum_x / 3.0 / total, sum_y / 3.0 / total
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
        edge = math.sqrt((xs[b] - xs[a]) * (xs[b] - xs[a]) + (ys[b] - ys[a]) * (ys[b] - ys[a]))
        total += edge
        sum_x += edge * ((xs[a] + xs[b]) / 2.0)
        sum_y += edge * ((ys[a] + ys[b]) / 2.0)
    return (sum_x / total, sum_y / total) if total > 0.0 else (box.x, box.y)


# Who stands where when, laid out for the rules.

N_TIMES = HORIZON_STEPS + 1
STOPPED_SPEED_MPS = 0.05
LENGTH, WIDTH = 2.0 * HALF_LENGTH, 2.0 * HALF_WIDTH  # of the ego [m]
CIRCUMRADIUS = math.hypot(HALF_LENGTH, HALF_WIDTH)  # of the ego [m]
CELL_M = 2.0
CELLS_PER_SIDE = 64  # a power of two
_PLACED = 6  # numbers of an object at an instant


class Cells(NamedTuple):
    """Which objects an ego may touch, by the time and the square cell that its centre is in.

    The cells repeat after CELLS_PER_SIDE in x and y, so the grid has no edges; what stands a whole period away is told
    apart by the boxes themselves.
    """

    starts: Rows  # rows[starts[c]:starts[c + 1]] are of cell c, times outermost
    rows: Rows  # t * N + object


class Obstacles(NamedTuple):
    """N objects over T = 41 steps of 0.1 s, world frame."""

    boxes: Array  # (T, N, 5) centre x, y [m], heading [rad], length, width [m]; NaN when absent
    is_stopped: Bools  # (N,) no road user, or at most 0.05 m/s when first seen
    collision_score: Array  # (N,) what an at-fault collision leaves of NC: 0 for road users, else 0.5
    spans: Array  # (N, 5) see extents_over_time
    placed: Array  # (T * N, 6) centre x, y [m], length, width [m], cos, sin of the heading; empty without an index
    cells: Cells  # the index; empty without one


@kernel
def obstacles_of(boxes: Array, is_stopped: Bools, collision_score: Array) -> Obstacles:
    """Obstacles from boxes (T, N, 5), is_stopped (N,) and collision_score (N,)."""
    no_cells = Cells(np.empty(0, np.uint32), np.empty(0, np.uint32))
    return Obstacles(boxes, is_stopped, collision_score, extents_over_time(boxes), np.empty((0, _PLACED)), no_cells)


@kernel
def with_index(obstacles: Obstacles) -> Obstacles:
    """The same obstacles, quicker to look up: only many trajectories repay it."""
    n_times, n_items = obstacles.boxes.shape[:2]
    placed = np.empty((n_times * n_items, _PLACED))
    starts, rows = np.zeros(n_times * CELLS_PER_SIDE * CELLS_PER_SIDE + 1, np.uint32), np.empty(0, np.uint32)
    for fill in (False, True):  # counted, summed to the cells' ends, filled from there
        for t in range(n_times):
            for item in range(n_items):
                box = box_at(obstacles, t, item)
                row = t * n_items + item
                placed[row, 0], placed[row, 1], placed[row, 2] = box.x, box.y, box.length
                placed[row, 3], placed[row, 4], placed[row, 5] = box.width, box.cos, box.sin
                _register(box, t, row, fill, starts, rows)
        if not fill:
            end = 0
            for cell in range(len(starts)):
                end += starts[cell]
                starts[cell] = end
            rows = np.empty(end, np.uint32)
    boxes, is_stopped, collision_score = obstacles.boxes, obstacles.is_stopped, obstacles.collision_score
    return Obstacles(boxes, is_stopped, collision_score, obstacles.spans, placed, Cells(starts, rows))


@hidden_kernel
def _register(box: Box, t: int, row: int, fill: bool, starts: Rows, rows: Rows) -> None:
    """Count an object in, or write it into, the cells that come within the ego's circumradius of its box at step t."""
    margin = CIRCUMRADIUS + ROUNDING_M
    reach_x = 0.5 * (box.length * abs(box.cos) + box.width * abs(box.sin)) + margin
    reach_y = 0.5 * (box.length * abs(box.sin) + box.width * abs(box.cos)) + margin
    if not math.isfinite(box.x + box.y + reach_x + reach_y):
        return
    left, low = math.floor((box.x - reach_x) / CELL_M), math.floor((box.y - reach_y) / CELL_M)
    right = min(math.floor((box.x + reach_x) / CELL_M), left + CELLS_PER_SIDE - 1)
    high = min(math.floor((box.y + reach_y) / CELL_M), low + CELLS_PER_SIDE - 1)
    everywhere = right - left == CELLS_PER_SIDE - 1 or high - low == CELLS_PER_SIDE - 1
    center_reach = margin + math.sqrt(0.5) * CELL_M  # from the box to a cell's centre
    for up in range(low, high + 1):
        dy = (up + 0.5) * CELL_M - box.y
        for column in range(left, right + 1):
            dx = (column + 0.5) * CELL_M - box.x
            along = max(abs(box.cos * dx + box.sin * dy) - 0.5 * box.length, 0.0)
            across = max(abs(box.cos * dy - box.sin * dx) - 0.5 * box.width, 0.0)
            if everywhere or along * along + across * across <= center_reach * center_reach:
                cell = _cell(t, up, column)
                if fill:
                    starts[cell] -= 1
                    rows[starts[cell]] = row
                else:
                    starts[cell] += 1


@inlined
def _cell(t: int, row: int, column: int) -> int:
    return (t * CELLS_PER_SIDE + (row & (CELLS_PER_SIDE - 1))) * CELLS_PER_SIDE + (column & (CELLS_PER_SIDE - 1))


@kernel
def obstacles_of_tracks(
    boxes: Array, velocities: Array, valid: Bools, collision_score: Array, ego_box: Array
) -> Obstacles:
    """The obstacles that tracks of N objects are over their first 41 steps.

    boxes (S >= 41, N, 5), velocities (S, N, 2) and valid (S, N) as in AgentTracks; collision_score: (N,). Left out for
    good is who is never there, and who touches the ego's box (5,) at first (one of NaN: nobody). Whether one stands its
    velocity at its first appearance says (docs/reward.md 2).
    """
    first_seen, column, n_kept = np.full(valid.shape[1], -1), np.full(valid.shape[1], -1), 0
    for t in range(N_TIMES - 1, -1, -1):
        for i in range(valid.shape[1]):
            first_seen[i] = t if valid[t, i] else first_seen[i]
    ego = _box(ego_box)
    for i in range(valid.shape[1]):
        if first_seen[i] > 0 or (first_seen[i] == 0 and not touching(ego, _box(boxes[0, i]))):
            column[i] = n_kept
            n_kept += 1
    met = np.full((N_TIMES, n_kept, 5), np.nan)
    for t in range(N_TIMES):
        for i in range(valid.shape[1]):
            if valid[t, i] and column[i] >= 0:
                for c in range(5):
                    met[t, column[i], c] = boxes[t, i, c]
    is_stopped, score = np.empty(n_kept, np.bool_), np.empty(n_kept)
    for i in range(valid.shape[1]):
        if column[i] >= 0:
            vx, vy = velocities[first_seen[i], i]
            score[column[i]] = collision_score[i]
            is_stopped[column[i]] = collision_score[i] > 0.0 or np.hypot(vx, vy) <= STOPPED_SPEED_MPS
    return obstacles_of(met, is_stopped, score)


@kernel
def _box(box: Array) -> Box:
    x, y, heading, length, width = box
    return Box(x, y, heading, math.cos(heading), math.sin(heading), length, width)


@kernel
def extents_over_time(boxes: Array) -> Array:
    """(N, 5) of boxes (T, N, 5): least x, y, most x, y of the centre at any time [m], largest diagonal squared [m^2].

    An object that is never there has a least above its most.
    """
    n_items = boxes.shape[1]
    spans = np.empty((n_items, 5))
    for item in range(n_items):
        spans[item, 0], spans[item, 1], spans[item, 2] = math.inf, math.inf, -math.inf
        spans[item, 3], spans[item, 4] = -math.inf, 0.0
    for t in range(boxes.shape[0]):
        for item in range(n_items):
            x, y, length, width = boxes[t, item, 0], boxes[t, item, 1], boxes[t, item, 3], boxes[t, item, 4]
            diagonal_sq = length * length + width * width
            # spelled out, for NaN is to move none of them
            spans[item, 0] = x if x < spans[item, 0] else spans[item, 0]
            spans[item, 1] = y if y < spans[item, 1] else spans[item, 1]
            spans[item, 2] = x if x > spans[item, 2] else spans[item, 2]
            spans[item, 3] = y if y > spans[item, 3] else spans[item, 3]
            spans[item, 4] = diagonal_sq if diagonal_sq > spans[item, 4] else spans[item, 4]
    return spans


@inlined
def list_within_reach(obstacles: Obstacles, body: Body, within_reach: Rows) -> int:
    """List who is not out of reach of a placed body all along where the rules look. How many there are."""
    least_x, least_y, most_x, most_y = _looked_at(body)
    spans, n = obstacles.spans, 0
    for item in range(len(spans)):
        # as far as out_of_reach ever looks
        reach = math.sqrt(0.5 * (spans[item, 4] + LENGTH * LENGTH + WIDTH * WIDTH) + ROUNDING_M) + ROUNDING_M
        if (
            spans[item, 0] - reach <= most_x
            and spans[item, 2] + reach >= least_x
            and spans[item, 1] - reach <= most_y
            and spans[item, 3] + reach >= least_y
        ):
            within_reach[n] = item
            n += 1
    return n


@inlined
def box_at(obstacles: Obstacles, t: int, item: int) -> Box:
    """Where an object is at step t; NaN when absent."""
    x, y, heading = obstacles.boxes[t, item, 0], obstacles.boxes[t, item, 1], obstacles.boxes[t, item, 2]
    length, width = obstacles.boxes[t, item, 3], obstacles.boxes[t, item, 4]
    if len(obstacles.placed) > 0:
        row = t * obstacles.boxes.shape[1] + item
        return Box(x, y, heading, obstacles.placed[row, 4], obstacles.placed[row, 5], length, width)
    return Box(x, y, heading, math.cos(heading), math.sin(heading), length, width)


@inlined
def out_of_reach(obstacles: Obstacles, t: int, item: int, ego: Box) -> bool:
    """Whether an object is too far away, or absent, to touch the ego at step t: nothing dearer is needed."""
    boxes = obstacles.boxes
    dx, dy, length, width = boxes[t, item, 0] - ego.x, boxes[t, item, 1] - ego.y, boxes[t, item, 3], boxes[t, item, 4]
    # squared sum of the circumradii <= twice the sum of their squares
    reach_sq = 0.5 * (length * length + width * width + ego.length * ego.length + ego.width * ego.width)
    return not dx * dx + dy * dy <= reach_sq + ROUNDING_M


# The rules.

STOPPED_EGO_MPS = 0.05
STOPPED_EGO_TTC_MPS = 5e-3
BEHIND_RAD = math.radians(150.0)
AHEAD_RAD = math.radians(30.0)
_STEPS_BETWEEN = 3
TTC_STEPS = tuple(range(0, 10, _STEPS_BETWEEN))  # projections 0, 0.3, 0.6, 0.9 s ahead
_N_AHEAD = len(TTC_STEPS)


class Looks(NamedTuple):
    """Scratch for the contacts of trajectories of T instants each, P in all, with N objects.

    A look is 4 * t + its place in TTC_STEPS, a pair a look and an object that is asked about there.
    """

    cell: ShortInts  # (4, P) of where the ego looks at each of TTC_STEPS, times left out
    x: Array  # (4, P) where its body's centre is there [m]
    y: Array  # (4, P)
    listed: Rows  # (3, 4 T) looks, and of which rows of the index on up to which
    within_reach: Rows  # (N,) objects without an index
    look: Rows  # (M,) of a pair
    item: Rows  # (M,) its object
    beside: Array  # (8, M) what gap_m takes of the two
    asking: Bytes  # (N,) bits below: the rules that still look at an object


NC, TTC = 1, 2
PAIRS_AT_ONCE = 48


@register_jitable
def empty_looks(n_instants: int, n_times: int, n_items: int) -> Looks:
    """Room for trajectories of T instants each, P in all, among N objects."""
    cell, listed = np.empty((_N_AHEAD, n_instants), np.int32), np.empty((3, _N_AHEAD * n_times), np.uint32)
    x, y, n_pairs = np.empty((_N_AHEAD, n_instants)), np.empty((_N_AHEAD, n_instants)), PAIRS_AT_ONCE + n_items
    within_reach, look, item = np.empty(n_items, np.uint32), np.empty(n_pairs, np.uint32), np.empty(n_pairs, np.uint32)
    return Looks(cell, x, y, listed, within_reach, look, item, np.empty((8, n_pairs)), np.empty(n_items, np.uint8))


@inlined
def set_looks(body: Body, looks: Looks) -> None:
    """Fill in where a placed body looks."""
    for k, step in enumerate(TTC_STEPS):
        cell, x, y = looks.cell[k], looks.x[k], looks.y[k]
        for t in range(len(body.x)):
            gone = body.speed[t] * (step * 0.1)
            x[t], y[t] = body.x[t] + body.cos[t] * gone, body.y[t] + body.sin[t] * gone
            cell[t] = _cell(0, math.floor(y[t] / CELL_M), math.floor(x[t] / CELL_M))


@inlined
def _list_looks(obstacles: Obstacles, looks: Looks, start: int, n_times: int) -> int:
    """List looks in time, with an index those with somebody in the cell. How many there are."""
    n, starts, indexed = 0, obstacles.cells.starts, len(obstacles.placed) > 0
    for t in range(n_times):
        for k in range(_N_AHEAD if t < n_times - max(TTC_STEPS) else 1):
            looks.listed[0, n] = _N_AHEAD * t + k
            if indexed:
                cell = _cell(t + TTC_STEPS[k], 0, 0) + looks.cell[k, start + t]
                looks.listed[1, n], looks.listed[2, n] = starts[cell], starts[cell + 1]
                prefetch(obstacles.cells.rows, np.uint64(starts[cell]))
                n += starts[cell + 1] > starts[cell]
            else:
                n += 1
    return n


@inlined
def _ego_at(body: Body, looks: Looks, start: int, states: Array, look: int) -> Box:
    t, k = look // _N_AHEAD, look % _N_AHEAD
    x, y = looks.x[k, start + t], looks.y[k, start + t]
    return Box(x, y, states[t, HEADING], body.cos[t], body.sin[t], LENGTH, WIDTH)


@inlined
def _pairs_within_reach(
    obstacles: Obstacles, n_near: int, body: Body, looks: Looks, start: int, first: int, n_listed: int, ahead: bool
) -> tuple[int, int]:
    """As `_pairs_that_may_touch`, of the first `n_near` objects `within_reach`."""
    i, n, one, room = first, np.uint64(0), np.uint64(1), np.uint64(len(looks.look) - len(looks.asking))
    while i < n_listed and n <= room:
        look = looks.listed[0, i]
        i += 1
        t, k = look // np.uint32(_N_AHEAD), look % np.uint32(_N_AHEAD)
        if ahead or k == 0:
            at, step = np.uint32(start) + t, t + np.uint32(_STEPS_BETWEEN) * k
            ego = Box(looks.x[k, at], looks.y[k, at], 0.0, body.cos[t], body.sin[t], LENGTH, WIDTH)
            for near in range(n_near):
                item = looks.within_reach[near]
                looks.look[n], looks.item[n] = look, item
                if not out_of_reach(obstacles, step, item, ego):
                    n += one
    return i, int(n)


@inlined
def _pairs_that_may_touch(
    obstacles: Obstacles, body: Body, looks: Looks, start: int, first: int, n_listed: int, ahead: bool
) -> tuple[int, int]:
    """List the pairs that may touch, of the listed looks from `first` on and as many as there is room for.

    The first look that is left, and how many pairs there are. ahead: not only of looks at the instant itself.
    """
    placed, rows, one = obstacles.placed, obstacles.cells.rows, np.uint64(1)
    gap, dy, cos, sin = looks.beside[0], looks.beside[1], looks.beside[2], looks.beside[3]
    length, width, ego_cos, ego_sin = looks.beside[4], looks.beside[5], looks.beside[6], looks.beside[7]
    i, n, n_items = first, np.uint64(0), np.uint64(len(looks.asking))
    room = np.uint64(len(looks.look)) - n_items
    while i < n_listed and n <= room:
        look, entry, last = looks.listed[0, i], np.uint64(looks.listed[1, i]), np.uint64(looks.listed[2, i])
        i += 1
        if ahead or look % np.uint32(_N_AHEAD) == 0:
            while entry < last:
                row = np.uint64(rows[entry])
                prefetch(placed, row * np.uint64(_PLACED))
                looks.look[n], looks.item[n] = look, row
                n += one
                entry += one
    for p in range(n):
        look, row = looks.look[p], looks.item[p]
        t, k = look // np.uint32(_N_AHEAD), look % np.uint32(_N_AHEAD)
        at = np.uint32(start) + t
        gap[p], dy[p] = placed[row, 0] - looks.x[k, at], placed[row, 1] - looks.y[k, at]
        length[p], width[p], cos[p], sin[p] = placed[row, 2], placed[row, 3], placed[row, 4], placed[row, 5]
        ego_cos[p], ego_sin[p] = body.cos[t], body.sin[t]
    for p in range(n):
        ego = Box(0.0, 0.0, 0.0, ego_cos[p], ego_sin[p], LENGTH, WIDTH)
        gap[p] = gap_m(ego, Box(gap[p], dy[p], 0.0, cos[p], sin[p], length[p], width[p]))
    n_kept = 0
    for p in range(n):
        look = looks.look[p]
        step = look // np.uint32(_N_AHEAD) + np.uint32(_STEPS_BETWEEN) * (look % np.uint32(_N_AHEAD))
        looks.look[n_kept], looks.item[n_kept] = look, looks.item[p] - step * n_items
        n_kept += gap[p] <= ROUNDING_M
    return i, n_kept


@hidden_kernel
def first_contacts(
    obstacles: Obstacles, states: Array, body: Body, looks: Looks, start: int, map_index: MapIndex, places: Places
) -> tuple[float, float, float]:
    """NC in {0, 0.5, 1}, the time index of the first collision at fault, and that of the first TTC violation.

    A TTC violation is where the ego, going straight on for up to 0.9 s, runs into something; the index is inf where
    there is none. states: (T, 11) of one trajectory; body: placed there, with its flags; looks: set by `set_looks`,
    from `start` on for this one; map_index: within its intersections contacts beside the ego count for TTC too.
    """
    indexed = len(obstacles.placed) > 0
    n_near = 0 if indexed else list_within_reach(obstacles, body, looks.within_reach)
    pair_look, pair_item = looks.look.view(np.int32), looks.item.view(np.int32)
    nc, hit, violated, ends = 1.0, math.inf, math.inf, states.shape[0] - max(TTC_STEPS)
    for item in range(len(looks.asking)):
        looks.asking[item] = NC | TTC
    i, n_listed = 0, _list_looks(obstacles, looks, start, states.shape[0])
    while i < n_listed and (nc > 0.0 or violated == math.inf):
        ahead = violated == math.inf
        if indexed:
            i, n = _pairs_that_may_touch(obstacles, body, looks, start, i, n_listed, ahead)
        else:
            i, n = _pairs_within_reach(obstacles, n_near, body, looks, start, i, n_listed, ahead)
        for p in range(n):
            look, item = pair_look[p], pair_item[p]
            t, k = look // _N_AHEAD, look % _N_AHEAD
            asks = NC if k == 0 and nc > 0.0 else 0
            asks |= TTC if violated == math.inf and t < ends and body.speed[t] >= STOPPED_EGO_TTC_MPS else 0
            asks &= looks.asking[item]
            if asks == 0:
                continue
            ego, other = _ego_at(body, looks, start, states, look), box_at(obstacles, t + TTC_STEPS[k], item)
            gap = gap_m(ego, other)
            if gap > ROUNDING_M or not (gap < -ROUNDING_M or touching(ego, other)):
                continue
            rear_x, rear_y = states[t, X], states[t, Y]
            if asks & NC:
                if _at_fault(ego, rear_x, rear_y, body, t, other, obstacles.is_stopped[item], map_index, places):
                    nc, hit = min(nc, obstacles.collision_score[item]), min(hit, float(t))
                else:
                    looks.asking[item] &= TTC
            if asks & TTC:
                angle = _angle_to(rear_x, rear_y, ego.heading, other)  # the ego as it is now
                if angle < AHEAD_RAD or (
                    not angle > BEHIND_RAD
                    and (
                        is_off_lane(map_index, body, t, HALF_LENGTH, HALF_WIDTH, places)
                        or in_intersection(map_index, rear_x, rear_y, places)
                    )
                ):
                    violated = float(t)
                looks.asking[item] &= NC
    return nc, hit, violated


@hidden_kernel
def _looked_at(body: Body) -> tuple[float, float, float, float]:
    """Least x, y, most x, y [m] of the places of a placed body that both rules look at."""
    ahead = max(TTC_STEPS) * 0.1
    least_x, least_y, most_x, most_y = math.inf, math.inf, -math.inf, -math.inf
    for t in range(len(body.x)):
        x, y, gone = body.x[t], body.y[t], body.speed[t] * ahead
        ahead_x, ahead_y = x + body.cos[t] * gone, y + body.sin[t] * gone
        least_x, least_y = min(least_x, x, ahead_x), min(least_y, y, ahead_y)
        most_x, most_y = max(most_x, x, ahead_x), max(most_y, y, ahead_y)
    return least_x, least_y, most_x, most_y


@hidden_kernel
def _at_fault(
    ego: Box,
    rear_x: float,
    rear_y: float,
    body: Body,
    t: int,
    other: Box,
    stopped: bool,
    map_index: MapIndex,
    places: Places,
) -> bool:
    """Whether the ego, its rear axle at (rear_x, rear_y) [m], is to blame for touching another box."""
    if body.speed[t] <= STOPPED_EGO_MPS:
        return False
    if stopped:
        return True
    if _angle_to(rear_x, rear_y, ego.heading, other) > BEHIND_RAD:
        return False
    half_length = ego.length / 2.0
    front_x, front_y = ego.x + half_length * ego.cos, ego.y + half_length * ego.sin
    front = Box(front_x, front_y, ego.heading, ego.cos, ego.sin, 0.0, ego.width)
    return touching(front, other) or is_off_lane(map_index, body, t, HALF_LENGTH, HALF_WIDTH, places)


@hidden_kernel
def _angle_to(x: float, y: float, heading: float, other: Box) -> float:
    """Angle [rad] between a heading [rad] and the ray from (x, y) [m] to the centroid of a box.

    The cosine is not clipped, as in the public metric: where rounding lifts it above 1 the angle is NaN, so a
    perfectly aligned object is neither ahead nor behind (docs/reward.md 2g); so is one centred on (x, y). The last bit
    decides there, so the heading's sine and cosine are the machine's own, as numpy's are, not the body's.
    """
    cos, sin = math.cos(heading), math.sin(heading)
    to_x, to_y = centroid(other)
    dx, dy = to_x - x, to_y - y
    distance = math.hypot(dx, dy)
    return math.acos(cos * np.divide(dx, distance) + sin * np.divide(dy, distance))  # numpy's: 0 / 0 is NaN

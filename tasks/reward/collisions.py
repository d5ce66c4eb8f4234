"""No at-fault collision and time to collision of one trajectory (docs/reward.md 2b, 2g).

Both rules walk through the contacts of the ego's body in time and stop looking at an object once a contact with it was
harmless.
"""

import math
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import inlined, kernel
from tasks.reward.areas import MapIndex, in_intersection
from tasks.reward.centerline import OFF_LANE, Body
from tasks.world.arrays import Array, Bools, ShortInts
from tasks.world.clip import HORIZON_STEPS
from tasks.world.frames import HEADING, X, Y
from tasks.world.geometry import LARGEST

# Everything the ego may run into, and a map from a place and a time to what can be touched there.
#
# Indexed objects are registered, per time, in every square cell whose centre points an ego body could touch them
# from, whatever its heading; an ego position then reads one cell. The cells repeat after CELLS_PER_SIDE in x and y,
# so the grid has no edges and a fixed size; what stands a whole period away is told apart by the boxes themselves.
# Unindexed objects are the same structure with one cell for everywhere and all times.

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


@kernel
def apart(first: Box, second: Box) -> bool:
    """Whether two boxes are clear of each other by more than rounding.

    True only where `touching` is False, and nearly always then; without trigonometry.
    """
    dx, dy = second.x - first.x, second.y - first.y
    c = abs(first.cos * second.cos + first.sin * second.sin)
    s = abs(first.cos * second.sin - first.sin * second.cos)
    along1 = 2.0 * abs(first.cos * dx + first.sin * dy) - (first.length + second.length * c + second.width * s)
    across1 = 2.0 * abs(first.cos * dy - first.sin * dx) - (first.width + second.length * s + second.width * c)
    along2 = 2.0 * abs(second.cos * dx + second.sin * dy) - (second.length + first.length * c + first.width * s)
    across2 = 2.0 * abs(second.cos * dy - second.sin * dx) - (second.width + first.length * s + first.width * c)
    return max(max(along1, across1), max(along2, across2)) > ROUNDING_M


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
CELLS_PER_SIDE = 64  # a power of two
SMALLEST_CELL_M = 2.0
ENTRIES_PER_BOX = 128  # bounds the index: cells grow until no more are expected on average


class Obstacles(NamedTuple):
    """N objects over T = 41 steps of 0.1 s, world frame, and where they can be touched."""

    boxes: Array  # (T, N, 5) centre x, y [m], heading [rad], length, width [m]; NaN when absent
    is_stopped: Bools  # (N,) no road user, or at most 0.05 m/s when first seen
    collision_score: Array  # (N,) what an at-fault collision leaves of NC: 0 for road users, else 0.5
    spans: Array  # (N, 5) of unindexed objects, see spans_of; (0, 5) of indexed ones
    axes: Array  # (T, N, 2) cos, sin of the headings; (0, N, 2): worked out where needed
    starts: ShortInts  # (T x cells + 1,) items[starts[c]:starts[c + 1]] are the objects of cell c, times outermost
    items: ShortInts  # (E,)
    cells_per_side: int  # 1: one cell for everywhere and all times
    cells_per_m: float


def index_obstacles(boxes: Array, is_stopped: Bools, collision_score: Array, ego_circumradius_m: float) -> Obstacles:
    """Objects that are the same for all trajectories, ready for egos whose corners are this far from their centre.

    boxes: (T, N, 5); is_stopped, collision_score: (N,), as in Obstacles.
    """
    plain = unindexed(boxes, is_stopped, collision_score)
    obstacles = plain._replace(spans=plain.spans[:0], axes=_axes(plain.boxes), cells_per_side=CELLS_PER_SIDE)
    obstacles = obstacles._replace(cells_per_m=_cells_per_m(obstacles, ego_circumradius_m))
    starts, items = _index(obstacles, ego_circumradius_m)
    return obstacles._replace(starts=starts, items=items)


@kernel
def unindexed(boxes: Array, is_stopped: Bools, collision_score: Array) -> Obstacles:
    """Objects to be looked at one by one: for traffic that few trajectories meet (`with_objects`).

    boxes: (T, N, 5); is_stopped, collision_score: (N,), as in Obstacles.
    """
    starts = np.zeros(2, np.int32)
    starts[1] = len(is_stopped)
    axes, items = np.empty((0, len(is_stopped), 2)), np.arange(len(is_stopped)).astype(np.int32)
    return Obstacles(boxes, is_stopped, collision_score, spans_of(boxes), axes, starts, items, 1, 0.0)


@kernel
def lay_out(
    boxes: Array, velocities: Array, valid: Bools, collision_score: Array, ego_box: Array
) -> tuple[bool, Obstacles]:
    """The unindexed obstacles that tracks of N objects are over their first 41 steps; False where one is not well.

    boxes (S >= 41, N, 5), velocities (S, N, 2) and valid (S, N) as in AgentTracks; collision_score: (N,). Left out for
    good is who is never there, and who touches the ego's box (5,) at first (one of NaN: nobody). Not well is who is
    there with a size below zero or a number that is infinite or above LARGEST; with a NaN in the box it is not there.
    Whether it stands its velocity at its first appearance says (docs/reward.md 2).
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
    met, n_wrong = np.full((N_TIMES, n_kept, 5), np.nan), 0
    for t in range(valid.shape[0]):
        for i in range(valid.shape[1]):
            if valid[t, i] and _is_known(boxes, t, i):
                n_wrong += not _is_well(boxes, velocities, t, i)
                if t < N_TIMES and column[i] >= 0:
                    for c in range(5):
                        met[t, column[i], c] = boxes[t, i, c]
    kept = np.flatnonzero(column >= 0)
    is_stopped, score = np.empty(n_kept, np.bool_), collision_score[kept]
    for k in range(n_kept):
        vx, vy = velocities[first_seen[kept[k]], kept[k]]
        is_stopped[k] = score[k] > 0.0 or np.hypot(vx, vy) <= STOPPED_SPEED_MPS
    return n_wrong == 0, unindexed(met, is_stopped, score)


@inlined
def _is_known(boxes: Array, t: int, i: int) -> bool:
    """Whether no number of a box is NaN."""
    return not math.isnan(
        abs(boxes[t, i, 0]) + abs(boxes[t, i, 1]) + abs(boxes[t, i, 2]) + abs(boxes[t, i, 3]) + abs(boxes[t, i, 4])
    )


@inlined
def _is_well(boxes: Array, velocities: Array, t: int, i: int) -> bool:
    """Whether an object's numbers are finite and at most LARGEST, and its sizes not negative."""
    well = (boxes[t, i, 3] >= 0.0) & (boxes[t, i, 4] >= 0.0)
    for c in range(5):
        well &= abs(boxes[t, i, c]) <= LARGEST
    return well & (abs(velocities[t, i, 0]) <= LARGEST) & (abs(velocities[t, i, 1]) <= LARGEST)


@kernel
def _box(box: Array) -> Box:
    x, y, heading, length, width = box
    return Box(x, y, heading, math.cos(heading), math.sin(heading), length, width)


@kernel
def with_objects(obstacles: Obstacles, boxes: Array, is_stopped: Bools) -> Obstacles:
    """The same unindexed objects, elsewhere: boxes (T, N, 5) that one trajectory meets, is_stopped (N,) of them."""
    return Obstacles(
        boxes,
        is_stopped,
        obstacles.collision_score,
        spans_of(boxes),
        obstacles.axes,
        obstacles.starts,
        obstacles.items,
        obstacles.cells_per_side,
        obstacles.cells_per_m,
    )


@kernel
def spans_of(boxes: Array) -> Array:
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


@kernel
def within_reach(
    obstacles: Obstacles, path: tuple[float, float, float, float], length: float, width: float
) -> Obstacles:
    """Unindexed objects without those that are out of reach all along a path; indexed ones as they are.

    path: least x, y, most x, y of the centres [m] of an ego body of that length and width [m].
    """
    if obstacles.cells_per_side > 1:
        return obstacles
    spans = obstacles.spans
    items = np.empty(len(spans), np.int32)
    n = 0
    for item in range(len(spans)):
        # as far as out_of_reach ever looks
        reach = math.sqrt(0.5 * (spans[item, 4] + length * length + width * width) + ROUNDING_M) + ROUNDING_M
        if (
            spans[item, 0] - reach <= path[2]
            and spans[item, 2] + reach >= path[0]
            and spans[item, 1] - reach <= path[3]
            and spans[item, 3] + reach >= path[1]
        ):
            items[n] = item
            n += 1
    starts = np.zeros(2, np.int32)
    starts[1] = n
    return Obstacles(
        obstacles.boxes,
        obstacles.is_stopped,
        obstacles.collision_score,
        spans,
        obstacles.axes,
        starts,
        items[:n],
        obstacles.cells_per_side,
        obstacles.cells_per_m,
    )


@kernel
def cell_of(obstacles: Obstacles, t: int, x: float, y: float) -> int:
    """The cell whose items are all the objects that an ego body centred on (x, y) [m] at step t may touch."""
    n = obstacles.cells_per_side
    if n == 1:
        return 0
    column = math.floor(x * obstacles.cells_per_m) & (n - 1)
    row = math.floor(y * obstacles.cells_per_m) & (n - 1)
    return (t * n + row) * n + column


@kernel
def box_at(obstacles: Obstacles, t: int, item: int) -> Box:
    """Where an object is at step t; NaN when absent."""
    x, y, heading = obstacles.boxes[t, item, 0], obstacles.boxes[t, item, 1], obstacles.boxes[t, item, 2]
    length, width = obstacles.boxes[t, item, 3], obstacles.boxes[t, item, 4]
    if obstacles.cells_per_side > 1:
        return Box(x, y, heading, obstacles.axes[t, item, 0], obstacles.axes[t, item, 1], length, width)
    return Box(x, y, heading, math.cos(heading), math.sin(heading), length, width)


@kernel
def out_of_reach(obstacles: Obstacles, t: int, item: int, ego: Box) -> bool:
    """Whether an unindexed object is too far away, or absent, to touch the ego at step t: nothing dearer is needed."""
    if obstacles.cells_per_side > 1:
        return False
    boxes = obstacles.boxes
    dx, dy, length, width = boxes[t, item, 0] - ego.x, boxes[t, item, 1] - ego.y, boxes[t, item, 3], boxes[t, item, 4]
    # squared sum of the circumradii <= twice the sum of their squares
    reach_sq = 0.5 * (length * length + width * width + ego.length * ego.length + ego.width * ego.width)
    return not dx * dx + dy * dy <= reach_sq + ROUNDING_M


@kernel
def _axes(boxes: Array) -> Array:
    """Cos and sin (T, N, 2) of the headings, by the same library as in `box_at`."""
    axes = np.empty((boxes.shape[0], boxes.shape[1], 2))
    for t in range(boxes.shape[0]):
        for i in range(boxes.shape[1]):
            axes[t, i, 0], axes[t, i, 1] = math.cos(boxes[t, i, 2]), math.sin(boxes[t, i, 2])
    return axes


@kernel
def _reach(box: Box, ego_radius: float) -> tuple[float, float]:
    """How far from a box's centre the centre of an ego that touches it can be, along x and y [m]; NaN when absent."""
    c, s, margin = abs(box.cos), abs(box.sin), ego_radius + ROUNDING_M
    return 0.5 * (box.length * c + box.width * s) + margin, 0.5 * (box.length * s + box.width * c) + margin


@kernel
def _cells_per_m(obstacles: Obstacles, ego_radius: float) -> float:
    """The finest grid that keeps the index small."""
    n_times, n_items = obstacles.boxes.shape[:2]
    cell = SMALLEST_CELL_M
    while True:
        entries = 0.0
        for t in range(n_times):
            for item in range(n_items):
                reach_x, reach_y = _reach(box_at(obstacles, t, item), ego_radius)
                area = min(2.0 * reach_x / cell + 1.0, CELLS_PER_SIDE) * min(2.0 * reach_y / cell + 1.0, CELLS_PER_SIDE)
                if math.isfinite(area):
                    entries += area
        if entries <= ENTRIES_PER_BOX * n_times * n_items:
            return 1.0 / cell
        cell *= 2.0


@kernel
def _index(obstacles: Obstacles, ego_radius: float) -> tuple[ShortInts, ShortInts]:
    """Starts and items of the cells: counted, summed to the cells' ends, filled from there."""
    n_times, n_items = obstacles.boxes.shape[:2]
    starts = np.zeros(n_times * CELLS_PER_SIDE * CELLS_PER_SIDE + 1, dtype=np.int32)
    items = np.empty(0, dtype=np.int32)
    for fill in (False, True):
        for t in range(n_times):
            for item in range(n_items):
                _register(obstacles, t, item, ego_radius, fill, starts, items)
        if not fill:
            end = 0
            for cell in range(starts.size):
                end += starts[cell]
                starts[cell] = end
            items = np.empty(end, dtype=np.int32)
    return starts, items


@kernel
def _register(
    obstacles: Obstacles, t: int, item: int, ego_radius: float, fill: bool, starts: ShortInts, items: ShortInts
) -> None:
    """Count an object in, or write it into, the cells that come within the ego's radius of its box at step t."""
    box, per_m = box_at(obstacles, t, item), obstacles.cells_per_m
    reach_x, reach_y = _reach(box, ego_radius)
    if not math.isfinite(box.x + box.y + reach_x + reach_y):
        return
    left, right = math.floor((box.x - reach_x) * per_m), math.floor((box.x + reach_x) * per_m)
    low, high = math.floor((box.y - reach_y) * per_m), math.floor((box.y + reach_y) * per_m)
    everywhere = right - left >= CELLS_PER_SIDE or high - low >= CELLS_PER_SIDE
    center_reach = ego_radius + ROUNDING_M + math.sqrt(0.5) / per_m  # from the box to a cell's centre
    for row in range(low, min(high + 1, low + CELLS_PER_SIDE)):
        dy = (row + 0.5) / per_m - box.y
        first = (t * CELLS_PER_SIDE + (row & (CELLS_PER_SIDE - 1))) * CELLS_PER_SIDE
        for column in range(left, min(right + 1, left + CELLS_PER_SIDE)):
            dx = (column + 0.5) / per_m - box.x
            along = max(abs(box.cos * dx + box.sin * dy) - 0.5 * box.length, 0.0)
            across = max(abs(box.cos * dy - box.sin * dx) - 0.5 * box.width, 0.0)
            if everywhere or along * along + across * across <= center_reach * center_reach:
                cell = first + (column & (CELLS_PER_SIDE - 1))
                if fill:
                    starts[cell] -= 1
                    items[starts[cell]] = item
                else:
                    starts[cell] += 1


STOPPED_EGO_MPS = 0.05
STOPPED_EGO_TTC_MPS = 5e-3
BEHIND_RAD = math.radians(150.0)
AHEAD_RAD = math.radians(30.0)
TTC_STEPS = (0, 3, 6, 9)  # projections 0, 0.3, 0.6, 0.9 s ahead


@kernel
def first_collision(
    obstacles: Obstacles, states: Array, body: Body, half_length: float, half_width: float, ignored: Bools
) -> tuple[float, float]:
    """NC in {0, 0.5, 1} and the time index of the first collision at fault, inf where there is none.

    states: (41, 11) of one trajectory; body: placed there, with its flags; half_length, half_width: of the body [m];
    ignored: (N,) scratch.
    """
    ignored[:] = False
    nc, first = 1.0, math.inf
    for t in range(states.shape[0]):
        ego = Box(
            body.x[t], body.y[t], states[t, HEADING], body.cos[t], body.sin[t], 2.0 * half_length, 2.0 * half_width
        )
        cell = cell_of(obstacles, t, ego.x, ego.y)
        for entry in range(obstacles.starts[cell], obstacles.starts[cell + 1]):
            item = obstacles.items[entry]
            if ignored[item] or out_of_reach(obstacles, t, item, ego):
                continue
            other = box_at(obstacles, t, item)
            if apart(ego, other) or not touching(ego, other):
                continue
            off_lane = (body.flags[t] & OFF_LANE) != 0
            if _at_fault(ego, states[t, X], states[t, Y], body.speed[t], off_lane, other, obstacles.is_stopped[item]):
                nc, first = min(nc, obstacles.collision_score[item]), min(first, float(t))
            else:
                ignored[item] = True
        if nc == 0.0:
            break
    return nc, first


@kernel
def first_time_to_collision(
    obstacles: Obstacles,
    states: Array,
    body: Body,
    map_index: MapIndex,
    half_length: float,
    half_width: float,
    ignored: Bools,
) -> float:
    """First time index at which the ego, going straight on for up to 0.9 s, runs into something; inf: none.

    Arguments as for `first_collision`; map_index: within its intersections contacts beside the ego count too.
    """
    ignored[:] = False
    for t in range(states.shape[0] - max(TTC_STEPS)):
        if body.speed[t] < STOPPED_EGO_TTC_MPS:
            continue
        c, s = body.cos[t], body.sin[t]
        for step in TTC_STEPS:
            gone = body.speed[t] * (step * 0.1)
            x, y = body.x[t] + c * gone, body.y[t] + s * gone
            ego = Box(x, y, states[t, HEADING], c, s, 2.0 * half_length, 2.0 * half_width)
            cell = cell_of(obstacles, t + step, x, y)
            for entry in range(obstacles.starts[cell], obstacles.starts[cell + 1]):
                item = obstacles.items[entry]
                if ignored[item] or out_of_reach(obstacles, t + step, item, ego):
                    continue
                other = box_at(obstacles, t + step, item)
                if apart(ego, other) or not touching(ego, other):
                    continue
                angle = _angle_to(states[t, X], states[t, Y], ego.heading, other)  # the ego as it is now
                if angle < AHEAD_RAD or (not angle > BEHIND_RAD and _exposed(map_index, states, body, t)):
                    return float(t)
                ignored[item] = True
    return math.inf


@kernel
def reach_of(body: Body) -> tuple[float, float, float, float]:
    """Least x, y, most x, y [m] of the places of a placed body that both rules look at."""
    ahead = max(TTC_STEPS) * 0.1
    least_x, least_y, most_x, most_y = math.inf, math.inf, -math.inf, -math.inf
    for t in range(len(body.x)):
        x, y, gone = body.x[t], body.y[t], body.speed[t] * ahead
        ahead_x, ahead_y = x + body.cos[t] * gone, y + body.sin[t] * gone
        least_x, least_y = min(least_x, x, ahead_x), min(least_y, y, ahead_y)
        most_x, most_y = max(most_x, x, ahead_x), max(most_y, y, ahead_y)
    return least_x, least_y, most_x, most_y


@kernel
def _exposed(map_index: MapIndex, states: Array, body: Body, t: int) -> bool:
    """Whether objects beside the ego count at step t: between lanes, off the road or in an intersection."""
    return (body.flags[t] & OFF_LANE) != 0 or in_intersection(map_index, states[t, X], states[t, Y])


@kernel
def _at_fault(ego: Box, rear_x: float, rear_y: float, speed: float, off_lane: bool, other: Box, stopped: bool) -> bool:
    """Whether the ego, its rear axle at (rear_x, rear_y) [m], is to blame for touching another box."""
    if speed <= STOPPED_EGO_MPS:
        return False
    if stopped:
        return True
    if _angle_to(rear_x, rear_y, ego.heading, other) > BEHIND_RAD:
        return False
    half_length = ego.length / 2.0
    front_x, front_y = ego.x + half_length * ego.cos, ego.y + half_length * ego.sin
    return off_lane or touching(Box(front_x, front_y, ego.heading, ego.cos, ego.sin, 0.0, ego.width), other)


@kernel
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

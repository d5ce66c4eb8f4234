"""Where two ways cannot be driven at once: cells of two paths that overlap, or of a path and somebody's log. Compiled.

A path is looked at from where its vehicle is to where its log will have come to: it is late at most. A zone is the
first stretch in which a cell as wide as the one vehicle overlaps a cell of the other's path. Where both ways go the
same direction there, only its beginning is one: behind it the one that is first leads, and the other follows a box.
"""

import math

import numpy as np

from tasks.kernels.compiled import inner_kernel, kernel
from tasks.rollout.corridor import Paths, boxes_overlap
from tasks.rollout.stretches import CELLS, PATH_SPACING_M
from tasks.rollout.traffic_state import AgentStates
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.geometry import wrapped

MERGES_WITHIN_RAD = math.radians(45.0)  # ways that go the same direction
MARGIN_M = 0.2  # between two bodies that pass each other
MET_STEPS = 15  # of a log within a path: afterwards it is in the way, and a leader


@kernel
def zones_of(
    paths: Paths, owner: Ints, begin: Array, nose: Array, end: Array, half_width: Array,
    log: AgentStates, replays: Bools, clock: Ints, n_steps: int,
) -> tuple[Ints, Array]:  # fmt: skip
    """Zones (Z, 3): path, agent, its path or -1 where it replays its log; and (Z, 4): in, out, other's in, out.

    owner (M,): whose path; begin, end (M,): what of it will be driven [m]; nose (M,): where the bumper is; half_width
    (N,) [m] of the agents; log (S, N); replays (N,): who may replay its log, from step clock (N,) of it on, for
    n_steps.
    """
    n_paths = len(owner)
    size, n = 64, 0
    who, where = np.empty((size, 3), np.int64), np.empty((size, 4))
    for m in range(n_paths):
        if not begin[m] < end[m]:
            continue
        for o in range(m + 1, n_paths):
            if owner[o] == owner[m] or not begin[o] < end[o]:
                continue
            own_in, own_out, other_in, other_out, ends = _crossing(
                paths, m, begin[m], end[m], half_width[owner[m]], o, begin[o], end[o], half_width[owner[o]]
            )
            while own_in < np.inf and (
                (nose[m] > own_in and nose[o] > other_in)
                or (own_out - own_in <= PATH_SPACING_M and (nose[m] > own_in or nose[o] > other_in))
            ):  # who is there already leads, if they go the same direction; there may be another one ahead
                own_in, own_out, other_in, other_out, ends = _crossing(
                    paths, m, ends + PATH_SPACING_M, end[m], half_width[owner[m]],
                    o, begin[o], end[o], half_width[owner[o]],
                )  # fmt: skip
            if own_in < np.inf:
                if n + 2 > size:
                    size *= 2
                    who, where = _grown(who, where, size)
                who[n, 0], who[n, 1], who[n, 2] = m, owner[o], o
                where[n, 0], where[n, 1], where[n, 2], where[n, 3] = own_in, own_out, other_in, other_out
                who[n + 1, 0], who[n + 1, 1], who[n + 1, 2] = o, owner[m], m
                where[n + 1, 0], where[n + 1, 1] = other_in, other_out
                where[n + 1, 2], where[n + 1, 3] = own_in, own_out
                n += 2
    for j in range(len(replays)):
        if not replays[j]:
            continue
        x, y, radius = _disc_around(log, j, clock[j], n_steps)
        if radius < 0.0:
            continue
        for m in range(n_paths):
            if owner[m] == j or not begin[m] < end[m]:
                continue
            own_in, own_out, first, last = _met(
                paths, m, begin[m], end[m], half_width[owner[m]], log, j, clock[j], n_steps, x, y, radius
            )
            if own_in < np.inf:
                if n + 1 > size:
                    size *= 2
                    who, where = _grown(who, where, size)
                who[n, 0], who[n, 1], who[n, 2] = m, j, -1
                where[n, 0], where[n, 1], where[n, 2], where[n, 3] = own_in, own_out, first, last
                n += 1
    return who[:n], where[:n]


@kernel
def _grown(who: Ints, where: Array, size: int) -> tuple[Ints, Array]:
    more_who, more_where = np.empty((size, 3), np.int64), np.empty((size, 4))
    more_who[: len(who)] = who
    more_where[: len(where)] = where
    return more_who, more_where


@inner_kernel
def _crossing(
    paths: Paths, m: int, m_begin: float, m_end: float, m_half: float,
    o: int, o_begin: float, o_end: float, o_half: float,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """(in, out) along path m and along path o of their first zone between begin and end; inf: there is none.

    And how far along path m cells overlap.
    """
    n = paths.heading.shape[1]
    m_first, m_last = max(int(m_begin / PATH_SPACING_M), 0), min(int(m_end / PATH_SPACING_M) + 1, n - 1)
    o_first, o_last = max(int(o_begin / PATH_SPACING_M), 0), min(int(o_end / PATH_SPACING_M) + 1, n - 1)
    reach = math.hypot(m_half + 0.5 * MARGIN_M, 0.5 * PATH_SPACING_M) + math.hypot(
        o_half + 0.5 * MARGIN_M, 0.5 * PATH_SPACING_M
    )
    low, high, first, last = np.inf, -np.inf, np.inf, -np.inf
    for a_stretch in range(m_first // CELLS, m_last // CELLS + 1):
        a_from, a_to = max(a_stretch * CELLS, m_first), min((a_stretch + 1) * CELLS - 1, m_last)
        near = False
        for b_stretch in range(o_first // CELLS, o_last // CELLS + 1):
            near = near or _stretches_near(paths, m, a_stretch, o, b_stretch, reach)
        for a in range(a_from, a_to + 1):
            if not near:
                if high >= low:
                    return _zone(paths, m, low, high, o, first, last)
                break
            found = False
            for b_stretch in range(o_first // CELLS, o_last // CELLS + 1):
                if not _stretches_near(paths, m, a_stretch, o, b_stretch, reach):
                    continue
                for b in range(max(b_stretch * CELLS, o_first), min((b_stretch + 1) * CELLS - 1, o_last) + 1):
                    if _cells_overlap(paths, m, a, m_half, o, b, o_half, reach):
                        found = True
                        first, last = min(first, b * PATH_SPACING_M), max(last, b * PATH_SPACING_M)
            if found:
                low, high = min(low, a * PATH_SPACING_M), a * PATH_SPACING_M
            elif high >= low:
                return _zone(paths, m, low, high, o, first, last)
    if high >= low:
        return _zone(paths, m, low, high, o, first, last)
    return np.inf, np.inf, np.inf, np.inf, np.inf


@inner_kernel
def _zone(
    paths: Paths, m: int, low: float, high: float, o: int, first: float, last: float
) -> tuple[float, float, float, float, float]:
    """The zone; of ways that go the same direction only its first cell."""
    a, b, ends = int(low / PATH_SPACING_M), int(first / PATH_SPACING_M), high
    if abs(wrapped(paths.heading[m, a] - paths.heading[o, b])) <= MERGES_WITHIN_RAD:
        high, last = low, first
    half = 0.5 * PATH_SPACING_M
    return low - half, high + half, first - half, last + half, ends


@inner_kernel
def _stretches_near(paths: Paths, m: int, a: int, o: int, b: int, reach: float) -> bool:
    """May cells of stretch a of path m and of stretch b of path o be within `reach` of each other?"""
    a, b = min(a, paths.stretches.shape[1] - 1), min(b, paths.stretches.shape[1] - 1)
    dx = paths.stretches[m, a, 0] - paths.stretches[o, b, 0]
    dy = paths.stretches[m, a, 1] - paths.stretches[o, b, 1]
    far = paths.stretches[m, a, 6] + paths.stretches[o, b, 6] + reach
    return dx * dx + dy * dy <= far * far


@inner_kernel
def _cells_overlap(paths: Paths, m: int, a: int, m_half: float, o: int, b: int, o_half: float, reach: float) -> bool:
    """Does the cell around point a of path m share area with that around point b of path o?"""
    dx, dy = paths.xy[o, b, 0] - paths.xy[m, a, 0], paths.xy[o, b, 1] - paths.xy[m, a, 1]
    if dx * dx + dy * dy > reach * reach:
        return False
    one = (paths.xy[m, a, 0], paths.xy[m, a, 1], paths.heading[m, a], PATH_SPACING_M, 2.0 * m_half + MARGIN_M)
    other = (paths.xy[o, b, 0], paths.xy[o, b, 1], paths.heading[o, b], PATH_SPACING_M, 2.0 * o_half + MARGIN_M)
    return boxes_overlap(one, other)


@inner_kernel
def _disc_around(log: AgentStates, j: int, clock: int, n_steps: int) -> tuple[float, float, float]:
    """Centre and radius [m] of a disc around track j from step `clock` on; radius < 0: it is not there."""
    low_x, high_x, low_y, high_y, body = np.inf, -np.inf, np.inf, -np.inf, 0.0
    for k in range(clock, min(clock + n_steps, log.valid.shape[0])):
        if log.valid[k, j]:
            low_x, high_x = min(low_x, log.boxes[k, j, 0]), max(high_x, log.boxes[k, j, 0])
            low_y, high_y = min(low_y, log.boxes[k, j, 1]), max(high_y, log.boxes[k, j, 1])
            body = max(body, 0.5 * math.hypot(log.boxes[k, j, 3], log.boxes[k, j, 4]))
    if high_x < low_x:
        return 0.0, 0.0, -1.0
    return 0.5 * (low_x + high_x), 0.5 * (low_y + high_y), 0.5 * math.hypot(high_x - low_x, high_y - low_y) + body


@inner_kernel
def _met(
    paths: Paths, m: int, begin: float, end: float, half: float,
    log: AgentStates, j: int, clock: int, n_steps: int, x: float, y: float, radius: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """(in, out) along path m, and the first and last step of track j in there; inf: it does not come there.

    Nor where it is in there from the start: it is in the way then.
    """
    n = paths.heading.shape[1]
    first, last = max(int(begin / PATH_SPACING_M), 0), min(int(end / PATH_SPACING_M) + 1, n - 1)
    low, high, came, left = np.inf, -np.inf, np.inf, -np.inf
    cell_radius = math.hypot(0.5 * PATH_SPACING_M, half + 0.5 * MARGIN_M)
    near_first, near_last = last + 1, first - 1
    for b in range(first // CELLS, min(last // CELLS, paths.stretches.shape[1] - 1) + 1):
        dx, dy = paths.stretches[m, b, 0] - x, paths.stretches[m, b, 1] - y
        far = paths.stretches[m, b, 6] + radius + cell_radius
        if dx * dx + dy * dy <= far * far:
            near_first, near_last = min(near_first, max(b * CELLS, first)), max(near_last, (b + 1) * CELLS)
    for k in range(clock, min(clock + n_steps, log.valid.shape[0])):
        if not log.valid[k, j] or k > came + MET_STEPS:
            continue
        box = (log.boxes[k, j, 0], log.boxes[k, j, 1], log.boxes[k, j, 2], log.boxes[k, j, 3], log.boxes[k, j, 4])
        reach = cell_radius + 0.5 * math.hypot(box[3], box[4])
        found = False
        for a in range(near_first, min(near_last, last) + 1):
            px, py = paths.xy[m, a, 0], paths.xy[m, a, 1]
            dx, dy = box[0] - px, box[1] - py
            if dx * dx + dy * dy > reach * reach:
                continue
            if boxes_overlap((px, py, paths.heading[m, a], PATH_SPACING_M, 2.0 * half + MARGIN_M), box):
                found = True
                low, high = min(low, a * PATH_SPACING_M), max(high, a * PATH_SPACING_M)
        if found:
            if k == clock:
                return np.inf, np.inf, np.inf, np.inf
            came, left = min(came, float(k)), float(k)
        elif came < np.inf:
            break
    if came == np.inf:
        return np.inf, np.inf, np.inf, np.inf
    return low - 0.5 * PATH_SPACING_M, high + 0.5 * PATH_SPACING_M, came, left

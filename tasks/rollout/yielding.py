"""Traffic that keeps the intent of its log and gives way where paths cross or merge (`traffic.yields`). Compiled."""

import math
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import hidden_kernel, inner_kernel, kernel
from tasks.rollout.corridor import CELLS, CLOSED, PATH_SPACING_M, Paths, boxes_overlap, project_on_path
from tasks.rollout.idm import (
    DRIVEN,
    REPLAYED,
    AgentStates,
    IdmDriver,
    Motion,
    Roles,
    RolloutRows,
    Yielding,
    following_acceleration,
    free_acceleration,
    stop_line_gap,
)
from tasks.rollout.lane_following import NEVER, STANDS_BELOW_MPS
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import HORIZON_STEPS, STEP_S, Scene
from tasks.world.geometry import wrapped

# What a driver means to do: the speeds of its own log along its path, and its stops until the log goes on.
#
# A log's speeds, summed up along the path from where the vehicle is, say when the log is where: a schedule. One that is
# held up looks at the moment of the log in which that was at its place, so it drives as fast there as the log did, only
# later; where the log stood it stands until the log goes on, and not at all where that was long ago. Nothing of this
# needs a memory: path length and time say all.

MOST_TURN_RAD = math.radians(30.0)  # of a body against its path
ON_PATH_M = 1.0  # a log farther from its path's points does not tell how a body on the path is headed
FADES_M = 10.0  # before its log is on the path, and behind the log's end, it comes to be headed along the path
ADAPTS_S = 0.5  # within which a driver that is not as fast as it means to be becomes so
MOST_ACCEL = 4.0  # m/s2, of a schedule: tracks that are put together wrongly make more
ON_TIME_M = 0.3  # one that is so near to its log is where that is: else it might never leave where that stood


@kernel
def schedules(
    boxes: Array, velocities: Array, valid: Bools, owner: Ints, anchor_step: Ints, anchor_at: Array
) -> tuple[Array, Array, Ints]:
    """Path length [m] (M, S) and speed [m/s] (M, S) of each path's log at every step, and its last step (M,).

    boxes (S, N, 5), velocities (S, N, 2), valid (S, N): the logs; owner (M,): whose path it is; the log is at path
    length anchor_at (M,) in step anchor_step (M,). Before its first and after its last step a log goes on as fast as
    there. From the anchor on nobody accelerates harder than MOST_ACCEL.
    """
    n_paths, n_steps = len(owner), len(valid)
    at, speed = np.empty((n_paths, n_steps)), np.zeros((n_paths, n_steps))
    last = np.empty(n_paths, np.int64)
    for m in range(n_paths):
        last[m] = _logged_speeds(boxes, velocities, valid, owner[m], speed[m])
        anchor = anchor_step[m]
        for k in range(anchor + 1, n_steps):
            speed[m, k] = min(speed[m, k], speed[m, k - 1] + MOST_ACCEL * STEP_S)
        at[m, anchor] = anchor_at[m]
        for k in range(anchor + 1, n_steps):
            at[m, k] = at[m, k - 1] + 0.5 * (speed[m, k - 1] + speed[m, k]) * STEP_S
        for k in range(anchor - 1, -1, -1):
            at[m, k] = at[m, k + 1] - 0.5 * (speed[m, k + 1] + speed[m, k]) * STEP_S
    return at, speed, last


@hidden_kernel
def _logged_speeds(boxes: Array, velocities: Array, valid: Bools, i: int, speed: Array) -> int:
    """Fill the forward speeds (S,) [m/s] of track i, 0 where it stands; returns its last step, or -1."""
    n, before, last = len(valid), -1, -1
    for k in range(n):
        if valid[k, i]:
            last = k
    for k in range(last + 1):
        if not valid[k, i]:
            continue
        h = boxes[k, i, 2]
        forward = velocities[k, i, 0] * math.cos(h) + velocities[k, i, 1] * math.sin(h)
        speed[k] = forward if forward >= STANDS_BELOW_MPS else 0.0
        for gap in range(before + 1, k):  # before the first step, or lost for a while
            start = speed[before] if before >= 0 else speed[k]
            speed[gap] = start + (speed[k] - start) * (gap - before) / (k - before)
        before = k
    for k in range(last + 1, n):
        speed[k] = speed[last] if last >= 0 else 0.0
    return last


@kernel
def turns_as_logged(paths: Paths, boxes: Array, valid: Bools, owner: Ints, anchor_step: Ints, at: Array) -> Array:
    """(M, P) [rad] that a body on a path is turned against it, as its log is: the middle of a long one swings out.

    boxes (S, N, 5), valid (S, N), owner (M,), anchor_step (M,): as in `schedules`; at (M, S): from there.
    """
    n_paths, n_points = paths.heading.shape
    out = np.zeros((n_paths, n_points))
    for m in range(n_paths):
        before_s, before_turn = -np.inf, 0.0
        for k in range(anchor_step[m], at.shape[1]):
            if not valid[k, owner[m]] or at[m, k] < before_s + PATH_SPACING_M:
                continue
            cell = min(max(int(at[m, k] / PATH_SPACING_M), 0), n_points - 1)
            turn = wrapped(boxes[k, owner[m], 2] - paths.heading[m, cell])
            dx = boxes[k, owner[m], 0] - paths.xy[m, cell, 0]
            dy = boxes[k, owner[m], 1] - paths.xy[m, cell, 1]
            if abs(turn) > MOST_TURN_RAD or math.hypot(dx, dy) > ON_PATH_M:
                continue
            if before_s == -np.inf:
                before_s, before_turn = at[m, k] - FADES_M, 0.0
            for p in range(max(math.ceil(before_s / PATH_SPACING_M), 0), cell + 1):
                share = (p * PATH_SPACING_M - before_s) / (at[m, k] - before_s)
                out[m, p] = before_turn + share * (turn - before_turn)
            before_s, before_turn = at[m, k], turn
        for p in range(max(math.ceil(max(before_s, 0.0) / PATH_SPACING_M), 0), n_points):
            share = (p * PATH_SPACING_M - before_s) / FADES_M
            if share >= 1.0:
                break
            out[m, p] = (1.0 - share) * before_turn
    return out


@hidden_kernel
def body_turn_at(yielding: Yielding, m: int, s: float) -> float:
    """[rad] of a body at path length s of path m against it."""
    last = yielding.turned.shape[1] - 1
    cell = min(max(s / PATH_SPACING_M, 0.0), last - 1e-9)
    k = int(cell)
    return yielding.turned[m, k] + (cell - k) * (yielding.turned[m, k + 1] - yielding.turned[m, k])


@hidden_kernel
def _first_step_at(yielding: Yielding, m: int, s: float) -> float:
    """When the log of path m comes to path length s, in steps; inf: never; 0 where it is beyond from the start."""
    n = yielding.at.shape[1]
    low, high = 0, n  # at[low - 1] < s <= at[high]
    while low < high:
        middle = (low + high) // 2
        if yielding.at[m, middle] < s:
            low = middle + 1
        else:
            high = middle
    if low == 0:
        return 0.0
    if low == n:
        over, v = s - yielding.at[m, n - 1], yielding.speed[m, n - 1]
        return n - 1 + over / (v * STEP_S) if v > 0.0 else np.inf
    a, b = yielding.at[m, low - 1], yielding.at[m, low]
    return low - 1 + (s - a) / (b - a)


@hidden_kernel
def log_moment(yielding: Yielding, m: int, s: float, step: int) -> float:
    """The moment of its log [steps] that a driver at path length s of path m is in, at `step`."""
    n = yielding.at.shape[1]
    here = yielding.at[m, step] if step < n else np.inf
    if abs(here - s) <= ON_TIME_M:
        return float(step)
    if here < s:  # ahead of its log
        return min(_first_step_at(yielding, m, s), n - 1.0)
    return min(_first_step_at(yielding, m, s + ON_TIME_M), n - 1.0)


@hidden_kernel
def log_speed_at(yielding: Yielding, m: int, moment: float) -> float:
    """[m/s] of the log of path m at a moment [steps]."""
    last = yielding.speed.shape[1] - 1
    k = min(int(moment), last)
    f = min(moment - k, 1.0) if k < last else 0.0
    return yielding.speed[m, k] + f * (yielding.speed[m, min(k + 1, last)] - yielding.speed[m, k])


@hidden_kernel
def seconds_to(yielding: Yielding, m: int, s: float, speed: float, step: int, to: float, accel_max: float) -> float:
    """[s] that a driver at path length s of path m, if nobody holds it up, takes to path length `to`."""
    if to <= s:
        return 0.0
    moment = log_moment(yielding, m, s, step)
    planned = max(_first_step_at(yielding, m, to) - moment, 0.0) * STEP_S
    if speed >= log_speed_at(yielding, m, moment) - STANDS_BELOW_MPS:
        return planned
    alone = (math.sqrt(speed * speed + 2.0 * accel_max * (to - s)) - speed) / accel_max
    return max(planned, alone)


@hidden_kernel
def intended_acceleration(
    yielding: Yielding, paths: Paths, driver: IdmDriver, m: int, s: float, speed: float,
    start: int, t: int, nose: float,
) -> float:  # fmt: skip
    """[m/s2] of one driven at path length s of path m for the road alone: as its log drives there, up to a red light.

    start + t: the clip's step, row t of the rollout; nose: path length of the bumper.
    """
    line, most = stop_line_gap(paths, m, t, nose, speed, driver.decel_max), driver.accel_max
    if line < np.inf:
        return min(
            _as_logged(yielding, paths, driver, m, s, speed, start + t),
            following_acceleration(most, speed, line, 0.0, driver),
        )
    return _as_logged(yielding, paths, driver, m, s, speed, start + t)


@hidden_kernel
def _as_logged(yielding: Yielding, paths: Paths, driver: IdmDriver, m: int, s: float, speed: float, step: int) -> float:
    moment = log_moment(yielding, m, s, step)
    wanted, then = log_speed_at(yielding, m, moment), log_speed_at(yielding, m, moment + 1.0)
    if then == 0.0 and speed < STANDS_BELOW_MPS:
        return -speed / STEP_S
    logged = (then - wanted) / STEP_S
    accel = logged + (wanted - speed) / ADAPTS_S
    hardest = min(max(driver.decel_max, -logged), driver.emergency_decel)
    accel = min(max(accel, -hardest), max(driver.accel_max, logged))
    if moment >= yielding.last[m]:  # nobody knows how fast it went there: the road's limits hold
        cell = min(max(round(s / PATH_SPACING_M), 0), paths.heading.shape[1] - 1)
        accel = min(accel, free_acceleration(speed, paths.target_speed[m, cell], driver))
    return accel


# Where two ways cannot be driven at once: cells of two paths that overlap, or of a path and somebody's log.
#
# A path is looked at from where its vehicle is to where its log will have come to: it is late at most. A zone is the
# first stretch in which a cell as wide as the one vehicle overlaps a cell of the other's path. Where both ways go the
# same direction there, only its beginning is one: behind it the one that is first leads, and the other follows a box.

MERGES_WITHIN_RAD = math.radians(45.0)  # ways that go the same direction
MARGIN_M = 0.2  # between two bodies that pass each other
MET_STEPS = 15  # of a log within a path: afterwards it is in the way, and a leader


@kernel
def find_zones(
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
    for i in range(len(who)):  # element by element: numba takes seconds to compile the copy of a slice
        for c in range(3):
            more_who[i, c] = who[i, c]
        for c in range(4):
            more_where[i, c] = where[i, c]
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


@hidden_kernel
def _zone(
    paths: Paths, m: int, low: float, high: float, o: int, first: float, last: float
) -> tuple[float, float, float, float, float]:
    """The zone; of ways that go the same direction only its first cell."""
    a, b, ends = int(low / PATH_SPACING_M), int(first / PATH_SPACING_M), high
    if abs(wrapped(paths.heading[m, a] - paths.heading[o, b])) <= MERGES_WITHIN_RAD:
        high, last = low, first
    half = 0.5 * PATH_SPACING_M
    return low - half, high + half, first - half, last + half, ends


@hidden_kernel
def _stretches_near(paths: Paths, m: int, a: int, o: int, b: int, reach: float) -> bool:
    """May cells of stretch a of path m and of stretch b of path o be within `reach` of each other?"""
    a, b = min(a, paths.stretches.shape[1] - 1), min(b, paths.stretches.shape[1] - 1)
    dx = paths.stretches[m, a, 0] - paths.stretches[o, b, 0]
    dy = paths.stretches[m, a, 1] - paths.stretches[o, b, 1]
    far = paths.stretches[m, a, 6] + paths.stretches[o, b, 6] + reach
    return dx * dx + dy * dy <= far * far


@hidden_kernel
def _cells_overlap(paths: Paths, m: int, a: int, m_half: float, o: int, b: int, o_half: float, reach: float) -> bool:
    """Does the cell around point a of path m share area with that around point b of path o?"""
    dx, dy = paths.xy[o, b, 0] - paths.xy[m, a, 0], paths.xy[o, b, 1] - paths.xy[m, a, 1]
    if dx * dx + dy * dy > reach * reach:
        return False
    one = (paths.xy[m, a, 0], paths.xy[m, a, 1], paths.heading[m, a], PATH_SPACING_M, 2.0 * m_half + MARGIN_M)
    other = (paths.xy[o, b, 0], paths.xy[o, b, 1], paths.heading[o, b], PATH_SPACING_M, 2.0 * o_half + MARGIN_M)
    return boxes_overlap(one, other)


@hidden_kernel
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


# A scene's schedules and zones, and who gives way in each: once per scene, whatever the ego will do.
#
# Of two that would be in a zone at once gives way, first who has a closed light or a stop of its log before it, then
# who turns, then who comes later by the logs, then who has the other one on its right.

MOVES_M = 0.5  # who is less far by the end of the rollout stands
TURNS_RAD = math.radians(30.0)  # of the way up to the end of a zone
AT_ONCE_STEPS = 5  # who comes so little later does not come later
ASIDE = 0.3  # sine of the angle at which another way comes from the right or the left
STOP_BEFORE_M = 12.0  # of a zone, a stop of the log is one for it


def prepare_yielding(scene: Scene, roles: Roles, paths: Paths, log: AgentStates) -> Yielding:
    """What drivers on `paths` mean to do, and where they look out for others."""
    start, n_steps = scene.step, len(log.valid)
    owner, anchor_step, pose = _anchors(scene, roles, log, len(paths.heading))
    anchor_at = _places(paths, pose)
    at, speed, last = schedules(log.boxes, log.velocities, log.valid, owner, anchor_step, anchor_at)
    front = 0.5 * pose[:, 3]
    end = at[:, min(start + HORIZON_STEPS, n_steps - 1)]
    begin = np.minimum(anchor_at, at[:, start])
    moves = end - begin > MOVES_M
    replays = roles.moving_kind & ~roles.standing & ((roles.path < 0) | (roles.join_step > start))
    half_width = 0.5 * np.nan_to_num(np.nanmax(log.boxes[..., 4], axis=0, initial=0.0))
    who, where = find_zones(
        paths, owner, begin - front, anchor_at + front, np.where(moves, end + front, -np.inf), half_width,
        log, replays, roles.clock, HORIZON_STEPS + 1,
    )  # fmt: skip
    order = np.argsort(who[:, 0], kind="stable")
    who, where = who[order], where[order]
    return Yielding(
        at=at,
        speed=speed,
        last=last,
        turned=turns_as_logged(paths, log.boxes, log.valid, owner, anchor_step, at),
        zone_start=np.searchsorted(who[:, 0], np.arange(len(owner) + 1)),
        zone_agent=np.ascontiguousarray(who[:, 1]),
        zone_path=np.ascontiguousarray(who[:, 2]),
        **{name: np.ascontiguousarray(where[:, k]) for k, name in enumerate(_EDGES)},
        gives_way=_who_gives_way(paths, who, where, at, speed, begin, start),
        trailing=_trailing(scene, roles),
    )


def _trailing(scene: Scene, roles: Roles) -> Array:
    """(N,) what each agent tows reaches so far behind its own rear [m]."""
    now, out = scene.agents, np.zeros(len(roles.first_part))
    for i in np.flatnonzero(roles.first_part != np.arange(len(out))).tolist():
        first = roles.first_part[i]
        shared = now.valid[:, i] & now.valid[:, first]
        k = scene.step if shared[scene.step] else int(shared.argmax())
        away = math.hypot(*(now.boxes[k, i, :2] - now.boxes[k, first, :2]))
        out[first] = max(out[first], away + 0.5 * (now.boxes[k, i, 3] - now.boxes[k, first, 3]))
    return out


_EDGES = ("zone_in", "zone_out", "other_in", "other_out")


def _anchors(scene: Scene, roles: Roles, log: AgentStates, n_paths: int) -> tuple[Ints, Ints, Array]:
    """Whose each path is (M,), a step of its log (M,), and where it is then (M, 5): now, or where it will appear."""
    owner, step = np.zeros(n_paths, np.int64), np.zeros(n_paths, np.int64)
    pose = np.zeros((n_paths, 5))
    now = scene.agents
    for numbers, joins in ((roles.path, roles.join_step), (roles.logged_path, roles.clock)):
        for i in np.flatnonzero(numbers >= 0).tolist():
            m = numbers[i]
            owner[m] = i
            if now.valid[scene.step, i]:
                step[m], pose[m] = roles.clock[i], now.boxes[scene.step, i]
            else:
                seen = np.flatnonzero(log.valid[:, i])
                after = seen[seen >= joins[i]] if joins[i] < NEVER else seen
                step[m] = after[0] if len(after) else seen[-1]
                pose[m] = log.boxes[step[m], i]
    return owner, step, pose


@kernel
def _places(paths: Paths, pose: Array) -> Array:
    """(M,) path length of each path's own pose (M, >= 2)."""
    out = np.empty(len(pose))
    for m in range(len(pose)):
        out[m] = project_on_path(paths, m, pose[m, 0], pose[m, 1])[0]
    return out


def _who_gives_way(paths: Paths, who: Ints, where: Array, at: Array, speed: Array, begin: Array, start: int) -> Bools:
    """(Z,) of zones `who` (Z, 3), `where` (Z, 4)."""
    replayed = who[:, 2] < 0
    of = np.where(replayed, who[:, 0], who[:, 2])
    own = _claims(paths, who[:, 0], where[:, 0], where[:, 1], at, speed, begin, start)
    other = _claims(paths, of, where[:, 2], where[:, 3], at, speed, begin, start)
    later = own.comes - other.comes
    crossed = np.sin(other.heading - own.heading)  # above 0: the other one comes from the right
    rules = (
        own.held - other.held,
        own.turns - other.turns,
        np.where(np.abs(later) >= AT_ONCE_STEPS, later, 0.0),
        np.where(np.abs(crossed) >= ASIDE, crossed, 0.0),
        later,
        (who[:, 0] - of).astype(np.float64),
    )
    behind, decided = replayed.copy(), replayed.copy()
    for rule in rules:
        behind |= ~decided & (rule > 0.0)
        decided |= rule != 0.0
    return behind


class _Claims(NamedTuple):
    """What is compared in turn, (Z,) each: of two the one with less goes first."""

    held: Array  # 1: a closed light or a stop of the log is before the zone
    turns: Array  # 1: the way up to the end of the zone turns
    comes: Array  # steps from now until the log comes there
    heading: Array  # [rad] there


def _claims(
    paths: Paths, path: Ints, enters: Array, leaves: Array, at: Array, speed: Array, begin: Array, start: int
) -> _Claims:
    held = np.zeros(len(path))
    ends = np.stack([begin[path], enters, leaves])
    heading = paths.heading[path, np.clip((ends / PATH_SPACING_M).astype(int), 0, paths.heading.shape[1] - 1)]
    for z, m in enumerate(path.tolist()):
        lines = slice(paths.line_start[m], paths.line_start[m + 1])
        before = (paths.line_at[lines] >= begin[m]) & (paths.line_at[lines] <= enters[z])
        stops = (speed[m, start:] == 0.0) & (at[m, start:] <= enters[z]) & (at[m, start:] >= enters[z] - STOP_BEFORE_M)
        held[z] = float((before & (paths.line_state[0, lines] == CLOSED)).any() or stops.any())
    turns = (np.abs(heading[2] - heading[0]) > TURNS_RAD).astype(np.float64)
    comes = (at[path, start:] < enters[:, None]).sum(axis=1).astype(np.float64)
    return _Claims(held, turns, comes, heading[1])


# Who waits before a zone that two ways share, and how hard it brakes for that.
#
# Of two drivers that would be in a zone at once, the one that has to give way stops before it, unless it could do so
# only by an emergency stop: then it goes on and the other one stops. Each judges by what both can see: where they are,
# how fast, and what both mean to do. Who replays its log cannot give way.

GAP_S = 0.5  # between one that leaves a zone and the next one
INSIDE_M = 0.3  # with the nose so far in it, one does not stop any more
SHORTEST_M = 0.1
FASTER_MPS = 1.0  # than its schedule


@hidden_kernel
def cannot_stop_before(speed: float, ahead: float, driver: IdmDriver) -> bool:
    """Could one only stop before a zone that begins `ahead` [m] of its nose by braking harder than half of what tyres
    can?"""
    if ahead < -INSIDE_M:
        return True
    return speed * speed > driver.emergency_decel * max(ahead, SHORTEST_M)


@hidden_kernel
def yielding_acceleration(
    yielding: Yielding, driver: IdmDriver, start: int, t: int, i: int,
    m: int, s: float, speed: float, rows: RolloutRows, mode: Ints, motion: Motion, accel: float,
) -> float:  # fmt: skip
    """Acceleration [m/s2] of agent i, driven, for those that it gives way to; `accel` without them."""
    front = 0.5 * rows.boxes[t, i, 3]
    for z in range(yielding.zone_start[m], yielding.zone_start[m + 1]):
        j = yielding.zone_agent[z]
        if not rows.valid[t, j]:
            continue
        ahead = yielding.zone_in[z] - s - front
        if cannot_stop_before(speed, ahead, driver):
            continue
        o = yielding.zone_path[z]
        if o >= 0:
            if mode[j] != DRIVEN or motion.path[t, j] != o:
                continue
            other_s, other_speed, other_front = motion.s[t, j], motion.speed[t, j], 0.5 * rows.boxes[t, j, 3]
            if other_s - other_front - yielding.trailing[j] > yielding.other_out[z]:
                continue
            other_ahead = yielding.other_in[z] - other_s - other_front
            if not (yielding.gives_way[z] or cannot_stop_before(other_speed, other_ahead, driver)):
                continue
            nose_s = yielding.other_in[z] - other_front
            rear_s = yielding.other_out[z] + other_front + yielding.trailing[j]
            comes = seconds_to(yielding, o, other_s, other_speed, start + t, nose_s, driver.accel_max)
            leaves = seconds_to(yielding, o, other_s, other_speed, start + t, rear_s, driver.accel_max)
        else:
            if mode[j] != REPLAYED:
                continue
            comes = (yielding.other_in[z] - motion.clock[t, j]) * STEP_S
            leaves = (yielding.other_out[z] - motion.clock[t, j]) * STEP_S
            if leaves < 0.0:
                continue
        rear = yielding.zone_out[z] + front + yielding.trailing[i]
        gone = seconds_to(yielding, m, s, speed, start + t, rear, driver.accel_max)
        if comes == np.inf or comes > gone + GAP_S:
            continue
        there = seconds_to(yielding, m, s, speed, start + t, yielding.zone_in[z] - front, driver.accel_max)
        if there > leaves + GAP_S:
            continue
        waits = following_acceleration(driver.accel_max, speed, ahead, 0.0, driver)
        if waits < accel:
            accel = waits
    return accel


@hidden_kernel
def may_enter(
    yielding: Yielding, driver: IdmDriver, m: int, k: int, t: int, log: AgentStates, i: int,
    rows: RolloutRows, mode: Ints, motion: Motion,
) -> bool:  # fmt: skip
    """May agent i appear in row t on path m as in step k of its log: is in every zone one of two able to wait?

    Not where its log is faster than its schedule, which is as fast as a car can be: then the log is wrong.
    """
    scheduled = min(k, yielding.at.shape[1] - 1)  # a log may be made longer than its schedule
    s, front, speed = yielding.at[m, scheduled], 0.5 * log.boxes[k, i, 3], yielding.speed[m, scheduled]
    if math.hypot(log.velocities[k, i, 0], log.velocities[k, i, 1]) > speed + FASTER_MPS:
        return False
    for z in range(yielding.zone_start[m], yielding.zone_start[m + 1]):
        j, o = yielding.zone_agent[z], yielding.zone_path[z]
        if o < 0 or mode[j] != DRIVEN:
            continue
        other_front = 0.5 * rows.boxes[t, j, 3]
        if motion.path[t, j] != o or motion.s[t, j] - other_front - yielding.trailing[j] > yielding.other_out[z]:
            continue
        if cannot_stop_before(
            motion.speed[t, j], yielding.other_in[z] - motion.s[t, j] - other_front, driver
        ) and cannot_stop_before(speed, yielding.zone_in[z] - s - front, driver):
            return False
    return True

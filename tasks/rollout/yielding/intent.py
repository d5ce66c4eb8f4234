"""What a driver means to do: the speeds of its own log along its path, and its stops until the log goes on. Compiled.

A log's speeds, summed up along the path from where the vehicle is, say when the log is where: a schedule. One that is
held up looks at the moment of the log in which that was at its place, so it drives as fast there as the log did, only
later; where the log stood it stands until the log goes on, and not at all where that was long ago. Nothing of this
needs a memory: path length and time say all.
"""

import math

import numpy as np

from tasks.kernels.compiled import inner_kernel, kernel
from tasks.rollout.corridor import Paths
from tasks.rollout.idm import IdmDriver, following_acceleration, free_acceleration, stop_line_gap
from tasks.rollout.roles import STANDS_BELOW_MPS
from tasks.rollout.stretches import PATH_SPACING_M
from tasks.rollout.traffic_state import Yielding
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import STEP_S
from tasks.world.geometry import wrapped

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


@inner_kernel
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


@inner_kernel
def turned_at(yielding: Yielding, m: int, s: float) -> float:
    """[rad] of a body at path length s of path m against it."""
    last = yielding.turned.shape[1] - 1
    cell = min(max(s / PATH_SPACING_M, 0.0), last - 1e-9)
    k = int(cell)
    return yielding.turned[m, k] + (cell - k) * (yielding.turned[m, k + 1] - yielding.turned[m, k])


@inner_kernel
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


@inner_kernel
def moment_of(yielding: Yielding, m: int, s: float, step: int) -> float:
    """The moment of its log [steps] that a driver at path length s of path m is in, at `step`."""
    n = yielding.at.shape[1]
    here = yielding.at[m, step] if step < n else np.inf
    if abs(here - s) <= ON_TIME_M:
        return float(step)
    if here < s:  # ahead of its log
        return min(_first_step_at(yielding, m, s), n - 1.0)
    return min(_first_step_at(yielding, m, s + ON_TIME_M), n - 1.0)


@inner_kernel
def speed_in(yielding: Yielding, m: int, moment: float) -> float:
    """[m/s] of the log of path m at a moment [steps]."""
    last = yielding.speed.shape[1] - 1
    k = min(int(moment), last)
    f = min(moment - k, 1.0) if k < last else 0.0
    return yielding.speed[m, k] + f * (yielding.speed[m, min(k + 1, last)] - yielding.speed[m, k])


@inner_kernel
def seconds_to(yielding: Yielding, m: int, s: float, speed: float, step: int, to: float, accel_max: float) -> float:
    """[s] that a driver at path length s of path m, if nobody holds it up, takes to path length `to`."""
    if to <= s:
        return 0.0
    moment = moment_of(yielding, m, s, step)
    planned = max(_first_step_at(yielding, m, to) - moment, 0.0) * STEP_S
    if speed >= speed_in(yielding, m, moment) - STANDS_BELOW_MPS:
        return planned
    alone = (math.sqrt(speed * speed + 2.0 * accel_max * (to - s)) - speed) / accel_max
    return max(planned, alone)


@inner_kernel
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


@inner_kernel
def _as_logged(yielding: Yielding, paths: Paths, driver: IdmDriver, m: int, s: float, speed: float, step: int) -> float:
    moment = moment_of(yielding, m, s, step)
    wanted, then = speed_in(yielding, m, moment), speed_in(yielding, m, moment + 1.0)
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

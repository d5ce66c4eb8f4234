"""Slow twin of the drivers that keep their intent and give way: every zone, every step of a log is looked at.

Who is at path length s of path m is in the moment of its log in which that was there: now, if the log is within 0.3 m,
else when it came there (0.3 m farther on, for one that is late: it has left then). It drives as fast as the log did.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel
from tasks.rollout.idm import DRIVEN, Yielding
from tasks.world.clip import STEP_S

Array = NDArray[np.float64]

STANDS_BELOW = 0.3  # [m/s]


@kernel
def turned_on(yielding: Yielding, m: int, s: float) -> float:
    """[rad] of a body at s against its path: on the line through what stands at the points before and behind."""
    last = yielding.turned.shape[1] - 1
    place = min(max(s / 0.5, 0.0), last - 1e-9)
    k = math.floor(place)
    return yielding.turned[m, k] + (place - k) * (yielding.turned[m, k + 1] - yielding.turned[m, k])


@kernel
def comes_to(yielding: Yielding, m: int, s: float) -> float:
    """When the log comes to s, in steps."""
    at, n = yielding.at[m], yielding.at.shape[1]
    for k in range(n):
        if at[k] >= s:
            return 0.0 if k == 0 else k - 1 + (s - at[k - 1]) / (at[k] - at[k - 1])
    last = yielding.speed[m, n - 1]
    return n - 1 + (s - at[n - 1]) / (last * STEP_S) if last > 0.0 else np.inf


@kernel
def moment(yielding: Yielding, m: int, s: float, step: int) -> float:
    n = yielding.at.shape[1]
    here = yielding.at[m, step] if step < n else np.inf
    if abs(here - s) <= 0.3:
        return float(step)
    return min(comes_to(yielding, m, s if here < s else s + 0.3), n - 1.0)


@kernel
def logged_speed(yielding: Yielding, m: int, at: float) -> float:
    speed, last = yielding.speed[m], yielding.speed.shape[1] - 1
    k = int(at)
    if k >= last:
        return speed[last]
    return speed[k] + (at - k) * (speed[k + 1] - speed[k])


@kernel
def seconds(yielding: Yielding, m: int, s: float, speed: float, step: int, to: float, accel: float) -> float:
    """Until one at s is at `to`: as its log, or as hard as comfort lets it where it is slower than that."""
    if to <= s:
        return 0.0
    now = moment(yielding, m, s, step)
    planned = max(comes_to(yielding, m, to) - now, 0.0) * STEP_S
    if speed < logged_speed(yielding, m, now) - STANDS_BELOW:
        return max(planned, (math.sqrt(speed * speed + 2.0 * accel * (to - s)) - speed) / accel)
    return planned


@kernel
def intended(
    yielding: Yielding, m: int, s: float, speed: float, step: int, free: float,
    comfortable: float, emergency: float, accel_max: float,
) -> float:  # fmt: skip
    """[m/s2]; free: on a free road with the path's own target speed, which counts once the log has ended."""
    now = moment(yielding, m, s, step)
    wanted, then = logged_speed(yielding, m, now), logged_speed(yielding, m, now + 1.0)
    if then == 0.0 and speed < STANDS_BELOW:
        return -speed / STEP_S
    logged = (then - wanted) / STEP_S
    accel = logged + (wanted - speed) / 0.5
    accel = max(accel, -min(max(comfortable, -logged), emergency))
    accel = min(accel, max(accel_max, logged))
    return min(accel, free) if now >= yielding.last[m] else accel


@kernel
def cannot_stop(speed: float, ahead: float, emergency: float) -> bool:
    return ahead < -0.3 or speed * speed > emergency * max(ahead, 0.1)


@kernel
def waits_before(
    yielding: Yielding, z: int, step: int, s: float, speed: float, front: float,
    other_there: bool, other_drives_on: int, other_replays: bool, other_clock: int,
    other_s: float, other_speed: float, other_front: float, emergency: float, accel_max: float, trailing: float,
) -> float:  # fmt: skip
    """Distance [m] of the nose to zone z if its owner waits before it, or inf. other_drives_on: a path, or -1.

    trailing [m]: what the owner tows.
    """
    towed = yielding.trailing[yielding.zone_agent[z]]
    m = np.searchsorted(yielding.zone_start, z, side="right") - 1
    begin, end = yielding.zone_in[z], yielding.zone_out[z]
    ahead = begin - s - front
    if not other_there or cannot_stop(speed, ahead, emergency):
        return np.inf
    o = yielding.zone_path[z]
    if o >= 0:
        if other_drives_on != o or other_s - other_front - towed > yielding.other_out[z]:
            return np.inf
        other_ahead = yielding.other_in[z] - other_s - other_front
        if not yielding.gives_way[z] and not cannot_stop(other_speed, other_ahead, emergency):
            return np.inf
        nose, rear = yielding.other_in[z] - other_front, yielding.other_out[z] + other_front + towed
        comes = seconds(yielding, o, other_s, other_speed, step, nose, accel_max)
        leaves = seconds(yielding, o, other_s, other_speed, step, rear, accel_max)
    else:
        if not other_replays:
            return np.inf
        comes = (yielding.other_in[z] - other_clock) * STEP_S
        leaves = (yielding.other_out[z] - other_clock) * STEP_S
        if leaves < 0.0:
            return np.inf
    gone = seconds(yielding, m, s, speed, step, end + front + trailing, accel_max)
    there = seconds(yielding, m, s, speed, step, begin - front, accel_max)
    meets = comes != np.inf and comes <= gone + 0.5 and there <= leaves + 0.5
    return ahead if meets else np.inf


@kernel
def has_way(
    yielding: Yielding, m: int, k: int, logged: float, front: float,
    mode: NDArray[np.int64], path: NDArray[np.int64], s: Array, speed: Array, fronts: Array, emergency: float,
) -> bool:  # fmt: skip
    """Is nobody in a zone of path m, or bound to come there, that one in step k of its log could not stop before?

    logged [m/s]: what its log says; faster than its schedule is wrong.
    """
    if m < 0:
        return True
    if logged > yielding.speed[m, k] + 1.0:
        return False
    for z in range(len(yielding.zone_in)):
        owner = np.searchsorted(yielding.zone_start, z, side="right") - 1
        j, o = yielding.zone_agent[z], yielding.zone_path[z]
        if owner != m or o < 0 or mode[j] != DRIVEN or path[j] != o:
            continue
        if s[j] - fronts[j] - yielding.trailing[j] > yielding.other_out[z]:
            continue
        bound = cannot_stop(speed[j], yielding.other_in[z] - s[j] - fronts[j], emergency)
        if bound and cannot_stop(yielding.speed[m, k], yielding.zone_in[z] - yielding.at[m, k] - front, emergency):
            return False
    return True

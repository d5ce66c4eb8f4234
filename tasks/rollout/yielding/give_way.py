"""Who waits before a zone that two ways share, and how hard it brakes for that. Compiled.

Of two drivers that would be in a zone at once, the one that has to give way stops before it, unless it could do so only
by an emergency stop: then it goes on and the other one stops. Each judges by what both can see: where they are, how
fast, and what both mean to do. Who replays its log cannot give way.
"""

import math

import numpy as np

from tasks.kernels.compiled import inner_kernel
from tasks.rollout.idm import IdmDriver, following_acceleration
from tasks.rollout.traffic_state import DRIVEN, REPLAYED, AgentStates, Diverged, Motion, RolloutRows, Yielding
from tasks.rollout.yielding.intent import seconds_to
from tasks.world.clip import STEP_S

GAP_S = 0.5  # between one that leaves a zone and the next one
INSIDE_M = 0.3  # with the nose so far in it, one does not stop any more
SHORTEST_M = 0.1
FASTER_MPS = 1.0  # than its schedule


@inner_kernel
def is_committed(speed: float, ahead: float, driver: IdmDriver) -> bool:
    """Could one only stop before a zone that begins `ahead` [m] of its nose by braking harder than half of what tyres
    can?"""
    if ahead < -INSIDE_M:
        return True
    return speed * speed > driver.emergency_decel * max(ahead, SHORTEST_M)


@inner_kernel
def yields_for(
    yielding: Yielding, driver: IdmDriver, start: int, t: int, i: int,
    m: int, s: float, speed: float, rows: RolloutRows, diverged: Diverged, motion: Motion, record: Motion,
    afresh: bool, accel: float, leader: int,
) -> tuple[float, int]:  # fmt: skip
    """(acceleration [m/s2], whom for) of agent i, driven, for those that it gives way to; `accel` without them.

    afresh: everyone is asked about, else those that have diverged.
    """
    front = 0.5 * rows.boxes[t, i, 3]
    for z in range(yielding.zone_start[m], yielding.zone_start[m + 1]):
        j = yielding.zone_agent[z]
        if not (afresh or diverged.found[j]) or not rows.valid[t, j]:
            continue
        ahead = yielding.zone_in[z] - s - front
        if is_committed(speed, ahead, driver):
            continue
        o, own = yielding.zone_path[z], motion if diverged.found[j] else record
        if o >= 0:
            if diverged.mode[j] != DRIVEN or own.path[t, j] != o:
                continue
            other_s, other_speed, other_front = own.s[t, j], own.speed[t, j], 0.5 * rows.boxes[t, j, 3]
            if other_s - other_front > yielding.other_out[z]:
                continue
            other_ahead = yielding.other_in[z] - other_s - other_front
            if not (yielding.gives_way[z] or is_committed(other_speed, other_ahead, driver)):
                continue
            nose_s, rear_s = yielding.other_in[z] - other_front, yielding.other_out[z] + other_front
            comes = seconds_to(yielding, o, other_s, other_speed, start + t, nose_s, driver.accel_max)
            leaves = seconds_to(yielding, o, other_s, other_speed, start + t, rear_s, driver.accel_max)
        else:
            if diverged.mode[j] != REPLAYED:
                continue
            comes = (yielding.other_in[z] - own.clock[t, j]) * STEP_S
            leaves = (yielding.other_out[z] - own.clock[t, j]) * STEP_S
            if leaves < 0.0:
                continue
        gone = seconds_to(yielding, m, s, speed, start + t, yielding.zone_out[z] + front, driver.accel_max)
        if comes == np.inf or comes > gone + GAP_S:
            continue
        there = seconds_to(yielding, m, s, speed, start + t, yielding.zone_in[z] - front, driver.accel_max)
        if there > leaves + GAP_S:
            continue
        waits = following_acceleration(driver.accel_max, speed, ahead, 0.0, driver)
        if waits < accel:
            accel, leader = waits, j
    return accel, leader


@inner_kernel
def has_way(
    yielding: Yielding, driver: IdmDriver, m: int, k: int, t: int, log: AgentStates, i: int,
    rows: RolloutRows, diverged: Diverged, motion: Motion, record: Motion, afresh: bool,
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
        if o < 0 or not (afresh or diverged.found[j]) or diverged.mode[j] != DRIVEN:
            continue
        own, other_front = motion if diverged.found[j] else record, 0.5 * rows.boxes[t, j, 3]
        if own.path[t, j] != o or own.s[t, j] - other_front > yielding.other_out[z]:
            continue
        if is_committed(own.speed[t, j], yielding.other_in[z] - own.s[t, j] - other_front, driver) and is_committed(
            speed, yielding.zone_in[z] - s - front, driver
        ):
            return False
    return True

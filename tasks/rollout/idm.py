"""The Intelligent Driver Model: how hard one driver brakes or accelerates (Treiber et al. 2000; docs/reward.md 5).

    dv/dt = a [1 - (v / v0)^delta - (s* / gap)^2],   s* = s0 + v T + v (v - v_lead) / (2 sqrt(a b))

The published parameters are kept and speeds never go below zero. Unlike the public traffic a driver brakes harder than
`b` only where stopping behind the leader's own emergency stop needs it, and never harder than tyres can: logged drivers
follow closer than s* and would otherwise all stamp on the brake at the first step. Compiled.
"""

import math
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import inner_kernel
from tasks.rollout.corridor import Paths
from tasks.world.clip import STEP_S

STOP_LINE_TOLERANCE_M = 1.0  # a car that stopped with its nose this far over the line still waits
SMALLEST_GAP_M = 0.1  # keeps s* / gap finite
OPEN, CLOSED_IF_STOPPABLE, CLOSED = 0, 1, 2  # a stop line's state: green, yellow, red


class IdmDriver(NamedTuple):
    """What all driven vehicles go by, of TrafficSettings."""

    min_gap_m: float  # s0
    headway_s: float  # T
    accel_max: float  # a [m/s2]
    decel_max: float  # b [m/s2], comfortable
    exponent: float  # delta
    emergency_decel: float  # [m/s2]
    lookahead_m: float  # of path in front of the bumper
    blend_length_m: float  # over which a start off the path fades


@inner_kernel
def free_acceleration(speed: float, target_speed: float, driver: IdmDriver) -> float:
    """Acceleration [m/s2] on a road with nobody in front."""
    return max(driver.accel_max * (1.0 - (speed / target_speed) ** driver.exponent), -driver.decel_max)


@inner_kernel
def following_acceleration(free: float, speed: float, gap: float, lead_speed: float, driver: IdmDriver) -> float:
    """Acceleration [m/s2] `gap` behind a leader, of one whose acceleration on a free road would be `free`."""
    gap = max(gap, SMALLEST_GAP_M)
    closing = speed * (speed - lead_speed) / (2.0 * math.sqrt(driver.accel_max * driver.decel_max))
    desired = driver.min_gap_m + max(0.0, speed * driver.headway_s + closing)
    ratio = desired / gap
    hardest = min(max(driver.decel_max, needed_deceleration(speed, gap, lead_speed, driver)), driver.emergency_decel)
    return max(free - driver.accel_max * ratio * ratio, -hardest)


@inner_kernel
def needed_deceleration(speed: float, gap: float, lead_speed: float, driver: IdmDriver) -> float:
    """[m/s2] that stops half the minimum gap behind a leader which makes an emergency stop now."""
    lead_stop = max(lead_speed, 0.0) ** 2 / (2.0 * driver.emergency_decel)
    distance = max(gap - 0.5 * driver.min_gap_m, SMALLEST_GAP_M) + lead_stop
    return speed * speed / (2.0 * distance)


@inner_kernel
def advance(speed: float, acceleration: float) -> tuple[float, float]:
    """(distance [m], speed [m/s]) after STEP_S at constant acceleration, standing still once stopped."""
    new_speed = speed + acceleration * STEP_S
    if new_speed < 0.0:
        return speed * speed / (-2.0 * acceleration), 0.0
    return 0.5 * (speed + new_speed) * STEP_S, new_speed


@inner_kernel
def stop_line_gap(paths: Paths, m: int, step: int, nose: float, speed: float, decel: float) -> float:
    """Distance [m] from the bumper at path length `nose` to the nearest closed stop line."""
    gap = np.inf
    for q in range(paths.line_start[m], paths.line_start[m + 1]):
        distance = paths.line_at[q] - nose
        state = paths.line_state[step, q]
        if state == OPEN or (state == CLOSED_IF_STOPPABLE and speed * speed > 2.0 * decel * distance):
            continue
        if distance >= 0.0 or (distance > -STOP_LINE_TOLERANCE_M and speed < 1.0):
            gap = min(gap, max(distance, 0.0))
    return gap

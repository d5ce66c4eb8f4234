"""Slow twin of the traffic: every pair at every step, one ego at a time (Treiber et al. 2000; docs/reward.md 5).

    dv/dt = a [1 - (v / v0)^delta - (s* / gap)^2],   s* = s0 + v T + v (v - v_lead) / (2 sqrt(a b))

All agents look at the same instant and then move together, so their order does not matter. A leader is any box, the
ego included, that reaches into the corridor the driver's own body will sweep along its path; speeds never go below
zero. The published parameters are kept. Unlike the public traffic a driver brakes harder than `b` only where stopping
behind the leader's own emergency stop needs it, and never harder than tyres can: logged drivers follow closer than s*
and would otherwise all stamp on the brake at the first step. A vehicle that replays its log switches to IDM, along its
logged way, as soon as a driven vehicle there asks for more than `b`; it stays there for the rest of the rollout.
Compiled: tens of agents for 4 s take some milliseconds.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel
from tasks.rollout.traffic_state import Yielding
from tasks.world.clip import STEP_S
from tests.tasks.rollout.slow_corridor import (
    PATH_SPACING_M,
    Paths,
    boxes_overlap,
    corners_of,
    corridor_gap,
    pose_on_path,
    project_on_path,
)
from tests.tasks.rollout.slow_yielding import has_way, intended, turned_on, waits_before

Array = NDArray[np.float64]

STOP_LINE_TOLERANCE_M = 1.0  # a car that stopped with its nose this far over the line still waits
SMALLEST_GAP_M = 0.1  # keeps s* / gap finite
OPEN, CLOSED_IF_STOPPABLE, CLOSED = 0, 1, 2  # a stop line's state: green, yellow, red
ABSENT, REPLAYED, DRIVEN, STANDING = 0, 1, 2, 3  # what moves an agent at the moment


class IdmDriver(NamedTuple):
    """One driver's habits; SI units."""

    min_gap: float  # s0 [m]
    headway: float  # T [s]
    accel: float  # a [m/s2]
    decel: float  # b [m/s2], comfortable
    exponent: float  # delta
    emergency_decel: float  # [m/s2]
    lookahead: float  # [m] of path in front of the bumper
    corridor_margin: float  # [m] each side
    blend_length: float  # [m] over which a start off the path fades
    largest_offset: float  # [m] a start farther from the path stays on its log
    enter_clearance: float  # [m] from the ego's centre


class Roles(NamedTuple):
    """Who does what, N agents; steps are the clip's."""

    path: NDArray[np.int64]  # (N,) index of its path, -1: none
    logged_path: NDArray[np.int64]  # (N,) index of the path along its own log, for one that may have to brake; -1: none
    join_step: NDArray[np.int64]  # (N,) logged step from which it is driven, if it has a path
    hold_until: NDArray[np.int64]  # (N,) a car that stands in its log does not start before
    clock: NDArray[np.int64]  # (N,) step of its log it is at when the rollout starts
    standing: NDArray[np.bool_]  # (N,) parked
    moving_kind: NDArray[np.bool_]  # (N,) vehicle, pedestrian or bicycle: does not walk into a driven car
    enters_clear: NDArray[np.bool_]  # (N,) vehicles that may only enter with clearance to the ego


class AgentStates(NamedTuple):
    """Agents' boxes (.., N, 5), velocities (.., N, 2), presence (.., N) and centre heights (.., N)."""

    boxes: Array
    velocities: Array
    valid: NDArray[np.bool_]
    center_z: Array


@kernel
def idm_acceleration(speed: float, target_speed: float, gap: float, lead_speed: float, driver: IdmDriver) -> float:
    """Acceleration [m/s2]; gap = inf on a free road."""
    free = driver.accel * (1.0 - (speed / target_speed) ** driver.exponent)
    return following_acceleration(max(free, -driver.decel), speed, gap, lead_speed, driver)


@kernel
def following_acceleration(free: float, speed: float, gap: float, lead_speed: float, driver: IdmDriver) -> float:
    """[m/s2] of one whose acceleration on a free road would be `free`."""
    gap = max(gap, SMALLEST_GAP_M)
    closing = speed * (speed - lead_speed) / (2.0 * math.sqrt(driver.accel * driver.decel))
    desired = driver.min_gap + max(0.0, speed * driver.headway + closing)
    ratio = desired / gap
    hardest = min(max(driver.decel, needed_deceleration(speed, gap, lead_speed, driver)), driver.emergency_decel)
    return max(free - driver.accel * ratio * ratio, -hardest)


@kernel
def needed_deceleration(speed: float, gap: float, lead_speed: float, driver: IdmDriver) -> float:
    """[m/s2] that stops half the minimum gap behind a leader which makes an emergency stop now."""
    lead_stop = max(lead_speed, 0.0) ** 2 / (2.0 * driver.emergency_decel)
    distance = max(gap - 0.5 * driver.min_gap, SMALLEST_GAP_M) + lead_stop
    return speed * speed / (2.0 * distance)


@kernel
def advance(speed: float, acceleration: float) -> tuple[float, float]:
    """(distance [m], speed [m/s]) after STEP_S at constant acceleration, standing still once stopped."""
    new_speed = speed + acceleration * STEP_S
    if new_speed < 0.0:
        return speed * speed / (-2.0 * acceleration), 0.0
    return 0.5 * (speed + new_speed) * STEP_S, new_speed


@kernel
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


@kernel
def _start_on(
    paths: Paths, m: int, box: Array, velocity: Array, driver: IdmDriver
) -> tuple[float, float, float, float]:
    """(path length, offset to the left, turn, speed) of a vehicle that starts to follow path m."""
    s, left = project_on_path(paths, m, box[0], box[1])
    difference = box[2] - pose_on_path(paths, m, s, 0.0, left, 0.0, driver.blend_length)[2]
    turn = (difference + math.pi) % (2.0 * math.pi) - math.pi
    return s, left, turn, max(0.0, velocity[0] * math.cos(box[2]) + velocity[1] * math.sin(box[2]))


@kernel
def _gap_to(
    paths: Paths, m: int, s: float, travelled: float, offset: float, turn: float, box: Array,
    other: Array, corners: Array, radius: float, driver: IdmDriver,
) -> tuple[float, float]:  # fmt: skip
    """(gap [m] from the bumper of `box` along its path to an other box, path heading there); inf: not in the way."""
    if not math.hypot(other[0] - box[0], other[1] - box[1]) <= driver.lookahead + box[3] + radius:
        return np.inf, 0.0  # also where it is absent (NaN)
    return corridor_gap(
        paths, m, s, travelled, offset, turn, 0.5 * box[3], 0.5 * box[4] + driver.corridor_margin,
        corners, other, radius, driver.blend_length, driver.lookahead,
    )  # fmt: skip


@kernel
def _must_brake(
    paths: Paths, m: int, i: int, box: Array, velocity: Array,
    boxes: Array, velocities: Array, mode: NDArray[np.int64], corners: Array, radius: Array, driver: IdmDriver,
) -> bool:  # fmt: skip
    """Does a driven vehicle on path m ask agent i, at `box`, for more than the comfortable deceleration?"""
    s, left, turn, speed = _start_on(paths, m, box, velocity, driver)
    if 0.5 * speed * speed <= driver.decel * SMALLEST_GAP_M:
        return False  # too slow to need it at any gap
    for j in range(mode.shape[0]):
        if j == i or mode[j] != DRIVEN:
            continue
        gap, h = _gap_to(paths, m, s, 0.0, left, turn, box, boxes[j], corners[j], radius[j], driver)
        if gap < np.inf:
            lead_speed = velocities[j, 0] * math.cos(h) + velocities[j, 1] * math.sin(h)
            if needed_deceleration(speed, gap, lead_speed, driver) > driver.decel:
                return True
    return False


@kernel
def _touches_driven(box: Array, row: Array, mode: NDArray[np.int64], but: int) -> bool:
    for j in range(mode.shape[0]):  # noqa: SIM110 (compiled)
        if j != but and mode[j] == DRIVEN and boxes_overlap(box, row[j]):
            return True
    return False


@kernel
def _is_free(box: Array, row: Array, mode: NDArray[np.int64], ego: Array, margin: float) -> bool:
    """Is a box, lengthened by `margin` at both ends, clear of everyone present and of the ego?"""
    grown = box.copy()
    grown[3] += 2.0 * margin
    if boxes_overlap(grown, ego):
        return False
    for j in range(mode.shape[0]):  # noqa: SIM110 (compiled)
        if mode[j] != ABSENT and boxes_overlap(grown, row[j]):
            return False
    return True


@kernel
def _has_room(
    box: Array, velocity: Array, row: Array, velocities: Array, mode: NDArray[np.int64],
    ego: Array, ego_velocity: Array, driver: IdmDriver,
) -> bool:  # fmt: skip
    """As _is_free, with a headway and the way to brake to the other's speed at both ends."""
    c, s = math.cos(box[2]), math.sin(box[2])
    speed = velocity[0] * c + velocity[1] * s
    grown = box.copy()
    for j in range(mode.shape[0] + 1):
        if j < mode.shape[0] and mode[j] == ABSENT:
            continue
        other, v = (ego, ego_velocity) if j == mode.shape[0] else (row[j], velocities[j])
        closing = speed - v[0] * c - v[1] * s
        margin = driver.min_gap + (driver.headway * speed + closing * closing / (2.0 * driver.decel))
        grown[3] = box[3] + 2.0 * margin
        if boxes_overlap(grown, other):
            return False
    return True


@kernel
def drive(
    start: int,
    log: AgentStates,
    now: AgentStates,
    roles: Roles,
    paths: Paths,
    ego_boxes: Array,
    ego_velocities: Array,
    driver: IdmDriver,
    yielding: Yielding | None,
) -> tuple[Array, Array, NDArray[np.bool_], Array, NDArray[np.bool_]]:
    """Boxes (T, N, 5), velocities (T, N, 2), valid (T, N), centre z (T, N) and who was driven (N,).

    start: the clip's step of row 0; log: the clip's tracks over all its steps; now: the agents at `start`;
    ego_boxes (T, 5), ego_velocities (T, 2): the ego's box (true centre) and world velocity, T = 41.
    """
    n_rows, n = ego_boxes.shape[0], now.valid.shape[0]
    n_log = log.valid.shape[0]
    boxes = np.full((n_rows, n, 5), np.nan)
    velocities = np.full((n_rows, n, 2), np.nan)
    valid = np.zeros((n_rows, n), np.bool_)
    center_z = np.full((n_rows, n), np.nan)
    boxes[0], velocities[0], valid[0], center_z[0] = now.boxes, now.velocities, now.valid, now.center_z

    mode, path = np.zeros(n, np.int64), np.full(n, -1)
    clock = roles.clock.copy()
    s, travelled, speed = np.zeros(n), np.zeros(n), np.zeros(n)
    offset, turn, base_z = np.zeros(n), np.zeros(n), np.zeros(n)
    was_driven = np.zeros(n, np.bool_)
    corners = np.zeros((n + 1, 4, 2))
    radius = np.zeros(n + 1)
    fresh, takes = np.zeros(n, np.int64), np.full(n, -1)

    for i in range(n):
        if now.valid[i]:
            mode[i] = STANDING if roles.standing[i] else REPLAYED

    for t in range(n_rows - 1):
        for j in range(n + 1):
            box = ego_boxes[t] if j == n else boxes[t, j]
            corners_of(box, corners[j])
            radius[j] = 0.5 * math.hypot(box[3], box[4])

        # Who is on the lane and due switches to IDM, at its own pose and speed; so does who must brake on its log.
        for i in range(n):
            takes[i] = -1
            if mode[i] != REPLAYED or not valid[t, i]:
                continue
            m = roles.path[i]
            if m >= 0 and clock[i] >= roles.join_step[i]:
                left = project_on_path(paths, m, boxes[t, i, 0], boxes[t, i, 1])[1]
                if abs(left) <= driver.largest_offset:
                    takes[i] = m
            m = roles.logged_path[i]
            if takes[i] < 0 and m >= 0 and _must_brake(
                paths, m, i, boxes[t, i], velocities[t, i], boxes[t], velocities[t], mode, corners, radius, driver
            ):  # fmt: skip
                takes[i] = m
        for i in range(n):
            m = takes[i]
            if m >= 0:
                mode[i], path[i], travelled[i] = DRIVEN, m, 0.0
                s[i], offset[i], turn[i], speed[i] = _start_on(paths, m, boxes[t, i], velocities[t, i], driver)
                if yielding is not None:
                    turn[i] = (turn[i] - turned_on(yielding, m, s[i]) + math.pi) % (2.0 * math.pi) - math.pi
                k = min(max(round(s[i] / PATH_SPACING_M), 0), paths.heading.shape[1] - 1)
                base_z[i] = center_z[t, i] - paths.height[m, k]

        # Everyone driven looks at row t and moves to row t + 1.
        s_now, speed_now = s.copy(), speed.copy()
        for i in range(n):
            if mode[i] != DRIVEN:
                continue
            m = path[i]
            length, width = boxes[t, i, 3], boxes[t, i, 4]
            held = start + t < roles.hold_until[i] and travelled[i] == 0.0 and m == roles.path[i]
            step_m, new_speed = 0.0, 0.0
            if not held:
                was_driven[i] = True
                k = min(max(round(s[i] / PATH_SPACING_M), 0), paths.heading.shape[1] - 1)
                target = paths.target_speed[m, k]
                free = max(driver.accel * (1.0 - (speed[i] / target) ** driver.exponent), -driver.decel)
                accel = following_acceleration(free, speed[i], np.inf, 0.0, driver)
                if yielding is not None:
                    accel = intended(
                        yielding, m, s[i], speed[i], start + t, free, driver.decel, driver.emergency_decel, driver.accel
                    )
                    free = driver.accel
                line = stop_line_gap(paths, m, t, s[i] + 0.5 * length, speed[i], driver.decel)
                if line < np.inf:
                    accel = min(accel, following_acceleration(free, speed[i], line, 0.0, driver))
                for j in range(n + 1):
                    if j == i or (j < n and mode[j] == ABSENT) or (j < n and not valid[t, j]):
                        continue
                    other = ego_boxes[t] if j == n else boxes[t, j]
                    gap, h = _gap_to(
                        paths, m, s[i], travelled[i], offset[i], turn[i], boxes[t, i],
                        other, corners[j], radius[j], driver,
                    )  # fmt: skip
                    if gap < np.inf:
                        v = ego_velocities[t] if j == n else velocities[t, j]
                        lead_speed = v[0] * math.cos(h) + v[1] * math.sin(h)
                        accel = min(accel, following_acceleration(free, speed[i], gap, lead_speed, driver))
                if yielding is not None:
                    for z in range(yielding.zone_start[m], yielding.zone_start[m + 1]):
                        j = yielding.zone_agent[z]
                        gap = waits_before(
                            yielding, z, start + t, s[i], speed[i], 0.5 * length,
                            valid[t, j], path[j] if mode[j] == DRIVEN else -1, mode[j] == REPLAYED, clock[j],
                            s_now[j], speed_now[j], 0.5 * boxes[t, j, 3], driver.emergency_decel, driver.accel,
                        )  # fmt: skip
                        if gap < np.inf:
                            accel = min(accel, following_acceleration(driver.accel, speed[i], gap, 0.0, driver))
                step_m, new_speed = advance(speed[i], accel)
            s[i] += step_m
            travelled[i] += step_m
            speed[i] = new_speed
            x, y, h = pose_on_path(paths, m, s[i], travelled[i], offset[i], turn[i], driver.blend_length)
            if yielding is not None:
                h += turned_on(yielding, m, s[i])
            k = min(max(round(s[i] / PATH_SPACING_M), 0), paths.heading.shape[1] - 1)
            if step_m == 0.0:
                boxes[t + 1, i] = boxes[t, i]  # a standing car keeps its box to the last bit
            else:
                boxes[t + 1, i, 0], boxes[t + 1, i, 1] = x, y
                boxes[t + 1, i, 2] = (h + math.pi) % (2.0 * math.pi) - math.pi
                boxes[t + 1, i, 3], boxes[t + 1, i, 4] = length, width
            velocities[t + 1, i, 0] = new_speed * math.cos(boxes[t + 1, i, 2])
            velocities[t + 1, i, 1] = new_speed * math.sin(boxes[t + 1, i, 2])
            center_z[t + 1, i] = base_z[i] + paths.height[m, k]
            valid[t + 1, i] = True

        # The others: the parked stay, the replayed take the next step of their log; who cannot brake along it (who
        # walks or cycles, or reverses) not where a driven car is.
        for i in range(n):
            if mode[i] == STANDING:
                boxes[t + 1, i], center_z[t + 1, i], valid[t + 1, i] = boxes[t, i], center_z[t, i], True
                velocities[t + 1, i] = 0.0
            elif mode[i] == REPLAYED:
                k = min(clock[i] + 1, n_log - 1)
                if roles.moving_kind[i] and roles.logged_path[i] < 0 and valid[t, i] and log.valid[k, i]:
                    blocked = _touches_driven(log.boxes[k, i], boxes[t + 1], mode, i)
                    # One that walks goes on once it is touched; a vehicle would drive through.
                    if blocked and (roles.enters_clear[i] or not _touches_driven(boxes[t, i], boxes[t + 1], mode, i)):
                        boxes[t + 1, i], center_z[t + 1, i], valid[t + 1, i] = boxes[t, i], center_z[t, i], True
                        velocities[t + 1, i] = 0.0
                        continue
                clock[i] = k
                if log.valid[k, i]:
                    boxes[t + 1, i], velocities[t + 1, i] = log.boxes[k, i], log.velocities[k, i]
                    center_z[t + 1, i], valid[t + 1, i] = log.center_z[k, i], True

        # Newcomers, judged against everyone who was already there.
        k = min(start + t + 1, n_log - 1)
        for i in range(n):
            fresh[i] = ABSENT
            if mode[i] != ABSENT or not log.valid[k, i]:
                continue
            box, ego = log.boxes[k, i], ego_boxes[t + 1]
            if roles.enters_clear[i]:
                far = math.hypot(box[0] - ego[0], box[1] - ego[1]) >= driver.enter_clearance
                free = _is_free(box, boxes[t + 1], mode, ego, driver.min_gap)
                if yielding is not None:
                    free = _has_room(
                        box, log.velocities[k, i], boxes[t + 1], velocities[t + 1], mode, ego, ego_velocities[t + 1],
                        driver,
                    )  # fmt: skip
                    v = math.hypot(log.velocities[k, i, 0], log.velocities[k, i, 1])
                    free = free and has_way(
                        yielding, roles.path[i], k, v, 0.5 * box[3], mode, path, s, speed, 0.5 * boxes[t + 1, :, 3],
                        driver.emergency_decel,
                    )  # fmt: skip
                if not (far and free):
                    continue
            elif roles.moving_kind[i] and _touches_driven(box, boxes[t + 1], mode, i):
                continue
            fresh[i] = STANDING if roles.standing[i] else REPLAYED
        for i in range(n):
            if fresh[i] != ABSENT:
                mode[i], clock[i] = fresh[i], k
                boxes[t + 1, i], velocities[t + 1, i] = log.boxes[k, i], log.velocities[k, i]
                center_z[t + 1, i], valid[t + 1, i] = log.center_z[k, i], True

    return boxes, velocities, valid, center_z, was_driven

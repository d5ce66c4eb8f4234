"""The Intelligent Driver Model: how hard one driver brakes or accelerates (Treiber et al. 2000; docs/reward.md 5).

    dv/dt = a [1 - (v / v0)^delta - (s* / gap)^2],   s* = s0 + v T + v (v - v_lead) / (2 sqrt(a b))

The published parameters are kept and speeds never go below zero. Unlike the public traffic a driver brakes harder than
`b` only where stopping behind the leader's own emergency stop needs it, and never harder than tyres can: logged drivers
follow closer than s* and would otherwise all stamp on the brake at the first step. Compiled.
"""

import math
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import hidden_kernel, inner_kernel, kernel
from tasks.rollout.corridor import (
    CLOSED_IF_STOPPABLE,
    OPEN,
    PATH_SPACING_M,
    Box,
    CorridorAhead,
    Paths,
    Way,
    boxes_overlap,
    corridor_ahead,
    corridor_gap,
    free_way,
    may_meet,
    near_corridor,
    pose_on_path,
    project_on_path,
)
from tasks.rollout.lane_following import SNAP_M
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import STEP_S
from tasks.world.geometry import wrapped

STOP_LINE_TOLERANCE_M = 1.0  # a car that stopped with its nose this far over the line still waits
SMALLEST_GAP_M = 0.1  # keeps s* / gap finite
SURELY_MPS2 = 1e-9  # above what rounding can do to an acceleration


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
def matters_within(free: float, speed: float, accel: float, lead_speed: float, driver: IdmDriver) -> float:
    """Gap [m] from which on a leader, `lead_speed` fast in any direction, leaves a driver at least `accel` [m/s2]."""
    spare = free - accel - SURELY_MPS2
    if spare <= 0.0:
        return np.inf
    closing = speed * (speed + lead_speed) / (2.0 * math.sqrt(driver.accel_max * driver.decel_max))
    desired = driver.min_gap_m + max(0.0, speed * driver.headway_s + closing)
    return max(desired * math.sqrt(driver.accel_max / spare), SMALLEST_GAP_M)


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


# What the traffic's kernels work on: NamedTuples of contiguous arrays, N agents, steps of STEP_S.
#
# No tuple holds another one: taking a tuple out of a tuple counts a reference to each of its arrays.

ABSENT, REPLAYED, DRIVEN, STANDING, EGO, TOWED = 0, 1, 2, 3, 4, 5  # what moves one at the moment


class Roles(NamedTuple):
    """What each of N agents does, whatever the ego does; for the traffic's kernels. Steps are the clip's."""

    path: Ints  # (N,) index of its path, -1: none
    logged_path: Ints  # (N,) index of the path along its own log, for one that may have to brake; -1: none
    join_step: Ints  # (N,) logged step from which it is driven, if it has a path
    hold_until: Ints  # (N,) a car that stands in its log does not start before
    clock: Ints  # (N,) step of its log it is at when the rollout starts
    standing: Bools  # (N,) parked
    moving_kind: Bools  # (N,) vehicle, pedestrian or bicycle: does not walk into a driven car
    enters_clear: Bools  # (N,) vehicles that may only enter with clearance to the ego
    first_part: Ints  # (N,) of the vehicle it is a part of, which moves it; itself where nothing tows it
    trails: Array  # (N, K, 2) where the way behind that led, newest first (trails_behind); NaN where it ends


class Yielding(NamedTuple):
    """What drivers mean to do on each of M paths, and the Z zones where two of them cannot be at once; S clip steps."""

    at: Array  # (M, S) path length that the log has come to [m]; never falls
    speed: Array  # (M, S) of the log there [m/s], 0 where it stands
    last: Ints  # (M,) step of the log's end
    turned: Array  # (M, P) of a body against the path [rad], as its log is
    zone_start: Ints  # (M + 1,) zones of path m: zone_start[m]..zone_start[m + 1] - 1
    zone_agent: Ints  # (Z,) whom the zone is shared with
    zone_path: Ints  # (Z,) on which path, -1: on its log
    zone_in: Array  # (Z,) path length at which the zone begins [m]
    zone_out: Array  # (Z,) and at which it ends
    other_in: Array  # (Z,) the same along the other's path [m]; or the first step of its log in there
    other_out: Array  # (Z,) and the last
    gives_way: Bools  # (Z,) the other one goes first
    trailing: Array  # (N,) what an agent tows reaches so far behind its own rear [m]; 0: it tows nothing


class AgentStates(NamedTuple):
    """Agents over S steps."""

    boxes: Array  # (S, N, 5) centre x, y [m], heading [rad], length, width [m]; NaN where absent
    velocities: Array  # (S, N, 2) [m/s]
    valid: Bools  # (S, N)
    center_z: Array  # (S, N) [m]


class RolloutRows(NamedTuple):
    """A rollout's T rows of N agents and, in the last place, the ego; the absent hold NaN and False."""

    boxes: Array  # (T, N + 1, 5) as in AgentStates
    velocities: Array  # (T, N + 1, 2) [m/s]
    valid: Bools  # (T, N + 1)
    center_z: Array  # (T, N + 1) [m]
    radius: Array  # (T, N + 1) around the box [m]


class Motion(NamedTuple):
    """How each agent moves at every row, those due having switched to IDM."""

    mode: Ints  # (T, N) ABSENT, REPLAYED, DRIVEN, STANDING, TOWED
    path: Ints  # (T, N) of one that is driven, -1: not driven
    clock: Ints  # (T, N) the step of its log a replayed one is at
    s: Array  # (T, N) path length [m]; of one that is towed behind the first part
    travelled: Array  # (T, N) since it is driven or towed [m]
    speed: Array  # (T, N) along the path [m/s]; of one that is towed above the first part's
    offset: Array  # (T, N) to the left of the path, when it switched to IDM [m]
    turn: Array  # (T, N) against the path, when it switched to IDM [rad]
    base_z: Array  # (T, N) its centre's height above the path's [m]
    was_driven: Bools  # (T, N) moved by IDM before


@kernel
def empty_rows(n_rows: int, n: int) -> RolloutRows:
    """Nobody there yet."""
    return RolloutRows(
        np.full((n_rows, n + 1, 5), np.nan),
        np.full((n_rows, n + 1, 2), np.nan),
        np.zeros((n_rows, n + 1), np.bool_),
        np.full((n_rows, n + 1), np.nan),
        np.full((n_rows, n + 1), np.nan),
    )


@kernel
def empty_motion(n_rows: int, n: int) -> Motion:
    """Nobody moves."""
    shape = (n_rows, n)
    return Motion(
        np.zeros(shape, np.int64), np.full(shape, -1), np.zeros(shape, np.int64),
        np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape),
        np.zeros(shape, np.bool_),
    )  # fmt: skip


_NONE, _NO_INT, _NO_BOOL = np.empty((0, 1)), np.empty((0, 0), np.int64), np.empty((0, 0), np.bool_)
NO_ROWS = (
    RolloutRows(np.empty((0, 1, 5)), np.empty((0, 1, 2)), _NO_BOOL, _NONE, _NONE),
    Motion(_NO_INT, _NO_INT, _NO_INT, _NONE, _NONE, _NONE, _NONE, _NONE, _NONE, _NO_BOOL),
)


@kernel
def begin_with(rows: RolloutRows, motion: Motion, first: RolloutRows, moved: Motion) -> None:
    """Take over the first rows of an answer to the same ego, or none."""
    n = len(first.valid)
    if n == 0:
        return
    rows.boxes[:n], rows.velocities[:n], rows.valid[:n] = first.boxes, first.velocities, first.valid
    rows.center_z[:n], rows.radius[:n] = first.center_z, first.radius
    motion.mode[:n], motion.path[:n], motion.clock[:n] = moved.mode, moved.path, moved.clock
    motion.s[:n], motion.travelled[:n], motion.speed[:n] = moved.s, moved.travelled, moved.speed
    motion.offset[:n], motion.turn[:n], motion.base_z[:n] = moved.offset, moved.turn, moved.base_z
    motion.was_driven[:n] = moved.was_driven


@hidden_kernel
def moves_off_log(mode: int) -> bool:
    """Is one in that mode where the simulation has it?"""
    return mode in (DRIVEN, TOWED)


# The traffic's rules for one agent: when it switches to IDM, how hard it drives, when it waits, when it enters.

LARGEST_OFFSET_M = SNAP_M + 2.0  # a start farther from the path stays on its log
CORRIDOR_MARGIN_M = 0.1  # beside the body, each side
ENTER_CLEARANCE_M = 30.0  # of the ego's centre from where a vehicle enters


@hidden_kernel
def nearest_point_index(paths: Paths, s: float) -> int:
    """Index of the path's point nearest to path length s."""
    return min(max(round(s / PATH_SPACING_M), 0), paths.heading.shape[1] - 1)


@hidden_kernel
def box_of(boxes: Array, t: int, i: int) -> Box:
    return boxes[t, i, 0], boxes[t, i, 1], boxes[t, i, 2], boxes[t, i, 3], boxes[t, i, 4]


@hidden_kernel
def forward_speed(rows: RolloutRows, t: int, i: int) -> float:
    h = rows.boxes[t, i, 2]
    return rows.velocities[t, i, 0] * math.cos(h) + rows.velocities[t, i, 1] * math.sin(h)


@hidden_kernel
def project_onto_path(
    paths: Paths, m: int, rows: RolloutRows, t: int, i: int, driver: IdmDriver
) -> tuple[float, float, float, float]:
    """(path length, offset to the left, turn, speed) of agent i if it starts to follow path m from row t."""
    s, left = project_on_path(paths, m, rows.boxes[t, i, 0], rows.boxes[t, i, 1])
    turn = wrapped(rows.boxes[t, i, 2] - pose_on_path(paths, m, s, 0.0, left, 0.0, driver.blend_length_m)[2])
    return s, left, turn, max(0.0, forward_speed(rows, t, i))


@hidden_kernel
def path_to_join(roles: Roles, paths: Paths, rows: RolloutRows, t: int, i: int, clock: int) -> int:
    """The path on which agent i, replayed, switches to IDM by itself: its own, once it is due and on it; or -1."""
    m = roles.path[i]
    if m < 0 or clock < roles.join_step[i]:
        return -1
    left = project_on_path(paths, m, rows.boxes[t, i, 0], rows.boxes[t, i, 1])[1]
    return m if abs(left) <= LARGEST_OFFSET_M else -1


@hidden_kernel
def way_along(rows: RolloutRows, t: int, i: int, m: int, s: float, travelled: float, offset: float, turn: float) -> Way:
    """Agent i, as big as in row t, on its way along path m."""
    front, half_width = 0.5 * rows.boxes[t, i, 3], 0.5 * rows.boxes[t, i, 4] + CORRIDOR_MARGIN_M
    return Way(m, s, travelled, offset, turn, front, half_width)


@hidden_kernel
def gap_to(
    paths: Paths, driver: IdmDriver, rows: RolloutRows, t: int, i: int, way: Way, view: CorridorAhead, j: int,
    within: float,
) -> tuple[float, float]:  # fmt: skip
    """(gap [m] from the bumper of agent i along its path to j, path heading there); inf: not in the way `within` m."""
    box, radius = box_of(rows.boxes, t, j), rows.radius[t, j]
    away = math.hypot(box[0] - rows.boxes[t, i, 0], box[1] - rows.boxes[t, i, 1])
    if away <= driver.lookahead_m + rows.boxes[t, i, 3] + radius and may_meet(
        paths.stretches, way.path, view, box, radius
    ):
        return corridor_gap(paths, way, box, radius, driver.blend_length_m, min(driver.lookahead_m, within))
    return np.inf, 0.0


@hidden_kernel
def must_brake(roles: Roles, paths: Paths, driver: IdmDriver, rows: RolloutRows, t: int, i: int, mode: Ints) -> bool:
    """Does a driven one ask agent i, on its logged path, for more than the comfortable deceleration?"""
    m = roles.logged_path[i]
    if m < 0:
        return False
    speed = max(0.0, forward_speed(rows, t, i))
    if 0.5 * speed * speed <= driver.decel_max * SMALLEST_GAP_M:
        return False  # too slow to need it at any gap
    s, left, turn, _ = project_onto_path(paths, m, rows, t, i, driver)
    way = way_along(rows, t, i, m, s, 0.0, left, turn)
    view = corridor_ahead(paths, way, driver.blend_length_m, driver.lookahead_m)
    for j in range(len(mode)):
        if (
            j == i
            or not moves_off_log(mode[j])
            or not near_corridor(view, rows.boxes[t, j, 0], rows.boxes[t, j, 1], rows.radius[t, j])
        ):
            continue
        gap, h = gap_to(paths, driver, rows, t, i, way, view, j, driver.lookahead_m)
        if gap < np.inf:
            lead_speed = rows.velocities[t, j, 0] * math.cos(h) + rows.velocities[t, j, 1] * math.sin(h)
            if needed_deceleration(speed, gap, lead_speed, driver) > driver.decel_max:
                return True
    return False


@hidden_kernel
def road_acceleration(paths: Paths, driver: IdmDriver, t: int, m: int, s: float, speed: float, length: float) -> float:
    """[m/s2] of one driven at path length s of path m, for the road alone: its target speed and its stop lines."""
    free = free_acceleration(speed, paths.target_speed[m, nearest_point_index(paths, s)], driver)
    accel = following_acceleration(free, speed, np.inf, 0.0, driver)
    line = stop_line_gap(paths, m, t, s + 0.5 * length, speed, driver.decel_max)
    if line < np.inf:
        accel = min(accel, following_acceleration(free, speed, line, 0.0, driver))
    return accel


@hidden_kernel
def acceleration_for_others(
    roles: Roles, paths: Paths, driver: IdmDriver, rows: RolloutRows, t: int, i: int, way: Way, speed: float,
    accel: float, yielding: Yielding | None, near: Ints,
) -> float:  # fmt: skip
    """Acceleration [m/s2] of agent i, driven, for the others but what it tows; `accel` without them. near: scratch.

    One that keeps its intent slows down for a leader from what it could do at most, not from what it means to do.
    """
    view = corridor_ahead(paths, way, driver.blend_length_m, driver.lookahead_m)
    if yielding is None:
        free = free_acceleration(speed, paths.target_speed[way.path, nearest_point_index(paths, way.s)], driver)
    else:
        free = driver.accel_max
    nose, travelled = way.s + way.front, way.travelled + way.front
    x, y, _ = pose_on_path(paths, way.path, nose, travelled, way.offset, way.turn, driver.blend_length_m)
    cell_radius, n, nearest, least = math.hypot(way.half_width, PATH_SPACING_M), 0, 0, np.inf
    for j in range(rows.valid.shape[1]):
        if (
            j == i
            or not rows.valid[t, j]
            or (j < len(roles.first_part) and roles.first_part[j] == i)
            or not near_corridor(view, rows.boxes[t, j, 0], rows.boxes[t, j, 1], rows.radius[t, j])
        ):
            continue
        away = free_way(x, y, cell_radius, box_of(rows.boxes, t, j), rows.radius[t, j])
        near[n] = j
        if away < least:
            nearest, least = n, away
        n += 1
    for k in range(n):
        j = near[nearest if k == 0 else k - (k <= nearest)]  # behind the nearest fewer matter
        lead_speed = math.hypot(rows.velocities[t, j, 0], rows.velocities[t, j, 1])
        within = matters_within(free, speed, accel, lead_speed, driver)
        if free_way(x, y, cell_radius, box_of(rows.boxes, t, j), rows.radius[t, j]) >= within:
            continue
        gap, h = gap_to(paths, driver, rows, t, i, way, view, j, within)
        if gap < np.inf:
            lead_speed = rows.velocities[t, j, 0] * math.cos(h) + rows.velocities[t, j, 1] * math.sin(h)
            behind = following_acceleration(free, speed, gap, lead_speed, driver)
            if behind < accel:
                accel = behind
    return accel


@hidden_kernel
def touches_driven(boxes: Array, k: int, i: int, rows: RolloutRows, t: int, mode: Ints) -> bool:
    """Does agent i at boxes[k, i] share area with a driven one in row t?"""
    box = box_of(boxes, k, i)
    radius = 0.5 * math.hypot(box[3], box[4])
    for j in range(len(mode)):
        if j == i or not moves_off_log(mode[j]):
            continue
        dx, dy, reach = rows.boxes[t, j, 0] - box[0], rows.boxes[t, j, 1] - box[1], radius + rows.radius[t, j]
        if dx * dx + dy * dy <= reach * reach and boxes_overlap(box, box_of(rows.boxes, t, j)):
            return True
    return False


@inner_kernel
def is_clear(
    roles: Roles, driver: IdmDriver, log: AgentStates, k: int, i: int,
    rows: RolloutRows, t: int, mode: Ints, yielding: Yielding | None,
) -> bool:  # fmt: skip
    """May agent i appear as in step k of its log, as far as those already there in row t let it?

    A vehicle needs the minimum gap at both ends; one that keeps its intent its headway too, and room to brake. Parts
    of one vehicle need nothing between them.
    """
    if not roles.enters_clear[i]:
        return not (roles.moving_kind[i] and touches_driven(log.boxes, k, i, rows, t, mode))
    x, y, heading, length, width = box_of(log.boxes, k, i)
    c, s, radius = math.cos(heading), math.sin(heading), 0.5 * (length + width)
    speed = log.velocities[k, i, 0] * c + log.velocities[k, i, 1] * s
    for j in range(len(mode)):
        if mode[j] == ABSENT or (j < len(roles.first_part) and roles.first_part[j] == roles.first_part[i]):
            continue
        margin = driver.min_gap_m
        if yielding is not None:
            closing = speed - rows.velocities[t, j, 0] * c - rows.velocities[t, j, 1] * s
            margin += driver.headway_s * speed + closing * closing / (2.0 * driver.decel_max)
        dx, dy, reach = rows.boxes[t, j, 0] - x, rows.boxes[t, j, 1] - y, radius + abs(margin) + rows.radius[t, j]
        if dx * dx + dy * dy > reach * reach:
            continue
        if boxes_overlap((x, y, heading, length + 2.0 * margin, width), box_of(rows.boxes, t, j)):
            return False
    return True


@hidden_kernel
def far_from_ego(roles: Roles, log_boxes: Array, k: int, i: int, rows: RolloutRows, t: int) -> bool:
    """May agent i appear as in step k of its log, as far as its distance to the ego in row t lets it?"""
    ego = rows.boxes.shape[1] - 1
    dx, dy = log_boxes[k, i, 0] - rows.boxes[t, ego, 0], log_boxes[k, i, 1] - rows.boxes[t, ego, 1]
    return not roles.enters_clear[i] or math.hypot(dx, dy) >= ENTER_CLEARANCE_M

"""The traffic's rules for one agent: when it switches to IDM, how hard it drives, when it waits, when it enters.

Each rule is an "or" or a "hardest of" over others, and is asked about a list of them: all, or only those who are not
where an earlier answer saw them. Compiled.
"""

import math

import numpy as np

from tasks.kernels.compiled import inner_kernel
from tasks.rollout.corridor import (
    PATH_SPACING_M,
    Box,
    CorridorAhead,
    Paths,
    Way,
    boxes_overlap,
    corridor_gap,
    in_view,
    look_ahead,
    may_meet,
    pose_on_path,
    project_on_path,
)
from tasks.rollout.idm import (
    SMALLEST_GAP_M,
    IdmDriver,
    following_acceleration,
    free_acceleration,
    needed_deceleration,
    stop_line_gap,
)
from tasks.rollout.lane_following import SNAP_M
from tasks.rollout.traffic_state import ABSENT, DRIVEN, NOBODY, AgentStates, Roles, RolloutRows, Yielding
from tasks.world.arrays import Array, Ints
from tasks.world.geometry import wrapped

LARGEST_OFFSET_M = SNAP_M + 2.0  # a start farther from the path stays on its log
CORRIDOR_MARGIN_M = 0.1  # beside the body, each side
ENTER_CLEARANCE_M = 30.0  # of the ego's centre from where a vehicle enters


@inner_kernel
def cell_of(paths: Paths, s: float) -> int:
    """Index of the path's point nearest to path length s."""
    return min(max(round(s / PATH_SPACING_M), 0), paths.heading.shape[1] - 1)


@inner_kernel
def box_of(boxes: Array, t: int, i: int) -> Box:
    return boxes[t, i, 0], boxes[t, i, 1], boxes[t, i, 2], boxes[t, i, 3], boxes[t, i, 4]


@inner_kernel
def _forward_speed(rows: RolloutRows, t: int, i: int) -> float:
    h = rows.boxes[t, i, 2]
    return max(0.0, rows.velocities[t, i, 0] * math.cos(h) + rows.velocities[t, i, 1] * math.sin(h))


@inner_kernel
def start_on(
    paths: Paths, m: int, rows: RolloutRows, t: int, i: int, driver: IdmDriver
) -> tuple[float, float, float, float]:
    """(path length, offset to the left, turn, speed) of agent i if it starts to follow path m from row t."""
    s, left = project_on_path(paths, m, rows.boxes[t, i, 0], rows.boxes[t, i, 1])
    turn = wrapped(rows.boxes[t, i, 2] - pose_on_path(paths, m, s, 0.0, left, 0.0, driver.blend_length_m)[2])
    return s, left, turn, _forward_speed(rows, t, i)


@inner_kernel
def due_path(roles: Roles, paths: Paths, rows: RolloutRows, t: int, i: int, clock: int) -> int:
    """The path on which agent i, replayed, switches to IDM by itself: its own, once it is due and on it; or -1."""
    m = roles.path[i]
    if m < 0 or clock < roles.join_step[i]:
        return -1
    left = project_on_path(paths, m, rows.boxes[t, i, 0], rows.boxes[t, i, 1])[1]
    return m if abs(left) <= LARGEST_OFFSET_M else -1


@inner_kernel
def way_of(rows: RolloutRows, t: int, i: int, m: int, s: float, travelled: float, offset: float, turn: float) -> Way:
    """Agent i, as big as in row t, on its way along path m."""
    front, half_width = 0.5 * rows.boxes[t, i, 3], 0.5 * rows.boxes[t, i, 4] + CORRIDOR_MARGIN_M
    return Way(m, s, travelled, offset, turn, front, half_width)


@inner_kernel
def gap_to(
    paths: Paths, driver: IdmDriver, rows: RolloutRows, t: int, i: int, way: Way, view: CorridorAhead, j: int
) -> tuple[float, float]:
    """(gap [m] from the bumper of agent i along its path to j, path heading there); inf: not in the way."""
    box, radius = box_of(rows.boxes, t, j), rows.radius[t, j]
    away = math.hypot(box[0] - rows.boxes[t, i, 0], box[1] - rows.boxes[t, i, 1])
    if away <= driver.lookahead_m + rows.boxes[t, i, 3] + radius and may_meet(
        paths.stretches, way.path, view, box, radius
    ):
        return corridor_gap(paths, way, box, radius, driver.blend_length_m, driver.lookahead_m)
    return np.inf, 0.0


@inner_kernel
def braked_for(
    roles: Roles, paths: Paths, driver: IdmDriver, rows: RolloutRows, t: int, i: int,
    mode: Ints, others: Ints, n_others: int,
) -> int:  # fmt: skip
    """The driven one that asks agent i, on its logged path, for more than the comfortable deceleration, or NOBODY."""
    m = roles.logged_path[i]
    if m < 0:
        return NOBODY
    speed = _forward_speed(rows, t, i)
    if 0.5 * speed * speed <= driver.decel_max * SMALLEST_GAP_M:
        return NOBODY  # too slow to need it at any gap
    s, left, turn, _ = start_on(paths, m, rows, t, i, driver)
    way = way_of(rows, t, i, m, s, 0.0, left, turn)
    view = look_ahead(paths, way, driver.blend_length_m, driver.lookahead_m)
    for a in range(n_others):
        j = others[a]
        if (
            j == i
            or mode[j] != DRIVEN
            or not in_view(view, rows.boxes[t, j, 0], rows.boxes[t, j, 1], rows.radius[t, j])
        ):
            continue
        gap, h = gap_to(paths, driver, rows, t, i, way, view, j)
        if gap < np.inf:
            lead_speed = rows.velocities[t, j, 0] * math.cos(h) + rows.velocities[t, j, 1] * math.sin(h)
            if needed_deceleration(speed, gap, lead_speed, driver) > driver.decel_max:
                return j
    return NOBODY


@inner_kernel
def road_acceleration(paths: Paths, driver: IdmDriver, t: int, m: int, s: float, speed: float, length: float) -> float:
    """[m/s2] of one driven at path length s of path m, for the road alone: its target speed and its stop lines."""
    free = free_acceleration(speed, paths.target_speed[m, cell_of(paths, s)], driver)
    accel = following_acceleration(free, speed, np.inf, 0.0, driver)
    line = stop_line_gap(paths, m, t, s + 0.5 * length, speed, driver.decel_max)
    if line < np.inf:
        accel = min(accel, following_acceleration(free, speed, line, 0.0, driver))
    return accel


@inner_kernel
def hardest_acceleration(
    paths: Paths, driver: IdmDriver, rows: RolloutRows, t: int, i: int, way: Way, speed: float,
    others: Ints, n_others: int, accel: float, leader: int, yielding: Yielding | None,
) -> tuple[float, int]:  # fmt: skip
    """(acceleration [m/s2], leader) of agent i, driven, for the others on the list; `accel` without them.

    One that keeps its intent slows down for a leader from what it could do at most, not from what it means to do.
    """
    view = look_ahead(paths, way, driver.blend_length_m, driver.lookahead_m)
    for a in range(n_others):
        j = others[a]
        if (
            j == i
            or not rows.valid[t, j]
            or not in_view(view, rows.boxes[t, j, 0], rows.boxes[t, j, 1], rows.radius[t, j])
        ):
            continue
        gap, h = gap_to(paths, driver, rows, t, i, way, view, j)
        if gap < np.inf:
            lead_speed = rows.velocities[t, j, 0] * math.cos(h) + rows.velocities[t, j, 1] * math.sin(h)
            if yielding is None:
                free = free_acceleration(speed, paths.target_speed[way.path, cell_of(paths, way.s)], driver)
            else:
                free = driver.accel_max
            behind = following_acceleration(free, speed, gap, lead_speed, driver)
            if behind < accel:
                accel, leader = behind, j
    return accel, leader


@inner_kernel
def touches_driven(
    boxes: Array, k: int, i: int, rows: RolloutRows, t: int, mode: Ints, others: Ints, n_others: int
) -> bool:
    """Does agent i at boxes[k, i] share area with a driven one of the list in row t?"""
    box = box_of(boxes, k, i)
    radius = 0.5 * math.hypot(box[3], box[4])
    for a in range(n_others):
        j = others[a]
        if j == i or mode[j] != DRIVEN:
            continue
        dx, dy, reach = rows.boxes[t, j, 0] - box[0], rows.boxes[t, j, 1] - box[1], radius + rows.radius[t, j]
        if dx * dx + dy * dy <= reach * reach and boxes_overlap(box, box_of(rows.boxes, t, j)):
            return True
    return False


@inner_kernel
def is_clear(
    roles: Roles, driver: IdmDriver, log: AgentStates, k: int, i: int,
    rows: RolloutRows, t: int, mode: Ints, others: Ints, n_others: int, yielding: Yielding | None,
) -> bool:  # fmt: skip
    """May agent i appear as in step k of its log, as far as those of the list, already there in row t, let it?

    A vehicle needs the minimum gap at both ends; one that keeps its intent its headway too, and room to brake.
    """
    if not roles.enters_clear[i]:
        return not (roles.moving_kind[i] and touches_driven(log.boxes, k, i, rows, t, mode, others, n_others))
    x, y, heading, length, width = box_of(log.boxes, k, i)
    for a in range(n_others):
        j = others[a]
        if mode[j] == ABSENT:
            continue
        margin = driver.min_gap_m
        if yielding is not None:
            c, s = math.cos(heading), math.sin(heading)
            speed = log.velocities[k, i, 0] * c + log.velocities[k, i, 1] * s
            closing = speed - rows.velocities[t, j, 0] * c - rows.velocities[t, j, 1] * s
            margin += driver.headway_s * speed + closing * closing / (2.0 * driver.decel_max)
        if boxes_overlap((x, y, heading, length + 2.0 * margin, width), box_of(rows.boxes, t, j)):
            return False
    return True


@inner_kernel
def far_from_ego(roles: Roles, log_boxes: Array, k: int, i: int, rows: RolloutRows, t: int) -> bool:
    """May agent i appear as in step k of its log, as far as its distance to the ego in row t lets it?"""
    ego = rows.boxes.shape[1] - 1
    dx, dy = log_boxes[k, i, 0] - rows.boxes[t, ego, 0], log_boxes[k, i, 1] - rows.boxes[t, ego, 1]
    return not roles.enters_clear[i] or math.hypot(dx, dy) >= ENTER_CLEARANCE_M

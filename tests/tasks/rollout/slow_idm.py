"""Slow twin of the traffic: every pair at every step, one ego at a time (docs/reward.md 5). Compiled.

Nobody is left out because it cannot matter: every box is asked for in every corridor, every edge of a path for the
nearest one. All agents look at the same instant and then move together. How one driver answers one gap, and what a
corridor finds of one box, is the product's, which test_idm.py holds against closed forms and shapely; so is where a
towed box is, which test_towing.py holds against a twin of its own.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel
from tasks.rollout.corridor import PATH_SPACING_M, Paths, Way, boxes_overlap, corridor_gap, pose_on_path
from tasks.rollout.idm import (
    ABSENT,
    CORRIDOR_MARGIN_M,
    DRIVEN,
    ENTER_CLEARANCE_M,
    LARGEST_OFFSET_M,
    REPLAYED,
    SMALLEST_GAP_M,
    STANDING,
    TOWED,
    AgentStates,
    IdmDriver,
    Roles,
    Yielding,
    advance,
    following_acceleration,
    free_acceleration,
    needed_deceleration,
    stop_line_gap,
)
from tasks.rollout.lane_following import hitch, towed_pose
from tasks.world.clip import STEP_S
from tests.tasks.rollout.slow_yielding import has_way, intended, turned_on, waits_before

Array = NDArray[np.float64]


@kernel
def project_on_path(paths: Paths, m: int, x: float, y: float) -> tuple[float, float]:
    """(path length, offset to the left) of the point of path m nearest to (x, y): of all of its edges."""
    x0, y0 = paths.xy[m, :-1, 0], paths.xy[m, :-1, 1]
    ex, ey, dx, dy = paths.xy[m, 1:, 0] - x0, paths.xy[m, 1:, 1] - y0, x - x0, y - y0
    f = np.minimum(np.maximum((dx * ex + dy * ey) / (ex * ex + ey * ey), 0.0), 1.0)
    squares = (dx - f * ex) ** 2 + (dy - f * ey) ** 2
    k = np.argmin(squares)
    return (k + f[k]) * PATH_SPACING_M, math.copysign(math.sqrt(squares[k]), ex[k] * dy[k] - ey[k] * dx[k])


@kernel
def _start_on(
    paths: Paths, m: int, box: Array, velocity: Array, driver: IdmDriver
) -> tuple[float, float, float, float]:
    """(path length, offset to the left, turn, speed) of a vehicle that starts to follow path m."""
    s, left = project_on_path(paths, m, box[0], box[1])
    difference = box[2] - pose_on_path(paths, m, s, 0.0, left, 0.0, driver.blend_length_m)[2]
    turn = (difference + math.pi) % (2.0 * math.pi) - math.pi
    return s, left, turn, max(0.0, velocity[0] * math.cos(box[2]) + velocity[1] * math.sin(box[2]))


@kernel
def _along(box: Array, velocity: Array) -> float:
    """[m/s] the way it is headed."""
    return velocity[0] * math.cos(box[2]) + velocity[1] * math.sin(box[2])


@kernel
def _gap_to(
    paths: Paths, m: int, s: float, travelled: float, offset: float, turn: float, box: Array, other: Array,
    driver: IdmDriver,
) -> tuple[float, float]:  # fmt: skip
    """(gap [m] from the bumper of `box` along its path to an other box, path heading there); inf: not in the way."""
    radius = 0.5 * math.hypot(other[3], other[4])
    if not math.hypot(other[0] - box[0], other[1] - box[1]) <= driver.lookahead_m + box[3] + radius:
        return np.inf, 0.0  # also where it is absent (NaN)
    way = Way(m, s, travelled, offset, turn, 0.5 * box[3], 0.5 * box[4] + CORRIDOR_MARGIN_M)
    return corridor_gap(paths, way, other, radius, driver.blend_length_m, driver.lookahead_m)


@kernel
def _must_brake(
    paths: Paths, m: int, i: int, box: Array, velocity: Array,
    boxes: Array, velocities: Array, mode: NDArray[np.int64], driver: IdmDriver,
) -> bool:  # fmt: skip
    """Does a driven vehicle on path m ask agent i, at `box`, for more than the comfortable deceleration?"""
    s, left, turn, speed = _start_on(paths, m, box, velocity, driver)
    if 0.5 * speed * speed <= driver.decel_max * SMALLEST_GAP_M:
        return False  # too slow to need it at any gap
    for j in range(mode.shape[0]):
        if j == i or (mode[j] != DRIVEN and mode[j] != TOWED):
            continue
        gap, h = _gap_to(paths, m, s, 0.0, left, turn, box, boxes[j], driver)
        if gap < np.inf:
            lead_speed = velocities[j, 0] * math.cos(h) + velocities[j, 1] * math.sin(h)
            if needed_deceleration(speed, gap, lead_speed, driver) > driver.decel_max:
                return True
    return False


@kernel
def _touches_driven(box: Array, row: Array, mode: NDArray[np.int64], but: int) -> bool:
    for j in range(mode.shape[0]):
        if j != but and (mode[j] == DRIVEN or mode[j] == TOWED) and boxes_overlap(box, row[j]):
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
        margin = driver.min_gap_m + (driver.headway_s * speed + closing * closing / (2.0 * driver.decel_max))
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
    yields: bool,
    yielding: Yielding,
) -> tuple[Array, Array, NDArray[np.bool_], Array, NDArray[np.bool_]]:
    """Boxes (T, N, 5), velocities (T, N, 2), valid (T, N), centre z (T, N) and who was driven (N,).

    start: the clip's step of row 0; log: the clip's tracks over all its steps; now: the agents at `start`;
    ego_boxes (T, 5), ego_velocities (T, 2): the ego's box (true centre) and world velocity, T = 41; `yielding` is
    looked at where drivers give way alone (of one type, so that all this is compiled once).
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
    fresh, takes, since = np.zeros(n, np.int64), np.full(n, -1), np.zeros(n, np.int64)
    parts_last = np.argsort(roles.first_part != np.arange(n), kind="mergesort")

    for i in range(n):
        if now.valid[i]:
            mode[i] = STANDING if roles.standing[i] else REPLAYED

    for t in range(n_rows - 1):
        # Who is on the lane and due switches to IDM, at its own pose and speed; so does who must brake on its log.
        for i in range(n):
            takes[i] = -1
            if mode[i] != REPLAYED or not valid[t, i]:
                continue
            m = roles.path[i]
            if m >= 0 and clock[i] >= roles.join_step[i]:
                left = project_on_path(paths, m, boxes[t, i, 0], boxes[t, i, 1])[1]
                if abs(left) <= LARGEST_OFFSET_M:
                    takes[i] = m
            m = roles.logged_path[i]
            if takes[i] < 0 and m >= 0 and _must_brake(
                paths, m, i, boxes[t, i], velocities[t, i], boxes[t], velocities[t], mode, driver
            ):  # fmt: skip
                takes[i] = m
        for i in range(n):
            m = takes[i]
            if m >= 0:
                mode[i], path[i], travelled[i] = DRIVEN, m, 0.0
                s[i], offset[i], turn[i], speed[i] = _start_on(paths, m, boxes[t, i], velocities[t, i], driver)
                if yields:
                    turn[i] = (turn[i] - turned_on(yielding, m, s[i]) + math.pi) % (2.0 * math.pi) - math.pi
                k = min(max(round(s[i] / PATH_SPACING_M), 0), paths.heading.shape[1] - 1)
                base_z[i] = center_z[t, i] - paths.height[m, k]

        for i in range(n):
            lead = roles.first_part[i]
            if lead != i and mode[i] == REPLAYED and mode[lead] == DRIVEN and valid[t, i]:
                mode[i], since[i], travelled[i] = TOWED, t, 0.0
                s[i], offset[i], turn[i] = hitch(boxes, valid, lead, t, roles.trails, i)
                speed[i] = _along(boxes[t, i], velocities[t, i]) - _along(boxes[t, lead], velocities[t, lead])
                base_z[i] = center_z[t, i] - center_z[t, lead]

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
                free = free_acceleration(speed[i], paths.target_speed[m, k], driver)
                accel = following_acceleration(free, speed[i], np.inf, 0.0, driver)
                if yields:
                    accel = intended(
                        yielding,
                        m,
                        s[i],
                        speed[i],
                        start + t,
                        free,
                        driver.decel_max,
                        driver.emergency_decel,
                        driver.accel_max,
                    )
                    free = driver.accel_max
                line = stop_line_gap(paths, m, t, s[i] + 0.5 * length, speed[i], driver.decel_max)
                if line < np.inf:
                    accel = min(accel, following_acceleration(free, speed[i], line, 0.0, driver))
                for j in range(n + 1):
                    if j == i or (j < n and (mode[j] == ABSENT or not valid[t, j] or roles.first_part[j] == i)):
                        continue
                    other = ego_boxes[t] if j == n else boxes[t, j]
                    gap, h = _gap_to(
                        paths, m, s[i], travelled[i], offset[i], turn[i], boxes[t, i],
                        other, driver,
                    )  # fmt: skip
                    if gap < np.inf:
                        v = ego_velocities[t] if j == n else velocities[t, j]
                        lead_speed = v[0] * math.cos(h) + v[1] * math.sin(h)
                        accel = min(accel, following_acceleration(free, speed[i], gap, lead_speed, driver))
                if yields:
                    for z in range(yielding.zone_start[m], yielding.zone_start[m + 1]):
                        j = yielding.zone_agent[z]
                        gap = waits_before(
                            yielding, z, start + t, s[i], speed[i], 0.5 * length,
                            valid[t, j], path[j] if mode[j] == DRIVEN else -1, mode[j] == REPLAYED, clock[j],
                            s_now[j], speed_now[j], 0.5 * boxes[t, j, 3], driver.emergency_decel, driver.accel_max,
                            yielding.trailing[i],
                        )  # fmt: skip
                        if gap < np.inf:
                            accel = min(accel, following_acceleration(driver.accel_max, speed[i], gap, 0.0, driver))
                step_m, new_speed = advance(speed[i], accel)
            s[i] += step_m
            travelled[i] += step_m
            speed[i] = new_speed
            x, y, h = pose_on_path(paths, m, s[i], travelled[i], offset[i], turn[i], driver.blend_length_m)
            if yields:
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

        for i in range(n):
            if mode[i] != TOWED:
                continue
            lead = roles.first_part[i]
            boxes[t + 1, i], valid[t + 1, i] = boxes[t, i], True
            center_z[t + 1, i] = center_z[t + 1, lead] + base_z[i]
            was_driven[i] = was_driven[lead]
            moved, most = boxes[t + 1, lead] - boxes[t, lead], driver.emergency_decel * STEP_S
            speed[i] = 0.0 if abs(speed[i]) <= most else speed[i] - math.copysign(most, speed[i])
            s[i] -= speed[i] * STEP_S
            if moved[0] != 0.0 or moved[1] != 0.0 or speed[i] != 0.0:
                travelled[i] += math.hypot(moved[0], moved[1])
                boxes[t + 1, i, 0], boxes[t + 1, i, 1], boxes[t + 1, i, 2] = towed_pose(
                    boxes, valid, lead, t + 1, since[i], roles.trails, i, s[i], offset[i], turn[i], travelled[i],
                    driver.blend_length_m,
                )  # fmt: skip
            v = _along(boxes[t + 1, lead], velocities[t + 1, lead]) + speed[i]
            velocities[t + 1, i, 0] = v * math.cos(boxes[t + 1, i, 2])
            velocities[t + 1, i, 1] = v * math.sin(boxes[t + 1, i, 2])

        # The others: the parked stay, the replayed take the next step of their log; who cannot brake along it (who
        # walks or cycles, or reverses) not where a driven car is.
        clock_before = clock.copy()
        for i in parts_last:
            if mode[i] == STANDING:
                boxes[t + 1, i], center_z[t + 1, i], valid[t + 1, i] = boxes[t, i], center_z[t, i], True
                velocities[t + 1, i] = 0.0
            elif mode[i] == REPLAYED:
                k, lead = min(clock[i] + 1, n_log - 1), roles.first_part[i]
                if lead != i and mode[lead] == REPLAYED and valid[t, lead]:
                    if clock[lead] == clock_before[lead] and valid[t, i]:
                        boxes[t + 1, i], center_z[t + 1, i], valid[t + 1, i] = boxes[t, i], center_z[t, i], True
                        velocities[t + 1, i] = 0.0
                        continue
                elif roles.moving_kind[i] and roles.logged_path[i] < 0 and valid[t, i] and log.valid[k, i]:
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
                far = math.hypot(box[0] - ego[0], box[1] - ego[1]) >= ENTER_CLEARANCE_M
                others = np.where(roles.first_part == roles.first_part[i], ABSENT, mode)
                free = _is_free(box, boxes[t + 1], others, ego, driver.min_gap_m)
                if yields:
                    free = _has_room(
                        box, log.velocities[k, i], boxes[t + 1], velocities[t + 1], others, ego, ego_velocities[t + 1],
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
            for j in range(n):  # the first part waits until all others that are not there can come with it
                if j != i and roles.first_part[j] == i and mode[j] == ABSENT and fresh[j] == ABSENT:
                    fresh[i] = ABSENT
        for i in range(n):
            lead = roles.first_part[i]
            kept_out = mode[lead] == ABSENT and fresh[lead] == ABSENT and log.valid[k, lead]
            if lead != i and (mode[lead] == DRIVEN or kept_out):
                fresh[i] = ABSENT
        for i in range(n):
            if fresh[i] != ABSENT:
                mode[i], clock[i] = fresh[i], k
                boxes[t + 1, i], velocities[t + 1, i] = log.boxes[k, i], log.velocities[k, i]
                center_z[t + 1, i], valid[t + 1, i] = log.center_z[k, i], True

    return boxes, velocities, valid, center_z, was_driven

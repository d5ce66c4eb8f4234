"""The traffic's steps around one ego: those on a path by IDM, the rest by its log. Compiled.

All agents look at the same instant and then move together, so their order does not matter. A leader is any box, the
ego included, that reaches into the corridor the driver's own body will sweep along its path. A vehicle that replays
its log switches to IDM, along its logged way, as soon as a driven vehicle there asks for more than the comfortable
deceleration; it stays there for the rest of the rollout. What a driven vehicle tows follows it (towing.py).
"""

import math

import numpy as np

from tasks.kernels.compiled import hidden_kernel, kernel
from tasks.rollout.corridor import Paths, pose_on_path, project_on_path
from tasks.rollout.idm import (
    ABSENT,
    DRIVEN,
    EGO,
    REPLAYED,
    STANDING,
    TOWED,
    AgentStates,
    IdmDriver,
    Motion,
    Roles,
    RolloutRows,
    Yielding,
    acceleration_for_others,
    advance,
    empty_motion,
    empty_rows,
    far_from_ego,
    forward_speed,
    is_clear,
    must_brake,
    nearest_point_index,
    path_to_join,
    project_onto_path,
    road_acceleration,
    touches_driven,
    way_along,
)
from tasks.rollout.towing import faster_than_first, hitch, towed_pose
from tasks.rollout.yielding import body_turn_at, intended_acceleration, may_enter, yielding_acceleration
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import STEP_S
from tasks.world.geometry import wrapped


@kernel
def drive(
    start: int, log: AgentStates, now: AgentStates, roles: Roles, paths: Paths, driver: IdmDriver,
    ego_boxes: Array, ego_velocities: Array, yielding: Yielding | None,
) -> tuple[RolloutRows, Motion]:  # fmt: skip
    """The traffic's answer to one ego: boxes (T, 5) (true centre) and world velocities (T, 2), T = 41.

    start: the clip's step of row 0; log: the clip's tracks over all its steps; now: the agents (1, N) at `start`;
    yielding: None where drivers have no intent but their target speed, and give way to nobody.
    """
    rows, motion = initial_rows(now, roles, ego_boxes, ego_velocities)
    mode, scratch = np.empty(len(roles.path) + 1, np.int64), np.empty(len(roles.path), np.int64)
    for t in range(ego_boxes.shape[0] - 1):
        _switch_to_idm(roles, paths, driver, t, rows, mode, scratch, motion, yielding)
        _drive_on(start, roles, paths, driver, t, rows, mode, motion, yielding)
        _tow(roles, driver, t, rows, mode, motion)
        _replay(log, roles, t, rows, mode, motion)
        _admit(start, log, roles, driver, t, rows, mode, scratch, motion, yielding)
    return rows, motion


@kernel
def initial_rows(now: AgentStates, roles: Roles, ego_boxes: Array, ego_velocities: Array) -> tuple[RolloutRows, Motion]:
    """Row 0 around one ego, boxes (T, 5) and velocities (T, 2), who is in all rows."""
    n_rows, n = ego_boxes.shape[0], roles.path.shape[0]
    rows, motion = empty_rows(n_rows, n), empty_motion(n_rows, n)
    for t in range(n_rows):
        for k in range(5):
            rows.boxes[t, n, k] = ego_boxes[t, k]
        rows.velocities[t, n, 0], rows.velocities[t, n, 1] = ego_velocities[t, 0], ego_velocities[t, 1]
        rows.valid[t, n] = True
        rows.radius[t, n] = 0.5 * math.hypot(ego_boxes[t, 3], ego_boxes[t, 4])
    for i in range(n):
        motion.clock[0, i] = roles.clock[i]
        _place(rows, 0, now, 0, i)
        rows.valid[0, i] = now.valid[0, i]
        if now.valid[0, i]:
            motion.mode[0, i] = STANDING if roles.standing[i] else REPLAYED
    return rows, motion


@kernel
def who_is_asked(
    start: int, roles: Roles, paths: Paths, driver: IdmDriver, t: int, rows: RolloutRows, motion: Motion
) -> tuple[Bools, Ints]:
    """(N,) whose next state a policy is asked for at row t, those driven and not held by their log; and the modes."""
    n = motion.mode.shape[1]
    mode, asked = np.empty(n + 1, np.int64), np.zeros(n, np.bool_)
    _switch_to_idm(roles, paths, driver, t, rows, mode, np.empty(n, np.int64), motion, None)
    for i in range(len(asked)):
        held = start + t < roles.hold_until[i] and motion.path[t, i] == roles.path[i] and not motion.was_driven[t, i]
        asked[i] = mode[i] == DRIVEN and not held
    return asked, mode


@kernel
def apply_policy_answer(
    start: int, log: AgentStates, roles: Roles, paths: Paths, driver: IdmDriver, t: int, asked: Bools, answer: Array,
    rows: RolloutRows, mode: Ints, motion: Motion,
) -> None:  # fmt: skip
    """From row t to row t + 1: who is asked by the answer (N, 4) x, y, heading, speed; the others as in `drive`."""
    for i in range(len(asked)):
        if mode[i] != DRIVEN:
            continue
        _stay(rows, t, i)
        if asked[i]:
            x, y, h, speed = answer[i, 0], answer[i, 1], wrapped(answer[i, 2]), answer[i, 3]
            m, s = motion.path[t, i], project_on_path(paths, motion.path[t, i], x, y)[0]
            rows.boxes[t + 1, i, 0], rows.boxes[t + 1, i, 1], rows.boxes[t + 1, i, 2] = x, y, h
            rows.velocities[t + 1, i, 0], rows.velocities[t + 1, i, 1] = speed * math.cos(h), speed * math.sin(h)
            rows.center_z[t + 1, i] = motion.base_z[t, i] + paths.height[m, nearest_point_index(paths, s)]
            motion.was_driven[t + 1, i] = True
    _tow(roles, driver, t, rows, mode, motion)
    _replay(log, roles, t, rows, mode, motion)
    _admit(start, log, roles, driver, t, rows, mode, np.empty(len(asked), np.int64), motion, None)


@hidden_kernel
def _place(rows: RolloutRows, t: int, source: AgentStates, k: int, i: int) -> None:
    """Agent i, in row t, is where it is in step k of a world."""
    for c in range(5):
        rows.boxes[t, i, c] = source.boxes[k, i, c]
    rows.velocities[t, i, 0], rows.velocities[t, i, 1] = source.velocities[k, i, 0], source.velocities[k, i, 1]
    rows.center_z[t, i], rows.valid[t, i] = source.center_z[k, i], True
    rows.radius[t, i] = 0.5 * math.hypot(source.boxes[k, i, 3], source.boxes[k, i, 4])


@hidden_kernel
def _stay(rows: RolloutRows, t: int, i: int) -> None:
    """Agent i, in row t + 1, stands where it is in row t."""
    for k in range(5):
        rows.boxes[t + 1, i, k] = rows.boxes[t, i, k]
    rows.velocities[t + 1, i, 0], rows.velocities[t + 1, i, 1] = 0.0, 0.0
    rows.center_z[t + 1, i], rows.radius[t + 1, i] = rows.center_z[t, i], rows.radius[t, i]
    rows.valid[t + 1, i] = True


@hidden_kernel
def _switch_to_idm(
    roles: Roles, paths: Paths, driver: IdmDriver, t: int,
    rows: RolloutRows, mode: Ints, switch: Ints, motion: Motion, yielding: Yielding | None,
) -> None:  # fmt: skip
    """Who is on its path and due switches to IDM, at its own pose and speed; so does who must brake on its log.

    What it tows is moved by it from then on.
    Fills what moves each agent, and the ego, from row t on (N + 1,); row t + 1 of the motion is row t's. switch: (N,)
    scratch.
    """
    n = motion.mode.shape[1]
    mode[n] = EGO
    for i in range(n):
        mode[i], switch[i] = motion.mode[t, i], -1
    for i in range(n):
        if mode[i] == REPLAYED and rows.valid[t, i]:
            switch[i] = path_to_join(roles, paths, rows, t, i, motion.clock[t, i])
            if switch[i] < 0 and must_brake(roles, paths, driver, rows, t, i, mode):
                switch[i] = roles.logged_path[i]
    for i in range(n):
        m = switch[i]
        if m >= 0:
            mode[i] = DRIVEN
            s, offset, turn, speed = project_onto_path(paths, m, rows, t, i, driver)
            if yielding is not None:
                turn = wrapped(turn - body_turn_at(yielding, m, s))
            motion.mode[t, i], motion.path[t, i], motion.travelled[t, i] = DRIVEN, m, 0.0
            motion.s[t, i], motion.offset[t, i], motion.turn[t, i], motion.speed[t, i] = s, offset, turn, speed
            motion.base_z[t, i] = rows.center_z[t, i] - paths.height[m, nearest_point_index(paths, s)]
        first = roles.first_part[i]
        if first != i and mode[i] == REPLAYED and rows.valid[t, i] and (mode[first] == DRIVEN or switch[first] >= 0):
            mode[i] = TOWED
            away, offset, turn = hitch(rows.boxes, rows.valid, first, t, roles.trails, i)
            motion.mode[t, i], motion.s[t, i], motion.travelled[t, i] = TOWED, away, 0.0
            motion.offset[t, i], motion.turn[t, i] = offset, turn
            motion.speed[t, i] = forward_speed(rows, t, i) - forward_speed(rows, t, first)
            motion.base_z[t, i] = rows.center_z[t, i] - rows.center_z[t, first]
        motion.mode[t + 1, i], motion.path[t + 1, i] = motion.mode[t, i], motion.path[t, i]
        motion.clock[t + 1, i], motion.s[t + 1, i] = motion.clock[t, i], motion.s[t, i]
        motion.travelled[t + 1, i], motion.speed[t + 1, i] = motion.travelled[t, i], motion.speed[t, i]
        motion.offset[t + 1, i], motion.turn[t + 1, i] = motion.offset[t, i], motion.turn[t, i]
        motion.base_z[t + 1, i] = motion.base_z[t, i]
        motion.was_driven[t + 1, i] = motion.was_driven[t, i]


@hidden_kernel
def _drive_on(
    start: int, roles: Roles, paths: Paths, driver: IdmDriver, t: int,
    rows: RolloutRows, mode: Ints, motion: Motion, yielding: Yielding | None,
) -> None:  # fmt: skip
    """Those who are driven look at row t and move."""
    for i in range(motion.mode.shape[1]):
        if mode[i] != DRIVEN:
            continue
        m, s, travelled, speed = motion.path[t, i], motion.s[t, i], motion.travelled[t, i], motion.speed[t, i]
        if start + t < roles.hold_until[i] and travelled == 0.0 and m == roles.path[i]:
            _advance(paths, driver, t, i, 0.0, 0.0, rows, motion, yielding)
            continue
        if yielding is None:
            accel = road_acceleration(paths, driver, t, m, s, speed, rows.boxes[t, i, 3])
        else:
            nose = s + 0.5 * rows.boxes[t, i, 3]
            accel = intended_acceleration(yielding, paths, driver, m, s, speed, start, t, nose)
        way = way_along(rows, t, i, m, s, travelled, motion.offset[t, i], motion.turn[t, i])
        accel = acceleration_for_others(roles, paths, driver, rows, t, i, way, speed, accel, yielding)
        if yielding is not None:
            accel = yielding_acceleration(yielding, driver, start, t, i, m, s, speed, rows, mode, motion, accel)
        motion.was_driven[t + 1, i] = True
        step_m, new_speed = advance(speed, accel)
        _advance(paths, driver, t, i, step_m, new_speed, rows, motion, yielding)


@hidden_kernel
def _advance(
    paths: Paths, driver: IdmDriver, t: int, i: int, step_m: float, new_speed: float, rows: RolloutRows, motion: Motion,
    yielding: Yielding | None,
) -> None:  # fmt: skip
    """Agent i, driven, is `step_m` on along its path in row t + 1."""
    m, s, travelled = motion.path[t + 1, i], motion.s[t + 1, i] + step_m, motion.travelled[t + 1, i] + step_m
    motion.s[t + 1, i], motion.travelled[t + 1, i], motion.speed[t + 1, i] = s, travelled, new_speed
    _stay(rows, t, i)  # a standing car keeps its box to the last bit
    if step_m != 0.0:
        offset, turn = motion.offset[t + 1, i], motion.turn[t + 1, i]
        x, y, h = pose_on_path(paths, m, s, travelled, offset, turn, driver.blend_length_m)
        rows.boxes[t + 1, i, 0], rows.boxes[t + 1, i, 1] = x, y
        if yielding is not None:
            h += body_turn_at(yielding, m, s)
        rows.boxes[t + 1, i, 2] = wrapped(h)
    h = rows.boxes[t + 1, i, 2]
    rows.velocities[t + 1, i, 0], rows.velocities[t + 1, i, 1] = new_speed * math.cos(h), new_speed * math.sin(h)
    rows.center_z[t + 1, i] = motion.base_z[t + 1, i] + paths.height[m, nearest_point_index(paths, s)]


@hidden_kernel
def _tow(roles: Roles, driver: IdmDriver, t: int, rows: RolloutRows, mode: Ints, motion: Motion) -> None:
    """Those towed come after what tows them, which is in row t + 1 already."""
    for i in range(motion.mode.shape[1]):
        if mode[i] != TOWED:
            continue
        first, since = roles.first_part[i], t
        while since > 0 and motion.mode[since - 1, i] == TOWED:
            since -= 1
        _stay(rows, t, i)
        step_m = math.hypot(
            rows.boxes[t + 1, first, 0] - rows.boxes[t, first, 0], rows.boxes[t + 1, first, 1] - rows.boxes[t, first, 1]
        )
        faster = faster_than_first(motion.speed[t, i], driver.emergency_decel)
        motion.speed[t + 1, i], motion.s[t + 1, i] = faster, motion.s[t, i] - faster * STEP_S
        motion.travelled[t + 1, i] += step_m
        if step_m > 0.0 or faster != 0.0:
            x, y, h = towed_pose(
                rows.boxes, rows.valid, first, t + 1, since, roles.trails, i,
                motion.s[t + 1, i], motion.offset[t, i], motion.turn[t, i], motion.travelled[t + 1, i],
                driver.blend_length_m,
            )  # fmt: skip
            rows.boxes[t + 1, i, 0], rows.boxes[t + 1, i, 1], rows.boxes[t + 1, i, 2] = x, y, h
        h, v = rows.boxes[t + 1, i, 2], forward_speed(rows, t + 1, first) + faster
        rows.velocities[t + 1, i, 0], rows.velocities[t + 1, i, 1] = v * math.cos(h), v * math.sin(h)
        rows.center_z[t + 1, i] = rows.center_z[t + 1, first] + motion.base_z[t, i]
        motion.was_driven[t + 1, i] = motion.was_driven[t + 1, first]


@hidden_kernel
def _replay(log: AgentStates, roles: Roles, t: int, rows: RolloutRows, mode: Ints, motion: Motion) -> None:
    """The parked stay, the replayed take the next step of their log.

    Who cannot brake along its log (who walks or cycles, or reverses) takes none to where a driven car is; one that
    walks goes on once it is touched, a vehicle would drive through. What is towed waits as what tows it does.
    """
    for towed in (False, True):  # what tows before what it tows
        for i in range(motion.mode.shape[1]):
            first = roles.first_part[i]
            if (first != i) != towed:
                continue
            if mode[i] == STANDING:
                _stay(rows, t, i)
            if mode[i] != REPLAYED:
                continue
            k = min(motion.clock[t, i] + 1, log.valid.shape[0] - 1)
            waits = False
            if towed and mode[first] == REPLAYED and rows.valid[t, first]:
                waits = rows.valid[t, i] and motion.clock[t + 1, first] == motion.clock[t, first]
            elif roles.moving_kind[i] and roles.logged_path[i] < 0 and rows.valid[t, i] and log.valid[k, i]:
                waits = touches_driven(log.boxes, k, i, rows, t + 1, mode) and (
                    roles.enters_clear[i] or not touches_driven(rows.boxes, t, i, rows, t + 1, mode)
                )
            if waits:
                _stay(rows, t, i)
            else:
                motion.clock[t + 1, i] = k
                if log.valid[k, i]:
                    _place(rows, t + 1, log, k, i)


@hidden_kernel
def _admit(
    start: int, log: AgentStates, roles: Roles, driver: IdmDriver, t: int,
    rows: RolloutRows, mode: Ints, enters: Ints, motion: Motion, yielding: Yielding | None,
) -> None:  # fmt: skip
    """Newcomers, judged against everyone who was already there. enters: (N,) scratch.

    The parts of one vehicle enter together, or by their log behind one that is not there yet, or is on its log.
    """
    n = motion.mode.shape[1]
    k = min(start + t + 1, log.valid.shape[0] - 1)
    for i in range(n):
        enters[i] = False
        if mode[i] != ABSENT or not log.valid[k, i]:
            continue
        enters[i] = far_from_ego(roles, log.boxes, k, i, rows, t + 1) and is_clear(
            roles, driver, log, k, i, rows, t + 1, mode, yielding
        )
        if yielding is not None and enters[i] and roles.path[i] >= 0:
            enters[i] = may_enter(yielding, driver, roles.path[i], k, t + 1, log, i, rows, mode, motion)
    for i in range(n):
        if roles.first_part[i] != i and mode[i] == ABSENT and not enters[i]:
            enters[roles.first_part[i]] = False
    for i in range(n):
        first = roles.first_part[i]
        kept_out = mode[first] == ABSENT and log.valid[k, first] and not enters[first]
        if first != i and (mode[first] == DRIVEN or kept_out):
            enters[i] = False
    for i in range(n):
        if enters[i]:
            motion.mode[t + 1, i], motion.clock[t + 1, i] = STANDING if roles.standing[i] else REPLAYED, k
            _place(rows, t + 1, log, k, i)

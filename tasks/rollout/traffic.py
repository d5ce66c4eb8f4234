"""The traffic's steps: those on a path by IDM, the rest by its log; against one ego, or against many at once.

All agents look at the same instant and then move together, so their order does not matter. A leader is any box, the
ego included, that reaches into the corridor the driver's own body will sweep along its path. A vehicle that replays
its log switches to IDM, along its logged way, as soon as a driven vehicle there asks for more than the comfortable
deceleration; it stays there for the rest of the rollout.

Against many egos most agents do the same. One rollout without an ego is recorded: what each agent did in each step and
because of whom. Against an ego an agent keeps to the record until the ego, or an agent that has diverged from the
record before, changes its answer; then it has diverged too and is asked anew at every step. Every rule is an "or" or a
"hardest of" over others (rules.py), so an answer of the record that no diverged agent gave stands, and only the
diverged are to be asked: the outcome is the very same, to the last bit. Compiled.
"""

import math

import numpy as np

from tasks.kernels.compiled import hidden_kernel, kernel
from tasks.rollout.corridor import Paths, pose_on_path, project_on_path
from tasks.rollout.idm import (
    ABSENT,
    DRIVEN,
    EGO,
    NOBODY,
    REPLAYED,
    STANDING,
    AgentStates,
    Diverged,
    IdmDriver,
    Motion,
    Roles,
    RolloutRows,
    Yielding,
    advance,
    braked_for,
    cell_of,
    due_path,
    empty_motion,
    empty_rows,
    far_from_ego,
    hardest_acceleration,
    is_clear,
    nobody_diverged,
    road_acceleration,
    start_on,
    touches_driven,
    way_of,
)
from tasks.rollout.yielding import has_way, intended_acceleration, turned_at, yields_for
from tasks.world.arrays import Array, Bools
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
    rows, motion, diverged = first_row(now, roles, ego_boxes, ego_velocities)
    for t in range(ego_boxes.shape[0] - 1):
        _step(start, log, roles, paths, driver, t, rows, diverged, motion, motion, yielding)
    return rows, motion


@kernel
def first_row(
    now: AgentStates, roles: Roles, ego_boxes: Array, ego_velocities: Array
) -> tuple[RolloutRows, Motion, Diverged]:
    """Row 0 around one ego, boxes (T, 5) and velocities (T, 2); everybody is to be asked at every step."""
    n_rows, n = ego_boxes.shape[0], roles.path.shape[0]
    rows, motion, diverged = empty_rows(n_rows, n), empty_motion(n_rows, n), nobody_diverged(n)
    _set_ego(rows, diverged, ego_boxes, ego_velocities)
    for i in range(n):
        _diverge(diverged, i)
        motion.clock[0, i] = roles.clock[i]
        _place(rows, 0, now, 0, i)
        rows.valid[0, i] = now.valid[0, i]
        if now.valid[0, i]:
            motion.mode[0, i] = STANDING if roles.standing[i] else REPLAYED
    return rows, motion, diverged


@kernel
def begin_step(
    start: int, roles: Roles, paths: Paths, driver: IdmDriver, t: int, rows: RolloutRows, diverged: Diverged,
    motion: Motion,
) -> Bools:  # fmt: skip
    """(N,) whose next state a policy is asked for at row t: who is driven, and is not held by its log."""
    _switch_to_idm(roles, paths, driver, t, rows, diverged, motion, motion, None)
    asked = np.zeros(motion.mode.shape[1], np.bool_)
    for i in range(len(asked)):
        _carry(motion, t, motion, t + 1, i)
        held = start + t < roles.hold_until[i] and motion.path[t, i] == roles.path[i] and not motion.was_driven[t, i]
        asked[i] = diverged.mode[i] == DRIVEN and not held
    return asked


@kernel
def finish_step(
    start: int, log: AgentStates, roles: Roles, paths: Paths, driver: IdmDriver, t: int, asked: Bools, answer: Array,
    rows: RolloutRows, diverged: Diverged, motion: Motion,
) -> None:  # fmt: skip
    """From row t to row t + 1: who is asked by the answer (N, 4) x, y, heading, speed; the others as in `drive`."""
    for i in range(len(asked)):
        if diverged.mode[i] != DRIVEN:
            continue
        _stay(rows, t, i)
        if asked[i]:
            x, y, h, speed = answer[i, 0], answer[i, 1], wrapped(answer[i, 2]), answer[i, 3]
            m, s = motion.path[t, i], project_on_path(paths, motion.path[t, i], x, y)[0]
            rows.boxes[t + 1, i, 0], rows.boxes[t + 1, i, 1], rows.boxes[t + 1, i, 2] = x, y, h
            rows.velocities[t + 1, i, 0], rows.velocities[t + 1, i, 1] = speed * math.cos(h), speed * math.sin(h)
            rows.center_z[t + 1, i] = motion.base_z[t, i] + paths.height[m, cell_of(paths, s)]
            motion.was_driven[t + 1, i] = True
    _replay(log, roles, t, rows, diverged, motion, motion)
    _admit(start, log, roles, driver, t, rows, diverged, motion, motion, None)


@kernel
def drive_many(
    start: int, log: AgentStates, now: AgentStates, roles: Roles, paths: Paths, driver: IdmDriver,
    ego_boxes: Array, ego_velocities: Array, yielding: Yielding | None,
) -> tuple[Array, Array, Bools, Bools]:  # fmt: skip
    """The traffic's answer to each of B egos (B, T, 5), (B, T, 2): as `drive` to it alone, to the last bit.

    Boxes (B, T, N, 5), velocities (B, T, N, 2), valid (B, T, N) and who was driven (B, N).
    """
    n_egos, n_rows, n = ego_boxes.shape[0], ego_boxes.shape[1], roles.path.shape[0]
    nowhere = np.full((n_rows, 5), np.inf)
    recorded, record = drive(start, log, now, roles, paths, driver, nowhere, np.zeros((n_rows, 2)), yielding)
    boxes, velocities = np.empty((n_egos, n_rows, n, 5)), np.empty((n_egos, n_rows, n, 2))
    valid, was_driven = np.empty((n_egos, n_rows, n), np.bool_), np.empty((n_egos, n), np.bool_)
    rows, motion, diverged = empty_rows(n_rows, n), empty_motion(n_rows, n), nobody_diverged(n)
    for b in range(n_egos):
        for t in range(n_rows):
            for i in range(n + 1):
                _copy(recorded, t, i, rows.boxes, rows.velocities, rows.valid)
                rows.center_z[t, i], rows.radius[t, i] = recorded.center_z[t, i], recorded.radius[t, i]
        diverged.found[:], diverged.size[0] = False, 0
        _set_ego(rows, diverged, ego_boxes[b], ego_velocities[b])
        for t in range(n_rows - 1):
            _step(start, log, roles, paths, driver, t, rows, diverged, motion, record, yielding)
        for t in range(n_rows):
            for i in range(n):
                _copy(rows, t, i, boxes[b], velocities[b], valid[b])
        for i in range(n):
            moved = motion.was_driven if diverged.found[i] else record.was_driven
            was_driven[b, i] = moved[n_rows - 1, i]
    return boxes, velocities, valid, was_driven


@hidden_kernel
def _copy(rows: RolloutRows, t: int, i: int, boxes: Array, velocities: Array, valid: Bools) -> None:
    """Where i is in row t; element by element: numba takes seconds to compile the copy of a slice."""
    for k in range(5):
        boxes[t, i, k] = rows.boxes[t, i, k]
    velocities[t, i, 0], velocities[t, i, 1] = rows.velocities[t, i, 0], rows.velocities[t, i, 1]
    valid[t, i] = rows.valid[t, i]


@kernel
def _set_ego(rows: RolloutRows, diverged: Diverged, boxes: Array, velocities: Array) -> None:
    ego = len(diverged.found) - 1
    for t in range(boxes.shape[0]):
        for k in range(5):
            rows.boxes[t, ego, k] = boxes[t, k]
        rows.velocities[t, ego, 0], rows.velocities[t, ego, 1] = velocities[t, 0], velocities[t, 1]
        rows.valid[t, ego] = True
        rows.radius[t, ego] = 0.5 * math.hypot(boxes[t, 3], boxes[t, 4])
    diverged.mode[ego] = EGO
    _diverge(diverged, ego)


@hidden_kernel
def _diverge(diverged: Diverged, i: int) -> None:
    diverged.found[i] = True
    diverged.listed[diverged.size[0]] = i
    diverged.size[0] += 1


@hidden_kernel
def _diverge_at(t: int, i: int, r: int, rows: RolloutRows, diverged: Diverged, motion: Motion, record: Motion) -> None:
    """Agent i diverges from step t on: its motion there becomes motion at row r; it is not in row t + 1 yet."""
    _diverge(diverged, i)
    _carry(record, t, motion, r, i)
    _vanish(rows, t + 1, i)


@hidden_kernel
def _carry(of: Motion, t: int, to: Motion, r: int, i: int) -> None:
    """What agent i was at row t of one rollout it is at row r of another."""
    to.mode[r, i], to.path[r, i], to.clock[r, i] = of.mode[t, i], of.path[t, i], of.clock[t, i]
    to.s[r, i], to.travelled[r, i], to.speed[r, i] = of.s[t, i], of.travelled[t, i], of.speed[t, i]
    to.offset[r, i], to.turn[r, i], to.base_z[r, i] = of.offset[t, i], of.turn[t, i], of.base_z[t, i]
    to.was_driven[r, i] = of.was_driven[t, i]


@hidden_kernel
def _vanish(rows: RolloutRows, t: int, i: int) -> None:
    for k in range(5):
        rows.boxes[t, i, k] = np.nan
    rows.velocities[t, i, 0], rows.velocities[t, i, 1] = np.nan, np.nan
    rows.center_z[t, i], rows.radius[t, i], rows.valid[t, i] = np.nan, np.nan, False


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
def _step(
    start: int, log: AgentStates, roles: Roles, paths: Paths, driver: IdmDriver, t: int,
    rows: RolloutRows, diverged: Diverged, motion: Motion, record: Motion, yielding: Yielding | None,
) -> None:  # fmt: skip
    """From row t to row t + 1; `record`: the motion of another rollout, for those that have not diverged."""
    _switch_to_idm(roles, paths, driver, t, rows, diverged, motion, record, yielding)
    for i in range(motion.mode.shape[1]):
        if diverged.found[i]:
            _carry(motion, t, motion, t + 1, i)
    _drive_on(start, roles, paths, driver, t, rows, diverged, motion, record, yielding)
    _replay(log, roles, t, rows, diverged, motion, record)
    _admit(start, log, roles, driver, t, rows, diverged, motion, record, yielding)


@hidden_kernel
def _switch_to_idm(
    roles: Roles, paths: Paths, driver: IdmDriver, t: int,
    rows: RolloutRows, diverged: Diverged, motion: Motion, record: Motion, yielding: Yielding | None,
) -> None:  # fmt: skip
    """Who is on its path and due switches to IDM, at its own pose and speed; so does who must brake on its log."""
    n, mode = motion.mode.shape[1], diverged.mode
    for i in range(n):
        if diverged.found[i]:
            mode[i] = motion.mode[t, i]
            _vanish(rows, t + 1, i)
        else:
            mode[i] = REPLAYED if record.switch[t, i] >= 0 else record.mode[t, i]
    for i in range(n):
        motion.switch[t, i], motion.switch_for[t, i] = -1, NOBODY
        if mode[i] != REPLAYED or not rows.valid[t, i]:
            continue
        afresh, switch, switch_for = diverged.found[i], -1, NOBODY
        if not afresh:
            switch, switch_for = record.switch[t, i], record.switch_for[t, i]
            afresh = switch_for != NOBODY and diverged.found[switch_for]
        if afresh:
            clock = motion.clock[t, i] if diverged.found[i] else record.clock[t, i]
            switch, switch_for = due_path(roles, paths, rows, t, i, clock), NOBODY
        if switch < 0:
            others = diverged.everyone if afresh else diverged.listed
            n_others = len(others) if afresh else diverged.size[0]
            switch_for = braked_for(roles, paths, driver, rows, t, i, mode, others, n_others)
            if switch_for != NOBODY:
                switch = roles.logged_path[i]
        if not diverged.found[i] and switch != record.switch[t, i]:
            _diverge_at(t, i, t, rows, diverged, motion, record)
            motion.mode[t, i] = REPLAYED
        motion.switch[t, i], motion.switch_for[t, i] = switch, switch_for
    for i in range(n):
        m = motion.switch[t, i]
        if m >= 0:
            mode[i] = DRIVEN
            if diverged.found[i]:
                s, offset, turn, speed = start_on(paths, m, rows, t, i, driver)
                if yielding is not None:
                    turn = wrapped(turn - turned_at(yielding, m, s))
                motion.mode[t, i], motion.path[t, i], motion.travelled[t, i] = DRIVEN, m, 0.0
                motion.s[t, i], motion.offset[t, i], motion.turn[t, i], motion.speed[t, i] = s, offset, turn, speed
                motion.base_z[t, i] = rows.center_z[t, i] - paths.height[m, cell_of(paths, s)]


@hidden_kernel
def _drive_on(
    start: int, roles: Roles, paths: Paths, driver: IdmDriver, t: int,
    rows: RolloutRows, diverged: Diverged, motion: Motion, record: Motion, yielding: Yielding | None,
) -> None:  # fmt: skip
    """Those who are driven look at row t and move."""
    for i in range(motion.mode.shape[1]):
        motion.leader[t, i] = NOBODY
        if diverged.mode[i] != DRIVEN:
            continue
        m, s, travelled, speed, offset, turn = _motion_of(t, i, diverged, motion, record)
        if start + t < roles.hold_until[i] and travelled == 0.0 and m == roles.path[i]:
            if diverged.found[i]:
                _advance(paths, driver, t, i, 0.0, 0.0, rows, motion, yielding)
            continue
        afresh, accel, leader = diverged.found[i], 0.0, NOBODY
        if not afresh:
            accel, leader = record.accel[t, i], record.leader[t, i]
            afresh = leader != NOBODY and diverged.found[leader]
        if afresh:
            leader = NOBODY
            if yielding is None:
                accel = road_acceleration(paths, driver, t, m, s, speed, rows.boxes[t, i, 3])
            else:
                nose = s + 0.5 * rows.boxes[t, i, 3]
                accel = intended_acceleration(yielding, paths, driver, m, s, speed, start, t, nose)
        others = diverged.everyone if afresh else diverged.listed
        n_others = len(others) if afresh else diverged.size[0]
        way = way_of(rows, t, i, m, s, travelled, offset, turn)
        accel, leader = hardest_acceleration(
            paths, driver, rows, t, i, way, speed, others, n_others, accel, leader, yielding
        )
        if yielding is not None:
            accel, leader = yields_for(
                yielding, driver, start, t, i, m, s, speed, rows, diverged, motion, record, afresh, accel, leader
            )
        if not diverged.found[i]:
            if accel == record.accel[t, i]:
                continue
            _diverge_at(t, i, t + 1, rows, diverged, motion, record)
        motion.accel[t, i], motion.leader[t, i], motion.was_driven[t + 1, i] = accel, leader, True
        step_m, new_speed = advance(speed, accel)
        _advance(paths, driver, t, i, step_m, new_speed, rows, motion, yielding)


@hidden_kernel
def _motion_of(
    t: int, i: int, diverged: Diverged, motion: Motion, record: Motion
) -> tuple[int, float, float, float, float, float]:
    """Path, path length, distance travelled, speed, offset and turn of agent i at row t, diverged or not."""
    if diverged.found[i]:
        return (
            motion.path[t, i], motion.s[t, i], motion.travelled[t, i],
            motion.speed[t, i], motion.offset[t, i], motion.turn[t, i],
        )  # fmt: skip
    return (
        record.path[t, i], record.s[t, i], record.travelled[t, i],
        record.speed[t, i], record.offset[t, i], record.turn[t, i],
    )  # fmt: skip


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
            h += turned_at(yielding, m, s)
        rows.boxes[t + 1, i, 2] = wrapped(h)
    h = rows.boxes[t + 1, i, 2]
    rows.velocities[t + 1, i, 0], rows.velocities[t + 1, i, 1] = new_speed * math.cos(h), new_speed * math.sin(h)
    rows.center_z[t + 1, i] = motion.base_z[t + 1, i] + paths.height[m, cell_of(paths, s)]


@hidden_kernel
def _replay(
    log: AgentStates, roles: Roles, t: int, rows: RolloutRows, diverged: Diverged, motion: Motion, record: Motion
) -> None:  # fmt: skip
    """The parked stay, the replayed take the next step of their log.

    Who cannot brake along its log (who walks or cycles, or reverses) takes none to where a driven car is; one that
    walks goes on once it is touched, a vehicle would drive through.
    """
    n, mode = motion.mode.shape[1], diverged.mode
    for i in range(n):
        motion.blocked[t, i], motion.waits[t, i] = False, False
        has_diverged = diverged.found[i]
        if mode[i] == STANDING and has_diverged:
            _stay(rows, t, i)
        if mode[i] != REPLAYED:
            continue
        clock = motion.clock[t, i] if has_diverged else record.clock[t, i]
        k = min(clock + 1, log.valid.shape[0] - 1)
        if roles.moving_kind[i] and roles.logged_path[i] < 0 and rows.valid[t, i] and log.valid[k, i]:
            afresh = has_diverged or record.blocked[t, i]
            others = diverged.everyone if afresh else diverged.listed
            n_others = len(others) if afresh else diverged.size[0]
            blocked = touches_driven(log.boxes, k, i, rows, t + 1, mode, others, n_others)
            waits = blocked and (
                roles.enters_clear[i]
                or not touches_driven(rows.boxes, t, i, rows, t + 1, mode, diverged.everyone, n)
            )  # fmt: skip
            if not has_diverged and waits != record.waits[t, i]:
                _diverge_at(t, i, t + 1, rows, diverged, motion, record)
                has_diverged = True
            motion.blocked[t, i], motion.waits[t, i] = blocked, waits
        if has_diverged and motion.waits[t, i]:
            _stay(rows, t, i)
        elif has_diverged:
            motion.clock[t + 1, i] = k
            if log.valid[k, i]:
                _place(rows, t + 1, log, k, i)


@hidden_kernel
def _admit(
    start: int, log: AgentStates, roles: Roles, driver: IdmDriver, t: int,
    rows: RolloutRows, diverged: Diverged, motion: Motion, record: Motion, yielding: Yielding | None,
) -> None:  # fmt: skip
    """Newcomers, judged against everyone who was already there."""
    n = motion.mode.shape[1]
    k = min(start + t + 1, log.valid.shape[0] - 1)
    for i in range(n):
        motion.enters[t, i] = False
        if diverged.mode[i] != ABSENT or not log.valid[k, i]:
            continue
        afresh = diverged.found[i] or not record.enters[t, i]
        others = diverged.everyone if afresh else diverged.listed
        n_others = len(others) if afresh else diverged.size[0]
        enters = far_from_ego(roles, log.boxes, k, i, rows, t + 1) and is_clear(
            roles, driver, log, k, i, rows, t + 1, diverged.mode, others, n_others, yielding
        )
        if yielding is not None and enters and roles.path[i] >= 0:
            enters = has_way(yielding, driver, roles.path[i], k, t + 1, log, i, rows, diverged, motion, record, afresh)
        if not diverged.found[i]:
            if enters == record.enters[t, i]:
                continue
            _diverge_at(t, i, t + 1, rows, diverged, motion, record)
        motion.enters[t, i] = enters
    for i in range(n):
        if motion.enters[t, i]:
            motion.mode[t + 1, i], motion.clock[t + 1, i] = STANDING if roles.standing[i] else REPLAYED, k
            _place(rows, t + 1, log, k, i)

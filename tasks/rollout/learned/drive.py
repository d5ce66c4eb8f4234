"""Worlds in lockstep, their vehicles driven by a policy: who is where, who is asked, who waits, who enters.

Who is driven, on which way, and from when is decided as for IDM (tasks/rollout/simulate.py); who replays the log waits
before a driven vehicle, and goes on late. Vehicles enter where they have room and the ego is not near. Compiled but for
the policy.
"""

import math
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.rollout.corridor import Box, Paths, boxes_overlap, project_on_path
from tasks.rollout.idm import IdmDriver
from tasks.rollout.learned.policy import (
    HEADING,
    SEEN_ROWS,
    SPEED,
    BadPolicy,
    RoadLines,
    SeenWorlds,
    TrafficPolicy,
    X,
    Y,
)
from tasks.rollout.rules import ENTER_CLEARANCE_M, LARGEST_OFFSET_M, box_of, cell_of
from tasks.rollout.traffic_state import ABSENT, DRIVEN, REPLAYED, STANDING, AgentStates, Roles
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.bounds import all_within

BEFORE = SEEN_ROWS - 1  # rows of the past
NEVER_DRIVEN = 1_000_000


class Worlds(NamedTuple):
    """B worlds over the past and T rows of a rollout; the ego is the last of each row, there in all of them."""

    boxes: Array  # (BEFORE + T, B, N + 1, 5) as in AgentStates
    velocities: Array  # (BEFORE + T, B, N + 1, 2) [m/s]
    valid: Bools  # (BEFORE + T, B, N + 1)
    center_z: Array  # (BEFORE + T, B, N + 1) [m]
    mode: Ints  # (B, N) ABSENT, REPLAYED, DRIVEN, STANDING: at the row that was come to
    clock: Ints  # (B, N) the step of its log one that replays it is at
    driven_from: Ints  # (B, N) row of the rollout that the policy first led to


def drive_learned(
    policy: TrafficPolicy, streets: RoadLines, kinds: Ints, start: int, log: AgentStates, past: AgentStates,
    roles: Roles, driver: IdmDriver, egos: tuple[Array, Array], ego_past: tuple[Array, Array],
) -> Worlds:  # fmt: skip
    """The traffic's answer to B egos, boxes (B, T, 5) about the true centre and velocities (B, T, 2).

    past: the agents over the SEEN_ROWS rows up to `start`; ego_past: the ego's boxes and velocities in them. Raises
    BadPolicy where the policy answers no states.
    """
    n_worlds, n_rows, n = egos[0].shape[0], egos[0].shape[1], roles.path.shape[0]
    worlds = _first(past, roles, n_worlds, n_rows)
    for places, before, after in zip((worlds.boxes, worlds.velocities), ego_past, egos):
        places[:SEEN_ROWS, :, n] = before[:, None]
        places[BEFORE:, :, n] = after.swapaxes(0, 1)
    for t in range(n_rows - 1):
        asked = take_over(start, t, roles, streets.ways, worlds)
        answer = np.zeros((n_worlds, n, 4))
        if asked.any():
            rows = slice(t, t + SEEN_ROWS)
            seen = SeenWorlds(worlds.boxes[rows], worlds.velocities[rows], worlds.valid[rows], kinds, asked)
            ways = streets.ways._replace(line_state=streets.ways.line_state[t : t + 1])
            now = RoadLines(streets.lane_points, streets.lane_first, streets.way, ways)
            answer = checked(policy, policy.next_states(seen, now), asked)
        move(start, t, log, roles, streets.ways, asked, answer, worlds)
        admit(start, t, log, roles, driver, worlds)
    return worlds


def checked(policy: TrafficPolicy, answer: Array, asked: Bools) -> Array:
    """The answer as the kernels take it. Raises BadPolicy."""
    name, expected = type(policy).__name__, (*asked.shape, 4)
    answer = np.ascontiguousarray(answer, np.float64)
    if answer.shape != expected:
        raise BadPolicy(f"{name}.next_states gave {answer.shape}, not {expected}: x, y, heading, speed")
    if not all_within(answer[asked]):
        raise BadPolicy(f"{name}.next_states gave a state that is not finite, or too large to be one")
    return answer


def _first(past: AgentStates, roles: Roles, n_worlds: int, n_rows: int) -> Worlds:
    """The past and row 0, the same in all worlds."""
    n = roles.path.shape[0]
    shape = (BEFORE + n_rows, n_worlds, n + 1)
    worlds = Worlds(
        np.full((*shape, 5), np.nan), np.full((*shape, 2), np.nan), np.zeros(shape, bool), np.full(shape, np.nan),
        np.zeros((n_worlds, n), np.int64), np.tile(roles.clock, (n_worlds, 1)),
        np.full((n_worlds, n), NEVER_DRIVEN),
    )  # fmt: skip
    for name in AgentStates._fields:
        getattr(worlds, name)[:SEEN_ROWS, :, :n] = getattr(past, name)[:, None]
    worlds.valid[:, :, n] = True
    worlds.mode[:, past.valid[-1]] = REPLAYED
    worlds.mode[:, past.valid[-1] & roles.standing] = STANDING
    return worlds


@kernel
def take_over(start: int, t: int, roles: Roles, paths: Paths, worlds: Worlds) -> Bools:
    """(B, N) who is asked at row t: who is on its way and due is driven, from now on; who waits for its log is not."""
    row = BEFORE + t
    n_worlds, n = worlds.mode.shape
    asked = np.zeros((n_worlds, n), np.bool_)
    for b in range(n_worlds):
        for i in range(n):
            if worlds.mode[b, i] == REPLAYED and worlds.valid[row, b, i] and roles.path[i] >= 0:
                if worlds.clock[b, i] < roles.join_step[i]:
                    continue
                x, y = worlds.boxes[row, b, i, 0], worlds.boxes[row, b, i, 1]
                if abs(project_on_path(paths, roles.path[i], x, y)[1]) <= LARGEST_OFFSET_M:
                    worlds.mode[b, i] = DRIVEN
            if worlds.mode[b, i] == DRIVEN:
                asked[b, i] = start + t >= roles.hold_until[i] or worlds.driven_from[b, i] != NEVER_DRIVEN
    return asked


@kernel
def move(
    start: int, t: int, log: AgentStates, roles: Roles, paths: Paths, asked: Bools, answer: Array, worlds: Worlds
) -> None:
    """From row t to row t + 1: who is asked by the answer (B, N, 4), who replays its log by that; others stay."""
    row, n = BEFORE + t, worlds.mode.shape[1]
    for b in range(worlds.mode.shape[0]):
        for i in range(n):
            if worlds.mode[b, i] == DRIVEN or worlds.mode[b, i] == STANDING:
                _stay(worlds, row, b, i)
            if worlds.mode[b, i] == DRIVEN and asked[b, i]:
                _lead_to(paths, roles.path[i], answer, worlds, row, b, i)
                worlds.driven_from[b, i] = min(worlds.driven_from[b, i], t + 1)
        for i in range(n):
            if worlds.mode[b, i] != REPLAYED:
                continue
            k = min(worlds.clock[b, i] + 1, log.valid.shape[0] - 1)
            if (
                roles.moving_kind[i]
                and worlds.valid[row, b, i]
                and log.valid[k, i]
                and _meets_driven(worlds, row + 1, b, i, box_of(log.boxes, k, i))
                and (roles.enters_clear[i] or not _meets_driven(worlds, row + 1, b, i, box_of(worlds.boxes[row], b, i)))
            ):
                _stay(worlds, row, b, i)
                continue
            worlds.clock[b, i] = k
            if log.valid[k, i]:
                _place(worlds, row + 1, b, i, log, k)


@kernel
def admit(start: int, t: int, log: AgentStates, roles: Roles, driver: IdmDriver, worlds: Worlds) -> None:
    """Who is in the log at row t + 1 and was not there before enters, if those who were there leave it room."""
    row, n = BEFORE + t + 1, worlds.mode.shape[1]
    k = min(start + t + 1, log.valid.shape[0] - 1)
    for b in range(worlds.mode.shape[0]):
        enters = np.zeros(n, np.bool_)
        for i in range(n):
            if worlds.mode[b, i] != ABSENT or not log.valid[k, i]:
                continue
            if not roles.enters_clear[i]:
                enters[i] = not (roles.moving_kind[i] and _meets_driven(worlds, row, b, i, box_of(log.boxes, k, i)))
                continue
            dx = log.boxes[k, i, 0] - worlds.boxes[row, b, n, 0]
            dy = log.boxes[k, i, 1] - worlds.boxes[row, b, n, 1]
            enters[i] = math.hypot(dx, dy) >= ENTER_CLEARANCE_M and _has_room(worlds, row, b, i, log, k, driver)
        for i in range(n):
            if enters[i]:
                worlds.mode[b, i], worlds.clock[b, i] = STANDING if roles.standing[i] else REPLAYED, k
                _place(worlds, row, b, i, log, k)


@kernel
def _has_room(worlds: Worlds, row: int, b: int, i: int, log: AgentStates, k: int, driver: IdmDriver) -> bool:
    """Whether agent i finds its headway and room to brake at both ends, where step k of its log has it."""
    x, y, heading, length, width = box_of(log.boxes, k, i)
    c, s = math.cos(heading), math.sin(heading)
    speed = log.velocities[k, i, 0] * c + log.velocities[k, i, 1] * s
    for j in range(worlds.valid.shape[2]):
        if j == i or not worlds.valid[row, b, j]:
            continue
        closing = speed - worlds.velocities[row, b, j, 0] * c - worlds.velocities[row, b, j, 1] * s
        margin = driver.min_gap_m + driver.headway_s * speed + closing * closing / (2.0 * driver.decel_max)
        if boxes_overlap((x, y, heading, length + 2.0 * margin, width), box_of(worlds.boxes[row], b, j)):
            return False
    return True


@kernel
def _meets_driven(worlds: Worlds, row: int, b: int, i: int, box: Box) -> bool:
    """Would agent i in this box share area with a driven one in the row?"""
    for j in range(worlds.mode.shape[1]):
        if j != i and worlds.mode[b, j] == DRIVEN and boxes_overlap(box, box_of(worlds.boxes[row], b, j)):
            return True
    return False


@kernel
def _lead_to(paths: Paths, m: int, answer: Array, worlds: Worlds, row: int, b: int, i: int) -> None:
    """Agent i is where the answer has it in the next row; as high above its way as before."""
    s = project_on_path(paths, m, worlds.boxes[row, b, i, 0], worlds.boxes[row, b, i, 1])[0]
    worlds.boxes[row + 1, b, i, 0], worlds.boxes[row + 1, b, i, 1] = answer[b, i, X], answer[b, i, Y]
    worlds.boxes[row + 1, b, i, 2] = h = answer[b, i, HEADING]
    worlds.velocities[row + 1, b, i, 0] = answer[b, i, SPEED] * math.cos(h)
    worlds.velocities[row + 1, b, i, 1] = answer[b, i, SPEED] * math.sin(h)
    on = project_on_path(paths, m, answer[b, i, X], answer[b, i, Y])[0]
    worlds.center_z[row + 1, b, i] += paths.height[m, cell_of(paths, on)] - paths.height[m, cell_of(paths, s)]


@kernel
def _stay(worlds: Worlds, row: int, b: int, i: int) -> None:
    """Agent i stands in the next row where it is in this one."""
    for k in range(5):
        worlds.boxes[row + 1, b, i, k] = worlds.boxes[row, b, i, k]
    worlds.velocities[row + 1, b, i, 0], worlds.velocities[row + 1, b, i, 1] = 0.0, 0.0
    worlds.center_z[row + 1, b, i], worlds.valid[row + 1, b, i] = worlds.center_z[row, b, i], True


@kernel
def _place(worlds: Worlds, row: int, b: int, i: int, log: AgentStates, k: int) -> None:
    """Agent i is in the row where step k of its log has it."""
    for c in range(5):
        worlds.boxes[row, b, i, c] = log.boxes[k, i, c]
    worlds.velocities[row, b, i, 0], worlds.velocities[row, b, i, 1] = log.velocities[k, i, 0], log.velocities[k, i, 1]
    worlds.center_z[row, b, i], worlds.valid[row, b, i] = log.center_z[k, i], True

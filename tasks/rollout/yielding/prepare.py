"""A scene's schedules and zones, and who gives way in each: once per scene, whatever the ego will do.

Of two that would be in a zone at once gives way, first who has a closed light or a stop of its log before it, then who
turns, then who comes later by the logs, then who has the other one on its right.
"""

import math
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.rollout.corridor import Paths, project_on_path
from tasks.rollout.idm import CLOSED
from tasks.rollout.roles import NEVER
from tasks.rollout.stretches import PATH_SPACING_M
from tasks.rollout.traffic_state import AgentStates, Roles, Yielding
from tasks.rollout.yielding.intent import schedules, turns_as_logged
from tasks.rollout.yielding.zones import zones_of
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import HORIZON_STEPS, Scene

MOVES_M = 0.5  # who is less far by the end of the rollout stands
TURNS_RAD = math.radians(30.0)  # of the way up to the end of a zone
AT_ONCE_STEPS = 5  # who comes so little later does not come later
ASIDE = 0.3  # sine of the angle at which another way comes from the right or the left
STOP_BEFORE_M = 12.0  # of a zone, a stop of the log is one for it


def yielding_in(scene: Scene, roles: Roles, paths: Paths, log: AgentStates) -> Yielding:
    """What drivers on `paths` mean to do, and where they look out for others."""
    start, n_steps = scene.step, len(log.valid)
    owner, anchor_step, pose = _anchors(scene, roles, log, len(paths.heading))
    anchor_at = _places(paths, pose)
    at, speed, last = schedules(log.boxes, log.velocities, log.valid, owner, anchor_step, anchor_at)
    front = 0.5 * pose[:, 3]
    end = at[:, min(start + HORIZON_STEPS, n_steps - 1)]
    begin = np.minimum(anchor_at, at[:, start])
    moves = end - begin > MOVES_M
    replays = roles.moving_kind & ~roles.standing & ((roles.path < 0) | (roles.join_step > start))
    half_width = 0.5 * np.nan_to_num(np.nanmax(log.boxes[..., 4], axis=0, initial=0.0))
    who, where = zones_of(
        paths, owner, begin - front, anchor_at + front, np.where(moves, end + front, -np.inf), half_width,
        log, replays, roles.clock, HORIZON_STEPS + 1,
    )  # fmt: skip
    order = np.argsort(who[:, 0], kind="stable")
    who, where = who[order], where[order]
    return Yielding(
        at=at,
        speed=speed,
        last=last,
        turned=turns_as_logged(paths, log.boxes, log.valid, owner, anchor_step, at),
        zone_start=np.searchsorted(who[:, 0], np.arange(len(owner) + 1)),
        zone_agent=np.ascontiguousarray(who[:, 1]),
        zone_path=np.ascontiguousarray(who[:, 2]),
        **{name: np.ascontiguousarray(where[:, k]) for k, name in enumerate(_EDGES)},
        gives_way=_who_gives_way(paths, who, where, at, speed, begin, start),
    )


_EDGES = ("zone_in", "zone_out", "other_in", "other_out")


def _anchors(scene: Scene, roles: Roles, log: AgentStates, n_paths: int) -> tuple[Ints, Ints, Array]:
    """Whose each path is (M,), a step of its log (M,), and where it is then (M, 5): now, or where it will appear."""
    owner, step = np.zeros(n_paths, np.int64), np.zeros(n_paths, np.int64)
    pose = np.zeros((n_paths, 5))
    now = scene.agents
    for numbers, joins in ((roles.path, roles.join_step), (roles.logged_path, roles.clock)):
        for i in np.flatnonzero(numbers >= 0).tolist():
            m = numbers[i]
            owner[m] = i
            if now.valid[scene.step, i]:
                step[m], pose[m] = roles.clock[i], now.boxes[scene.step, i]
            else:
                seen = np.flatnonzero(log.valid[:, i])
                after = seen[seen >= joins[i]] if joins[i] < NEVER else seen
                step[m] = after[0] if len(after) else seen[-1]
                pose[m] = log.boxes[step[m], i]
    return owner, step, pose


@kernel
def _places(paths: Paths, pose: Array) -> Array:
    """(M,) path length of each path's own pose (M, >= 2)."""
    out = np.empty(len(pose))
    for m in range(len(pose)):
        out[m] = project_on_path(paths, m, pose[m, 0], pose[m, 1])[0]
    return out


def _who_gives_way(paths: Paths, who: Ints, where: Array, at: Array, speed: Array, begin: Array, start: int) -> Bools:
    """(Z,) of zones `who` (Z, 3), `where` (Z, 4)."""
    replayed = who[:, 2] < 0
    of = np.where(replayed, who[:, 0], who[:, 2])
    own = _claims(paths, who[:, 0], where[:, 0], where[:, 1], at, speed, begin, start)
    other = _claims(paths, of, where[:, 2], where[:, 3], at, speed, begin, start)
    later = own.comes - other.comes
    crossed = np.sin(other.heading - own.heading)  # above 0: the other one comes from the right
    rules = (
        own.held - other.held,
        own.turns - other.turns,
        np.where(np.abs(later) >= AT_ONCE_STEPS, later, 0.0),
        np.where(np.abs(crossed) >= ASIDE, crossed, 0.0),
        later,
        (who[:, 0] - of).astype(np.float64),
    )
    behind, decided = replayed.copy(), replayed.copy()
    for rule in rules:
        behind |= ~decided & (rule > 0.0)
        decided |= rule != 0.0
    return behind


class _Claims(NamedTuple):
    """What is compared in turn, (Z,) each: of two the one with less goes first."""

    held: Array  # 1: a closed light or a stop of the log is before the zone
    turns: Array  # 1: the way up to the end of the zone turns
    comes: Array  # steps from now until the log comes there
    heading: Array  # [rad] there


def _claims(
    paths: Paths, path: Ints, enters: Array, leaves: Array, at: Array, speed: Array, begin: Array, start: int
) -> _Claims:
    held = np.zeros(len(path))
    ends = np.stack([begin[path], enters, leaves])
    heading = paths.heading[path, np.clip((ends / PATH_SPACING_M).astype(int), 0, paths.heading.shape[1] - 1)]
    for z, m in enumerate(path.tolist()):
        lines = slice(paths.line_start[m], paths.line_start[m + 1])
        before = (paths.line_at[lines] >= begin[m]) & (paths.line_at[lines] <= enters[z])
        stops = (speed[m, start:] == 0.0) & (at[m, start:] <= enters[z]) & (at[m, start:] >= enters[z] - STOP_BEFORE_M)
        held[z] = float((before & (paths.line_state[0, lines] == CLOSED)).any() or stops.any())
    turns = (np.abs(heading[2] - heading[0]) > TURNS_RAD).astype(np.float64)
    comes = (at[path, start:] < enters[:, None]).sum(axis=1).astype(np.float64)
    return _Claims(held, turns, comes, heading[1])

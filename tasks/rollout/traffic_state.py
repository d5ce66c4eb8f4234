"""What the traffic's kernels work on: NamedTuples of contiguous arrays, N agents, steps of STEP_S.

No tuple holds another one: taking a tuple out of a tuple counts a reference to each of its arrays.
"""

from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import Array, Bools, Ints

ABSENT, REPLAYED, DRIVEN, STANDING, EGO = 0, 1, 2, 3, 4  # what moves one at the moment
NOBODY = -1


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
    """How each agent moves at every row, those due having switched to IDM, and what it decides there, for whom."""

    mode: Ints  # (T, N) ABSENT, REPLAYED, DRIVEN, STANDING
    path: Ints  # (T, N) of one that is driven, -1: not driven
    clock: Ints  # (T, N) the step of its log a replayed one is at
    s: Array  # (T, N) path length [m]
    travelled: Array  # (T, N) since it is driven [m]
    speed: Array  # (T, N) along the path [m/s]
    offset: Array  # (T, N) to the left of the path, when it switched to IDM [m]
    turn: Array  # (T, N) against the path, when it switched to IDM [rad]
    base_z: Array  # (T, N) its centre's height above the path's [m]
    was_driven: Bools  # (T, N) moved by IDM before
    switch: Ints  # (T, N) the path on which it switches to IDM here, -1: it does not
    switch_for: Ints  # (T, N) the driven one it had to brake for, NOBODY: it was due
    accel: Array  # (T, N) of one that is driven [m/s2]
    leader: Ints  # (T, N) whom that is for, NOBODY: the road, a stop line
    blocked: Bools  # (T, N) a driven one is where the next step of its log is
    waits: Bools  # (T, N) for it
    enters: Bools  # (T, N) appears at the end of the step


class Diverged(NamedTuple):
    """The agents that do not do what a recorded rollout says; the ego, as number N, is the first of them."""

    found: Bools  # (N + 1,)
    listed: Ints  # (N + 1,) in the order they left the record
    size: Ints  # (1,) how many they are
    everyone: Ints  # (N + 1,) 0 .. N
    mode: Ints  # (N + 1,) of everyone, diverged or not, at this row


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
    """Nobody moves, for nobody."""
    shape = (n_rows, n)
    return Motion(
        np.zeros(shape, np.int64), np.full(shape, -1), np.zeros(shape, np.int64),
        np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape),
        np.zeros(shape, np.bool_), np.full(shape, -1), np.full(shape, NOBODY), np.zeros(shape),
        np.full(shape, NOBODY), np.zeros(shape, np.bool_), np.zeros(shape, np.bool_), np.zeros(shape, np.bool_),
    )  # fmt: skip


@kernel
def nobody_diverged(n: int) -> Diverged:
    return Diverged(
        np.zeros(n + 1, np.bool_),
        np.zeros(n + 1, np.int64),
        np.zeros(1, np.int64),
        np.arange(n + 1),
        np.zeros(n + 1, np.int64),
    )

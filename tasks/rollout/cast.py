"""What the traffic's kernels work on: NamedTuples of contiguous arrays, N agents, steps of STEP_S.

No tuple holds another one: taking a tuple out of a tuple counts a reference to each of its arrays.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

ABSENT, REPLAYED, DRIVEN, STANDING, EGO = 0, 1, 2, 3, 4  # what moves one at the moment
NOBODY = -1


class Cast(NamedTuple):
    """Who does what, whatever the ego does; steps are the clip's."""

    path: Integers  # (N,) index of its path, -1: none
    logged_path: Integers  # (N,) index of the path along its own log, for one that may have to brake; -1: none
    join_step: Integers  # (N,) logged step from which it is driven, if it has a path
    hold_until: Integers  # (N,) a car that stands in its log does not start before
    clock: Integers  # (N,) step of its log it is at when the rollout starts
    standing: Booleans  # (N,) parked
    moving_kind: Booleans  # (N,) vehicle, pedestrian or bicycle: does not walk into a driven car
    enters_clear: Booleans  # (N,) vehicles that may only enter with clearance to the ego


class World(NamedTuple):
    """Agents over S steps."""

    boxes: Array  # (S, N, 5) centre x, y [m], heading [rad], length, width [m]; NaN where absent
    velocities: Array  # (S, N, 2) [m/s]
    valid: Booleans  # (S, N)
    center_z: Array  # (S, N) [m]


class Rows(NamedTuple):
    """A rollout's T rows of N agents and, in the last place, the ego; the absent hold NaN and False."""

    boxes: Array  # (T, N + 1, 5) as World
    velocities: Array  # (T, N + 1, 2) [m/s]
    valid: Booleans  # (T, N + 1)
    center_z: Array  # (T, N + 1) [m]
    radius: Array  # (T, N + 1) around the box [m]


class Motion(NamedTuple):
    """How each agent moves at every row, once who had to has taken the wheel, and what it decides there, for whom."""

    mode: Integers  # (T, N) ABSENT, REPLAYED, DRIVEN, STANDING
    path: Integers  # (T, N) of one that is driven, -1: not driven
    clock: Integers  # (T, N) the step of its log a replayed one is at
    s: Array  # (T, N) path length [m]
    travelled: Array  # (T, N) since it is driven [m]
    speed: Array  # (T, N) along the path [m/s]
    offset: Array  # (T, N) to the left of the path, when it took the wheel [m]
    turn: Array  # (T, N) against the path, when it took the wheel [rad]
    base_z: Array  # (T, N) its centre's height above the path's [m]
    was_driven: Booleans  # (T, N) moved by IDM before
    taken: Integers  # (T, N) the path on which it takes the wheel here, -1: it did not
    taken_for: Integers  # (T, N) the driven one it had to brake for, NOBODY: it was due
    accel: Array  # (T, N) of one that is driven [m/s2]
    leader: Integers  # (T, N) whom that is for, NOBODY: the road, a stop line
    blocked: Booleans  # (T, N) a driven one is where the next step of its log is
    waits: Booleans  # (T, N) for it
    enters: Booleans  # (T, N) appears at the end of the step


class Strays(NamedTuple):
    """Who does not do what a recorded rollout says; the ego, as number N, is the first of them."""

    found: Booleans  # (N + 1,)
    listed: Integers  # (N + 1,) in the order they left the record
    size: Integers  # (1,) how many they are
    everyone: Integers  # (N + 1,) 0 .. N
    mode: Integers  # (N + 1,) of everyone, strays or not, at this row


@kernel
def empty_rows(n_rows: int, n: int) -> Rows:
    """Nobody there yet."""
    return Rows(
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
def no_strays(n: int) -> Strays:
    return Strays(
        np.zeros(n + 1, np.bool_),
        np.zeros(n + 1, np.int64),
        np.zeros(1, np.int64),
        np.arange(n + 1),
        np.zeros(n + 1, np.int64),
    )

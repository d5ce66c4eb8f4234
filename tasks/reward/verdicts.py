"""Every rule applied to every trajectory, one after the other (docs/reward.md 2); no row depends on another."""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from tasks.kernels.compiled import kernel
from tasks.reward.prepare import N_TIMES, PreparedScene
from tasks.reward.rules.area_flags import areas_along
from tasks.reward.rules.centerline import Centerline, driving_direction, lane_keeping, progress_m
from tasks.reward.rules.comfort import comfort_along, comfort_scratch
from tasks.reward.rules.contacts import first_collision, first_time_to_collision, reach_of
from tasks.reward.rules.ego import MULTIPLE_LANES, NON_DRIVABLE, ONCOMING, Body, empty_body, place
from tasks.reward.rules.lights import RedLanes, first_red
from tasks.reward.rules.map_index import MapIndex
from tasks.reward.rules.obstacles import Obstacles, within_reach
from tasks.subscores import LABELLED, WHOLES
from tasks.world.arrays import Array, Bools, Bytes
from tasks.world.frames import EGO_STATE_SIZE, PACIFICA

INDEX_FROM_ROWS = 32  # an index of the objects costs about as much as it saves on that many trajectories

NC, DAC, DDC, TLC = (LABELLED.index(name) for name in ("nc", "dac", "ddc", "tlc"))
TTC, LK, HC = (LABELLED.index(name) for name in ("ttc", "lk", "hc"))
_WHOLES = tuple(LABELLED.index(name) for name in WHOLES)


class Verdicts(NamedTuple):
    """What the rules say of K trajectories; a sub-score without a rule stays as it was."""

    scores: Array  # (S + 1, K) by LABELLED; of EP nothing, which compares trajectories
    fails: Array  # (S, K) by JUDGED: the time index (0.1 s) at which it first fails, inf: never
    ep_raw_m: Array  # (K,) progress along the centreline [m]
    ego_areas: Bools  # (K, 41, 3)
    comfort: Bools  # (K, 6)


class Ego(NamedTuple):
    """The ego's body [m]."""

    half_length: float
    half_width: float
    rear_axle_to_center: float


class RuleContext(NamedTuple):
    """What a trajectory is judged against, but for the objects."""

    ego: Ego
    centerline: Centerline
    map_index: MapIndex
    red_lanes: RedLanes
    history: Array  # (14, 11), or (0, 11): history comfort is not judged


class Scratch(NamedTuple):
    """Reused from trajectory to trajectory; one for each thread."""

    body: Body
    ignored: Bools  # (N,) objects that a rule stopped looking at
    comfort: Array


def context_of(prepared: PreparedScene, with_history: bool) -> RuleContext:
    """A prepared scene as the kernels take it."""
    history = prepared.history if with_history and prepared.history is not None else np.empty((0, EGO_STATE_SIZE))
    return RuleContext(
        Ego(PACIFICA.half_length, PACIFICA.half_width, PACIFICA.rear_axle_to_center),
        prepared.centerline,
        prepared.map_index,
        prepared.red_lanes,
        history,
    )


@register_jitable
def scratch_for(n_objects: int) -> Scratch:
    """Room for one trajectory among N objects."""
    return Scratch(empty_body(N_TIMES), np.empty(n_objects, np.bool_), comfort_scratch())


@kernel
def judge_one(
    context: RuleContext, everything: Obstacles, states: Array, scratch: Scratch, k: int, out: Verdicts
) -> None:
    """All rules on one trajectory (41, 11), written to row k."""
    body, half_length, half_width = scratch.body, context.ego.half_length, context.ego.half_width
    place(states, context.ego.rear_axle_to_center, body)
    areas_along(context.map_index, body, half_length, half_width)
    _spread_flags(body.flags, out.ego_areas[k])
    obstacles = within_reach(everything, reach_of(body), 2.0 * half_length, 2.0 * half_width)
    out.scores[NC, k], out.fails[NC, k] = first_collision(
        obstacles, states, body, half_length, half_width, scratch.ignored
    )
    out.fails[DAC, k] = _first_with(body.flags, NON_DRIVABLE)
    out.scores[DDC, k], out.fails[DDC, k] = driving_direction(body)
    out.fails[TLC, k] = first_red(context.red_lanes, body, half_length, half_width)
    out.fails[TTC, k] = first_time_to_collision(
        obstacles, states, body, context.map_index, half_length, half_width, scratch.ignored
    )
    out.fails[LK, k] = lane_keeping(context.centerline, body)
    last = states.shape[0] - 1
    out.ep_raw_m[k] = progress_m(context.centerline, body.x[0], body.y[0], body.x[last], body.y[last])
    if len(context.history) > 0:
        out.fails[HC, k] = comfort_along(
            context.history, states, context.ego.rear_axle_to_center, scratch.comfort, out.comfort[k]
        )
    else:
        out.fails[HC, k] = math.inf
        out.comfort[k] = True
    for row in _WHOLES:
        out.scores[row, k] = 1.0 if out.fails[row, k] == math.inf else 0.0


@kernel
def _spread_flags(flags: Bytes, out: Bools) -> None:
    for t in range(len(flags)):
        out[t, 0] = flags[t] & MULTIPLE_LANES != 0
        out[t, 1] = flags[t] & NON_DRIVABLE != 0
        out[t, 2] = flags[t] & ONCOMING != 0


@kernel
def _first_with(flags: Bytes, bit: int) -> float:
    for t in range(len(flags)):
        if flags[t] & bit:
            return float(t)
    return math.inf

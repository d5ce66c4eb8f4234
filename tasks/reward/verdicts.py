"""Every rule applied to every trajectory, one after the other (docs/reward.md 2); no row depends on another."""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel
from tasks.reward.prepare import N_TIMES, PreparedScene
from tasks.reward.rules.area_flags import areas_along
from tasks.reward.rules.centerline import Centerline, progress_m
from tasks.reward.rules.comfort import N_FLAGS, comfort_along, comfort_scratch
from tasks.reward.rules.contacts import first_collision, first_time_to_collision, reach_of
from tasks.reward.rules.ego import MULTIPLE_LANES, NON_DRIVABLE, ONCOMING, Body, empty_body, place
from tasks.reward.rules.lane_discipline import driving_direction, lane_keeping
from tasks.reward.rules.lights import RedLanes, first_red
from tasks.reward.rules.map_index import MapIndex
from tasks.reward.rules.obstacles import Obstacles, spans_of, unindexed, with_objects, within_reach
from tasks.subscores import JUDGED, LABELLED, WHOLES
from tasks.world.bounds import LARGEST, all_within
from tasks.world.vehicle import EGO_STATE_SIZE, Vehicle

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_NO_BOXES, _NO_FLAGS = np.empty((0, N_TIMES, 0, 5)), np.empty((0, 0), np.bool_)
_NO_DRIVE = f"states must be finite and at most {LARGEST:g}: leave out what is not a drive"

INDEX_FROM_ROWS = 32  # an index of the objects costs about as much as it saves on that many trajectories


NC, DAC, DDC, TLC = (LABELLED.index(name) for name in ("nc", "dac", "ddc", "tlc"))
TTC, LK, HC, EP = (LABELLED.index(name) for name in ("ttc", "lk", "hc", "ep"))
_WHOLES = tuple(LABELLED.index(name) for name in WHOLES)


class Verdicts(NamedTuple):
    """What the rules say of K trajectories; a sub-score without a rule is NaN."""

    scores: Array  # (S + 1, K) by LABELLED; of EP the progress [m]
    fails: Array  # (S, K) by JUDGED: the time index (0.1 s) at which it first fails, inf: never
    ego_areas: Bools  # (K, 41, 3)
    comfort: Bools  # (K, 6)


class Ego(NamedTuple):
    """The ego's body [m]."""

    half_length: float
    half_width: float
    rear_axle_to_center: float


class World(NamedTuple):
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


def judge(prepared: PreparedScene, states: Array, *, with_history: bool = True) -> Verdicts:
    """What the rules say of simulated ego states (K, 41, 11). Raises ValueError for other shapes, non-finite states."""
    obstacles = prepared.indexed_obstacles if len(states) >= INDEX_FROM_ROWS else prepared.obstacles
    return _verdicts(world_of(prepared, with_history), obstacles, _NO_BOXES, _NO_FLAGS, states)


def judge_among(
    prepared: PreparedScene, boxes: Array, is_stopped: Bools, collision_score: Array, states: Array
) -> Verdicts:
    """The same where every trajectory meets its own objects, those of the scene set aside.

    boxes: (K, 41, N, 5), NaN when absent; is_stopped: (K, N) and collision_score: (N,) as in Obstacles; states:
    (K, 41, 11). Raises ValueError for other shapes, non-finite states.
    """
    n_objects = len(collision_score)
    if boxes.shape != (len(states), N_TIMES, n_objects, 5) or is_stopped.shape != (len(states), n_objects):
        raise ValueError(
            f"boxes must be ({len(states)}, {N_TIMES}, {n_objects}, 5) and is_stopped ({len(states)}, {n_objects}), "
            f"got {boxes.shape} and {is_stopped.shape}"
        )
    nobody = unindexed(np.full((N_TIMES, n_objects, 5), np.nan), np.zeros(n_objects, np.bool_), collision_score)
    boxes, is_stopped = np.require(boxes, None, ["C", "W"]), np.require(is_stopped, None, ["C", "W"])
    return _verdicts(world_of(prepared, with_history=True), nobody, boxes, is_stopped, states)


def checked_states(states: Array) -> Array:
    """Contiguous float64 states (K >= 1, 41, 11). Raises ValueError where they are not."""
    states = _shaped(states)
    if not all_within(states):
        raise ValueError(_NO_DRIVE)
    return states


def _shaped(states: Array) -> Array:
    states = np.ascontiguousarray(states, dtype=np.float64)
    if states.ndim != 3 or states.shape[1:] != (N_TIMES, EGO_STATE_SIZE) or states.shape[0] == 0:
        raise ValueError(f"states must be (K >= 1, {N_TIMES}, {EGO_STATE_SIZE}), got {states.shape}")
    return states if states.flags.writeable else states.copy()


def _verdicts(world: World, obstacles: Obstacles, boxes: Array, is_stopped: Bools, states: Array) -> Verdicts:
    states = _shaped(states)
    scores, fails = np.empty((len(LABELLED), len(states))), np.empty((len(JUDGED), len(states)))
    areas, comfort = np.empty((len(states), N_TIMES, 3), np.bool_), np.empty((len(states), N_FLAGS), np.bool_)
    if not _judge_all(world, obstacles, boxes, is_stopped, states, scores, fails, areas, comfort):
        raise ValueError(_NO_DRIVE)
    return Verdicts(scores, fails, areas, comfort)


def world_of(prepared: PreparedScene, with_history: bool) -> World:
    """A prepared scene as the kernels take it."""
    vehicle: Vehicle = prepared.vehicle
    history = prepared.history if with_history and prepared.history is not None else np.empty((0, EGO_STATE_SIZE))
    return World(
        Ego(vehicle.half_length, vehicle.half_width, vehicle.rear_axle_to_center),
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
def _judge_all(
    world: World,
    obstacles: Obstacles,
    boxes: Array,  # (K, 41, N, 5) of each trajectory's own objects, or none: all meet `obstacles`
    is_stopped: Bools,  # (K, N)
    states: Array,
    scores: Array,  # these four out: Verdicts
    fails: Array,
    areas: Bools,
    comfort: Bools,
) -> bool:
    """False, and nothing judged, where a state is not finite or above LARGEST."""
    beyond = 0
    for value in states.reshape(-1):
        beyond += not abs(value) <= LARGEST
    if beyond > 0:
        return False
    out = Verdicts(scores, fails, areas, comfort)
    out.scores[:], out.fails[:] = math.nan, math.nan
    scratch = scratch_for(obstacles.boxes.shape[1])
    spans = spans_of(obstacles)
    for k in range(states.shape[0]):
        met = obstacles
        if boxes.shape[0] > 0:
            met = with_objects(obstacles, boxes[k], is_stopped[k])
            spans = spans_of(met)
        _judge_one(world, met, spans, states[k], scratch, k, out)
    return True


@kernel
def _judge_one(
    world: World, everything: Obstacles, spans: Array, states: Array, scratch: Scratch, k: int, out: Verdicts
) -> None:
    """All rules on one trajectory (41, 11), written to row k; spans: of `everything`."""
    body, half_length, half_width = scratch.body, world.ego.half_length, world.ego.half_width
    place(states, world.ego.rear_axle_to_center, body)
    areas_along(world.map_index, body, half_length, half_width)
    _spread_flags(body.flags, out.ego_areas[k])
    obstacles = within_reach(everything, spans, reach_of(body), 2.0 * half_length, 2.0 * half_width)
    out.scores[NC, k], out.fails[NC, k] = first_collision(
        obstacles, states, body, half_length, half_width, scratch.ignored
    )
    out.fails[DAC, k] = _first_with(body.flags, NON_DRIVABLE)
    out.scores[DDC, k], out.fails[DDC, k] = driving_direction(body)
    out.fails[TLC, k] = first_red(world.red_lanes, body, half_length, half_width)
    out.fails[TTC, k] = first_time_to_collision(
        obstacles, states, body, world.map_index, half_length, half_width, scratch.ignored
    )
    out.fails[LK, k] = lane_keeping(world.centerline, body)
    last = states.shape[0] - 1
    out.scores[EP, k] = progress_m(world.centerline, body.x[0], body.y[0], body.x[last], body.y[last])
    if len(world.history) > 0:
        out.fails[HC, k] = comfort_along(
            world.history, states, world.ego.rear_axle_to_center, scratch.comfort, out.comfort[k]
        )
    else:
        out.fails[HC, k] = math.inf
        out.comfort[k] = True
    for row in _WHOLES:
        out.scores[row, k] = 1.0 if out.fails[row, k] == math.inf else 0.0


@kernel
def _spread_flags(flags: NDArray[np.uint8], out: Bools) -> None:
    for t in range(len(flags)):
        out[t, 0] = flags[t] & MULTIPLE_LANES != 0
        out[t, 1] = flags[t] & NON_DRIVABLE != 0
        out[t, 2] = flags[t] & ONCOMING != 0


@kernel
def _first_with(flags: NDArray[np.uint8], bit: int) -> float:
    for t in range(len(flags)):
        if flags[t] & bit:
            return float(t)
    return math.inf

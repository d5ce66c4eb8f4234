"""Every rule applied to every trajectory, one after the other (docs/reward.md 2); no row depends on another."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tasks.kernels import kernel
from tasks.reward.area_flags import areas_along
from tasks.reward.centerline import Centerline, progress_m
from tasks.reward.comfort import comfort_along, comfort_scratch
from tasks.reward.contacts import first_collision, first_time_to_collision
from tasks.reward.ego import MULTIPLE_LANES, NON_DRIVABLE, ONCOMING, Body, empty_body, place
from tasks.reward.lane_discipline import driving_direction, lane_keeping
from tasks.reward.lights import RedLanes, first_red
from tasks.reward.map_index import MapIndex
from tasks.reward.obstacles import Obstacles, unindexed, with_objects
from tasks.reward.prepare import N_TIMES, PreparedScene
from tasks.world.bounds import LARGEST, all_within
from tasks.world.vehicle import EGO_STATE_SIZE, Vehicle

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

INDEX_FROM_ROWS = 32  # an index of the objects costs about as much as it saves on that many trajectories


class Verdicts(NamedTuple):
    """What the rules say of K trajectories, as in Scores; a `*_index` is a time index (0.1 s), inf: never."""

    nc: Array  # (K,)
    dac: Array  # (K,)
    ddc: Array  # (K,)
    tlc: Array  # (K,)
    ttc: Array  # (K,)
    lk: Array  # (K,)
    hc: Array  # (K,)
    ep_raw_m: Array  # (K,)
    collision_index: Array  # (K,)
    dac_index: Array  # (K,)
    ddc_index: Array  # (K,)
    tlc_index: Array  # (K,)
    ttc_index: Array  # (K,)
    lk_index: Array  # (K,)
    hc_index: Array  # (K,)
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
    states = checked_states(states)
    obstacles = prepared.indexed_obstacles if len(states) >= INDEX_FROM_ROWS else prepared.obstacles
    verdicts = no_verdicts(len(states))
    scratch = scratch_for(obstacles.boxes.shape[1])
    shared = np.empty((0, N_TIMES, 0, 5)), np.empty((0, 0), np.bool_)
    _judge_all(world_of(prepared, with_history), obstacles, *shared, states, scratch, verdicts)
    return verdicts


def judge_among(
    prepared: PreparedScene, boxes: Array, is_stopped: Bools, collision_score: Array, states: Array
) -> Verdicts:
    """The same where every trajectory meets its own objects, those of the scene set aside.

    boxes: (K, 41, N, 5), NaN when absent; is_stopped: (K, N) and collision_score: (N,) as in Obstacles; states:
    (K, 41, 11). Raises ValueError for other shapes, non-finite states.
    """
    states = checked_states(states)
    n_objects = len(collision_score)
    if boxes.shape != (len(states), N_TIMES, n_objects, 5) or is_stopped.shape != (len(states), n_objects):
        raise ValueError(
            f"boxes must be ({len(states)}, {N_TIMES}, {n_objects}, 5) and is_stopped ({len(states)}, {n_objects}), "
            f"got {boxes.shape} and {is_stopped.shape}"
        )
    verdicts = no_verdicts(len(states))
    nobody = unindexed(np.full((N_TIMES, n_objects, 5), np.nan), np.zeros(n_objects, np.bool_), collision_score)
    boxes, is_stopped = np.require(boxes, None, ["C", "W"]), np.require(is_stopped, None, ["C", "W"])
    world, scratch = world_of(prepared, with_history=True), scratch_for(n_objects)
    _judge_all(world, nobody, boxes, is_stopped, states, scratch, verdicts)
    return verdicts


def checked_states(states: Array) -> Array:
    """Contiguous float64 states (K >= 1, 41, 11). Raises ValueError where they are not."""
    states = np.require(states, dtype=np.float64, requirements=["C", "W"])
    if states.ndim != 3 or states.shape[1:] != (N_TIMES, EGO_STATE_SIZE) or states.shape[0] == 0:
        raise ValueError(f"states must be (K >= 1, {N_TIMES}, {EGO_STATE_SIZE}), got {states.shape}")
    if not all_within(states):
        raise ValueError(f"states must be finite and at most {LARGEST:g}: leave out what is not a drive")
    return states


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


def no_verdicts(count: int) -> Verdicts:
    """Room for the verdicts on `count` trajectories."""
    numbers = np.empty((15, count))
    flags = np.empty((count, N_TIMES, 3), np.bool_), np.empty((count, 6), np.bool_)
    return Verdicts._make([*numbers, *flags])


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
    scratch: Scratch,
    out: Verdicts,
) -> None:
    for k in range(states.shape[0]):
        met = obstacles if boxes.shape[0] == 0 else with_objects(obstacles, boxes[k], is_stopped[k])
        _judge_one(world, met, states[k], scratch, k, out)


@kernel
def _judge_one(world: World, obstacles: Obstacles, states: Array, scratch: Scratch, k: int, out: Verdicts) -> None:
    """All rules on one trajectory (41, 11), written to row k."""
    body, half_length, half_width = scratch.body, world.ego.half_length, world.ego.half_width
    place(states, world.ego.rear_axle_to_center, body)
    areas_along(world.map_index, body, half_length, half_width)
    _spread_flags(body.flags, out.ego_areas[k])
    out.nc[k], out.collision_index[k] = first_collision(
        obstacles, states, body, half_length, half_width, scratch.ignored
    )
    out.dac_index[k] = _first_with(body.flags, NON_DRIVABLE)
    out.ddc[k], out.ddc_index[k] = driving_direction(body)
    out.tlc_index[k] = first_red(world.red_lanes, body, half_length, half_width)
    out.ttc_index[k] = first_time_to_collision(
        obstacles, states, body, world.map_index, half_length, half_width, scratch.ignored
    )
    out.lk_index[k] = lane_keeping(world.centerline, body)
    last = states.shape[0] - 1
    out.ep_raw_m[k] = progress_m(world.centerline, body.x[0], body.y[0], body.x[last], body.y[last])
    if len(world.history) > 0:
        out.hc_index[k] = comfort_along(
            world.history, states, world.ego.rear_axle_to_center, scratch.comfort, out.comfort[k]
        )
    else:
        out.hc_index[k] = math.inf
        out.comfort[k] = True
    out.dac[k] = 1.0 if out.dac_index[k] == math.inf else 0.0
    out.tlc[k] = 1.0 if out.tlc_index[k] == math.inf else 0.0
    out.ttc[k] = 1.0 if out.ttc_index[k] == math.inf else 0.0
    out.lk[k] = 1.0 if out.lk_index[k] == math.inf else 0.0
    out.hc[k] = 1.0 if out.hc_index[k] == math.inf else 0.0


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

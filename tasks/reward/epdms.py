"""EPDMS: the sub-scores of ego trajectories and what they add up to (docs/reward.md 2)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, make_dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from tasks.kernels.compiled import hidden_kernel, inlined, kernel, read_only
from tasks.reward.areas import (
    N_CORNERS,
    NEVER_RED,
    Places,
    RedLanes,
    empty_places,
    first_red,
    index_red_lanes,
    set_area_flags,
)
from tasks.reward.centerline import (
    DDC_WINDOW,
    NON_DRIVABLE,
    Body,
    Centerline,
    as_states,
    driving_direction_compliance,
    empty_body,
    index_centerline,
    instants_of,
    lane_keeping_failure,
    place_body,
    progress_m,
)
from tasks.reward.collisions import (
    CIRCUMRADIUS,
    N_TIMES,
    Looks,
    Obstacles,
    empty_looks,
    first_contacts,
    obstacles_of_tracks,
    set_looks,
    with_index,
)
from tasks.reward.comfort import LANES, N_FLAGS, comfort_scratch, first_uncomfortable_steps, interpolated_history
from tasks.reward.map_index import MapIndex, index_map, with_clearance
from tasks.subscores import (
    EC_WEIGHT,
    INDEX,
    LABELLED,
    MULTIPLIERS,
    PROGRESS_THRESHOLD_M,
    TOTAL_WEIGHT,
    WEIGHTS,
    WHOLES,
    multiplier_product,
    weighted_sum,
)
from tasks.world.arrays import Array, Bools, Bytes
from tasks.world.clip import MOVING_KINDS, AgentKind, AgentTracks, Clip, Scene
from tasks.world.frames import (
    EGO_STATE_SIZE,
    HALF_LENGTH,
    HALF_WIDTH,
    LARGEST,
    PACIFICA,
    REAR_AXLE_TO_CENTER,
    ego_boxes,
)
from tasks.world.road_map import LightState, MapLayer, MapPolygon, polygons_near

# Everything the reward asks of a scene, made once and used for any number of ego trajectories (docs/reward.md 2).

PAST_STEPS = (0, 5, 10, 15)  # of the 1.5 s history at 10 Hz: -1.5, -1.0, -0.5, 0 s
NO_RED: tuple[tuple[str, ...], Bools] = (), np.zeros((N_TIMES, 0), dtype=bool)
_NOBODY = read_only(np.full(5, np.nan))
LANE_LAYERS = frozenset({MapLayer.LANE, MapLayer.LANE_CONNECTOR})


# A scene is prepared several times among different objects: by a planner, for its score, for every rollout. And many
# of a clip's candidates have the same polygons within reach; an index is some 4 MB.
@lru_cache(maxsize=12)
def _indexed_map(polygons: tuple[MapPolygon, ...], route_lane_ids: frozenset[str]) -> MapIndex:
    return with_clearance(index_map(polygons, route_lane_ids), CIRCUMRADIUS)


@lru_cache(maxsize=4)
def _indexed_line(shape: tuple[int, ...], points: bytes) -> Centerline:
    return index_centerline(np.frombuffer(points).reshape(shape).copy())


@dataclass(frozen=True)
class PreparedScene:
    """A scene ready to score ego trajectories of 4 s at 10 Hz; steps 0..40, 0 is now. Arrays only: it pickles."""

    history: Array | None  # (14, 11) ego states at -1.5 .. -0.2 s; None: history comfort is not judged
    centerline: Centerline
    map_index: MapIndex
    obstacles: Obstacles
    red_lanes: RedLanes

    @cached_property
    def indexed_obstacles(self) -> Obstacles:
        """The same obstacles, quicker to look up; made when first asked for, since only many trajectories repay it."""
        return with_index(self.obstacles)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Arrays that a shared object store hands out read-only are copied: the kernels are compiled for others."""
        self.__dict__.update({name: _writable(value) for name, value in state.items()})


def _writable(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return np.require(value, requirements=["C", "W"])
    return type(value)._make(map(_writable, value)) if hasattr(value, "_make") else value


def prepare(
    *,
    past_states: Array | None,
    centerline: Array,
    polygons: Sequence[MapPolygon],
    route_lane_ids: frozenset[str],
    objects: AgentTracks,
    red_lanes: tuple[tuple[str, ...], Bools] = NO_RED,
    ego_state0: Array | None = None,
    drop_touching: bool = True,
) -> PreparedScene:
    """Prepare a scene given as plain arrays.

    past_states: (4, 11) ego at -1.5, -1.0, -0.5, 0 s, or None to leave history comfort out; centerline: (P, >= 2) of
    the route ahead; polygons: the map around the ego; objects: tracks of at least 41 steps, row 0 is now; red_lanes:
    lane connectors, and when they are red (41, L); lanes that are not among `polygons` are out of
    reach and left out; ego_state0: (11,), by default the last past state.
    drop_touching: objects whose box touches the ego's at step 0 are left out for good, as the public log replay does.
    Raises ValueError, naming the argument, for a centreline without length and polygons that bound no area or cross
    themselves.
    """
    if ego_state0 is None and past_states is not None:
        ego_state0 = past_states[-1]
    return PreparedScene(
        history=None if past_states is None else interpolated_history(read_only(past_states)),
        centerline=_indexed_line(np.shape(centerline), np.ascontiguousarray(centerline, np.float64).tobytes()),
        map_index=_indexed_map(tuple(polygons), route_lane_ids),
        obstacles=_obstacles(objects, ego_state0 if drop_touching else None),
        red_lanes=_red(red_lanes, polygons),
    )


def prepare_scene(scene: Scene, agents: AgentTracks, drop_touching: bool = True) -> PreparedScene:
    """Prepare step `scene.step` of a clip against `agents` (41 steps, row 0 is that step): a rollout's or the log's.

    Lights are red for on-route lane connectors over steps scene.step .. scene.step + 40; drop_touching: see `prepare`.
    """
    clip = scene.clip
    return prepare(
        past_states=scene.ego_history[list(PAST_STEPS)],
        centerline=scene.centerline,
        polygons=polygons_near(clip.road_map, ego_boxes(scene.ego_state, PACIFICA)[:2]),
        route_lane_ids=clip.route.lane_ids,
        objects=agents,
        red_lanes=_red_connectors(clip, scene.step),
        drop_touching=drop_touching,
    )


def with_objects(prepared: PreparedScene, objects: AgentTracks, ego_state0: Array | None) -> PreparedScene:
    """The same scene among other objects: tracks of at least 41 steps, row 0 is now.

    Those that touch the ego at `ego_state0` (11,) are left out for good; None: nobody is.
    """
    return replace(prepared, obstacles=_obstacles(objects, ego_state0))


def _red_connectors(clip: Clip, step: int) -> tuple[tuple[str, ...], Bools]:
    """Lane connectors whose light counts on the route, ids (L,), and where it is red from `step` on, (41, L)."""
    lights, lanes, route = clip.lights, clip.road_map.lanes, clip.route
    lit = route.lane_ids if route.lit_lane_ids is None else route.lit_lane_ids
    governed = [
        i
        for i, lane_id in enumerate(lights.lane_ids)
        if lane_id in lit and lane_id in lanes and lanes[lane_id].is_intersection
    ]
    if not governed:
        return NO_RED
    states = lights.states[step : step + N_TIMES, governed]
    return tuple(lights.lane_ids[i] for i in governed), states == LightState.RED


def _obstacles(objects: AgentTracks, ego_state0: Array | None) -> Obstacles:
    """The objects but those that touch an ego at `ego_state0`."""
    return obstacles_of_tracks(
        read_only(objects.boxes),
        read_only(objects.velocities),
        read_only(objects.valid, np.bool_),
        collision_scores(objects.kinds),
        _NOBODY if ego_state0 is None else read_only(ego_boxes(ego_state0, PACIFICA)),
    )


@lru_cache(maxsize=4)
def collision_scores(kinds: tuple[AgentKind, ...]) -> Array:
    """What an at-fault collision with each of N objects leaves of NC (N,): 0 for road users. Not to be written to."""
    return read_only(np.array([0.0 if kind in MOVING_KINDS else 0.5 for kind in kinds]))


def _red(red_lanes: tuple[tuple[str, ...], Bools], polygons: Sequence[MapPolygon]) -> RedLanes:
    lane_ids, is_red = red_lanes
    if not lane_ids:  # the usual case, and half the cost of preparing a pair's lights
        return NEVER_RED
    lanes = {polygon.token: polygon for polygon in polygons if polygon.layer in LANE_LAYERS}
    columns = [i for i, lane_id in enumerate(lane_ids) if lane_id in lanes and is_red[:, i].any()]
    return index_red_lanes([lanes[lane_ids[i]] for i in columns], is_red[:, columns])


# Every rule applied to every trajectory, one after the other (docs/reward.md 2); no row depends on another.

INDEX_FROM_ROWS = 256  # an index takes 0.8 ms, about what it saves on that many trajectories

NC, DAC, DDC, TLC = (LABELLED.index(name) for name in ("nc", "dac", "ddc", "tlc"))
TTC, LK, HC = (LABELLED.index(name) for name in ("ttc", "lk", "hc"))
_WHOLES = tuple(LABELLED.index(name) for name in WHOLES)


class Verdicts(NamedTuple):
    """What the rules say of K trajectories; a sub-score without a rule stays as it was."""

    scores: Array  # (S + 1, K) by LABELLED; of EP nothing, which compares trajectories
    fails: Array  # (S, K) by JUDGED: the time index (0.1 s) at which it first fails, inf: never
    ep_raw_m: Array  # (K,) progress along the centreline [m]
    comfort: Bools  # (K, 6)


class RuleContext(NamedTuple):
    """What a trajectory is judged against, but for the objects."""

    centerline: Centerline
    map_index: MapIndex
    red_lanes: RedLanes
    history: Array  # (14, 11), or (0, 11): history comfort is not judged


class Scratch(NamedTuple):
    """Reused from block to block; one for each thread."""

    body: Body
    places: Places
    looks: Looks
    moved: Array  # see driving_direction_compliance
    begun: Array  # see progress_m
    comfort: Array


def rule_context(prepared: PreparedScene, with_history: bool) -> RuleContext:
    """A prepared scene as the kernels take it."""
    history = prepared.history if with_history and prepared.history is not None else np.empty((0, EGO_STATE_SIZE))
    return RuleContext(prepared.centerline, prepared.map_index, prepared.red_lanes, history)


@register_jitable
def empty_scratch(context: RuleContext, n_objects: int, n_block: int) -> Scratch:
    """Room for that many trajectories at once among N objects."""
    n = n_block * N_TIMES
    places, looks = empty_places(context.map_index, N_CORNERS * n), empty_looks(n, N_TIMES, n_objects)
    comfort, begun = comfort_scratch(len(context.history) + N_TIMES), np.empty(3)
    begun[0] = math.nan  # nowhere yet
    return Scratch(empty_body(n), places, looks, np.empty(DDC_WINDOW - 1 + N_TIMES), begun, comfort)


@hidden_kernel
def judge_block(
    context: RuleContext, obstacles: Obstacles, states: Array, first: int, n: int, scratch: Scratch, out: Verdicts
) -> bool:
    """All rules on n trajectories of states (K, 41, 11), written to rows `first` on. False where a state is none."""
    rows = states[first : first + n].reshape(n * N_TIMES, EGO_STATE_SIZE)
    values, beyond = rows.reshape(-1), 0
    for i in range(len(values)):
        beyond += not abs(values[i]) <= LARGEST
    if beyond > 0:
        return False
    body = scratch.body
    place_body(rows, REAR_AXLE_TO_CENTER, body)
    set_area_flags(context.map_index, body, HALF_LENGTH, HALF_WIDTH, scratch.places)
    set_looks(body, scratch.looks)
    if len(context.history) > 0:
        here = slice(first, first + n)
        first_uncomfortable_steps(
            context.history, states[here], scratch.comfort, out.comfort[here], out.fails[HC][here]
        )
    for k in range(first, first + n):
        start = (k - first) * N_TIMES
        judge_one(context, obstacles, states[k], instants_of(body, start, start + N_TIMES), start, scratch, k, out)
    return True


@inlined
def judge_one(
    context: RuleContext,
    obstacles: Obstacles,
    states: Array,
    body: Body,
    start: int,
    scratch: Scratch,
    k: int,
    out: Verdicts,
) -> None:
    """All rules but comfort on one trajectory (41, 11) of a block, whose instants begin at `start`; to row k."""
    out.scores[NC, k], out.fails[NC, k], out.fails[TTC, k] = first_contacts(
        obstacles, states, body, scratch.looks, start, context.map_index, scratch.places
    )
    out.fails[DAC, k] = _first_with(body.flags, NON_DRIVABLE)
    out.scores[DDC, k], out.fails[DDC, k] = driving_direction_compliance(body, scratch.moved)
    out.fails[TLC, k] = first_red(context.red_lanes, body, HALF_LENGTH, HALF_WIDTH)
    out.fails[LK, k] = lane_keeping_failure(context.centerline, body)
    last = states.shape[0] - 1
    out.ep_raw_m[k] = progress_m(context.centerline, body.x[0], body.y[0], body.x[last], body.y[last], scratch.begun)
    if len(context.history) == 0:
        out.fails[HC, k] = math.inf
        out.comfort[k] = True
    for row in _WHOLES:
        out.scores[row, k] = 1.0 if out.fails[row, k] == math.inf else 0.0


@hidden_kernel
def _first_with(flags: Bytes, bit: int) -> float:
    for t in range(len(flags)):
        if flags[t] & bit:
            return float(t)
    return math.inf


Normalise = Literal["batch", "pairs"]
_NORMALISE = get_args(Normalise)
_COLUMNS = (*LABELLED, *INDEX.values())
_Columns: Any = make_dataclass("_Columns", [(name, Array) for name in _COLUMNS], frozen=True)

# Rows of a table of scores (N_ROWS, K): the fields of Scores in their order, up to its flags
N_ROWS = len(_COLUMNS) + 3
NO_REFERENCE = -1.0  # [m]
_EP, _N_SCORES = LABELLED.index("ep"), len(LABELLED)
_EP_RAW_M, _MULTIPLIER, PDM_SCORE = range(len(_COLUMNS), N_ROWS)
_FACTORS = tuple(LABELLED.index(name) for name in MULTIPLIERS)
_TERMS = tuple((LABELLED.index(name), weight) for name, weight in WEIGHTS.items())


@dataclass(frozen=True)
class Scores(_Columns):
    """Scores of K trajectories; every array has K rows.

    First the sub-scores of one plan (K,) by their names, 0 .. 1, `ep` relative to the batch; then the time index (K,)
    (0.1 s) at which each but `ep` first fails, inf: never (tasks.subscores.INDEX). `lk_index` is where 2 s off the
    centreline are complete; `hc_index` is negative in the history.
    """

    ep_raw_m: Array  # (K,) progress along the centreline [m]
    multiplier: Array  # (K,) what the weighted mean is multiplied by
    pdm_score: Array  # (K,) multiplier times weighted mean, without EC
    comfort: Bools  # (K, 6) flags of history comfort, see comfort.history_comfort

    def __len__(self) -> int:
        return len(self.pdm_score)

    @property
    def first_failures(self) -> dict[str, Array]:
        """Sub-score -> time index (K,) at which it first fails, inf: never."""
        return {name: getattr(self, index) for name, index in INDEX.items()}


def score(
    prepared: PreparedScene, states: Array, *, normalise: Normalise = "batch", with_history: bool = True
) -> Scores:
    """Score simulated ego states (K, 41, 11).

    normalise: "batch" relates progress to the best compliant progress of all rows, as the public scorer does with its
    batch; "pairs" scores each row as if in a two-row batch with row 0 (its reference, usually PDM-Closed), and row 0
    as if alone. with_history=False leaves history comfort at 1, as the public passes over the human and PDM-Closed do.
    Raises ValueError for other shapes or non-finite states.
    """
    if normalise not in _NORMALISE:
        raise ValueError(f"normalise must be one of {_NORMALISE}, got {normalise!r}")
    states = as_states("states", states)
    table = np.empty((N_ROWS, len(states)))
    comfort = np.empty((len(states), N_FLAGS), np.bool_)
    context, in_pairs = rule_context(prepared, with_history), normalise == "pairs"
    obstacles = prepared.indexed_obstacles if len(states) >= INDEX_FROM_ROWS else prepared.obstacles
    if not score_all(context, obstacles, states, in_pairs, NO_REFERENCE, table, comfort):
        raise ValueError(f"states must be finite and at most {LARGEST:g}: leave out what is not a drive")
    return Scores(*[*table, comfort])


def score_with_ec(scores: Scores, ec: Array) -> Array:
    """The final per-frame score (K,): the multiplier times the weighted mean, with extended comfort (K,)."""
    final: Array = scores.multiplier * (weighted_sum(vars(scores)) + EC_WEIGHT * ec) / (TOTAL_WEIGHT + EC_WEIGHT)
    return final


def human_filtered(scores: Scores, human: Scores) -> Scores:
    """The human-penalty filter: a sub-score at which the logged human gets exactly 0 becomes 1 (docs/reward.md 2l).

    human: one row, scored alone and without history against its own traffic. Multiplier and score are recomputed.
    Raises ValueError unless `human` has one row.
    """
    if len(human) != 1:
        raise ValueError(f"the human must be one row, got {len(human)}")
    forgiven: dict[str, Any] = {
        name: np.ones(len(scores)) for name in (*MULTIPLIERS, *WEIGHTS) if getattr(human, name)[0] == 0.0
    }
    scores = replace(scores, **forgiven)
    multiplier = multiplier_product(vars(scores))
    pdm_score = multiplier * weighted_sum(vars(scores)) / TOTAL_WEIGHT
    return replace(scores, multiplier=multiplier, pdm_score=pdm_score)


def select_rows(scores: Scores, index: slice | NDArray[np.integer] | Bools) -> Scores:
    """The chosen rows of the scores; progress stays relative to the batch it was scored in."""
    return Scores(**{field.name: getattr(scores, field.name)[index] for field in fields(Scores)})


@kernel
def score_all(
    context: RuleContext,
    obstacles: Obstacles,
    states: Array,  # (K, 41, 11)
    in_pairs: bool,
    reference_m: float,  # compliant progress of a reference that is not among the states; NO_REFERENCE: there is none
    table: Array,
    comfort: Bools,
) -> bool:
    """All rules and sums. One call: on two trajectories entering it takes as long as the rules.

    table: (N_ROWS, K), comfort: (K, 6), both out. False where a state is not finite or above LARGEST.
    """
    table[:] = math.nan  # what no rule says
    out = Verdicts(table[:_N_SCORES], table[_N_SCORES:_EP_RAW_M], table[_EP_RAW_M], comfort)
    n = min(LANES, len(states))
    scratch = empty_scratch(context, obstacles.boxes.shape[1], n)
    for first in range(0, len(states), n):  # the last block is a whole one too, some of it judged again
        if not judge_block(context, obstacles, states, min(first, len(states) - n), n, scratch, out):
            return False
    add_up(table, in_pairs, reference_m)
    return True


@kernel
def add_up(table: Array, in_pairs: bool, reference_m: float) -> None:
    """EP, multiplier and PDM score of a table (N_ROWS, K) from its other rows."""
    for k in range(table.shape[1]):
        multiplier = 1.0
        for row in _FACTORS:
            multiplier *= table[row, k]
        table[_MULTIPLIER, k] = multiplier
    if reference_m >= 0.0:
        ep = progress_beside(table[_EP_RAW_M], table[_MULTIPLIER], reference_m)
    else:
        ep = relative_progress(table[_EP_RAW_M], table[_MULTIPLIER], in_pairs)
    for k in range(table.shape[1]):
        table[_EP, k] = ep[k]
        total = 0.0
        for row, weight in _TERMS:
            total += weight * table[row, k]
        table[PDM_SCORE, k] = table[_MULTIPLIER, k] * total / TOTAL_WEIGHT


@kernel
def relative_progress(ep_raw_m: Array, multiplier: Array, in_pairs: bool) -> Array:
    """EP (K,): raw progress over the best compliant one, clipped to 0 .. 1; 1 where that best is at most 5 m."""
    best = ep_raw_m[0] * multiplier[0]
    if not in_pairs:
        for k in range(len(ep_raw_m)):
            best = max(best, ep_raw_m[k] * multiplier[k])
    return progress_beside(ep_raw_m, multiplier, best)


@kernel
def progress_beside(ep_raw_m: Array, multiplier: Array, best: float) -> Array:
    """EP (K,) of each trajectory alone beside a compliant progress `best` [m]."""
    ep = np.ones(len(ep_raw_m))
    for k in range(len(ep_raw_m)):
        best_here = max(best, ep_raw_m[k] * multiplier[k])
        if best_here > PROGRESS_THRESHOLD_M:
            ep[k] = min(max(ep_raw_m[k] / best_here, 0.0), 1.0)
    return ep

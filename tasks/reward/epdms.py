"""EPDMS: the sub-scores of ego trajectories and what they add up to (docs/reward.md 2)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, make_dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel
from tasks.reward.formula import (
    EC_WEIGHT,
    MULTIPLIERS,
    PROGRESS_THRESHOLD_M,
    TOTAL_WEIGHT,
    WEIGHTS,
    multiplied,
    weighted,
)
from tasks.reward.prepare import PreparedScene
from tasks.reward.rules.comfort import N_FLAGS
from tasks.reward.rules.ego import no_drive, shaped
from tasks.reward.rules.obstacles import N_TIMES, Obstacles, unindexed, with_objects
from tasks.reward.verdicts import INDEX_FROM_ROWS, RuleContext, Verdicts, context_of, judge_one, scratch_for
from tasks.subscores import INDEX, LABELLED
from tasks.world.arrays import Array, Bools
from tasks.world.geometry import LARGEST

Normalise = Literal["batch", "pairs"]
_NORMALISE = get_args(Normalise)
_NO_BOXES, _NO_FLAGS = np.empty((0, N_TIMES, 0, 5)), np.empty((0, 0), np.bool_)
_COLUMNS = (*LABELLED, *INDEX.values())
_Columns: Any = make_dataclass("_Columns", [(name, Array) for name in _COLUMNS], frozen=True)

# Rows of a table of scores (N_ROWS, K): the fields of Scores in their order, up to its flags
N_ROWS = len(_COLUMNS) + 3
_EP, _N_SCORES = LABELLED.index("ep"), len(LABELLED)
_EP_RAW_M, _MULTIPLIER, _PDM_SCORE = range(len(_COLUMNS), N_ROWS)
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
    ego_areas: Bools  # (K, 41, 3) multiple lanes, non-drivable, oncoming
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
    obstacles = prepared.indexed_obstacles if len(states) >= INDEX_FROM_ROWS else prepared.obstacles
    return _scored(context_of(prepared, with_history), obstacles, _NO_BOXES, _NO_FLAGS, states, _in_pairs(normalise))


def score_among(
    prepared: PreparedScene, boxes: Array, is_stopped: Bools, collision_score: Array, states: Array
) -> Scores:
    """The same in pairs where every trajectory meets its own objects, those of the scene set aside.

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
    return _scored(context_of(prepared, with_history=True), nobody, boxes, is_stopped, states, True)


def joined(parts: Sequence[Scores], normalise: Normalise) -> Scores:
    """The rows of all parts, their progress related anew; `normalise` as in `score`."""
    *numbers, areas, comfort = (np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Scores))
    table = np.stack(numbers)
    _add_up(table, _in_pairs(normalise))
    return Scores(*[*table, areas, comfort])


def _scored(
    context: RuleContext, obstacles: Obstacles, boxes: Array, is_stopped: Bools, states: Array, in_pairs: bool
) -> Scores:
    states = shaped("states", states)
    table = np.empty((N_ROWS, len(states)))
    areas, comfort = np.empty((len(states), N_TIMES, 3), np.bool_), np.empty((len(states), N_FLAGS), np.bool_)
    if not _score_all(context, obstacles, boxes, is_stopped, states, in_pairs, table, areas, comfort):
        raise no_drive("states")
    return Scores(*[*table, areas, comfort])


def _in_pairs(normalise: Normalise) -> bool:
    if normalise not in _NORMALISE:
        raise ValueError(f"normalise must be one of {_NORMALISE}, got {normalise!r}")
    return normalise == "pairs"


def score_with_ec(scores: Scores, ec: Array) -> Array:
    """The final per-frame score (K,): the multiplier times the weighted mean, with extended comfort (K,)."""
    final: Array = scores.multiplier * (weighted(vars(scores)) + EC_WEIGHT * ec) / (TOTAL_WEIGHT + EC_WEIGHT)
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
    multiplier = multiplied(vars(scores))
    pdm_score = multiplier * weighted(vars(scores)) / TOTAL_WEIGHT
    return replace(scores, multiplier=multiplier, pdm_score=pdm_score)


def rows(scores: Scores, index: slice | NDArray[np.integer] | Bools) -> Scores:
    """The chosen rows of the scores; progress stays relative to the batch it was scored in."""
    return Scores(**{field.name: getattr(scores, field.name)[index] for field in fields(Scores)})


@kernel
def _score_all(
    context: RuleContext,
    obstacles: Obstacles,
    boxes: Array,  # (K, 41, N, 5) of each trajectory's own objects, or none: all meet `obstacles`
    is_stopped: Bools,  # (K, N)
    states: Array,  # (K, 41, 11)
    in_pairs: bool,
    table: Array,
    areas: Bools,
    comfort: Bools,
) -> bool:
    """All rules and sums. One call: on two trajectories entering it takes as long as the rules.

    False, and nothing judged, where a state is not finite or above LARGEST.
    """
    beyond = 0
    for value in states.reshape(-1):
        beyond += not abs(value) <= LARGEST
    if beyond > 0:
        return False
    table[:] = math.nan  # what no rule says
    out = Verdicts(table[:_N_SCORES], table[_N_SCORES:_EP_RAW_M], table[_EP_RAW_M], areas, comfort)
    scratch = scratch_for(obstacles.boxes.shape[1])
    for k in range(states.shape[0]):
        met = obstacles
        if boxes.shape[0] > 0:
            met = with_objects(obstacles, boxes[k], is_stopped[k])
        judge_one(context, met, states[k], scratch, k, out)
    _add_up(table, in_pairs)
    return True


@kernel
def _add_up(table: Array, in_pairs: bool) -> None:
    """EP, multiplier and PDM score of a table (N_ROWS, K) from its other rows."""
    for k in range(table.shape[1]):
        multiplier = 1.0
        for row in _FACTORS:
            multiplier *= table[row, k]
        table[_MULTIPLIER, k] = multiplier
    ep = relative_progress(table[_EP_RAW_M], table[_MULTIPLIER], in_pairs)
    for k in range(table.shape[1]):
        table[_EP, k] = ep[k]
        total = 0.0
        for row, weight in _TERMS:
            total += weight * table[row, k]
        table[_PDM_SCORE, k] = table[_MULTIPLIER, k] * total / TOTAL_WEIGHT


@kernel
def relative_progress(ep_raw_m: Array, multiplier: Array, in_pairs: bool) -> Array:
    """EP (K,): raw progress over the best compliant one, clipped to 0 .. 1; 1 where that best is at most 5 m."""
    best = ep_raw_m[0] * multiplier[0]
    if not in_pairs:
        for k in range(len(ep_raw_m)):
            best = max(best, ep_raw_m[k] * multiplier[k])
    ep = np.ones(len(ep_raw_m))
    for k in range(len(ep_raw_m)):
        best_here = max(best, ep_raw_m[k] * multiplier[k])
        if best_here > PROGRESS_THRESHOLD_M:
            ep[k] = min(max(ep_raw_m[k] / best_here, 0.0), 1.0)
    return ep

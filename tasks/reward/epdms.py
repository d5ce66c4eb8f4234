"""EPDMS: the sub-scores of ego trajectories and what they add up to (docs/reward.md 2)."""

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
from tasks.reward.verdicts import EP, Verdicts, judge
from tasks.subscores import INDEX, JUDGED, LABELLED, OF_ONE_PLAN

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Normalise = Literal["batch", "pairs"]
_NORMALISE = get_args(Normalise)
_FACTORS = tuple(LABELLED.index(name) for name in MULTIPLIERS)  # rows of Verdicts.scores
_TERMS = tuple((LABELLED.index(name), weight) for name, weight in WEIGHTS.items())
_RULED, _INSTANTS = (*JUDGED, "ep_raw_m"), tuple(INDEX.values())
_Columns: Any = make_dataclass("_Columns", [(name, Array) for name in (*OF_ONE_PLAN, *_INSTANTS)], frozen=True)


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
    return combined(judge(prepared, states, with_history=with_history), normalise)


def combined(verdicts: Verdicts, normalise: Normalise = "batch") -> Scores:
    """What verdicts on K trajectories add up to; `normalise` as in `score`."""
    scores, fails, ego_areas, comfort = verdicts
    ep, multiplier, pdm_score = _combined(scores, _in_pairs(normalise))
    named = dict(zip(_RULED, scores)) | dict(zip(_INSTANTS, fails))
    return Scores(ep=ep, multiplier=multiplier, pdm_score=pdm_score, ego_areas=ego_areas, comfort=comfort, **named)


def relative_progress(ep_raw_m: Array, multiplier: Array, normalise: Normalise) -> Array:
    """EP (K,): raw progress over the best compliant one, clipped to 0 .. 1; 1 where that best is at most 5 m."""
    return _relative(ep_raw_m, multiplier, _in_pairs(normalise))


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


def rows(scores: Scores, index: slice | NDArray[np.integer] | NDArray[np.bool_]) -> Scores:
    """The chosen rows of the scores; progress stays relative to the batch it was scored in."""
    return Scores(**{field.name: getattr(scores, field.name)[index] for field in fields(Scores)})


@kernel
def _combined(scores: Array, in_pairs: bool) -> tuple[Array, Array, Array]:
    """EP, multiplier and PDM score (K,) of Verdicts.scores.

    One call: on two trajectories, numpy's dozen take longer than the rules.
    """
    multiplier, total = np.ones(scores.shape[1]), np.zeros(scores.shape[1])
    for row in _FACTORS:
        multiplier *= scores[row]
    ep = _relative(scores[EP], multiplier, in_pairs)
    for row, weight in _TERMS:
        total += weight * (ep if row == EP else scores[row])
    return ep, multiplier, multiplier * total / TOTAL_WEIGHT


@kernel
def _relative(ep_raw_m: Array, multiplier: Array, in_pairs: bool) -> Array:
    """EP (K,) as `relative_progress`."""
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

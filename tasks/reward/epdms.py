"""EPDMS: the sub-scores of ego trajectories and what they add up to (docs/reward.md 2)."""

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from tasks.reward.formula import EC_WEIGHT, MULTIPLIERS, WEIGHTS, share_of_best
from tasks.reward.prepare import PreparedScene
from tasks.reward.verdicts import Verdicts, judge

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Normalise = Literal["batch", "pairs"]


@dataclass(frozen=True)
class Scores:
    """Scores of K trajectories; every array has K rows. A `*_index` is a time index (0.1 s), inf: never."""

    nc: Array  # (K,) no at-fault collision: 0, 0.5, 1
    dac: Array  # (K,) drivable area compliance: 0, 1
    ddc: Array  # (K,) driving direction compliance: 0, 0.5, 1
    tlc: Array  # (K,) traffic light compliance: 0, 1
    ep: Array  # (K,) ego progress, 0 .. 1, relative to the batch
    ttc: Array  # (K,) time to collision: 0, 1
    lk: Array  # (K,) lane keeping: 0, 1
    hc: Array  # (K,) history comfort: 0, 1
    ep_raw_m: Array  # (K,) progress along the centreline [m]
    multiplier: Array  # (K,) nc dac tlc ddc
    pdm_score: Array  # (K,) multiplier (5 ep + 5 ttc + 2 lk + 2 hc) / 14
    collision_index: Array  # (K,) first at-fault collision
    dac_index: Array  # (K,) first off the drivable area
    ddc_index: Array  # (K,) first with 2 m against traffic within 1 s
    tlc_index: Array  # (K,) first on a red lane
    ttc_index: Array  # (K,) first with a collision ahead
    lk_index: Array  # (K,) completes 2 s off the centreline
    hc_index: Array  # (K,) first uncomfortable; negative: in the history
    ego_areas: Bools  # (K, 41, 3) multiple lanes, non-drivable, oncoming
    comfort: Bools  # (K, 6) flags of history comfort, see comfort.history_comfort

    def __len__(self) -> int:
        return len(self.nc)

    @property
    def first_failures(self) -> dict[str, Array]:
        """Sub-score -> time index (K,) at which it first fails, inf: never."""
        return {
            "nc": self.collision_index,
            "dac": self.dac_index,
            "ddc": self.ddc_index,
            "tlc": self.tlc_index,
            "ttc": self.ttc_index,
            "lk": self.lk_index,
            "hc": self.hc_index,
        }


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
    raw = verdicts._asdict()
    multiplier = np.prod([raw[name] for name in MULTIPLIERS], axis=0)
    ep = relative_progress(verdicts.ep_raw_m, multiplier, normalise)
    return _combined(Scores(ep=ep, multiplier=multiplier, pdm_score=np.zeros_like(ep), **raw))


def relative_progress(ep_raw_m: Array, multiplier: Array, normalise: Normalise) -> Array:
    """EP (K,): raw progress over the best compliant one, clipped to 0 .. 1; 1 where that best is at most 5 m."""
    if normalise not in get_args(Normalise):
        raise ValueError(f"normalise must be one of {get_args(Normalise)}, got {normalise!r}")
    compliant = ep_raw_m * multiplier
    best = np.full_like(compliant, compliant.max()) if normalise == "batch" else np.maximum(compliant, compliant[0])
    return share_of_best(ep_raw_m, best)


def score_with_ec(scores: Scores, ec: Array) -> Array:
    """The final per-frame score (K,): multiplier (5 ep + 5 ttc + 2 lk + 2 hc + 2 ec) / 16; ec: (K,)."""
    total = sum(WEIGHTS.values()) + EC_WEIGHT
    final: Array = scores.multiplier * (_weighted(scores) + EC_WEIGHT * ec) / total
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
    return _combined(replace(scores, **forgiven))


def rows(scores: Scores, index: slice | NDArray[np.integer] | NDArray[np.bool_]) -> Scores:
    """The chosen rows of the scores; progress stays relative to the batch it was scored in."""
    return Scores(**{field.name: getattr(scores, field.name)[index] for field in fields(Scores)})


def _weighted(scores: Scores) -> Array:
    return sum((weight * getattr(scores, name) for name, weight in WEIGHTS.items()), np.zeros(len(scores)))


def _combined(scores: Scores) -> Scores:
    """The scores with multiplier and pdm_score made from the sub-scores."""
    scores = replace(scores, multiplier=np.prod([getattr(scores, name) for name in MULTIPLIERS], axis=0))
    return replace(scores, pdm_score=scores.multiplier * _weighted(scores) / sum(WEIGHTS.values()))

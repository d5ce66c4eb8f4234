"""EPDMS: the sub-scores of ego trajectories and what they add up to (docs/reward.md 2)."""

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel
from tasks.reward.formula import EC_WEIGHT, MULTIPLIERS, PROGRESS_THRESHOLD_M, WEIGHTS
from tasks.reward.prepare import PreparedScene
from tasks.reward.verdicts import Verdicts, judge

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Normalise = Literal["batch", "pairs"]
_NORMALISE = get_args(Normalise)
EP_WEIGHT, TTC_WEIGHT, LK_WEIGHT, HC_WEIGHT = (WEIGHTS[name] for name in ("ep", "ttc", "lk", "hc"))
TOTAL_WEIGHT = sum(WEIGHTS.values())


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
    v = verdicts
    ep, multiplier, pdm_score = _combined(
        v.nc, v.dac, v.tlc, v.ddc, v.ttc, v.lk, v.hc, v.ep_raw_m, _in_pairs(normalise)
    )
    return Scores(ep=ep, multiplier=multiplier, pdm_score=pdm_score, **v._asdict())


def relative_progress(ep_raw_m: Array, multiplier: Array, normalise: Normalise) -> Array:
    """EP (K,): raw progress over the best compliant one, clipped to 0 .. 1; 1 where that best is at most 5 m."""
    return _relative(ep_raw_m, multiplier, _in_pairs(normalise))


def _in_pairs(normalise: Normalise) -> bool:
    if normalise not in _NORMALISE:
        raise ValueError(f"normalise must be one of {_NORMALISE}, got {normalise!r}")
    return normalise == "pairs"


def score_with_ec(scores: Scores, ec: Array) -> Array:
    """The final per-frame score (K,): multiplier (5 ep + 5 ttc + 2 lk + 2 hc + 2 ec) / 16; ec: (K,)."""
    weighted = _weighted(scores.ep, scores.ttc, scores.lk, scores.hc) + EC_WEIGHT * ec
    final: Array = scores.multiplier * weighted / (TOTAL_WEIGHT + EC_WEIGHT)
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
    multiplier = _product(scores.nc, scores.dac, scores.tlc, scores.ddc)
    pdm_score = multiplier * _weighted(scores.ep, scores.ttc, scores.lk, scores.hc) / TOTAL_WEIGHT
    return replace(scores, multiplier=multiplier, pdm_score=pdm_score)


def rows(scores: Scores, index: slice | NDArray[np.integer] | NDArray[np.bool_]) -> Scores:
    """The chosen rows of the scores; progress stays relative to the batch it was scored in."""
    return Scores(**{field.name: getattr(scores, field.name)[index] for field in fields(Scores)})


@kernel
def _combined(
    nc: Array,
    dac: Array,
    tlc: Array,
    ddc: Array,
    ttc: Array,
    lk: Array,
    hc: Array,
    ep_raw_m: Array,
    in_pairs: bool,
) -> tuple[Array, Array, Array]:
    """EP, multiplier and PDM score (K,). One call: on two trajectories, numpy's dozen take longer than the rules."""
    multiplier = _product(nc, dac, tlc, ddc)
    ep = _relative(ep_raw_m, multiplier, in_pairs)
    return ep, multiplier, multiplier * _weighted(ep, ttc, lk, hc) / TOTAL_WEIGHT


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


@register_jitable
def _product(nc: Array, dac: Array, tlc: Array, ddc: Array) -> Array:
    return nc * dac * tlc * ddc


@register_jitable
def _weighted(ep: Array, ttc: Array, lk: Array, hc: Array) -> Array:
    return EP_WEIGHT * ep + TTC_WEIGHT * ttc + LK_WEIGHT * lk + HC_WEIGHT * hc

"""How predicted sub-scores of a vocabulary become one number each, by which one trajectory is chosen.

    total = sum_i w_i log p_i + group log(sum_j v_j p_j)

over probabilities p: what multiplies in EPDMS and imitation in logarithms of their own, what is averaged there under
one. `release` and `proposals` are those of GTRS, navsim/agents/gtrs_dense/hydra_model.py (read in OpenDriveLab/SimScale
04cda10 and woxihuanjiangguo/ZTRS 3593a03, which agree). Neither weighs history comfort, for which those models have no
head.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

IMITATION = "imitation"

WeightingName = Literal["release", "proposals", "close"]


@dataclass(frozen=True)
class Weighting:
    """The weights of the sum above; what is not named weighs nothing."""

    alone: Mapping[str, float]  # w
    group: float
    inside: Mapping[str, float]  # v


WEIGHTINGS: dict[WeightingName, Weighting] = {
    # HydraTrajHead.forward: what GTRS-Dense plans with; SimScale's scripts use it for navhard and navtest alike
    "release": Weighting(
        {IMITATION: 0.03, "tlc": 0.1, "nc": 0.1, "dac": 0.9, "ddc": 0.2}, 6.0, {"ttc": 7.0, "ep": 7.0, "lk": 3.0}
    ),
    # HydraTrajHead.eval_dp_proposals: trajectories of a diffusion policy ranked beside the vocabulary; the scores of
    # 87.0 and 86.6 in its comment are of navtest's range
    "proposals": Weighting(
        {IMITATION: 0.01, "tlc": 0.1, "nc": 0.5, "dac": 0.5, "ddc": 0.5}, 3.0, {"ttc": 5.0, "ep": 5.0, "lk": 2.0}
    ),
    # ours: `release` with ten times its imitation, for small planners over hundreds of trajectories
    "close": Weighting(
        {IMITATION: 0.3, "tlc": 0.1, "nc": 0.1, "dac": 0.9, "ddc": 0.2}, 6.0, {"ttc": 7.0, "ep": 7.0, "lk": 3.0}
    ),
}


def total(scores: Mapping[str, Tensor], weighting: Weighting) -> Tensor:
    """One number (B, K) from probabilities (B, K) by name, comparable within a row only."""
    inside = sum(weight * scores[name].float() for name, weight in weighting.inside.items())
    assert isinstance(inside, Tensor)
    result = weighting.group * _log(inside)
    for name, weight in weighting.alone.items():
        result = result + weight * _log(scores[name].float())
    return result


def choose(scores: Mapping[str, Tensor], weighting: Weighting) -> Tensor:
    """Index (B,) of the best of K; of equals the first."""
    return total(scores, weighting).argmax(dim=1)


def _log(x: Tensor) -> Tensor:
    return x.clamp_min(torch.finfo(torch.float32).tiny).log()  # a probability that underflowed must not be -inf

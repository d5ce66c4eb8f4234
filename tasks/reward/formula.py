"""What sub-scores weigh in a score, and what progress counts as (docs/reward.md 2k). Needs numpy only."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MULTIPLIERS = ("nc", "dac", "tlc", "ddc")
WEIGHTS = {"ep": 5.0, "ttc": 5.0, "lk": 2.0, "hc": 2.0}
EC_WEIGHT = 2.0
PROGRESS_THRESHOLD_M = 5.0


def share_of_best(gained_m: Array, best_m: Array) -> Array:
    """EP (K,): metres gained over the best metres (K,), clipped to 0 .. 1; 1 where that best is at most 5 m."""
    far_enough = best_m > PROGRESS_THRESHOLD_M
    return np.where(far_enough, np.clip(gained_m / np.where(far_enough, best_m, 1.0), 0.0, 1.0), 1.0)

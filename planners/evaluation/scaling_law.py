"""How a score grows with the amount of data: S(N) = a log^2 N + b log N + c (paper, section 4.3, eq. 7 and 8).

N counts real and simulated samples together, log is the natural one. Where a < 0 the curve has a top, the amount of
data beyond which more of it hurts.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tasks.world.arrays import Array

FEWEST = 4  # points: three parameters and one degree of freedom for the residuals


@dataclass(frozen=True)
class ScalingLaw:
    """A fitted curve."""

    a: float
    b: float
    c: float
    residual_std: float  # sqrt(sum of squared residuals / (points - 3)): half the height of the band

    def score(self, n: Array | float) -> Array:
        """S at data sizes n."""
        log_n = np.log(n)
        return np.asarray(self.a * log_n**2 + self.b * log_n + self.c)

    @property
    def saturation(self) -> float | None:
        """The data size where the curve is highest, exp(-b / 2a); None where it has no top (a >= 0).

        Infinite where that is beyond all numbers.
        """
        if self.a >= 0.0:
            return None
        log_n = -self.b / (2.0 * self.a)
        return math.exp(log_n) if log_n < 700.0 else math.inf


def fit_scaling(n: Sequence[int] | Array, scores: Sequence[float] | Array) -> ScalingLaw:
    """The least-squares curve through scores at data sizes n; the model is linear in a, b, c, so it is exact.

    Raises ValueError for fewer than 4 points, fewer than 3 different sizes, sizes below 1 or scores that are no number.
    """
    sizes, values = np.asarray(n, np.float64), np.asarray(scores, np.float64)
    if sizes.shape != values.shape or sizes.ndim != 1:
        raise ValueError(f"n and scores must be one number a point each, got {sizes.shape} and {values.shape}")
    if len(sizes) < FEWEST:
        raise ValueError(f"{len(sizes)} points: a scaling curve needs at least {FEWEST}; run more rounds")
    if not (np.isfinite(sizes).all() and (sizes >= 1).all() and np.isfinite(values).all()):
        raise ValueError("data sizes must be at least 1 and scores finite")
    if len(np.unique(sizes)) < 3:
        raise ValueError(f"data sizes {sorted(set(sizes.tolist()))}: at least 3 different ones are needed")
    # Columns about the mean of log N: the same curve, and a matrix that is far from singular.
    log_n = np.log(sizes)
    middle = log_n.mean()
    columns = np.stack([(log_n - middle) ** 2, log_n - middle, np.ones_like(log_n)], axis=1)
    (a, slope, level), *_ = np.linalg.lstsq(columns, values, rcond=None)
    residuals = values - columns @ np.array([a, slope, level])
    return ScalingLaw(
        a=float(a),
        b=float(slope - 2.0 * a * middle),
        c=float(level - slope * middle + a * middle**2),
        residual_std=float(np.sqrt((residuals**2).sum() / (len(sizes) - 3))),
    )

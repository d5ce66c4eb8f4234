"""Adam (Kingma and Ba 2015) for rows of an array, each with a count of steps of its own.

Only rows that a photo shows are stepped: what is out of sight keeps still, and its moments wait for it.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import F32, FloatArray, Ints, ShortInts

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


@dataclass
class Learned:
    """An array that is learned, with its moments."""

    values: F32  # (N, C)
    first: F32  # (N, C) running mean of the gradient
    second: F32  # (N, C) running mean of its square
    steps: ShortInts  # (N,) how often each row was stepped

    @classmethod
    def of(cls, values: FloatArray) -> "Learned":
        """Never stepped yet; `values` (N, C)."""
        start = np.array(values, np.float32, order="C")
        return cls(start, np.zeros_like(start), np.zeros_like(start), np.zeros(len(start), np.int32))

    def step(self, rows: Ints, gradient: F32, rate: float, scale: F32 | None = None) -> None:
        """Moves `rows` (M,), none twice, against `gradient` (M, C) by `rate`, times `scale` (M,) where given."""
        sizes = np.ones(len(rows), np.float32) if scale is None else scale
        self.steps[rows] += 1
        counts = np.arange(self.steps.max(initial=0) + 1)
        unbiased = np.stack([1.0 - BETA1**counts, 1.0 - BETA2**counts], axis=1)
        step_rows(self.values, self.first, self.second, self.steps, rows, gradient, rate, sizes, unbiased)

    def take(self, rows: Ints) -> "Learned":
        """The rows (M,), moments and all."""
        return Learned(self.values[rows], self.first[rows], self.second[rows], self.steps[rows])

    def forget(self, rows: Ints) -> None:
        """What `rows` are now has nothing to do with what they were."""
        self.first[rows], self.second[rows], self.steps[rows] = 0.0, 0.0, 0


@kernel
def step_rows(
    values: Any, first: Any, second: Any, steps: Any, rows: Any, gradient: Any, rate: float, sizes: Any, unbiased: Any
) -> None:
    """One step of `Learned`, in place: x -= rate size m / (sqrt(v) + eps), m and v without their start's bias."""
    for k in range(rows.shape[0]):
        i = rows[k]
        size = rate * sizes[k] / unbiased[steps[i], 0]
        unbiased2 = unbiased[steps[i], 1]
        for c in range(values.shape[1]):
            g = float(gradient[k, c])
            m = BETA1 * first[i, c] + (1.0 - BETA1) * g
            v = BETA2 * second[i, c] + (1.0 - BETA2) * g * g
            first[i, c] = m
            second[i, c] = v
            values[i, c] -= size * m / (math.sqrt(v / unbiased2) + EPSILON)

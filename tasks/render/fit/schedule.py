"""How step sizes fall, and in which order photos are looked at."""

import numpy as np

from tasks.world.arrays import Ints


def decayed(rate: float, end: float, progress: float) -> float:
    """Exponentially from `rate` at progress 0 to `end` times that at 1 (Kerbl et al. 2023)."""
    return float(rate * end ** min(max(progress, 0.0), 1.0))


def photo_at(iteration: int, n: int, seed: int) -> int:
    """Which of n photos an iteration looks at: each once per round, shuffled by seed and round alone."""
    return int(shuffled(n, seed, iteration // n)[iteration % n])


def shuffled(n: int, seed: int, epoch: int) -> Ints:
    """0 to n - 1 in the order of one round."""
    return np.random.Generator(np.random.Philox(key=[seed, epoch])).permutation(n)

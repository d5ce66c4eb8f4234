"""Which of several drives is the better one where their scores tell little: the smoother."""

import numpy as np

from tasks.world.arrays import Array, Ints
from tasks.world.clip import STEP_S
from tasks.world.vehicle import AX, YAW_RATE

JERK_MPS3, YAW_ACCEL_RADPS2 = 0.5, 0.1  # at which one weighs as much as the other: extended comfort's limits


def roughness(states: Array) -> Array:
    """(K,) of driven states (K, T, 11): RMS over time of longitudinal jerk and yaw acceleration, in units of the above.

    The first jerk is that from the ego's acceleration now; its yaw rate now is left out, for logs leave it unknown.
    """
    jerk = np.diff(states[..., AX], axis=-1) / STEP_S
    yaw_accel = np.diff(states[..., 1:, YAW_RATE], axis=-1) / STEP_S
    squares = (jerk / JERK_MPS3) ** 2, (yaw_accel / YAW_ACCEL_RADPS2) ** 2
    rough: Array = np.sqrt(squares[0].mean(axis=-1) + squares[1].mean(axis=-1))
    return rough


def best_first(scores: Array, rough: Array, score_step: float) -> Ints:
    """Indices (K,) by score, in steps down from the best, smoothest first within a step, then as they stand."""
    steps = np.floor((scores.max() - scores) / score_step)
    return np.lexsort((rough, steps))

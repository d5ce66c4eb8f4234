"""Savitzky-Golay filters of the comfort rules (docs/reward.md 2i): a polynomial fitted to every window of samples.

Inside, a filter is a weighted sum of its window. The first and last half window of rows are the polynomial fitted to
the first or last window, evaluated at the rows' own places. Every filter ends by rounding to 8 decimals, as the public
metric does: its thresholds and the jerk of a filtered acceleration see rounded values.
"""

import math
from collections.abc import Callable

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S

Filter = Callable[[Array, Array], None]  # samples (T,) at 10 Hz, output (T,); T is at least the window

# Weights of the oldest to the newest sample, in scipy.signal.savgol_coeffs' own rounding. Exact fractions (-3 / 32,
# k / 28, ..) differ in the last bits, and the jerk of accelerations rounded to 8 decimals lies half-way between two
# roundings in every 14th row: there these bits decide, and a recorded RMS moves by 1e-9.
ACCEL_WEIGHTS = (
    -0.09374999999999997,
    0.09374999999999997,
    0.21874999999999992,
    0.2812499999999999,
    0.2812499999999999,
    0.2187499999999998,
    0.09374999999999994,
    -0.09374999999999989,
)
JERK_WEIGHTS = (
    -0.24999999999999872,
    -0.21428571428571408,
    -0.17857142857142932,
    -0.1428571428571444,
    -0.10714285714285925,
    -0.07142857142857399,
    -0.0357142857142885,
    -2.8796409701214998e-15,
    0.03571428571428293,
    0.0714285714285689,
    0.10714285714285504,
    0.14285714285714135,
    0.17857142857142783,
    0.21428571428571447,
    0.2500000000000014,
)
YAW_RATE_WEIGHTS = (
    -2.0000000000000004,
    -0.999999999999999,
    1.3322676295501878e-15,
    1.0000000000000013,
    2.0,
)
YAW_ACCEL_WEIGHTS = (
    28.571428571428555,
    -14.285714285714278,
    -28.571428571428566,
    -14.285714285714295,
    28.571428571428562,
)
PLAN_YAW_ACCEL_WEIGHTS = (
    28.571428571428566,
    -14.285714285714299,
    -28.571428571428577,
    -14.285714285714299,
    28.571428571428562,
)


def _edge_weights(window: int, order: int, derivative: int) -> tuple[Array, Array]:
    """Weights (window, half) of the first and of the last samples for the rows that have no full window around them."""
    half, middle = window // 2, (window - 1) / 2.0
    place = np.arange(window) - middle
    fit = np.linalg.pinv(np.vander(place, order + 1, increasing=True))  # (order + 1, window)
    scale = [math.perm(power, derivative) / STEP_S**derivative for power in range(order + 1)]
    basis = np.stack([s * place ** max(p - derivative, 0) for p, s in enumerate(scale)], axis=-1)  # (window, order + 1)
    weights = basis @ fit
    return np.ascontiguousarray(weights[:half].T), np.ascontiguousarray(weights[-half:].T)


def _filter(name: str, weights: tuple[float, ...], order: int, derivative: int) -> Filter:
    taps = np.array(weights)
    window = len(weights)
    half, before = window // 2, (window - 1) // 2
    head, tail = _edge_weights(window, order, derivative)

    def smooth(samples: Array, out: Array) -> None:
        n = len(samples)
        for i in range(n - window + 1):
            # The newest sample first: the order of scipy's sum
            total = samples[i + window - 1] * taps[window - 1]
            for j in range(window - 1):
                total += samples[i + j] * taps[j]
            out[i + before] = total
        for i in range(half):
            first, last = 0.0, 0.0
            for j in range(window):
                first += samples[j] * head[j, i]
                last += samples[n - window + j] * tail[j, i]
            out[i] = first
            out[n - half + i] = last
        for i in range(n):
            out[i] = np.rint(out[i] * 1e8) / 1e8

    # A name is a cache file: closures of one name share theirs, and processes that fill it at once mix them up.
    smooth.__name__ = smooth.__qualname__ = name
    return kernel(smooth)


smooth_accel = _filter("smooth_accel", ACCEL_WEIGHTS, order=2, derivative=0)
jerk_of = _filter("jerk_of", JERK_WEIGHTS, order=2, derivative=1)  # of a filtered acceleration
yaw_rate_of = _filter("yaw_rate_of", YAW_RATE_WEIGHTS, order=2, derivative=1)  # of an unwrapped heading
yaw_accel_of = _filter("yaw_accel_of", YAW_ACCEL_WEIGHTS, order=3, derivative=2)  # of an unwrapped heading
plan_yaw_accel_of = _filter("plan_yaw_accel_of", PLAN_YAW_ACCEL_WEIGHTS, order=2, derivative=2)  # extended comfort's


@kernel
def unwrap(angles: Array) -> None:
    """Add turns to angles (T,) [rad] in place until no step is longer than half a turn, as np.unwrap does."""
    wraps = False
    for i in range(1, len(angles)):
        wraps |= abs(angles[i] - angles[i - 1]) >= math.pi
    if not wraps:
        return
    turned, before = 0.0, angles[0]
    for i in range(1, len(angles)):
        step = angles[i] - before
        before = angles[i]
        if abs(step) >= math.pi:
            short = (step + math.pi) % (2.0 * math.pi) - math.pi
            if short == -math.pi and step > 0.0:
                short = math.pi
            turned += short - step
        angles[i] += turned

"""History comfort and two-frame extended comfort (docs/reward.md 2i, 2j)."""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from tasks.reward.comfort import ExtendedComfort
from tasks.world.clip import STEP_S
from tasks.world.frames import (
    AX,
    AY,
    HEADING,
    YAW_ACCEL,
    YAW_RATE,
    Vehicle,
)

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

LON_ACCEL_MPS2 = (-4.05, 2.40)
LAT_ACCEL_MPS2 = 4.89
JERK_MPS3 = 8.37
LON_JERK_MPS3 = 4.13
YAW_ACCEL_RADPS2 = 1.93
YAW_RATE_RADPS = 0.95
EC_LIMITS = (0.7, 0.5, 0.1, 0.1)  # RMS of acceleration, jerk, yaw rate, yaw acceleration (SI)


def history_comfort(history: Array | None, states: Array, vehicle: Vehicle) -> tuple[Array, Bools, Array]:
    """HC (K,) in {0, 1}, its six flags (K, 6), and the first uncomfortable row (K,), inf where there is none.

    history: (14, 11), or None: all are comfortable; states: (K, 41, 11). The row index counts 0.1 s steps from now;
    rows of the history have negative ones (-15 .. -2).
    Flags: longitudinal, lateral acceleration; jerk magnitude; longitudinal jerk; yaw acceleration; yaw rate.
    """
    n_rows = states.shape[0]
    if history is None:
        return np.ones(n_rows), np.ones((n_rows, 6), dtype=bool), np.full(n_rows, np.inf)
    series = np.concatenate([np.broadcast_to(history, (n_rows, *history.shape)), states], axis=1)
    shift = vehicle.rear_axle_to_center
    # At the centre, with the public signs: + d omega^2 where geometry says minus, and no lateral term.
    lon_accel = _accel(series[..., AX] + shift * series[..., YAW_RATE] ** 2 + shift * series[..., YAW_ACCEL])
    lat_accel = _accel(series[..., AY])
    jerk = _jerk(_accel(np.hypot(series[..., AX], series[..., AY])))
    lon_jerk = _jerk(lon_accel)
    heading = np.unwrap(series[..., HEADING], axis=-1)
    yaw_accel = _filtered(heading, window=5, order=3, derivative=2)
    yaw_rate = _filtered(heading, window=5, order=2, derivative=1)
    within: Bools = np.stack(
        [
            (LON_ACCEL_MPS2[0] < lon_accel) & (lon_accel < LON_ACCEL_MPS2[1]),
            np.abs(lat_accel) < LAT_ACCEL_MPS2,
            np.abs(jerk) < JERK_MPS3,
            np.abs(lon_jerk) < LON_JERK_MPS3,
            np.abs(yaw_accel) < YAW_ACCEL_RADPS2,
            np.abs(yaw_rate) < YAW_RATE_RADPS,
        ],
        axis=-1,
    )  # (K, 55, 6)
    flags: Bools = np.all(within, axis=1)
    step_of_row = np.concatenate([np.arange(-15, -15 + len(history)), np.arange(states.shape[1])])
    uncomfortable: Bools = np.any(~within, axis=-1)
    first = np.where(uncomfortable.any(axis=1), step_of_row[uncomfortable.argmax(axis=1)], np.inf)
    return np.where(np.all(flags, axis=1), 1.0, 0.0), flags, first


def extended_comfort(now_states: Array, previous_states: Array, interval_s: float = 0.5) -> ExtendedComfort:
    """Compare simulated states (K, 41, 11) with those (K or 1, 41, 11) of the plan made `interval_s` earlier."""
    shift = round(interval_s / STEP_S)
    # The overlap is cut out first and filtered then, so that the filters' edges fall inside the horizon.
    difference = _motion_features(now_states[..., :-shift, :]) - _motion_features(previous_states[..., shift:, :])
    rms = np.sqrt(np.mean(difference**2, axis=-2))
    return ExtendedComfort(ec=(rms <= EC_LIMITS).all(axis=-1).astype(np.float64), rms=rms)


def _motion_features(states: Array) -> Array:
    """Acceleration, jerk, yaw rate, yaw acceleration (..., T, 4) of states (..., T, 11)."""
    accel = _accel(np.hypot(states[..., AX], states[..., AY]))
    heading = np.unwrap(states[..., HEADING], axis=-1)
    yaw_rate = _filtered(heading, window=5, order=2, derivative=1)
    yaw_accel = _filtered(heading, window=5, order=2, derivative=2)  # order 2 here, 3 in history comfort
    return np.stack([accel, _jerk(accel), yaw_rate, yaw_accel], axis=-1)


def _accel(values: Array) -> Array:
    return _filtered(values, window=8, order=2, derivative=0)


def _jerk(filtered_accel: Array) -> Array:
    return _filtered(filtered_accel, window=15, order=2, derivative=1)


def _filtered(values: Array, window: int, order: int, derivative: int) -> Array:
    smooth = savgol_filter(values, window, order, deriv=derivative, delta=STEP_S, axis=-1)
    rounded: Array = np.round(smooth, 8)
    return rounded

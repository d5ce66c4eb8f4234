"""History comfort and two-frame extended comfort (docs/reward.md 2i, 2j).

The six limits hold on a series of 55 rows: 14 of history, then the 41 of the trajectory. It is judged one quantity at a
time, each a contiguous row of scratch.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba.extending import register_jitable

from tasks.kernels.compiled import kernel
from tasks.reward.centerline import as_states
from tasks.world.arrays import Array, Bools
from tasks.world.clip import HORIZON_STEPS, STEP_S
from tasks.world.frames import AX, AY, EGO_STATE_SIZE, HEADING, REAR_AXLE_TO_CENTER, STEERING, YAW_ACCEL, YAW_RATE

# Savitzky-Golay filters of the comfort rules (docs/reward.md 2i): a polynomial fitted to every window of samples.
#
# Inside, a filter is a weighted sum of its window. The first and last half window of rows are the polynomial fitted to
# the first or last window, evaluated at the rows' own places. Every filter ends by rounding to 8 decimals, as the
# public metric does: its thresholds and the jerk of a filtered acceleration see rounded values.

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
YAW_RATE_WEIGHTS = (-2.0000000000000004, -0.999999999999999, 1.3322676295501878e-15, 1.0000000000000013, 2.0)
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


# The rules.

# (6, 2): longitudinal, lateral acceleration [m/s2]; jerk; longitudinal jerk [m/s3]; yaw acceleration; yaw rate
LIMITS = np.array([(-4.05, 2.40), *((-most, most) for most in (4.89, 8.37, 4.13, 1.93, 0.95))])
EC_LIMITS = (0.7, 0.5, 0.1, 0.1)  # RMS of acceleration, jerk, yaw rate, yaw acceleration (SI)
PAST_PERIOD_STEPS = 5  # the history comes at 2 Hz
HISTORY_ROWS = 14  # -1.5 .. -0.2 s: the row at -0.1 s is missing in the public metric
HISTORY_START = -15  # step of the first row
N_FLAGS = 6
LONGEST_FILTER = len(JERK_WEIGHTS)  # samples
_SCRATCH_ROWS = N_FLAGS + 4


@kernel
def interpolated_history(past_states: Array) -> Array:
    """Ego states (14, 11) at -1.5, -1.4 .. -0.2 s, interpolated linearly between states (4, 11) at 2 Hz.

    Rates of yaw and steering are not part of the public interpolation and are 0.
    """
    past = past_states.copy()
    heading = past[:, HEADING].copy()
    unwrap(heading)
    for k in range(len(past)):  # element by element: numba takes seconds to compile the copy of a slice
        past[k, HEADING] = heading[k]
    past[:, STEERING + 1 :] = 0.0
    rows = np.empty((HISTORY_ROWS, EGO_STATE_SIZE))
    for row in range(HISTORY_ROWS):
        before = row // PAST_PERIOD_STEPS
        share, after = row / PAST_PERIOD_STEPS - before, min(before + 1, len(past) - 1)
        for column in range(EGO_STATE_SIZE):
            rows[row, column] = past[before, column] + share * (past[after, column] - past[before, column])
    return rows


@register_jitable
def comfort_scratch() -> Array:
    """Scratch (10, 55) for `first_uncomfortable_step`, one per thread."""
    return np.empty((_SCRATCH_ROWS, HISTORY_ROWS + HORIZON_STEPS + 1))


@kernel
def first_uncomfortable_step(
    history: Array,  # (14, 11) ego states, see interpolated_history
    states: Array,  # (41, 11) of one trajectory
    scratch: Array,  # (10, 55), see comfort_scratch
    flags: Bools,  # (6,) out, as in LIMITS
) -> float:
    """The first uncomfortable step, inf where there is none; a step of the history is negative (-15 .. -2).

    History comfort is the conjunction of the flags (docs/reward.md 2i).
    """
    judged, lon, lat, magnitude, heading = scratch[:N_FLAGS], scratch[6], scratch[7], scratch[8], scratch[9]
    before = len(history)
    _load(history, lon[:before], lat[:before], magnitude[:before], heading[:before])
    _load(states, lon[before:], lat[before:], magnitude[before:], heading[before:])
    _limited_quantities(lon, lat, magnitude, heading, judged)
    comfortable = True
    for f in range(N_FLAGS):
        flags[f] = _all_within(judged[f], LIMITS[f, 0], LIMITS[f, 1])
        comfortable &= flags[f]
    if comfortable:
        return math.inf
    row = _first_beyond(judged)
    return float(row + HISTORY_START) if row < before else float(row - before)


@kernel
def _limited_quantities(lon: Array, lat: Array, magnitude: Array, heading: Array, judged: Array) -> None:
    """The limited quantities (6, T) of a drive that is loaded; overwrites it."""
    unwrap(heading)
    smooth_accel(lon, judged[0])
    smooth_accel(lat, judged[1])
    smooth_accel(magnitude, lat)
    jerk_of(lat, judged[2])
    jerk_of(judged[0], judged[3])
    yaw_accel_of(heading, judged[4])
    yaw_rate_of(heading, judged[5])


@kernel
def _load(states: Array, lon: Array, lat: Array, magnitude: Array, heading: Array) -> None:
    for t in range(len(states)):
        ax, ay, omega = states[t, AX], states[t, AY], states[t, YAW_RATE]
        # At the centre, with the public signs: + d omega^2 where geometry says minus, and no lateral term
        lon[t] = ax + REAR_AXLE_TO_CENTER * (omega * omega) + REAR_AXLE_TO_CENTER * states[t, YAW_ACCEL]
        lat[t] = ay
        magnitude[t] = math.sqrt(ax * ax + ay * ay)
        heading[t] = states[t, HEADING]


@kernel
def _all_within(values: Array, low: float, high: float) -> bool:
    beyond = 0
    for value in values:
        beyond += not ((low < value) & (value < high))
    return beyond == 0


@kernel
def _first_beyond(judged: Array) -> int:
    """First column of (6, T) at which a flag's quantity is not within its limits; there must be one."""
    t = 0
    while True:
        for f in range(N_FLAGS):
            if not (LIMITS[f, 0] < judged[f, t] and judged[f, t] < LIMITS[f, 1]):
                return t
        t += 1


def comfortable(states: Array) -> Bools:
    """(T,) whether each instant of a drive (T, 11) of any length keeps the six limits of history comfort.

    Raises ValueError where the drive is shorter than the longest filter, 1.5 s.
    """
    if states.ndim != 2 or states.shape[1] != EGO_STATE_SIZE or len(states) < LONGEST_FILTER:
        raise ValueError(f"states must be (T >= {LONGEST_FILTER}, {EGO_STATE_SIZE}), got {states.shape}")
    within = np.ones(len(states), dtype=np.bool_)
    _within_limits(np.ascontiguousarray(states, np.float64), within)
    return within


@kernel
def _within_limits(states: Array, within: Bools) -> None:
    n = len(states)
    scratch = np.empty((_SCRATCH_ROWS, n))
    judged, lon, lat, magnitude, heading = scratch[:N_FLAGS], scratch[6], scratch[7], scratch[8], scratch[9]
    _load(states, lon, lat, magnitude, heading)
    _limited_quantities(lon, lat, magnitude, heading, judged)
    for t in range(n):
        for f in range(N_FLAGS):
            within[t] &= LIMITS[f, 0] < judged[f, t] and judged[f, t] < LIMITS[f, 1]


@dataclass(frozen=True)
class ExtendedComfort:
    """EC of K plans against the plans made a moment before."""

    ec: Array  # (K,) 1 where all four differences are small, else 0
    rms: Array  # (K, 4) acceleration [m/s^2], jerk [m/s^3], yaw rate [rad/s], yaw acceleration [rad/s^2]


def extended_comfort(now_states: Array, previous_states: Array, interval_s: float = 0.5) -> ExtendedComfort:
    """Compare simulated states (K, 41, 11) with those (K or 1, 41, 11) of the plan made `interval_s` earlier."""
    now, previous = as_states("now_states", now_states), as_states("previous_states", previous_states)
    rms = np.empty((len(now), len(EC_LIMITS)))
    _motion_rms(now, previous, round(interval_s / STEP_S), rms)
    return ExtendedComfort(ec=np.where((rms <= EC_LIMITS).all(axis=-1), 1.0, 0.0), rms=rms)


@kernel
def _motion_rms(now: Array, previous: Array, shift: int, rms: Array) -> None:
    """Root mean square (K, 4) over time of what now[k, :-shift] does otherwise than previous[k or 0, shift:]."""
    # The overlap is cut out first and filtered then, so that the filters' edges fall inside the horizon.
    n = now.shape[1] - shift
    ours, theirs, raw = np.empty((4, n)), np.empty((4, n)), np.empty(n)
    for k in range(len(now)):
        _motion(now[k, :n], raw, ours)
        if k < len(previous):
            _motion(previous[k, shift:], raw, theirs)
        for f in range(4):
            total = 0.0
            for t in range(n):
                difference = ours[f, t] - theirs[f, t]
                total += difference * difference
            rms[k, f] = math.sqrt(total / n)


@kernel
def _motion(states: Array, raw: Array, out: Array) -> None:
    """Acceleration, jerk, yaw rate, yaw acceleration (4, T) of states (T, 11); raw: scratch (T,)."""
    for t in range(len(states)):
        raw[t] = math.sqrt(states[t, AX] * states[t, AX] + states[t, AY] * states[t, AY])
    smooth_accel(raw, out[0])
    jerk_of(out[0], out[1])
    for t in range(len(states)):  # a slice assigned to a slice compiles for 5 s more
        raw[t] = states[t, HEADING]
    unwrap(raw)
    yaw_rate_of(raw, out[2])
    plan_yaw_accel_of(raw, out[3])

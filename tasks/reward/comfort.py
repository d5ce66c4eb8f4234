"""History comfort and two-frame extended comfort (docs/reward.md 2i, 2j).

The six limits hold on a series of 55 rows: 14 of history, then the 41 of the trajectory. LANES series are judged side
by side, one quantity at a time, each a row of scratch: instant by instant what the lanes have then, so that every loop
vectorises whatever its filter. Where there are fewer drives the last one stands in the other lanes too.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba.extending import register_jitable

from tasks.kernels.compiled import hidden_kernel, kernel
from tasks.reward.centerline import as_states
from tasks.world.arrays import Array, Bools
from tasks.world.clip import STEP_S
from tasks.world.frames import AX, AY, EGO_STATE_SIZE, HEADING, REAR_AXLE_TO_CENTER, STEERING, YAW_ACCEL, YAW_RATE

# Savitzky-Golay filters of the comfort rules (docs/reward.md 2i): a polynomial fitted to every window of samples.
#
# Inside, a filter is a weighted sum of its window. The first and last half window of rows are the polynomial fitted to
# the first or last window, evaluated at the rows' own places. Every filter ends by rounding to 8 decimals, as the
# public metric does: its thresholds and the jerk of a filtered acceleration see rounded values.

LANES = 16  # of fewer LLVM makes no vectors
Filter = Callable[[Array, Array], None]  # samples (T * LANES,) at 10 Hz, output alike; T is at least the window

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
        newest = (window - 1) * LANES
        for i in range(len(samples) - newest):
            # The newest sample first: the order of scipy's sum
            total = samples[i + newest] * taps[window - 1]
            for j in range(window - 1):
                total += samples[i + j * LANES] * taps[j]
            out[i + before * LANES] = total
        for weights, rows, seen in (
            (head, out[: half * LANES], samples),
            (tail, out[-half * LANES :], samples[-window * LANES :]),
        ):
            for row in range(half):
                for lane in range(LANES):
                    total = 0.0
                    for j in range(window):
                        total += seen[j * LANES + lane] * weights[j, row]
                    rows[row * LANES + lane] = total
        for i in range(len(samples)):
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
def unwrap(angles: Array, lanes: int) -> None:
    """Add turns to angles (T * lanes,) [rad] in place until no step is longer than half a turn, as np.unwrap does."""
    earlier, later, n_wraps = angles[:-lanes], angles[lanes:], 0
    for i in range(len(later)):
        n_wraps += abs(later[i] - earlier[i]) >= math.pi
    for lane in range(lanes if n_wraps > 0 else 0):
        turned, before = 0.0, angles[lane]
        for i in range(lane + lanes, len(angles), lanes):
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
_LON, _LAT, _MAGNITUDE, _HEADING, _BEYOND, _SCRATCH_ROWS = range(N_FLAGS, N_FLAGS + 6)


@kernel
def interpolated_history(past_states: Array) -> Array:
    """Ego states (14, 11) at -1.5, -1.4 .. -0.2 s, interpolated linearly between states (4, 11) at 2 Hz.

    Rates of yaw and steering are not part of the public interpolation and are 0.
    """
    past = past_states.copy()
    heading = past[:, HEADING].copy()
    unwrap(heading, 1)
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
def comfort_scratch(n_rows: int) -> Array:
    """Scratch for LANES series of that many rows, one per thread."""
    return np.empty((_SCRATCH_ROWS, n_rows * LANES))


@kernel
def first_uncomfortable_steps(
    history: Array,  # (14, 11) ego states, see interpolated_history
    states: Array,  # (up to LANES, 41, 11)
    scratch: Array,  # for 55 rows, see comfort_scratch
    flags: Bools,  # (K, 6) out, as in LIMITS
    first: Array,  # (K,) out: the first uncomfortable step, inf where there is none
) -> None:
    """History comfort of some trajectories; a step of the history is negative (-15 .. -2).

    It is the conjunction of the flags (docs/reward.md 2i).
    """
    _side_by_side(history.reshape(1, len(history), EGO_STATE_SIZE), 0, scratch)
    _side_by_side(states, len(history), scratch)
    _limited_quantities(scratch)
    beyond = scratch[_BEYOND]
    for i in range(len(beyond)):
        which = 0
        for f in range(N_FLAGS):
            value = scratch[f, i]
            which |= (not ((LIMITS[f, 0] < value) & (value < LIMITS[f, 1]))) << f
        beyond[i] = float(which)
    for k in range(len(first)):
        n_comfortable, which = 0, 0
        for row in range(len(beyond) // LANES):
            which |= int(beyond[row * LANES + k])
            n_comfortable += which == 0
        for f in range(N_FLAGS):
            flags[k, f] = which & 1 << f == 0
        step = n_comfortable + HISTORY_START if n_comfortable < len(history) else n_comfortable - len(history)
        first[k] = math.inf if which == 0 else float(step)


@hidden_kernel
def _side_by_side(states: Array, start: int, scratch: Array) -> None:
    """What the limited quantities are made of, from states (K, T, 11), into the rows of the series from `start` on."""
    lon, lat, magnitude, heading = scratch[_LON], scratch[_LAT], scratch[_MAGNITUDE], scratch[_HEADING]
    for lane in range(LANES):
        k = min(lane, len(states) - 1)
        for t in range(states.shape[1]):
            i = (start + t) * LANES + lane
            ax, ay, omega = states[k, t, AX], states[k, t, AY], states[k, t, YAW_RATE]
            # At the centre, with the public signs: + d omega^2 where geometry says minus, and no lateral term
            lon[i] = ax + REAR_AXLE_TO_CENTER * (omega * omega) + REAR_AXLE_TO_CENTER * states[k, t, YAW_ACCEL]
            lat[i] = ay
            magnitude[i] = math.sqrt(ax * ax + ay * ay)
            heading[i] = states[k, t, HEADING]


@hidden_kernel
def _limited_quantities(scratch: Array) -> None:
    """The limited quantities, the first rows of scratch, of what `_side_by_side` put into the others."""
    lon, lat, magnitude, heading = scratch[_LON], scratch[_LAT], scratch[_MAGNITUDE], scratch[_HEADING]
    unwrap(heading, LANES)
    smooth_accel(lon, scratch[0])
    smooth_accel(lat, scratch[1])
    smooth_accel(magnitude, lat)
    jerk_of(lat, scratch[2])
    jerk_of(scratch[0], scratch[3])
    yaw_accel_of(heading, scratch[4])
    yaw_rate_of(heading, scratch[5])


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
    ours, theirs, raw = np.empty((4, n * LANES)), np.empty((4, n * LANES)), np.empty(n * LANES)
    for start in range(0, len(now), LANES):
        _motions(now, start, 0, raw, ours)
        if start < len(previous):
            _motions(previous, start, shift, raw, theirs)
        for k in range(start, min(start + LANES, len(now))):
            for f in range(4):
                total = 0.0
                for i in range(k - start, n * LANES, LANES):
                    difference = ours[f, i] - theirs[f, i]
                    total += difference * difference
                rms[k, f] = math.sqrt(total / n)


@hidden_kernel
def _motions(states: Array, first: int, start: int, raw: Array, out: Array) -> None:
    """Acceleration, jerk, yaw rate, yaw acceleration (4, T * LANES) of states[first:, start : start + T]; raw: scratch.

    Where there are fewer than LANES the last ones stand in for the others.
    """
    for t in range(len(raw) // LANES):
        for lane in range(LANES):
            row = states[min(first + lane, len(states) - 1), start + t]
            raw[t * LANES + lane] = math.sqrt(row[AX] * row[AX] + row[AY] * row[AY])
    smooth_accel(raw, out[0])
    jerk_of(out[0], out[1])
    for t in range(len(raw) // LANES):
        for lane in range(LANES):
            raw[t * LANES + lane] = states[min(first + lane, len(states) - 1), start + t, HEADING]
    unwrap(raw, LANES)
    yaw_rate_of(raw, out[2])
    plan_yaw_accel_of(raw, out[3])

"""Speeds and curvatures fitted to the poses of a plan, and what the tracker looks at of them (docs/reward.md 1a).

Both fits are regularised least squares, and both are banded systems in the right unknowns, so that 40 instants cost
40 short steps:

Speeds. The heading enters the normal equations only through cos^2 + sin^2 = 1, and a displacement is v_i dt. With f_i
the forward displacement, minimise
    sum_i (f_i - v_i dt)^2 + 1e-4 sum_{i <= 36} ((v_{i+1} - v_i) / dt)^2 + 1e-4 ((v_39 - 2 v_38 + v_37) / dt)^2
(the public matrix of first differences keeps the -1 band only, but for its last row). The matrix is the same for all
plans and is factorised once.

Curvatures. Written in curvatures instead of their rates, with h_i the heading step, minimise
    sum_i (h_i - v_i dt k_i)^2 + 1e-2 sum_i ((k_{i+1} - k_i) / dt)^2 + 1e-10 k_0^2.
"""

from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import inlined
from tasks.kernels.trig import wrap
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, STEP_S

TRACKING_STEPS = 10  # LQR horizon, 1 s
ACCEL_PENALTY = 1e-4  # the public "jerk penalty"
CURVATURE_RATE_PENALTY = 1e-2
INITIAL_CURVATURE_PENALTY = 1e-10
COUPLING = CURVATURE_RATE_PENALTY / STEP_S**2


class Plans(NamedTuple):
    """Scratch for a block of B plans in the world frame; instants first, so that loops over the plans vectorise."""

    x: Array  # (41, B) rear axle [m]
    y: Array  # (41, B)
    heading: Array  # (41, B) [rad]
    cos: Array  # (41, B) of the heading
    sin: Array  # (41, B)
    speed: Array  # (40, B) fitted [m/s]
    curvature: Array  # (50, B) fitted [1/m]; the last one is held over the horizon past the plan's end
    inverse: Array  # (40, B) of the curvature fit's pivots
    excess: Array  # (B,) of the last pivot over the coupling


@inlined
def empty_plans(size: int) -> Plans:
    """Scratch for `size` plans, to be filled."""
    poses, steps = (HORIZON_STEPS + 1, size), (HORIZON_STEPS, size)
    return Plans(
        x=np.empty(poses),
        y=np.empty(poses),
        heading=np.empty(poses),
        cos=np.empty(poses),
        sin=np.empty(poses),
        speed=np.empty(steps),
        curvature=np.empty((HORIZON_STEPS + TRACKING_STEPS, size)),
        inverse=np.empty(steps),
        excess=np.empty(size),
    )


def _speed_fit() -> Array:
    """(5, 40) factors of the speed fit's elimination, forwards (own, last, last but one) and back (next, next but one).

    Plain Python, not LAPACK: the same bits on every machine.
    """
    n, penalty = HORIZON_STEPS, ACCEL_PENALTY / STEP_S**4
    differences = [{i: -1.0, i + 1: 1.0} for i in range(n - 3)] + [{n - 3: 1.0, n - 2: -2.0, n - 1: 1.0}]
    normal = np.eye(n)
    for row in differences:
        for i, a in row.items():
            for j, b in row.items():
                normal[i, j] += penalty * a * b
    diagonal, below, below2 = np.zeros((3, n + 2))
    for i in range(n):
        below2[i] = normal[i, i - 2] / diagonal[i - 2] if i > 1 else 0.0
        below[i] = (normal[i, i - 1] - below2[i] * diagonal[i - 2] * below[i - 1]) / diagonal[i - 1] if i > 0 else 0.0
        diagonal[i] = normal[i, i] - below[i] ** 2 * diagonal[i - 1] - below2[i] ** 2 * diagonal[i - 2]
    own = 1.0 / diagonal[:n]
    last, last2 = -below[:n] * np.roll(diagonal, 1)[:n] * own, -below2[:n] * np.roll(diagonal, 2)[:n] * own
    return np.stack([own / STEP_S, last, last2, -below[1 : n + 1], -below2[2:]])


SPEED_FIT = _speed_fit()


@inlined
def fit_speeds(n_plans: int, plans: Plans) -> None:
    """Fill `speed` from the poses and their cos and sin."""
    last = HORIZON_STEPS - 1
    for t in range(HORIZON_STEPS):
        for b in range(n_plans):
            dx, dy = plans.x[t + 1, b] - plans.x[t, b], plans.y[t + 1, b] - plans.y[t, b]
            plans.speed[t, b] = dx * plans.cos[t, b] + dy * plans.sin[t, b]
    for t in range(HORIZON_STEPS):
        own, before, before2 = SPEED_FIT[0, t], SPEED_FIT[1, t], SPEED_FIT[2, t]
        t1, t2 = max(t - 1, 0), max(t - 2, 0)
        for b in range(n_plans):
            plans.speed[t, b] = own * plans.speed[t, b] + before * plans.speed[t1, b] + before2 * plans.speed[t2, b]
    for t in range(last, -1, -1):
        after, after2 = SPEED_FIT[3, t], SPEED_FIT[4, t]
        t1, t2 = min(t + 1, last), min(t + 2, last)
        for b in range(n_plans):
            plans.speed[t, b] += after * plans.speed[t1, b] + after2 * plans.speed[t2, b]


@inlined
def fit_curvatures(n_plans: int, plans: Plans) -> None:
    """Fill `curvature` from the headings and fitted speeds: a symmetric tridiagonal system.

    Gaussian elimination keeps what a pivot exceeds the coupling by instead of the pivot itself: for a plan that hardly
    moves the excess is 1e-10 of the pivot, and their difference would have lost it.
    """
    last = HORIZON_STEPS - 1
    for b in range(n_plans):
        plans.excess[b], plans.curvature[0, b] = INITIAL_CURVATURE_PENALTY, 0.0  # what comes before the first row
    for t in range(HORIZON_STEPS):
        before = max(t - 1, 0)
        ahead = COUPLING if t < last else 0.0
        for b in range(n_plans):
            step_m = plans.speed[t, b] * STEP_S
            turn = wrap(plans.heading[t + 1, b] - plans.heading[t, b])
            excess = step_m * step_m + plans.excess[b]
            inverse = reciprocal(excess + ahead)
            plans.inverse[t, b] = inverse
            plans.excess[b] = COUPLING * excess * inverse
            plans.curvature[t, b] = (step_m * turn + COUPLING * plans.curvature[before, b]) * inverse
    for t in range(last - 1, -1, -1):
        for b in range(n_plans):
            plans.curvature[t, b] += COUPLING * plans.inverse[t, b] * plans.curvature[t + 1, b]
    for t in range(HORIZON_STEPS, HORIZON_STEPS + TRACKING_STEPS):
        for b in range(n_plans):
            plans.curvature[t, b] = plans.curvature[last, b]


@inlined
def reciprocal(value: float) -> float:
    """1 / value without the check for zero."""
    return 1.0 / value

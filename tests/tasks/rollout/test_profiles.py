"""The fitted profiles are the least-squares solutions, and a steady arc keeps its speed and curvature."""

from decimal import Decimal, localcontext

import numpy as np
import pytest

from tasks.kernels.compiled import kernel
from tasks.rollout.lqr import (
    BLOCK,
    COUPLING,
    INITIAL_CURVATURE_PENALTY,
    TRACKING_STEPS,
    Plans,
    fit_curvatures,
    fit_speeds,
)
from tests.tasks.rollout import slow_lqr

TIMES_S = 0.1 * np.arange(41)


@kernel
def fit(n_plans: int, plans: Plans) -> None:
    fit_speeds(n_plans, plans)
    fit_curvatures(n_plans, plans)


def fitted(reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speeds (K, 40) and curvatures (K, 50) of plans (K, 41, 3)."""
    x, y, heading = (np.ascontiguousarray(column.T) for column in np.moveaxis(reference, -1, 0))
    steps = np.full((40, len(reference)), np.nan)  # what scratch holds from before must not show
    padded = np.full((40 + TRACKING_STEPS, len(reference)), np.nan)
    plans = Plans(x, y, heading, np.cos(heading), np.sin(heading), steps, padded, steps.copy(), steps[0].copy())
    fit(len(reference), plans)
    return plans.speed.T, plans.curvature.T


def arc(speed: float, curvature: float) -> np.ndarray:
    turn = speed * curvature * TIMES_S
    return np.stack([np.sin(turn) / curvature, (1.0 - np.cos(turn)) / curvature, turn], axis=-1)


def test_profiles_of_a_steady_arc_are_its_speed_and_curvature():
    speed, curvature = fitted(arc(6.0, 0.05)[None])
    np.testing.assert_allclose(speed, 6.0, rtol=0.02)  # the acceleration penalty and the chord bend it slightly
    np.testing.assert_allclose(curvature, 0.05, rtol=0.02)


@pytest.mark.parametrize("n_plans", [1, BLOCK + 3])
def test_profiles_equal_the_dense_and_the_tridiagonal_solution_of_the_twin(n_plans: int):
    reference = arc(7.0, -0.03) + np.random.default_rng(0).normal(0.0, 0.05, (n_plans, 41, 3))
    speed, curvature = fitted(reference)
    expected = slow_lqr.velocity_profile(reference)
    np.testing.assert_allclose(speed, expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(curvature[:, :40], slow_lqr.curvature_profile(reference, expected), rtol=0, atol=1e-11)


def test_the_last_curvature_is_held_beyond_the_plan():
    _, curvature = fitted(arc(5.0, 0.1)[None] + np.random.default_rng(1).normal(0.0, 0.02, (1, 41, 3)))
    assert np.all(curvature[:, 40:] == curvature[:, 39:40])


def exact_curvatures(steps_m: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """(40,) minimiser of the curvature fit, by elimination with 60 digits."""
    with localcontext() as context:
        context.prec = 60
        coupling, step = Decimal(COUPLING), [Decimal(float(value)) for value in steps_m]
        diagonal = [m * m + coupling * (2 if 0 < i < 39 else 1) for i, m in enumerate(step)]
        diagonal[0] += Decimal(INITIAL_CURVATURE_PENALTY)
        right = [m * Decimal(float(turn)) for m, turn in zip(step, turns)]
        for i in range(1, 40):
            diagonal[i] -= coupling * coupling / diagonal[i - 1]
            right[i] += coupling / diagonal[i - 1] * right[i - 1]
        solution = [right[39] / diagonal[39]]
        for i in range(38, -1, -1):
            solution.append((right[i] + coupling * solution[-1]) / diagonal[i])
    return np.array([float(value) for value in reversed(solution)])


@pytest.mark.parametrize("moves_m", [1.0, 1e-2, 1e-4, 1e-6])
def test_curvatures_keep_their_digits_however_little_a_plan_moves(moves_m: float):
    reference = np.random.default_rng(2).normal(0.0, 1.0, (1, 41, 3)) * [moves_m, moves_m, 0.1]
    speed, curvature = fitted(reference)
    expected = exact_curvatures(speed[0] * 0.1, np.diff(reference[0, :, 2]))
    np.testing.assert_allclose(curvature[0, :40], expected, rtol=0, atol=1e-12 * np.abs(expected).max())

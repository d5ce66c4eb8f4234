import numpy as np
import pytest
from scipy.optimize import linprog, nnls

from tasks.quadratic import minimum


@pytest.mark.parametrize(("unknowns", "rows"), [(4, 5), (40, 80)])
def test_the_minimum_is_where_the_slope_is_held_by_bounds_that_it_pushes_against(unknowns: int, rows: int) -> None:
    """Random problems; where there is none, a linear program finds no point that keeps the bounds."""
    rng, without, pushed = np.random.default_rng(4), 0, 0
    for case in range(40):
        half, sides = rng.normal(size=(unknowns, unknowns)), rng.normal(size=(rows, unknowns))
        hessian, gradient = half @ half.T + 0.1 * np.eye(unknowns), 10.0 * rng.normal(size=unknowns)
        middle = np.concatenate([np.eye(unknowns), sides]) @ rng.normal(size=unknowns)
        middle += rng.normal(size=len(middle)) * (case % 4 == 3)  # of each four one may have no point within
        low, high = (middle + sign * rng.uniform(0.0, 1.0, len(middle)) for sign in (-1.0, 1.0))
        high[0] = np.inf
        found = minimum(hessian, gradient, sides, low, high)
        bounded = np.concatenate([np.eye(unknowns), sides])
        if isinstance(found, str):
            assert "no solution" in found
            limits = np.concatenate([high[1:], -low])
            assert (
                linprog(np.zeros(unknowns), np.concatenate([bounded[1:], -bounded]), limits, bounds=(None, None)).status
                == 2
            )
            without += 1
            continue
        reached = bounded @ found
        assert (reached >= low - 1e-9).all() and (reached <= high + 1e-9).all()
        held = np.concatenate([bounded[reached - low < 1e-7], -bounded[high - reached < 1e-7]])
        weights, left = nnls(held.T, hessian @ found + gradient)
        assert left < 1e-6, "no direction within the bounds goes down"
        pushed += int((weights > 0.0).sum())
    assert 0 < without <= 10 and pushed > 60


def test_the_same_problem_gives_the_same_bits_whatever_was_solved_before() -> None:
    rng = np.random.default_rng(5)
    half, sides = rng.normal(size=(2, 6, 6)), rng.normal(size=(2, 4, 6))
    problems = [(h @ h.T + np.eye(6), 5.0 * h[0], s, np.full(10, -0.3), np.full(10, 0.3)) for h, s in zip(half, sides)]
    first = minimum(*problems[0])
    minimum(*problems[1])
    np.testing.assert_array_equal(minimum(*problems[0]), first)


def test_what_has_no_least_value_is_told() -> None:
    told = minimum(-np.eye(2), np.zeros(2), np.ones((1, 2)), np.full(3, -1.0), np.ones(3))
    assert isinstance(told, str) and "none found" in told

"""The scaling curve against curves that are known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planners.evaluation.scaling_law import fit_scaling

SIZES = [150, 300, 450, 600, 750, 900]


def curve(a: float, b: float, c: float, sizes: list[int]) -> list[float]:
    return [a * math.log(n) ** 2 + b * math.log(n) + c for n in sizes]


@given(st.floats(-3, 3), st.floats(-5, 5), st.floats(-50, 50))
def test_a_curve_of_the_family_is_found_again(a: float, b: float, c: float) -> None:
    law = fit_scaling(SIZES, curve(a, b, c, SIZES))
    assert [law.a, law.b, law.c] == pytest.approx([a, b, c], abs=1e-6)
    assert law.residual_std == pytest.approx(0.0, abs=1e-8)
    np.testing.assert_allclose(law.score(np.array(SIZES)), curve(a, b, c, SIZES), atol=1e-8)


def test_a_parabola_has_its_top_where_it_was_put() -> None:
    top = 500.0
    scores = [40.0 - 2.0 * (math.log(n) - math.log(top)) ** 2 for n in SIZES]
    assert fit_scaling(SIZES, scores).saturation == pytest.approx(top)


def test_a_curve_that_bends_upwards_has_no_top() -> None:
    assert fit_scaling(SIZES, curve(0.5, -1.0, 3.0, SIZES)).saturation is None


def test_the_band_is_the_standard_deviation_of_the_residuals() -> None:
    """Four points, one degree of freedom: the residual is what is orthogonal to the three columns."""
    sizes = [1, 2, 4, 8]  # log N is 0, 1, 2, 3 times log 2; the orthogonal direction is (-1, 3, -3, 1) / sqrt(20)
    scores = [1.0, 2.0, 3.0, 4.0]
    off = np.array([-1.0, 3.0, -3.0, 1.0]) / math.sqrt(20.0)
    law = fit_scaling(sizes, scores + 0.7 * off)
    assert law.residual_std == pytest.approx(0.7)
    assert law.b * math.log(2.0) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("sizes", "scores", "said"),
    [
        ([1, 2, 3], [1.0, 2.0, 3.0], "3 points"),
        ([1, 1, 2, 2], [1.0, 2.0, 3.0, 4.0], "at least 3 different"),
        ([0, 1, 2, 3], [1.0, 2.0, 3.0, 4.0], "at least 1"),
        ([1, 2, 3, 4], [1.0, math.nan, 3.0, 4.0], "finite"),
        ([1, 2, 3, 4], [1.0, 2.0, 3.0], "one number a point"),
    ],
)
def test_what_cannot_be_fitted_is_refused(sizes: list[int], scores: list[float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        fit_scaling(sizes, scores)

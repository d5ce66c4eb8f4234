"""The kernels' own sine, cosine and wrapping: exact to a few last bits, and the same bits in any loop."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tasks.kernels import trig
from tasks.kernels.compiled import kernel

PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899")
ANGLES = st.floats(-1e6, 1e6)


def exact_sine(angle: float, shift_quarters: int = 0) -> Decimal:
    """sin(angle + shift pi/2) by Taylor's series with 60 digits."""
    with localcontext() as context:
        context.prec = 60
        x = (Decimal(angle) + shift_quarters * PI / 2).remainder_near(2 * PI)
        term = total = x
        for n in range(1, 40):
            term *= -x * x / (2 * n * (2 * n + 1))
            total += term
        return total


def units_off(got: float, exact: Decimal) -> float:
    return float(abs(Decimal(got) - exact) / Decimal(float(np.spacing(abs(float(exact))))))


@kernel
def sincos(angle: float) -> tuple[float, float]:
    return trig.sincos(angle)


@kernel
def wrap(angle: float) -> float:
    return trig.wrap(angle)


@kernel
def sincos_of_all(angles: np.ndarray, sines: np.ndarray, cosines: np.ndarray) -> None:
    for i in range(len(angles)):
        sines[i], cosines[i] = trig.sincos(angles[i])


@pytest.mark.parametrize("limit", [0.8, 3.2, 100.0, 1e4, 1e6])
def test_sine_and_cosine_are_within_two_and_a_half_last_places(limit: float):
    for angle in np.random.default_rng(0).uniform(-limit, limit, 400):
        sine, cosine = sincos(angle)
        assert units_off(sine, exact_sine(angle)) <= 2.5
        assert units_off(cosine, exact_sine(angle, 1)) <= 2.5


def test_no_digits_are_lost_next_to_the_zeros_and_extremes():
    for quarters in (*range(-9, 10), 1001, 6366, 636_619):
        nearest = quarters * np.pi / 2
        for angle in (nearest, np.nextafter(nearest, 1e9), np.nextafter(nearest, -1e9)):
            sine, cosine = sincos(angle)
            assert sine == exact_sine(angle) == 0 or units_off(sine, exact_sine(angle)) <= 2.5
            assert units_off(cosine, exact_sine(angle, 1)) <= 2.5


@given(angle=ANGLES)
def test_sine_is_odd_and_cosine_even_to_the_last_bit(angle: float):
    sine, cosine = sincos(angle)
    assert sincos(-angle) == (-sine, cosine)


@given(angles=st.lists(ANGLES, min_size=1, max_size=37))
def test_a_long_loop_gives_the_bits_of_single_calls(angles: list[float]):
    together = np.empty((2, len(angles)))
    sincos_of_all(np.array(angles), *together)
    assert np.array_equal(together.T, [sincos(angle) for angle in angles])


@given(angle=ANGLES)
def test_a_wrapped_angle_is_the_same_direction_between_minus_pi_and_pi(angle: float):
    wrapped = wrap(angle)
    assert -np.pi <= wrapped < np.pi
    assert abs(np.remainder(angle - wrapped + 1.0, 2.0 * np.pi) - 1.0) < 1e-9


@given(angle=st.floats(-np.pi, np.pi, exclude_max=True))
def test_an_angle_in_range_stays_as_it_is(angle: float):
    wrapped = wrap(angle)
    assert wrapped == angle or (angle > 3.14159265358979 and wrapped == -np.pi)


@pytest.mark.parametrize("turns", [-3, -1, 1, 2, 1000])
@pytest.mark.parametrize("side", [-1.0, 0.0, 1.0])
def test_the_seam_stays_in_range(turns: int, side: float):
    seam = (2 * turns + 1) * np.pi
    assert -np.pi <= wrap(seam if side == 0.0 else np.nextafter(seam, side * np.inf)) < np.pi

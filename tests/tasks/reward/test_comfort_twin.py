"""The comfort kernels equal the numpy version built on scipy's filters, and what can be said on paper."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import savgol_coeffs, savgol_filter

from tasks.reward import comfort
from tasks.reward.comfort import (
    LANES,
    LIMITS,
    comfort_scratch,
    extended_comfort,
    first_uncomfortable_steps,
    interpolated_history,
)
from tasks.world.frames import AX, AY, HEADING, PACIFICA, VX, YAW_ACCEL, YAW_RATE
from tests.tasks.reward.slow import comfort as slow

FILTERS = {  # window, order, derivative
    "smooth_accel": (8, 2, 0),
    "jerk_of": (15, 2, 1),
    "yaw_rate_of": (5, 2, 1),
    "yaw_accel_of": (5, 3, 2),
    "plan_yaw_accel_of": (5, 2, 2),
}


def judged(history: np.ndarray, *states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flags (K, 6) and first steps (K,) of K drives side by side."""
    flags, first = np.empty((len(states), 6), dtype=bool), np.empty(len(states))
    first_uncomfortable_steps(history, np.stack(states), comfort_scratch(len(history) + len(states[0])), flags, first)
    return flags, first


def series(accel: np.ndarray | float = 0.0, heading: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """History (14, 11) and states (41, 11) with these 55 values, all else 0."""
    rows = np.zeros((55, 11))
    rows[:, AX], rows[:, HEADING] = accel, heading
    return rows[:14].copy(), rows[14:].copy()


@st.composite
def drives(draw: st.DrawFn, n_rows: int) -> np.ndarray:
    """States (n_rows, 11): standing or moving, smooth or jumping, turning across the wrap or not."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    states = np.zeros((n_rows, 11))
    if draw(st.booleans()):
        accel = rng.normal(0.0, draw(st.sampled_from([0.0, 0.3, 2.0])), n_rows)
        states[:, AX] = np.cumsum(accel) * 0.3 if draw(st.booleans()) else accel
        states[rng.integers(n_rows) :, AX] += draw(st.sampled_from([0.0, -4.05, 2.4, 1.0]))
        states[:, AY] = rng.normal(0.0, draw(st.sampled_from([0.0, 4.0])), n_rows)
        states[:, VX] = np.maximum(0.0, 5.0 + 0.1 * np.cumsum(states[:, AX]))
    rate = draw(st.sampled_from([0.0, 0.0, 0.3, 0.95, 7.0])) + rng.normal(
        0.0, draw(st.sampled_from([0.0, 0.1])), n_rows
    )
    heading = draw(st.sampled_from([0.0, 3.1, -3.1])) + 0.1 * np.cumsum(rate)
    states[:, HEADING] = (heading + np.pi) % (2 * np.pi) - np.pi
    states[:, YAW_RATE], states[:, YAW_ACCEL] = rate, np.gradient(rate, 0.1)
    return states


@settings(max_examples=80)
@given(past=drives(4), states=st.lists(drives(41), min_size=1, max_size=3))
def test_flags_and_first_step_equal_the_slow_twin(past: np.ndarray, states: list[np.ndarray]) -> None:
    history = interpolated_history(past)
    flags, first = judged(history, *states)
    comfortable, slow_flags, slow_first = slow.history_comfort(history, np.stack(states), PACIFICA)
    assert np.array_equal(flags, slow_flags)
    assert np.array_equal(first, slow_first)
    assert np.array_equal(np.isinf(first), comfortable == 1.0) and np.array_equal(flags.all(axis=1), comfortable == 1.0)


@settings(max_examples=60)
@given(now=drives(41), other=drives(41), previous=drives(41), interval_s=st.sampled_from([0.1, 0.3, 0.5]))
def test_extended_comfort_equals_the_slow_twin(
    now: np.ndarray, other: np.ndarray, previous: np.ndarray, interval_s: float
) -> None:
    for before in (previous[None], np.stack([previous, other])):
        ours = extended_comfort(np.stack([now, other]), before, interval_s)
        theirs = slow.extended_comfort(np.stack([now, other]), before, interval_s)
        # A jerk half-way between two roundings at the very edge may fall either way.
        np.testing.assert_allclose(ours.rms, theirs.rms, rtol=1e-12, atol=3e-9)
        assert np.array_equal(ours.ec, theirs.ec)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("n_rows", [15, 36, 55])
def test_a_filter_equals_scipys_but_for_ties_of_the_rounding(name: str, n_rows: int) -> None:
    window, order, derivative = FILTERS[name]
    samples = np.random.default_rng(n_rows).normal(size=(12 * LANES, n_rows)).round(8)
    ours = np.empty_like(samples)
    for k in range(0, len(samples), LANES):
        side_by_side, out = samples[k : k + LANES].T.flatten(), np.empty(n_rows * LANES)
        getattr(comfort, name)(side_by_side, out)
        ours[k : k + LANES] = out.reshape(n_rows, LANES).T
    theirs = np.round(savgol_filter(samples, window, order, deriv=derivative, delta=0.1), 8)
    # Samples of 8 decimals put one sum in 14 half-way between two roundings. There the last bits of the weights decide,
    # which scipy solves for with other bits on other processors.
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1.01e-8)
    assert (ours != theirs).mean() < 0.1


def test_the_written_weights_are_scipys() -> None:
    weights = {
        "smooth_accel": comfort.ACCEL_WEIGHTS,
        "jerk_of": comfort.JERK_WEIGHTS,
        "yaw_rate_of": comfort.YAW_RATE_WEIGHTS,
        "yaw_accel_of": comfort.YAW_ACCEL_WEIGHTS,
        "plan_yaw_accel_of": comfort.PLAN_YAW_ACCEL_WEIGHTS,
    }
    for name, (window, order, derivative) in FILTERS.items():
        theirs = savgol_coeffs(window, order, deriv=derivative, delta=0.1)[::-1]
        np.testing.assert_allclose(weights[name], theirs, rtol=0, atol=1e-12)


@settings(max_examples=100)
@given(st.lists(st.floats(-10.0, 10.0) | st.sampled_from([0.0, np.pi, -np.pi, 2 * np.pi]), min_size=1, max_size=55))
def test_unwrapping_is_numpys(angles: list[float]) -> None:
    unwrapped = np.array(angles)
    comfort.unwrap(unwrapped, 1)
    assert np.array_equal(unwrapped, np.unwrap(angles))


@pytest.mark.parametrize(("accel", "inside"), [(2.4, False), (2.39999999, True), (-4.05, False), (-4.04999999, True)])
def test_the_limits_themselves_are_uncomfortable_and_rounding_is_to_eight_decimals(accel: float, inside: bool) -> None:
    flags, first = judged(*series(accel=accel))
    assert flags.tolist() == [[inside] + [True] * 5]
    assert first[0] == (np.inf if inside else -15.0)
    assert not judged(*series(accel=accel - np.sign(accel) * 4e-9))[0].all() or inside


@pytest.mark.parametrize("start", [0.0, 3.0, -3.1])
def test_a_constant_turn_has_its_yaw_rate_whatever_the_wrap(start: float) -> None:
    seconds = 0.1 * np.arange(55)
    for rate, comfortable in ((0.94, True), (0.95, False), (-0.94, True), (-0.95, False)):
        heading = (start + rate * seconds + np.pi) % (2 * np.pi) - np.pi
        flags, _ = judged(*series(heading=heading))
        assert flags.tolist() == [[True] * 5 + [comfortable]]


def test_a_quadratic_heading_has_its_yaw_acceleration() -> None:
    seconds = 0.1 * np.arange(55)
    for accel, comfortable in ((1.92, True), (1.93, False)):
        flags, _ = judged(*series(heading=0.5 * accel * (seconds - 2.75) ** 2))
        assert flags[0, 4] == comfortable


def test_limits_hold_the_six_rules_in_their_order() -> None:
    np.testing.assert_array_equal(LIMITS[:, 1], [2.40, 4.89, 8.37, 4.13, 1.93, 0.95])
    np.testing.assert_array_equal(LIMITS[:, 0], [-4.05, -4.89, -8.37, -4.13, -1.93, -0.95])


def test_a_difference_at_the_limit_of_extended_comfort_is_still_comfortable() -> None:
    now, before = np.zeros((2, 41, 11)), np.zeros((1, 41, 11))
    now[:, :, AX] = np.array([0.7, 0.70000001])[:, None]
    result = extended_comfort(now, before)
    np.testing.assert_allclose(result.rms[:, 0], [0.7, 0.70000001], rtol=0, atol=1e-15)
    assert result.ec.tolist() == [1.0, 0.0]

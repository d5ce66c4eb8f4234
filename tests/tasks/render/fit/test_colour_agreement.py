"""Cameras made to agree about colour: closed forms, and what noise must not do."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.render.fit.corrections import (
    align_cameras,
    apply_exposure,
    invert_exposure,
    relative_brightness,
    shared_colours,
)

RNG = np.random.default_rng(7)
POINTS = 4000
F32 = NDArray[np.float32]


def street() -> NDArray[np.float64]:
    """Colours (POINTS, 3): mostly grey, as of a street."""
    return np.clip(RNG.normal(0.45, 0.18, (POINTS, 1)) + RNG.normal(0.0, 0.05, (POINTS, 3)), 0.0, 1.0)


def row_of(gain: float, offset: float = 0.0) -> F32:
    return np.array([gain - 1.0, 0, 0, 0, gain - 1.0, 0, 0, 0, gain - 1.0, *3 * [offset]], np.float32)


def found(colours: NDArray[np.float64], seen: NDArray[np.bool_] | None = None) -> F32:
    return align_cameras(shared_colours(colours, np.ones(colours.shape[:2], bool) if seen is None else seen))


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.1])
def test_equal_cameras_with_noise_keep_their_contrast(noise: float) -> None:
    """Fitted to the mean of both by least squares each would lose a fifth of it at a noise of 0.1."""
    colours = street() + noise * RNG.standard_normal((2, POINTS, 3))
    assert np.abs(found(colours)).max() < 0.03


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_camera_s_gain_and_offset_are_found_through_noise_on_both_sides(noise: float) -> None:
    seen = (street() + noise * RNG.standard_normal((2, POINTS, 3))).astype(np.float32)
    taken = seen[0], apply_exposure(seen[1], row_of(0.6, 0.05))
    rows = found(np.stack(taken).astype(np.float64))
    np.testing.assert_allclose((1.0 + rows[1][[0, 4, 8]]) / (1.0 + rows[0][[0, 4, 8]]), 1.0 / 0.6, rtol=0.05)
    now = [apply_exposure(colours, row) for colours, row in zip(taken, rows)]
    np.testing.assert_allclose(now[0].mean(axis=0), now[1].mean(axis=0), atol=1e-4)
    np.testing.assert_allclose(now[0].std(axis=0), now[1].std(axis=0), rtol=0.02)


def test_the_common_colours_are_those_of_photos_on_average() -> None:
    """Way back to photos: gains 0.8 and 1.2 about the same light, whichever camera comes first."""
    light = street().astype(np.float32)
    for gains in ((0.8, 1.2), (1.2, 0.8)):
        rows = found(np.stack([apply_exposure(light, row_of(gain)) for gain in gains]).astype(np.float64))
        back = [invert_exposure(row) for row in rows]
        np.testing.assert_allclose([1.0 + row[[0, 4, 8]].mean() for row in back], gains, atol=0.01)
        np.testing.assert_allclose(np.mean(back, axis=0), np.zeros(12), atol=1e-5)


def test_a_ring_of_cameras_agrees_all_around_and_one_that_shares_nothing_keeps_its_colours() -> None:
    """Each shares points with its two neighbours alone, as cameras all around a car do."""
    gains = np.array([1.0, 1.2, 0.7, 0.9, 1.3, 1.1, 0.8, 1.0, 0.5])
    light = street()
    colours = gains[:, None, None] * (light + 0.05 * RNG.standard_normal((9, POINTS, 3)))
    seen = np.zeros((9, POINTS), bool)
    for c in range(8):
        at = np.arange(c * 500, c * 500 + 1000) % POINTS
        seen[c, at] = True
    rows = found(colours, seen)
    assert not rows[8].any()
    light_of = gains[:8] * (1.0 + rows[:8, [0, 4, 8]].mean(axis=1))
    np.testing.assert_allclose(light_of / light_of.mean(), 1.0, atol=0.03)


def test_a_handful_of_points_moves_little() -> None:
    """Seven say nothing; ten change the brightness, hardly the contrast."""
    light = street()
    assert not found(np.stack([light[:7], 0.5 * light[:7]])).any()
    few = found(np.stack([light[:10], 0.5 * light[:10]]))
    many = found(np.stack([light, 0.5 * light]))
    assert np.abs(few[:, :9]).max() < 0.5 * np.abs(many[:, :9]).max()


def test_how_bright_photos_are_comes_out_whatever_is_seen_where_and_some_points_are_wrong() -> None:
    rng = np.random.default_rng(3)
    gains = np.exp(rng.uniform(-0.4, 0.4, 8))
    points = rng.uniform(0.2, 0.6, 3000)
    grey = np.float32(gains[:, None] * points * np.exp(rng.normal(0.0, 0.03, (8, 3000))))
    seen = np.abs(np.linspace(0, 1, 3000) - np.linspace(0, 1, 8)[:, None]) < 0.25  # a drive: none sees all
    wrong = rng.uniform(size=seen.shape) < 0.15
    grey[wrong] = rng.uniform(0.05, 1.0, wrong.sum())
    logs = relative_brightness(grey, seen)
    np.testing.assert_allclose(logs, np.log(gains) - np.log(gains).mean(), atol=0.03)
    assert logs.mean() == pytest.approx(0.0, abs=1e-12)


def test_a_photo_that_shares_nothing_is_as_bright_as_the_mean() -> None:
    seen = np.ones((3, 50), bool)
    seen[2] = False
    grey = np.float32([[0.4] * 50, [0.2] * 50, [0.9] * 50])
    np.testing.assert_allclose(relative_brightness(grey, seen), [0.3466, -0.3466, 0.0], atol=0.01)
    assert not relative_brightness(grey, np.zeros((3, 50), bool)).any()

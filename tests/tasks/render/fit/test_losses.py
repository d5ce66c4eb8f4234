"""The loss and, above all, its gradient."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tasks.render.fit.losses import opaque_loss, photo_loss, photo_target, similarity

RNG = np.random.default_rng(0)
PHOTO = RNG.integers(0, 256, (17, 23, 3)).astype(np.uint8)
PICTURE = (PHOTO / 255.0 * 0.7 + 0.3 * RNG.uniform(0, 1, PHOTO.shape)).astype(np.float32)


def slow_ssim(x: NDArray[np.float64], y: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """Straight from the definition: 11 x 11 window, sigma 1.5, zeros beyond the border."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(taps, taps) / taps.sum() ** 2

    def mean(image: NDArray[np.float64]) -> NDArray[np.float64]:
        padded = np.pad(image, ((5, 5), (5, 5), (0, 0)))
        return np.asarray(
            np.einsum("hwcij,ij->hwc", np.lib.stride_tricks.sliding_window_view(padded, (11, 11), axis=(0, 1)), window)
        )

    mx, my = mean(x), mean(y)
    sxx, syy, sxy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    top = (2 * mx * my + 0.01**2) * (2 * sxy + 0.03**2)
    value = top / ((mx**2 + my**2 + 0.01**2) * (sxx + syy + 0.03**2))
    return float((weight[..., None] * value).sum() / (3 * weight.sum()))


def test_ssim_is_what_its_definition_says() -> None:
    target = photo_target(PHOTO)
    expected = slow_ssim(PICTURE.astype(np.float64), PHOTO / 255.0, np.ones(PHOTO.shape[:2]))
    assert 1.0 - photo_loss(PICTURE, target, 1.0)[0] == pytest.approx(expected, abs=1e-5)
    assert similarity(PICTURE, target).mean() == pytest.approx(expected, abs=1e-5)
    with pytest.raises(ValueError, match=r"a picture of \(17, 22, 3\) beside a photo of \(17, 23\)"):
        photo_loss(PICTURE[:, 1:], target, 1.0)


def test_ssim_gradient_agrees_with_finite_differences() -> None:
    ignored = np.zeros(PHOTO.shape[:2], bool)
    ignored[4:9, 3:7] = True
    target = photo_target(PHOTO, ignored)
    gradient = -photo_loss(PICTURE, target, 1.0)[1]
    x, y, weight = PICTURE.astype(np.float64), PHOTO / 255.0, (~ignored).astype(np.float64)
    for at in [(0, 0, 0), (5, 4, 1), (8, 11, 2), (16, 22, 0), (3, 7, 1)]:
        up, down = x.copy(), x.copy()
        up[at] += 1e-5
        down[at] -= 1e-5
        slope = (slow_ssim(up, y, weight) - slow_ssim(down, y, weight)) / 2e-5
        assert gradient[at] == pytest.approx(slope, rel=2e-3, abs=2e-7)


def test_a_picture_that_equals_the_photo_loses_nothing_and_ignored_pixels_do_not_count() -> None:
    ignored = np.zeros(PHOTO.shape[:2], bool)
    ignored[:, :5] = True
    target = photo_target(PHOTO, ignored)
    assert photo_loss(target.rgb, target, 0.2)[0] == pytest.approx(0.0, abs=1e-5)
    painted = target.rgb.copy()
    painted[:, :5] = 0.0
    loss, gradient, off_by = photo_loss(painted, target, 0.0)
    assert loss == 0.0
    assert not gradient.any()
    assert off_by == pytest.approx(np.mean((painted - target.rgb) ** 2))
    beyond = np.where(target.rgb > 0.5, np.float32(1.5), target.rgb - np.float32(0.5))  # as a photo has it: 1 and 0
    assert photo_loss(beyond, target, 0.2)[2] == pytest.approx(np.mean((np.clip(beyond, 0.0, 1.0) - target.rgb) ** 2))


def test_light_that_passes_where_there_is_ground_is_lost() -> None:
    alpha, ground = np.array([[0.2, 0.9], [0.5, 1.0]], np.float32), np.array([[False, False], [True, True]])
    loss, gradient = opaque_loss(alpha, ground, 0.4)
    assert loss == pytest.approx(0.4 * 0.5 / 4)
    np.testing.assert_allclose(gradient, [[0.0, 0.0], [-0.1, -0.1]])

"""How far a picture is from a photo, and which way it should change: L1 and SSIM (Wang et al. 2004)."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from tasks.kernels.compiled import numpy_division_kernel
from tasks.world.arrays import F32, Bools, Bytes

WINDOW, SIGMA = 11, 1.5  # pixels, as in the paper
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)  # for a range of 1
ONE, TWO = np.float32(1.0), np.float32(2.0)  # a float of Python's makes numba work in float64, at half the pace
_TAPS = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_32F)


@dataclass(frozen=True)
class Target:
    """A photo and what of it every comparison needs."""

    rgb: F32  # (H, W, 3) in [0, 1]
    mean: F32  # (H, W, 3) under the window
    variance: F32  # (H, W, 3) under the window
    share: F32  # (H, W, 3) of a mean over all that says something; 0: the pixel says nothing


def photo_target(rgb: Bytes, ignored: Bools | None = None) -> Target:
    """`rgb` (H, W, 3), `ignored` (H, W) pixels to leave out."""
    image = rgb.astype(np.float32) / np.float32(255.0)
    mean = _blur(image)
    counted = np.ones(image.shape, bool) if ignored is None else np.repeat(~ignored, 3).reshape(image.shape)
    share = counted.astype(np.float32) / np.float32(max(counted.sum(), 1))
    return Target(image, mean, _blur(image * image) - mean * mean, share)


def _blur(image: F32) -> F32:
    """Windowed mean (H, W, C), zeros beyond the border: symmetric, so it is its own adjoint."""
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, _TAPS, _TAPS, borderType=cv2.BORDER_CONSTANT), np.float32)


def ssim(rgb: F32, target: Target) -> tuple[float, F32]:
    """Mean structural similarity over weighted pixels and channels, and its gradient (H, W, 3)."""
    windowed = _blur(rgb), _blur(rgb * rgb), _blur(rgb * target.rgb)
    mean, _ = _similarity(*windowed, target.mean, target.variance, target.share)
    by_rgb, by_square, by_cross = (_blur(by) for by in windowed)
    _pull_back(rgb, target.rgb, by_rgb, by_square, by_cross)
    return mean, by_rgb


def similarity(rgb: F32, target: Target) -> F32:
    """Structural similarity of each pixel and channel (H, W, 3)."""
    windowed = _blur(rgb), _blur(rgb * rgb), _blur(rgb * target.rgb)
    return np.asarray(_similarity(*windowed, target.mean, target.variance, target.share)[1], np.float32)


@numpy_division_kernel
def _similarity(mean: Any, square: Any, cross: Any, target_mean: Any, target_variance: Any, share: Any) -> Any:
    """The mean of all shares of the similarity, and this (H, W, 3), of windowed x, x^2 and xy, which become the
    derivatives by them of that mean."""
    out, total = np.empty_like(mean), 0.0
    x, xx, xy, to = mean.ravel(), square.ravel(), cross.ravel(), out.ravel()
    y, yy, s = target_mean.ravel(), target_variance.ravel(), share.ravel()
    for i in range(x.size):
        a1, b1 = TWO * x[i] * y[i] + C1, x[i] * x[i] + y[i] * y[i] + C1
        a2, b2 = TWO * (xy[i] - x[i] * y[i]) + C2, xx[i] - x[i] * x[i] + yy[i] + C2
        by_1, by_2 = ONE / b1, ONE / b2
        value = a1 * by_1 * a2 * by_2
        by_square = -s[i] * value * by_2
        by_mean = TWO * s[i] * (y[i] * (a2 - a1) * by_1 * by_2 - x[i] * value * by_1) - TWO * x[i] * by_square
        x[i], xx[i], xy[i], to[i] = by_mean, by_square, TWO * s[i] * a1 * by_1 * by_2, value
    for row in range(out.shape[0]):
        total += (share[row] * out[row]).sum()
    return total, out


@numpy_division_kernel
def _pull_back(rgb: Any, photo: Any, by_mean: Any, by_square: Any, by_cross: Any) -> None:
    """From derivatives by windowed x, x^2 and xy, themselves windowed, to those by x, in place of the first."""
    x, y, by, square, cross = rgb.ravel(), photo.ravel(), by_mean.ravel(), by_square.ravel(), by_cross.ravel()
    for i in range(x.size):
        by[i] += TWO * x[i] * square[i] + y[i] * cross[i]


@numpy_division_kernel
def _add_difference(rgb: Any, photo: Any, share: Any, similar: Any, gradient: Any) -> Any:
    """The mean difference; `gradient` (H, W, 3) becomes that of (1 - `similar`) times it less `similar` times what it
    was."""
    x, y, s, by, total = rgb.ravel(), photo.ravel(), share.ravel(), gradient.ravel(), 0.0
    for i in range(x.size):
        off = x[i] - y[i]
        total += s[i] * abs(off)
        by[i] = (ONE - similar) * s[i] * np.sign(off) - similar * by[i]
    return total


def photo_loss(rgb: F32, target: Target, ssim_weight: float) -> tuple[float, F32]:
    """(1 - w) L1 + w (1 - SSIM) of a picture (H, W, 3), and its gradient (H, W, 3)."""
    alike, gradient = ssim(rgb, target) if ssim_weight > 0.0 else (0.0, np.zeros_like(rgb))
    similar = np.float32(ssim_weight)
    apart = float(_add_difference(rgb, target.rgb, target.share, similar, gradient))
    return (1.0 - ssim_weight) * apart + ssim_weight * (1.0 - alike), gradient


def opaque_loss(alpha: F32, ground: Bools, weight: float) -> tuple[float, F32]:
    """`weight` times the light that passes where the picture is `ground` (H, W), as a mean over all of it, and its
    gradient by `alpha`."""
    scale = np.float32(weight / alpha.size)
    return float(scale * (1.0 - alpha[ground]).sum()), np.where(ground, -scale, np.float32(0.0))

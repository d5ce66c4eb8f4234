"""How far a picture is from a photo, and which way it should change: L1 and SSIM (Wang et al. 2004)."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import F32, Bools, Bytes

WINDOW, SIGMA = 11, 1.5  # pixels, as in the paper
C1, C2 = 0.01**2, 0.03**2  # for a range of 1
_TAPS = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_32F)


@dataclass(frozen=True)
class Target:
    """A photo and what of it every comparison needs."""

    rgb: F32  # (H, W, 3) in [0, 1]
    mean: F32  # (H, W, 3) under the window
    variance: F32  # (H, W, 3) under the window
    weight: F32  # (H, W) 0: the pixel says nothing


def photo_target(rgb: Bytes, ignored: Bools | None = None) -> Target:
    """`rgb` (H, W, 3), `ignored` (H, W) pixels to leave out."""
    image = rgb.astype(np.float32) / np.float32(255.0)
    mean = _blur(image)
    weight = np.ones(rgb.shape[:2], np.float32) if ignored is None else (~ignored).astype(np.float32)
    return Target(image, mean, _blur(image * image) - mean * mean, weight)


def _blur(image: F32) -> F32:
    """Windowed mean (H, W, C), zeros beyond the border: symmetric, so it is its own adjoint."""
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, _TAPS, _TAPS, borderType=cv2.BORDER_CONSTANT), np.float32)


def ssim(rgb: F32, target: Target) -> tuple[float, F32]:
    """Mean structural similarity over weighted pixels and channels, and its gradient (H, W, 3)."""
    back = np.empty((*rgb.shape[:2], 9), np.float32)
    share = target.weight / np.float32(3.0 * max(float(target.weight.sum()), 1.0))
    total = _similarity(_blur(_products(rgb, target.rgb)), target.mean, target.variance, share, back)
    return total, _chain_to_picture(_blur(back), rgb, target.rgb)


@kernel
def _products(x: Any, y: Any) -> Any:
    """x, x^2, xy (H, W, 9), the three channels of each together."""
    out = np.empty((x.shape[0], x.shape[1], 9), np.float32)
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            for c in range(3):
                a, b = x[i, j, c], y[i, j, c]
                out[i, j, c], out[i, j, c + 3], out[i, j, c + 6] = a, a * a, a * b
    return out


@kernel
def _similarity(blurred: Any, mean: Any, variance: Any, share: Any, back: Any) -> float:
    """Sum of share times similarity; fills its derivatives by `blurred` (H, W, 9), the windowed `_products`."""
    total = 0.0
    for i in range(blurred.shape[0]):
        for j in range(blurred.shape[1]):
            for c in range(3):
                mu_x, mu_y = blurred[i, j, c], mean[i, j, c]
                cross = blurred[i, j, c + 6] - mu_x * mu_y
                spread = blurred[i, j, c + 3] - mu_x * mu_x + variance[i, j, c]
                a1, a2 = 2.0 * mu_x * mu_y + C1, 2.0 * cross + C2
                b1, b2 = mu_x * mu_x + mu_y * mu_y + C1, spread + C2
                value, s = a1 * a2 / (b1 * b2), share[i, j]
                by_xx = -s * value / b2
                by_mean = 2.0 * s * (mu_y * (a2 - a1) / (b1 * b2) - mu_x * value / b1) - 2.0 * mu_x * by_xx
                back[i, j, c], back[i, j, c + 3], back[i, j, c + 6] = by_mean, by_xx, 2.0 * s * a1 / (b1 * b2)
                total += s * value
    return total


@kernel
def _chain_to_picture(back: Any, x: Any, y: Any) -> Any:
    """Derivatives by x (H, W, 3), from those by x, x^2 and xy (H, W, 9)."""
    out = np.empty_like(x)
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            for c in range(3):
                out[i, j, c] = back[i, j, c] + 2.0 * x[i, j, c] * back[i, j, c + 3] + y[i, j, c] * back[i, j, c + 6]
    return out


def photo_loss(rgb: F32, target: Target, ssim_weight: float) -> tuple[float, F32]:
    """(1 - w) L1 + w (1 - SSIM) of a picture (H, W, 3), and its gradient (H, W, 3)."""
    share = target.weight[..., None] / np.float32(3.0 * max(float(target.weight.sum()), 1.0))
    off = rgb - target.rgb
    loss = (1.0 - ssim_weight) * float((share * np.abs(off)).sum())
    gradient = np.float32(1.0 - ssim_weight) * share * np.sign(off)
    if ssim_weight > 0.0:
        similarity, by_rgb = ssim(rgb, target)
        loss += ssim_weight * (1.0 - similarity)
        gradient -= np.float32(ssim_weight) * by_rgb
    return loss, gradient


def opaque_loss(alpha: F32, ground: Bools, weight: float) -> tuple[float, F32]:
    """`weight` times the light that passes where the picture is `ground` (H, W), as a mean over all of it, and its
    gradient by `alpha`."""
    scale = np.float32(weight / alpha.size)
    return float(scale * (1.0 - alpha[ground]).sum()), np.where(ground, -scale, np.float32(0.0))

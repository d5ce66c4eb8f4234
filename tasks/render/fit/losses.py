"""How far a picture is from a photo, and which way it should change: L1 and SSIM (Wang et al. 2004)."""

import importlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
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


def target_of(rgb: Bytes, ignored: Bools | None = None) -> Target:
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
    return total, _along(_blur(back), rgb, target.rgb)


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
def _along(back: Any, x: Any, y: Any) -> Any:
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


# How differently two pictures look, as a network sees it: LPIPS (Zhang et al. 2018), version 0.1 on AlexNet.
#
# The weights are a user's files, as the public packages have them: torchvision's AlexNet and the linear heads of
# `lpips` (`weights/v0.1/alex.pth`), or both in one, the state of `lpips.LPIPS(net="alex")`. torch is loaded by
# `lpips_of` alone.

Lpips = Callable[[F32, F32], float]  # of two pictures (H, W, 3) in [0, 1]
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of colours in [-1, 1], before the first layer
# AlexNet's convolutions by their place among torchvision's `features`: stride, padding, pooled before (3 x 3, by 2).
LAYERS = {0: (4, 2, False), 3: (1, 2, True), 6: (1, 1, True), 8: (1, 1, False), 10: (1, 1, False)}
SMALLEST_PX = 32  # a side: below it the second pooling has nothing left
EPSILON = 1e-10  # added to a feature's length


class BadWeights(ValueError):
    """The files are no weights of LPIPS, or torch is missing: says which and what to do."""


def lpips_of(files: Sequence[str | Path]) -> Lpips:
    """The measure with these weights. Raises BadWeights."""
    try:
        torch = importlib.import_module("torch")
    except ImportError as error:
        raise BadWeights(f'LPIPS needs torch ({error}): pip install -e ".[planners]"') from error
    network = _layers(_read(files, torch))
    head = [torch.from_numpy(np.asarray(numbers, np.float32)[None, :, None, None]) for numbers in (SHIFT, SCALE)]

    def features(picture: F32) -> list[Any]:
        """Of each layer (1, C, h, w), of length 1 at each place."""
        at = (2.0 * torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)[None] - 1.0 - head[0]) / head[1]
        found = []
        for weight, bias, _, (stride, padding, pooled) in network:
            at = torch.nn.functional.max_pool2d(at, 3, 2) if pooled else at
            at = torch.nn.functional.conv2d(at, weight, bias, stride, padding).clamp_min(0.0)
            found.append(at / ((at * at).sum(1, keepdim=True).sqrt() + EPSILON))
        return found

    def distance(a: F32, b: F32) -> float:
        """Raises ValueError for pictures that are too small or of different sizes."""
        if a.shape != b.shape or min(a.shape[:2]) < SMALLEST_PX:
            raise ValueError(f"LPIPS of pictures {a.shape} and {b.shape}: sides must be equal, {SMALLEST_PX} or more")
        with torch.no_grad():
            pairs = zip(features(a), features(b), network, strict=True)
            return float(sum(((x - y) ** 2 * layer[2]).sum(1).mean() for x, y, layer in pairs))

    return distance


def _read(files: Sequence[str | Path], torch: Any) -> dict[str, Any]:
    """All tensors of the files by name. Raises BadWeights."""
    found: dict[str, Any] = {}
    for file in files:
        try:
            found |= torch.load(file, map_location="cpu", weights_only=True)
        except Exception as error:  # what unpickling raises is of any type
            raise BadWeights(f"{file}: no weights that torch can load: {type(error).__name__} {error}") from error
    return found


def _layers(found: Mapping[str, Any]) -> list[tuple[Any, Any, Any, tuple[int, int, bool]]]:
    """Weight, bias, head (1, C, 1, 1) and shape of each convolution. Raises BadWeights for one that is absent."""
    named = {re.sub(r"^net\.slice\d\.", "features.", name): tensor for name, tensor in found.items()}
    layers = []
    for k, (at, shape) in enumerate(LAYERS.items()):
        names = f"features.{at}.weight", f"features.{at}.bias", f"lin{k}.model.1.weight"
        missing = [name for name in names if name not in named]
        if missing:
            what = (
                "AlexNet's (torchvision's alexnet-*.pth)" if "features" in missing[0] else "the heads (lpips' alex.pth)"
            )
            raise BadWeights(f"LPIPS: {missing[0]} is in none of the files: {what} are missing")
        layers.append((*(named[name].float() for name in names), shape))
    return layers

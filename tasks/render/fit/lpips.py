"""How differently two pictures look, as a network sees it: LPIPS (Zhang et al. 2018), version 0.1 on AlexNet.

The weights are a user's files, as the public packages have them: torchvision's AlexNet and the linear heads of `lpips`
(`weights/v0.1/alex.pth`), or both in one, the state of `lpips.LPIPS(net="alex")`. torch is loaded by `lpips_of` alone.
"""

import importlib
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tasks.world.arrays import F32

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

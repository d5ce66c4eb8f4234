"""Colours that make the photos come out: a few sweeps of SART over the blending weights.

With fixed geometry a picture is linear in the Gaussians' colours. Each photo's residual is carried back with the
weights it was blended with and divided by their sum (Andersen and Kak 1984), photo after photo in a fixed order.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.raster import gather, shade, splat
from tasks.world.arrays import F32, Array, Bools, Indices

RELAXATION = 0.6
PRIOR_WEIGHT = 0.3  # weight (in pixels) that keeps barely visible Gaussians near their colour


@dataclass(frozen=True)
class FitPhoto:
    """A photo to be reproduced."""

    rgb: F32  # (H, W, 3) in [0, 1]
    intrinsics: Array  # (3, 3)
    scene_from_camera: Array  # (4, 4)
    backdrop: F32  # (H, W, 3)
    passing: Bools  # (H, W) pixels that say nothing about the background


def refit_colours(
    scene_of: Callable[[int], Gaussians],
    photos: Sequence[FitPhoto],
    colours: F32,
    rows_of: Callable[[int], Indices],
    n_background: int,
    sweeps: int,
) -> F32:
    """Colours (G, 3) after `sweeps` passes.

    `scene_of(i)` the Gaussians of photo i, `rows_of(i)` the row in `colours` of each of them; the first `n_background`
    rows are the background's, which must not learn the colour of a car that drives by.
    """
    colours = colours.copy()
    for _ in range(sweeps):
        for i, photo in enumerate(photos):
            height, width = photo.rgb.shape[:2]
            splats = splat(scene_of(i), photo.intrinsics, photo.scene_from_camera, width, height)
            rows = rows_of(i)[splats.index]
            residual = photo.rgb - shade(splats, colours[rows], photo.backdrop).rgb
            sums, weights = gather(splats, residual, photo.passing, n_background)
            step = RELAXATION * sums / (weights + PRIOR_WEIGHT)[:, None]
            colours[rows] = np.clip(colours[rows] + step, 0.0, 1.0)
    return colours

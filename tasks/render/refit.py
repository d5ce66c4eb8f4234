"""Colours that make the photos come out: a few sweeps of SART over the blending weights.

With fixed geometry a picture is linear in the Gaussians' colours. Each photo's residual is carried back with the
weights it was blended with and divided by their sum (Andersen and Kak 1984), photo after photo in a fixed order.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from tasks.render.gaussians import F32, F64, Gaussians
from tasks.render.raster import gather, shade, splat

RELAXATION = 0.6
PRIOR_WEIGHT = 0.3  # weight (in pixels) that keeps barely visible Gaussians near their colour


def refit_colours(
    scene_of: Callable[[int], Gaussians],
    photos: Sequence[tuple[F32, F64, F64, F32]],
    colours: F32,
    rows_of: Callable[[int], np.ndarray],
    sweeps: int,
) -> F32:
    """Colours (G, 3) after `sweeps` passes.

    `photos`: (rgb (H, W, 3) in [0, 1], intrinsics, scene_from_camera, background (H, W, 3)); `scene_of(i)` the
    Gaussians of photo i, `rows_of(i)` the row in `colours` of each of them.
    """
    colours = colours.copy()
    for _ in range(sweeps):
        for i, (rgb, intrinsics, scene_from_camera, background) in enumerate(photos):
            height, width = rgb.shape[:2]
            rows, scene = rows_of(i), scene_of(i)
            splats = splat(scene, intrinsics, scene_from_camera, width, height)
            now = replace(scene, colours=colours[rows])
            view = shade(splats, now.colours, background)
            sums, weights = gather(splats, rgb - view.rgb, len(scene))
            step = RELAXATION * sums / (weights + PRIOR_WEIGHT)[:, None]
            colours[rows] = np.clip(colours[rows] + step, 0.0, 1.0)
    return colours

"""The sky as Gaussians, for programs that draw nothing else."""

import cv2
import numpy as np

from tasks.render.scene.sky import SkyMap
from tasks.render.splatting.gaussians import Gaussians
from tasks.world.arrays import F32, Array

DOME_M = 5000.0  # away: 100 m of driving move it by a degree
DOME_ROWS = 64  # of 2.8 degrees


def sky_gaussians(sky: SkyMap, centre: Array) -> Gaussians:
    """Opaque balls around `centre` (3,), row by row of about the same size, in the sky's colours; whites are cut."""
    height = np.pi / DOME_ROWS
    small = cv2.resize(sky.rgb, (4 * DOME_ROWS, DOME_ROWS), interpolation=cv2.INTER_AREA)
    rays: list[Array] = []
    colours: list[F32] = []
    for row in small[:, None]:
        elevation = np.pi / 2.0 - (len(rays) + 0.5) * height
        n = max(4, round(2.0 * np.pi * np.cos(elevation) / height))
        azimuth = ((np.arange(n) + 0.5) / n - 0.5) * 2.0 * np.pi
        flat = np.cos(elevation)
        rays.append(np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.full(n, np.sin(elevation))], axis=-1))
        colours.append(cv2.resize(row, (n, 1), interpolation=cv2.INTER_AREA)[0])
    directions = np.concatenate(rays)
    n = len(directions)
    return Gaussians(
        (centre + DOME_M * directions).astype(np.float32),
        np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (n, 1)),
        np.full((n, 3), np.log(0.6 * height * DOME_M), np.float32),
        np.full(n, 0.99, np.float32),
        np.clip(np.concatenate(colours), 0.0, 1.0).astype(np.float32),
        np.zeros((n, 0, 3), np.float32),
    )

"""What is behind everything: colour by direction."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from tasks.render.scene.sky_lookup import COLUMNS, ROWS, backdrop, sky_cells
from tasks.world.arrays import F32, Array, Bools

WINDOWS = 96  # side by side in a picture, in which it is smooth or not
SMOOTH, SMOOTH_SHARE = 0.02, 0.3  # deviation of the grey of a smooth window, and the share of them that makes it sky
SKY_WEIGHT = 1.0e4  # against one pixel of something else in the same direction


@dataclass(frozen=True)
class SkyMap:
    """Infinitely far colours. Where no photo saw sky: the mean colour seen in that direction, so that a hole in the
    scene is no hole to the sky."""

    rgb: F32  # (ROWS, COLUMNS, 3) from 0 on, above 1 where a photo of mean exposure is white; world directions

    def seen_by(self, intrinsics: Array, world_from_camera: Array, width: int, height: int, threads: int = 1) -> F32:
        """The backdrop (H, W, 3) of a camera. Raises ValueError for a map of another size, which a file may hold."""
        if self.rgb.shape != (ROWS, COLUMNS, 3):
            raise ValueError(f"sky: {self.rgb.shape}, expected ({ROWS}, {COLUMNS}, 3)")
        where = sky_cells(intrinsics, world_from_camera, width, height, threads)
        cells = np.require(self.rgb, np.float32, ["C", "W"])  # kernels compile once more for read-only arrays
        return backdrop(cells.reshape(-1, 3), where, threads)


def may_be_sky(rgb: F32) -> Bools:
    """Pixels (H, W) of a picture in [0, 1] that are as bright or as blue as the sky."""
    grey = rgb.mean(axis=-1)
    return np.asarray((grey > 0.6) | ((rgb[..., 2] > rgb[..., 0] + 0.04) & (grey > 0.4)))


def no_worse(sky_cost: F32, cost: F32) -> Bools:
    """Where the sky agrees with other photos about as well as the best depth does: (H, W)."""
    return np.asarray(sky_cost < 1.3 * cost + 0.03)


def smooth_around(rgb: F32, among: Bools) -> Bools:
    """Pixels (H, W) around which much of what is `among` (H, W) is smooth: sky and its clouds, but no boarded wall."""
    grey = rgb.mean(axis=-1)
    n = max(rgb.shape[1] // WINDOWS, 2) // 2 * 2 + 1
    mean = cv2.blur(grey, (n, n))
    rough = np.sqrt(np.maximum(cv2.blur(grey * grey, (n, n)) - mean * mean, 0.0))
    wide = (6 * n + 1, 6 * n + 1)
    smooth = cv2.blur((among & (rough < SMOOTH)).astype(np.float32), wide)
    return np.asarray(smooth > SMOOTH_SHARE * cv2.blur(among.astype(np.float32), wide))


def directions(intrinsics: Array, world_from_camera: Array, width: int, height: int) -> Array:
    """(H, W, 3) viewing directions in the world, not normalised."""
    return np.asarray(camera_rays(intrinsics, width, height) @ world_from_camera[:3, :3].T)


def camera_rays(intrinsics: Array, width: int, height: int) -> Array:
    """(H, W, 3) viewing directions in camera coordinates, z = 1."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x, y = (u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1]
    return np.stack([x, y, np.ones_like(u)], axis=-1)


def _cells(rays: Array) -> tuple[Array, Array]:
    elevation = np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    return (0.5 - elevation / np.pi) * ROWS - 0.5, (azimuth / (2 * np.pi) + 0.5) * COLUMNS - 0.5


def sky_of_views(views: Iterable[tuple[Array, F32, Bools]]) -> SkyMap:
    """The mean of what views show of the sky (and, with next to no weight, of the street).

    Each is directions (M, 3), their colours (M, 3) from 0 on, and whether it was sky (M,). Cells nobody looked at take
    the colour of the nearest one that was; plain grey without any view.
    """
    sums = np.zeros((ROWS * COLUMNS, 4))
    for rays, rgb, is_sky in views:
        weight = np.where(is_sky, SKY_WEIGHT, 1.0)
        rows, columns = _cells(rays)
        cell = np.clip(np.rint(rows), 0, ROWS - 1).astype(np.intp) * COLUMNS
        cell += np.rint(columns).astype(np.intp) % COLUMNS
        for channel in range(3):
            sums[:, channel] += np.bincount(cell, weight * rgb[:, channel], ROWS * COLUMNS)
        sums[:, 3] += np.bincount(cell, weight, ROWS * COLUMNS)
    cells = sums.reshape(ROWS, COLUMNS, 4)
    seen = cells[..., 3] > 0
    if not seen.any():
        return SkyMap(np.full((ROWS, COLUMNS, 3), 0.7, np.float32))
    colours = cells[..., :3] / np.maximum(cells[..., 3:], 1e-9)
    out = np.empty((ROWS, COLUMNS, 3), np.float32)
    for half in (slice(0, ROWS // 2), slice(ROWS // 2, ROWS)):  # sky and street do not fill each other
        there = seen[half] if seen[half].any() else seen
        source = colours[half] if seen[half].any() else colours
        wrapped = np.concatenate([there] * 3, axis=1)
        nearest = distance_transform_edt(~wrapped, return_distances=False, return_indices=True)
        rows = nearest[0][: ROWS // 2, COLUMNS : 2 * COLUMNS]
        out[half] = source[rows, nearest[1][: ROWS // 2, COLUMNS : 2 * COLUMNS] % COLUMNS]
    return SkyMap(out)

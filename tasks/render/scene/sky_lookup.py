"""Where in the sky map each pixel of a camera looks, and what it sees there."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.kernels.threads import in_chunks
from tasks.world.arrays import F32, Array, ShortInts

ROWS, COLUMNS = 256, 1024  # of the map: elevation +90 deg .. -90 deg, azimuth -180 deg .. 180 deg
ROWS_CHUNK = 16  # of the picture, looked up by a thread at a time


@dataclass(frozen=True)
class SkyCells:
    """The four cells of the sky around each pixel's direction; angles are dear, and an iteration needs them twice."""

    corners: ShortInts  # (H, W, 3) row of the upper two, columns of the left and of the right two
    shares: Array  # (H, W, 2) of the right and of the lower ones


def sky_cells(intrinsics: Array, scene_from_camera: Array, width: int, height: int, threads: int = 1) -> SkyCells:
    """Where a camera looks when nothing is in the way."""
    found = SkyCells(np.empty((height, width, 3), np.int32), np.empty((height, width, 2)))
    camera = np.array(intrinsics, np.float64), np.array(scene_from_camera, np.float64)
    in_chunks(partial(_find, *camera, found.corners, found.shares), height, ROWS_CHUNK, threads)
    return found


@kernel
def _find(k: Any, turn: Any, corners: Any, shares: Any, first: int, last: int) -> None:
    for row in range(first, last):
        for column in range(corners.shape[1]):
            a, b = (column + 0.5 - k[0, 2]) / k[0, 0], (row + 0.5 - k[1, 2]) / k[1, 1]
            x = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2]
            y = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2]
            z = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2]
            v = (0.5 - np.arctan2(z, np.sqrt(x * x + y * y)) / np.pi) * ROWS - 0.5
            u = (np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * COLUMNS - 0.5
            v0, u0 = min(max(int(np.floor(v)), 0), ROWS - 2), int(np.floor(u))
            corners[row, column, 0] = v0
            corners[row, column, 1] = u0 % COLUMNS
            corners[row, column, 2] = (u0 + 1) % COLUMNS
            shares[row, column, 0] = u - u0
            shares[row, column, 1] = min(max(v - v0, 0.0), 1.0)


def backdrop(cells: F32, where: SkyCells, threads: int = 1) -> F32:
    """The sky (H, W, 3), linear between its `cells` (ROWS * COLUMNS, 3)."""
    out = np.empty(where.corners.shape, np.float32)
    in_chunks(partial(_look_up, cells, where.corners, where.shares, out), len(out), ROWS_CHUNK, threads)
    return out


@kernel
def _look_up(cells: Any, corners: Any, shares: Any, out: Any, first: int, last: int) -> None:
    for row in range(first, last):
        for column in range(out.shape[1]):
            v, left, right = corners[row, column, 0], corners[row, column, 1], corners[row, column, 2]
            fu, fv = shares[row, column, 0], shares[row, column, 1]
            for c in range(3):
                top = cells[v * COLUMNS + left, c] * (1.0 - fu) + cells[v * COLUMNS + right, c] * fu
                low = cells[(v + 1) * COLUMNS + left, c] * (1.0 - fu) + cells[(v + 1) * COLUMNS + right, c] * fu
                out[row, column, c] = top * (1.0 - fv) + low * fv

"""The sky as something that is learned: looked up by direction, and the way back."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tasks.kernels import kernel
from tasks.render.gaussians import F32
from tasks.render.sky import COLUMNS, ROWS
from tasks.render.threads import in_chunks

HIDDEN = 0.99
ROWS_CHUNK = 16  # of the picture, looked up by a thread at a time


@kernel
def _corners(k: Any, turn: Any, column: int, row: int) -> Any:
    """Upper left cell of the four around a pixel's direction, and the shares of the right and the lower ones."""
    a, b = (column + 0.5 - k[0, 2]) / k[0, 0], (row + 0.5 - k[1, 2]) / k[1, 1]
    x = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2]
    y = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2]
    z = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2]
    v = (0.5 - np.arctan2(z, np.sqrt(x * x + y * y)) / np.pi) * ROWS - 0.5
    u = (np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * COLUMNS - 0.5
    v0, u0 = min(max(int(np.floor(v)), 0), ROWS - 2), int(np.floor(u))
    return v0, u0 % COLUMNS, (u0 + 1) % COLUMNS, u - u0, min(max(v - v0, 0.0), 1.0)


def backdrop(
    cells: F32,
    intrinsics: NDArray[np.float64],
    scene_from_camera: NDArray[np.float64],
    width: int,
    height: int,
    threads: int = 1,
) -> F32:
    """What `SkyMap.seen_by` shows (height, width, 3); `cells` (ROWS * COLUMNS, 3)."""
    out = np.empty((height, width, 3), np.float32)

    def run(first: int, last: int) -> None:
        _look_up(cells, intrinsics, scene_from_camera, first, last, out)

    in_chunks(run, height, ROWS_CHUNK, threads)
    return out


@kernel
def _look_up(cells: Any, k: Any, scene_from_camera: Any, first: int, last: int, out: Any) -> None:
    for row in range(first, last):
        for column in range(out.shape[1]):
            v, left, right, fu, fv = _corners(k, scene_from_camera, column, row)
            for c in range(3):
                top = cells[v * COLUMNS + left, c] * (1.0 - fu) + cells[v * COLUMNS + right, c] * fu
                low = cells[(v + 1) * COLUMNS + left, c] * (1.0 - fu) + cells[(v + 1) * COLUMNS + right, c] * fu
                out[row, column, c] = top * (1.0 - fv) + low * fv


@kernel
def _scatter(d_rgb: Any, alpha: Any, k: Any, scene_from_camera: Any, sums: Any, touched: Any) -> None:
    for row in range(alpha.shape[0]):
        for column in range(alpha.shape[1]):
            if alpha[row, column] > HIDDEN:
                continue
            light = 1.0 - alpha[row, column]
            v, left, right, fu, fv = _corners(k, scene_from_camera, column, row)
            for side in range(4):
                cell = (v + side // 2) * COLUMNS + (right if side % 2 else left)
                share = (fu if side % 2 else 1.0 - fu) * (fv if side // 2 else 1.0 - fv)
                touched[cell] = True
                for c in range(3):
                    sums[cell, c] += share * light * d_rgb[row, column, c]


def backdrop_gradient(
    d_rgb: F32, alpha: F32, intrinsics: NDArray[np.float64], scene_from_camera: NDArray[np.float64]
) -> tuple[NDArray[np.int64], F32]:
    """The cells (M,) that a photo's background came from, and the gradient by them (M, 3).

    `d_rgb` (H, W, 3) by the picture, `alpha` (H, W) of what stands before the background; where it hides more than
    HIDDEN the background is asked for nothing.
    """
    sums, touched = np.zeros((ROWS * COLUMNS, 3), np.float32), np.zeros(ROWS * COLUMNS, np.bool_)
    _scatter(d_rgb, alpha, intrinsics, scene_from_camera, sums, touched)
    rows = np.flatnonzero(touched)
    return rows, sums[rows]

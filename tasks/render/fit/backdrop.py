"""The backward pass of looking up the sky, which is learned."""

from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.render.scene.sky_lookup import COLUMNS, ROWS, SkyCells
from tasks.world.arrays import F32, Ints

HIDDEN = 0.99


@kernel
def _scatter(d_rgb: Any, alpha: Any, corners: Any, shares: Any, sums: Any, touched: Any) -> None:
    for row in range(alpha.shape[0]):
        for column in range(alpha.shape[1]):
            if alpha[row, column] > HIDDEN:
                continue
            light = 1.0 - alpha[row, column]
            v, left, right = corners[row, column, 0], corners[row, column, 1], corners[row, column, 2]
            fu, fv = shares[row, column, 0], shares[row, column, 1]
            for side in range(4):
                cell = (v + side // 2) * COLUMNS + (right if side % 2 else left)
                share = (fu if side % 2 else 1.0 - fu) * (fv if side // 2 else 1.0 - fv)
                touched[cell] = True
                for c in range(3):
                    sums[cell, c] += share * light * d_rgb[row, column, c]


def backdrop_gradient(d_rgb: F32, alpha: F32, where: SkyCells) -> tuple[Ints, F32]:
    """The cells (M,) that a photo's background came from, and the gradient by them (M, 3).

    `d_rgb` (H, W, 3) by the picture, `alpha` (H, W) of what stands before the background; where it hides more than
    HIDDEN the background is asked for nothing.
    """
    sums, touched = np.zeros((ROWS * COLUMNS, 3), np.float32), np.zeros(ROWS * COLUMNS, np.bool_)
    _scatter(d_rgb, alpha, where.corners, where.shares, sums, touched)
    rows = np.flatnonzero(touched)
    return rows, sums[rows]

"""Colour that depends on the side it is seen from: real spherical harmonics up to degree 3.

Basis, order and signs are those of 3D Gaussian splatting files (Kerbl et al. 2023, after Sloan 2008): with `f_dc`,
`f_rest` of a `.ply`, colours = 0.5 + C0 * f_dc and sh_rest = f_rest. The direction runs from the camera's centre to the
Gaussian's mean, in the frame that the Gaussians are given in.
"""

from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import F32, Array

C0 = 0.28209479177387814  # sqrt(1 / (4 pi))
C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
C2A, C2B, C2C = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396  # sqrt(15, 5/4, 15/4 over 4 pi)
C3A, C3B, C3C = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
C3D, C3E = 0.3731763325901154, 1.445305721320277
COUNTS = (0, 3, 8, 15)  # coefficients beyond degree 0, by degree


@kernel
def _basis(x: float, y: float, z: float, count: int, out: Any) -> None:
    """The first `count` basis functions beyond degree 0 of a unit direction."""
    if count >= 3:
        out[0], out[1], out[2] = -C1 * y, C1 * z, -C1 * x
    if count >= 8:
        out[3], out[4] = C2A * x * y, -C2A * y * z
        out[5] = C2B * (2.0 * z * z - x * x - y * y)
        out[6], out[7] = -C2A * x * z, C2C * (x * x - y * y)
    if count >= 15:
        out[8], out[9] = -C3A * y * (3.0 * x * x - y * y), C3B * x * y * z
        out[10] = -C3C * y * (4.0 * z * z - x * x - y * y)
        out[11] = C3D * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
        out[12] = -C3C * x * (4.0 * z * z - x * x - y * y)
        out[13], out[14] = C3E * z * (x * x - y * y), -C3A * x * (x * x - 3.0 * y * y)


@kernel
def _slopes(x: float, y: float, z: float, count: int, out: Any) -> None:
    """Derivatives (15, 3) of the basis' polynomials by x, y, z."""
    if count >= 3:
        out[0, 1], out[1, 2], out[2, 0] = -C1, C1, -C1
    if count >= 8:
        out[3, 0], out[3, 1] = C2A * y, C2A * x
        out[4, 1], out[4, 2] = -C2A * z, -C2A * y
        out[5, 0], out[5, 1], out[5, 2] = -2.0 * C2B * x, -2.0 * C2B * y, 4.0 * C2B * z
        out[6, 0], out[6, 2] = -C2A * z, -C2A * x
        out[7, 0], out[7, 1] = 2.0 * C2C * x, -2.0 * C2C * y
    if count >= 15:
        out[8, 0], out[8, 1] = -6.0 * C3A * x * y, -3.0 * C3A * (x * x - y * y)
        out[9, 0], out[9, 1], out[9, 2] = C3B * y * z, C3B * x * z, C3B * x * y
        out[10, 0], out[10, 1] = 2.0 * C3C * x * y, -C3C * (4.0 * z * z - x * x - 3.0 * y * y)
        out[10, 2] = -8.0 * C3C * y * z
        out[11, 0], out[11, 1] = -6.0 * C3D * x * z, -6.0 * C3D * y * z
        out[11, 2] = C3D * (6.0 * z * z - 3.0 * x * x - 3.0 * y * y)
        out[12, 0], out[12, 1] = -C3C * (4.0 * z * z - 3.0 * x * x - y * y), 2.0 * C3C * x * y
        out[12, 2] = -8.0 * C3C * x * z
        out[13, 0], out[13, 1], out[13, 2] = 2.0 * C3E * x * z, -2.0 * C3E * y * z, C3E * (x * x - y * y)
        out[14, 0], out[14, 1] = -3.0 * C3A * (x * x - y * y), 6.0 * C3A * x * y


@kernel
def basis(directions: Any, count: int) -> Any:
    """Basis functions beyond degree 0 (N, count) float64 of unit directions (N, 3); `count` in COUNTS."""
    out = np.empty((directions.shape[0], count), np.float64)
    for i in range(directions.shape[0]):
        _basis(directions[i, 0], directions[i, 1], directions[i, 2], count, out[i])
    return out


@kernel
def seen(means: Any, colours: Any, sh_rest: Any, center: Any, index: Any, out: Any, first: int, last: int) -> None:
    """Fills rgb (M, 3), never negative, of the Gaussians at `index` (M,) as seen from `center` (3,) float64, for rows
    `first` to `last`."""
    count = sh_rest.shape[1]
    values = np.empty(15, np.float64)
    for k in range(first, last):
        i = index[k]
        if count:
            x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
            scale = 1.0 / np.sqrt(x * x + y * y + z * z)
            _basis(x * scale, y * scale, z * scale, count, values)
        for c in range(3):
            total = float(colours[i, c])
            for m in range(count):
                total += values[m] * sh_rest[i, m, c]
            out[k, c] = max(total, 0.0)


@kernel
def seen_gradient(
    means: Any,
    colours: Any,
    sh_rest: Any,
    center: Any,
    index: Any,
    d_seen: Any,
    first: int,
    last: int,
    d_means: Any,
    d_colours: Any,
    d_rest: Any,
) -> Any:
    """Fills what a change of `seen` (M, 3) means for colours (M, 3) and sh_rest (M, count, 3), for rows `first` to
    `last`. Adds to `d_means` (M, 3), for the direction turns with the mean; returns the sum (3,) of what it added."""
    count = sh_rest.shape[1]
    values, slopes, added = np.empty(15, np.float64), np.zeros((15, 3), np.float64), np.zeros(3, np.float64)
    for k in range(first, last):
        i = index[k]
        if count == 0:
            for c in range(3):
                d_colours[k, c] = d_seen[k, c] if colours[i, c] >= 0.0 else 0.0
            continue
        x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
        scale = 1.0 / np.sqrt(x * x + y * y + z * z)
        x, y, z = x * scale, y * scale, z * scale
        _basis(x, y, z, count, values)
        _slopes(x, y, z, count, slopes)
        gx, gy, gz = 0.0, 0.0, 0.0
        for c in range(3):
            total = float(colours[i, c])
            for m in range(count):
                total += values[m] * sh_rest[i, m, c]
            upstream = float(d_seen[k, c]) if total >= 0.0 else 0.0
            d_colours[k, c] = upstream
            for m in range(count):
                d_rest[k, m, c] = upstream * values[m]
                pull = upstream * sh_rest[i, m, c]
                gx += pull * slopes[m, 0]
                gy += pull * slopes[m, 1]
                gz += pull * slopes[m, 2]
        along = gx * x + gy * y + gz * z  # a longer direction is the same direction
        gx, gy, gz = scale * (gx - along * x), scale * (gy - along * y), scale * (gz - along * z)
        d_means[k, 0] += gx
        d_means[k, 1] += gy
        d_means[k, 2] += gz
        added[0] += gx
        added[1] += gy
        added[2] += gz
    return added


def turned(sh_rest: F32, matrix: Array) -> F32:
    """Coefficients (N, M, 3) of the same light in a frame turned, or mirrored, by the orthogonal `matrix` (3, 3)."""
    count = sh_rest.shape[1]
    if count == 0 or np.array_equal(matrix, np.eye(3)):
        return sh_rest
    return np.einsum("ab,nbc->nac", turning(matrix, count), sh_rest).astype(np.float32)


def turning(matrix: Array, count: int) -> Array:
    """The orthogonal (count, count) matrix that takes coefficients to the frame turned by `matrix` (3, 3).

    The turned light f(matrix^T d) is again a sum of basis functions, so it is read off exactly from more directions
    than there are coefficients.
    """
    return np.asarray(np.linalg.pinv(basis(_DIRECTIONS, count)) @ basis(_DIRECTIONS @ matrix, count))


def _spread(n: int) -> Array:
    """n directions (n, 3) all over the sphere (a Fibonacci spiral)."""
    z = 1.0 - (2.0 * np.arange(n) + 1.0) / n
    angle = np.arange(n) * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


_DIRECTIONS = _spread(64)

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
def basis(directions: Any, count: int) -> Any:
    """Basis functions beyond degree 0 (N, count) float64 of unit directions (N, 3); `count` in COUNTS."""
    out = np.empty((directions.shape[0], count), np.float64)
    for i in range(directions.shape[0]):
        _basis(directions[i, 0], directions[i, 1], directions[i, 2], count, out[i])
    return out


@kernel
def shade_from(
    means: Any, colours: Any, sh_rest: Any, center: Any, index: Any, out: Any, first: int, last: int
) -> None:
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


def rotate_coefficients(sh_rest: F32, matrix: Array) -> F32:
    """Coefficients (N, M, 3) of the same light in a frame turned, or mirrored, by the orthogonal `matrix` (3, 3)."""
    count = sh_rest.shape[1]
    if count == 0 or np.array_equal(matrix, np.eye(3)):
        return sh_rest
    return np.einsum("ab,nbc->nac", coefficient_turn(count, matrix), sh_rest).astype(np.float32)


def coefficient_turn(count: int, matrix: Array) -> Array:
    """(count, count) what makes of coefficients those of the same light in a frame turned by `matrix` (3, 3).

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

"""Anisotropic 3-D Gaussians: what a rendered scene is made of."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.render.splatting import sh
from tasks.world.arrays import F32, Array, Bools, FloatArray, Indices

_NO_SH = np.zeros((0, 0, 3), np.float32)


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in one frame (a block's or a vehicle box's).

    Raises ValueError where the arrays' shapes do not agree.
    """

    means: F32  # (N, 3) [m]
    quats: F32  # (N, 4) w, x, y, z; unit; columns of the rotation are the axes of the scales
    log_scales: F32  # (N, 3) natural log of the standard deviations [m]
    opacities: F32  # (N,) in (0, 1)
    colours: F32  # (N, 3) rgb, what all sides have in common (SH degree 0); drawn as 0 below, above 1 as it is
    sh_rest: F32 = field(default_factory=lambda: _NO_SH)  # (N, M, 3), M 0, 3, 8 or 15: degrees 1 to 3, splatting.sh

    def __post_init__(self) -> None:
        n = len(self.means)
        if self.sh_rest is _NO_SH:
            object.__setattr__(self, "sh_rest", np.zeros((n, 0, 3), np.float32))
        if self.sh_rest.shape not in [(n, count, 3) for count in sh.COUNTS]:
            raise ValueError(f"Gaussians: sh_rest is {self.sh_rest.shape}, expected ({n}, 0 or 3 or 8 or 15, 3)")
        shapes = (self.means.shape, self.quats.shape, self.log_scales.shape, self.opacities.shape, self.colours.shape)
        if shapes != ((n, 3), (n, 4), (n, 3), (n,), (n, 3)):
            raise ValueError(f"Gaussians: shapes do not agree: {shapes}")

    def __len__(self) -> int:
        return len(self.means)

    def take(self, rows: Bools | Indices | slice) -> "Gaussians":
        """The Gaussians at `rows` (indices or mask); a slice copies nothing."""
        arrays = [getattr(self, each.name) for each in fields(self)]
        if isinstance(rows, slice) or rows.dtype == np.bool_:
            return Gaussians(*(array[rows] for array in arrays))
        return Gaussians(*(array.take(rows, axis=0) for array in arrays))  # a third of the time


EMPTY = Gaussians(*(np.zeros((0, *row), np.float32) for row in ((3,), (4,), (3,), (), (3,))))


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """All parts as one, in order, with the most coefficients of any; `EMPTY` for no parts."""
    if not parts:
        return EMPTY
    sh_rest = np.zeros((sum(len(p) for p in parts), max(p.sh_rest.shape[1] for p in parts), 3), np.float32)
    start = 0
    for part in parts:
        sh_rest[start : start + len(part), : part.sh_rest.shape[1]] = part.sh_rest
        start += len(part)
    names = (each.name for each in fields(Gaussians) if each.name != "sh_rest")
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Gaussians(**(whole | {"sh_rest": sh_rest}))


def moved(gaussians: Gaussians, target_from_source: Array) -> Gaussians:
    """The same Gaussians in another frame; `target_from_source` (4, 4) is rigid.

    The light turns along: who looks at a moved vehicle sees what its own frame says for that side.
    """
    rotation = target_from_source[:3, :3]
    means = gaussians.means @ rotation.T + target_from_source[:3, 3]
    quats = turned_quats(quats_of(rotation[None])[0], gaussians.quats)
    sh_rest = sh.rotate_coefficients(gaussians.sh_rest, rotation)
    return replace(gaussians, means=means.astype(np.float32), quats=quats.astype(np.float32), sh_rest=sh_rest)


@kernel
def turned_quats(turn: Array, quats: FloatArray) -> Array:
    """Hamilton products turn * quats of a quaternion (4,) w, x, y, z and many (N, 4)."""
    lw, lx, ly, lz = turn
    out = np.empty((len(quats), 4))
    for i in range(len(quats)):
        rw, rx, ry, rz = quats[i]
        out[i, 0] = lw * rw - lx * rx - ly * ry - lz * rz
        out[i, 1] = lw * rx + lx * rw + ly * rz - lz * ry
        out[i, 2] = lw * ry - lx * rz + ly * rw + lz * rx
        out[i, 3] = lw * rz + lx * ry - ly * rx + lz * rw
    return out


def quats_of(rotations: Array) -> Array:
    """Unit quaternions (N, 4) of rotation matrices (N, 3, 3)."""
    return np.asarray(_quats_of(np.ascontiguousarray(rotations, np.float64)))


@kernel
def _quats_of(rotations: Any) -> Any:
    out = np.empty((len(rotations), 4))
    for i in range(len(rotations)):
        m = rotations[i]
        # Each is 4 * (one component) * q; the one with the largest component is well conditioned.
        squares = (
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        )
        best = 0
        for k in range(1, 4):
            if squares[k] > squares[best]:
                best = k
        if best == 0:
            w, x, y, z = squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
        elif best == 1:
            w, x, y, z = m[2, 1] - m[1, 2], squares[1], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]
        elif best == 2:
            w, x, y, z = m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], squares[2], m[1, 2] + m[2, 1]
        else:
            w, x, y, z = m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[3]
        length = np.sqrt(w * w + x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = w / length, x / length, y / length, z / length
    return out


def rotations_of(quats: FloatArray) -> Array:
    """Rotation matrices (N, 3, 3) of unit quaternions (N, 4)."""
    w, x, y, z = np.asarray(quats, np.float64).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        axis=-2,
    )

"""Cameras do not agree about brightness: an affine colour per photo, and between any two that see the same."""

import numpy as np

from tasks.world.arrays import F32, Array, Bools, FloatArray

SIZE = 12  # a photo's row: 3 x 3 matrix minus identity, then 3 offsets
ROUNDS = 20  # of fitting each camera to the mean of all


def matrix_of(row: F32) -> tuple[F32, F32]:
    """Matrix (3, 3) and offset (3,): photo colour = matrix @ scene colour + offset."""
    return np.eye(3, dtype=np.float32) + row[:9].reshape(3, 3), row[9:]


def exposed(rgb: F32, row: F32) -> F32:
    """A picture (H, W, 3) as the photo with exposure `row` (12,) would show it."""
    matrix, offset = matrix_of(row)
    return np.asarray(rgb @ matrix.T + offset, np.float32)


def inverse(row: F32) -> F32:
    """The row (12,) that takes back what `row` does. Raises LinAlgError where that cannot be."""
    matrix, offset = matrix_of(row)
    back = np.linalg.inv(matrix.astype(np.float64))
    return np.concatenate([(back - np.eye(3)).ravel(), -back @ offset]).astype(np.float32)


def exposed_gradient(rgb: F32, row: F32, d_exposed: F32) -> tuple[F32, F32]:
    """Gradients by rgb (H, W, 3) and by the row (12,)."""
    matrix, _ = matrix_of(row)
    flat = d_exposed.reshape(-1, 3)
    d_row = np.concatenate([(flat.T @ rgb.reshape(-1, 3)).ravel(), flat.sum(axis=0)])
    return np.asarray(d_exposed @ matrix, np.float32), d_row.astype(np.float32)


def affine_between(source: FloatArray, target: FloatArray, ridge: float = 1e-3) -> F32:
    """The row (12,) that takes colours `source` (M, 3) closest to `target` (M, 3); identity where they say nothing.

    Least squares with a pull of `ridge` per sample towards identity.
    """
    padded = np.column_stack([source, np.ones(len(source))]).astype(np.float64)
    keep = ridge * max(len(source), 1) * np.eye(4)
    off = np.linalg.solve(padded.T @ padded + keep, padded.T @ (np.asarray(target, np.float64) - source))
    return np.concatenate([off[:3].T.ravel(), off[3]]).astype(np.float32)


def aligned(colours: Array, seen: Bools) -> F32:
    """Rows (C, 12) that make cameras of one instant agree on the lidar points that several of them see.

    `colours` (C, M, 3) in [0, 1] of M projected points in C cameras, `seen` (C, M). Each camera in turn is fitted to
    what all of them say of its points; the mean colour stays. Cameras that share no point keep theirs.
    """
    rows = np.zeros((len(colours), SIZE), np.float32)
    common = seen.sum(axis=0) > 1
    for _ in range(ROUNDS):
        now = np.stack([exposed(c.astype(np.float32), row) for c, row in zip(colours, rows)])
        mean = (now * seen[..., None]).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None]
        for c in range(len(colours)):
            use = seen[c] & common
            if use.sum() >= 8:
                rows[c] = affine_between(colours[c, use], mean[use], 1e-2)
    return rows

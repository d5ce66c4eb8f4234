"""Anchors: a few plans that stand for all, as means of clusters; a diffusion planner starts from them."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tasks.world.arrays import FloatArray

WAYPOINTS = 8  # 0.5 .. 4.0 s


def read_array(path: str, setting: str) -> NDArray[Any]:
    """The array in a .npy file. Raises ValueError naming the setting and the file."""
    try:
        loaded = np.load(Path(path), allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{setting}={path}: not readable as a .npy file: {error}") from error
    if not isinstance(loaded, np.ndarray):
        raise ValueError(f"{setting}={path}: expected one array, found an archive of several")
    return loaded


def checked_anchors(values: NDArray[Any], source: str) -> FloatArray:
    """`values` as float64 (A, 8, 2). Raises ValueError naming `source`."""
    if values.ndim != 3 or values.shape[1:] != (WAYPOINTS, 2) or len(values) == 0:
        raise ValueError(f"{source}: anchors have shape {values.shape}, expected (A >= 1, {WAYPOINTS}, 2)")
    if not np.isfinite(values).all():
        raise ValueError(f"{source}: anchors hold NaN or infinity")
    return values.astype(np.float64)


def cluster_anchors(plans: FloatArray, count: int, seed: int, iterations: int = 100) -> FloatArray:
    """Means (count, 8, 2) of k-means over the positions of plans (n, 8, >= 2), from a k-means++ start.

    Equal arguments give equal results. Raises ValueError where there are fewer distinct plans than anchors.
    """
    points = plans[:, :, :2].reshape(len(plans), -1).astype(np.float64)
    distinct = np.unique(points, axis=0)
    if len(distinct) < count:
        raise ValueError(f"{count} anchors cannot be made of {len(distinct)} distinct plans")
    rng = np.random.Generator(np.random.Philox(key=seed))
    centers = distinct[[int(rng.integers(len(distinct)))]]
    while len(centers) < count:
        mass = _squared(distinct, centers).min(axis=1)
        centers = np.concatenate([centers, distinct[[rng.choice(len(distinct), p=mass / mass.sum())]]])
    owner = np.full(len(points), -1)
    for _ in range(iterations):
        nearest = _squared(points, centers).argmin(axis=1)
        if np.array_equal(nearest, owner):
            break
        owner = nearest
        members = np.bincount(owner, minlength=count)
        sums = np.zeros_like(centers)
        np.add.at(sums, owner, points)
        centers = np.where(members[:, None] > 0, sums / np.maximum(members, 1)[:, None], centers)
    return centers.reshape(count, WAYPOINTS, 2)


def _squared(points: FloatArray, centers: FloatArray) -> FloatArray:
    """Squared distances (n, k)."""
    return np.stack([((points - center) ** 2).sum(axis=1) for center in centers], axis=1)

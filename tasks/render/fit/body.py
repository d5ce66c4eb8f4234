"""What no photo shows of a vehicle: a body inside its box, so that it is not hollow where it comes to be seen.

Where a photo does show the place, the fit takes away what is wrong; what none shows stays.
"""

import numpy as np
from scipy.spatial import cKDTree

from tasks.render.splatting.gaussians import Gaussians
from tasks.world.arrays import Array

SPACING_M = 0.3
SIGMA_M = 0.17  # of a Gaussian along its face
THICKNESS_M = 0.02
FAR_M = 0.3  # from all that was seen: there it begins
OPACITY = 0.95
# Shares of half the box, from its centre: length, width, bottom, top.
LOWER, CABIN, TALL = (0.94, 0.92, -0.65, 0.1), (0.5, 0.8, 0.1, 0.88), (0.95, 0.95, -0.65, 0.95)
TALL_M = 2.2  # vehicles at least this high have no bonnet


def unseen_body(seen: Gaussians, size: Array) -> Gaussians:
    """Gaussians (M,) in the frame of a vehicle's box of `size` (3,) [m], coloured like the nearest of what was seen."""
    boxes = (TALL,) if size[2] >= TALL_M else (LOWER, CABIN)
    parts = [_faces(np.asarray(size) / 2.0, shares) for shares in boxes]
    points, scales = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    distance, nearest = cKDTree(seen.means).query(points)
    far = distance > FAR_M
    n = int(far.sum())
    return Gaussians(
        points[far].astype(np.float32),
        np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (n, 1)),
        np.log(scales[far]).astype(np.float32),
        np.full(n, OPACITY, np.float32),
        seen.colours[nearest[far]],
    )


def _faces(half: Array, shares: tuple[float, float, float, float]) -> tuple[Array, Array]:
    """Points (M, 3) and scales (M, 3) [m] on four sides and the top."""
    x, y, low, high = half[0] * shares[0], half[1] * shares[1], half[2] * shares[2], half[2] * shares[3]
    along, across, up = _spaced(-x, x), _spaced(-y, y), _spaced(low, high)
    points, scales = [], []
    for axis, at, grids in (
        (0, (-x, x), (None, across, up)),
        (1, (-y, y), (along, None, up)),
        (2, (high,), (along, across, None)),
    ):
        for value in at:
            grid = np.meshgrid(*(np.array([value]) if g is None else g for g in grids), indexing="ij")
            points.append(np.stack(grid, axis=-1).reshape(-1, 3))
            flat = np.full(3, SIGMA_M)
            flat[axis] = THICKNESS_M
            scales.append(np.tile(flat, (len(points[-1]), 1)))
    return np.concatenate(points), np.concatenate(scales)


def _spaced(first: float, last: float) -> Array:
    return np.linspace(first, last, max(2, round((last - first) / SPACING_M) + 1))

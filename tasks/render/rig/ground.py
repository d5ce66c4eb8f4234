"""How high above the road a rig drove: at the right height of a plane its photos agree on what lies on it.

Corners hardly ever lie on asphalt; its grain and paint still look alike in two photos where they are laid on the road.
"""

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from scipy.ndimage import uniform_filter

from tasks.render.scene.driven_road import WIDE_M, driven_roads
from tasks.render.scene.sensed import Photo
from tasks.world.arrays import F32, Array, Bools

HEIGHTS_M = np.arange(-1.2, 0.81, 0.06)  # of the road in the ego's frame: rear axle, ground, or a rig's own origin
ACROSS_M = 0.1
REACH_M = (3.0, 14.0)  # from a camera: nearer is the ego's own body, farther no grain is seen
WINDOW = 9  # cells of ACROSS_M that are compared
GRAIN = 1.0  # grey levels of deviation, below which a window says nothing
LEAST_WINDOWS = 500
LEAST_LIKENESS = 0.3  # correlation at the best height, below which none is right


def ground_below(photos: Sequence[Photo], world_from_ego: Array) -> float | None:
    """z [m] of the road in the frame of the ego, poses (V, 4, 4) of the photos; None where photos do not tell."""
    order = np.argsort([photo.time_s for photo in photos], kind="stable")
    times_s = np.array([photo.time_s for photo in photos])
    greys = [cv2.cvtColor(photo.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) for photo in photos]
    pairs: list[tuple[int, int]] = []
    for name in sorted({photo.camera for photo in photos}):
        mine = [int(i) for i in order if photos[i].camera == name]
        pairs += pairwise(mine)
    likeness = np.zeros(len(HEIGHTS_M))
    for k, height in enumerate(HEIGHTS_M):
        points = driven_roads(world_from_ego, times_s, float(height), ACROSS_M)
        across = round(2.0 * WIDE_M / ACROSS_M) + 1
        laid = [_laid(photo, grey, points, across) for photo, grey in zip(photos, greys)]
        found = [_correlations(*laid[a], *laid[b]) for a, b in pairs]
        every = np.concatenate(found) if found else np.zeros(0)
        if len(every) >= LEAST_WINDOWS:
            likeness[k] = every.mean()
    best = int(likeness.argmax())
    if likeness[best] < LEAST_LIKENESS or not 0 < best < len(HEIGHTS_M) - 1:
        return None
    before, top, after = likeness[best - 1 : best + 2]  # between heights: where the parabola through three is highest
    part = 0.5 * (before - after) / (before - 2.0 * top + after)
    return float(HEIGHTS_M[best] + part * (HEIGHTS_M[1] - HEIGHTS_M[0]))


def _laid(photo: Photo, grey: F32, points: Array, across: int) -> tuple[F32, Bools]:
    """The photo's grey (A, across) on the road's points, and where it shows them near enough."""
    camera_from_world = np.linalg.inv(photo.world_from_camera)
    x, y, z = photo.intrinsics @ (points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]).T
    ahead = np.maximum(z, 0.1)
    u, v = (x / ahead - 0.5).astype(np.float32), (y / ahead - 0.5).astype(np.float32)
    height, width = grey.shape
    away = np.linalg.norm(points - photo.world_from_camera[:3, 3], axis=1)
    seen = (z > 0.5) & (u > 0) & (v > 0) & (u < width - 1) & (v < height - 1)
    seen &= (away > REACH_M[0]) & (away < REACH_M[1])
    picture = cv2.remap(grey, u.reshape(-1, across), v.reshape(-1, across), cv2.INTER_LINEAR)
    return np.asarray(picture, np.float32), seen.reshape(-1, across)


def _correlations(a: F32, in_a: Bools, b: F32, in_b: Bools) -> Array:
    """(M,) of the windows that both show and that have grain in both."""
    both = in_a & in_b
    rows = np.flatnonzero(both.any(axis=1))
    if len(rows) == 0:
        return np.zeros(0)
    part = slice(rows[0], rows[-1] + 1)
    whole = uniform_filter(both[part].astype(np.float64), WINDOW, mode="constant") > 0.999
    one, other = a[part].astype(np.float64), b[part].astype(np.float64)
    means = uniform_filter(one, WINDOW), uniform_filter(other, WINDOW)
    variances = [uniform_filter(x * x, WINDOW) - m * m for x, m in zip((one, other), means)]
    use = whole & (variances[0] > GRAIN**2) & (variances[1] > GRAIN**2)
    shared = uniform_filter(one * other, WINDOW) - means[0] * means[1]
    return np.asarray(shared[use] / np.sqrt(variances[0][use] * variances[1][use]))

"""The road as lidar knows it: a smooth height field, and Gaussians that lie flat on it.

Seen from one lane only, a road explains its photos just as well with paint that floats or stands; from a metre to the
side that paint breaks. Road Gaussians therefore keep to the surface, thin, with their third axis along its normal.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from tasks.kernels.compiled import kernel
from tasks.world.arrays import F32, Array, FloatArray, Ints

CELL_M = 0.5
SMOOTH_CELLS = 1.5
BESIDE_M = 15.0  # how far from where the cameras were a road is looked for
BELOW_M = (0.8, 3.0)  # of the cameras
NEAR_PLANE_M = 0.12  # what is further from the local plane is no road
PLANE_REACH_M = 15.0
LEAST_POINTS = 30
ALONG_M = 4.0  # a plane is fitted about this often
SLACK_M = 0.02  # how far a road Gaussian may leave the lidar's surface
THICKNESS_M = 0.005  # of a road Gaussian
# Standard deviation: a rasteriser draws a Gaussian as it looks at its middle, and one that reaches from afar to beneath
# the camera hangs as a veil before what is above the horizon.
LONGEST_M = 0.8


@dataclass(frozen=True)
class Road:
    """Heights on a grid; NaN where no road is known."""

    corner: Array  # (2,) x, y of the first node [m]
    heights: Array  # (X, Y) [m], every CELL_M
    slopes: Array  # (X, Y, 2) d height / d x, d y


def find_road(points: Array, eyes: Array) -> Road | None:
    """The road under the cameras: lidar `points` (M, 3), camera centres `eyes` (V, 3); None where there is none.

    Around each few metres of the way a plane is fitted to what lies below the cameras, and fitted again to what is
    near it; points near any plane make the height field.
    """
    on_road = np.zeros(len(points), bool)
    for eye in _spaced(eyes):
        away = np.linalg.norm(points[:, :2] - eye[:2], axis=1)
        below = eye[2] - points[:, 2]
        use = np.flatnonzero((away < PLANE_REACH_M) & (below > BELOW_M[0]) & (below < BELOW_M[1]))
        plane = _plane(points[use], eye)
        if plane is None:
            continue
        near = away < BESIDE_M
        off = points[near, 2] - np.column_stack([points[near, :2] - eye[:2], np.ones(near.sum())]) @ plane
        on_road[np.flatnonzero(near)[np.abs(off) < NEAR_PLANE_M]] = True
    if on_road.sum() < LEAST_POINTS:
        return None
    return _field(points[on_road])


def _spaced(eyes: Array) -> Sequence[Array]:
    kept = [eyes[0]]
    for eye in eyes:
        if np.linalg.norm(np.array(kept)[:, :2] - eye[:2], axis=1).min() >= ALONG_M:
            kept.append(eye)
    return kept


def _plane(points: Array, eye: Array) -> Array | None:
    """z = a (x - eye x) + b (y - eye y) + c, (3,), by trimmed least squares from the median height on."""
    if len(points) < LEAST_POINTS:
        return None
    design = np.column_stack([points[:, :2] - eye[:2], np.ones(len(points))])
    plane = np.array([0.0, 0.0, float(np.median(points[:, 2]))])
    for limit in (0.6, 0.4, 0.25, 0.15, NEAR_PLANE_M):
        near = np.abs(points[:, 2] - design @ plane) < limit
        if near.sum() < LEAST_POINTS:
            return None
        plane = np.linalg.lstsq(design[near], points[near, 2], rcond=None)[0]
    return np.asarray(plane)


def _field(points: Array) -> Road:
    corner = points[:, :2].min(axis=0) - 2.0 * CELL_M
    size = np.ceil((points[:, :2].max(axis=0) - corner) / CELL_M).astype(int) + 3
    cells = np.rint((points[:, :2] - corner) / CELL_M).astype(int)
    flat = cells[:, 0] * size[1] + cells[:, 1]
    count = np.bincount(flat, minlength=size.prod()).reshape(size).astype(float)
    base = float(points[:, 2].mean())
    total = np.bincount(flat, points[:, 2] - base, minlength=size.prod()).reshape(size)
    weight = gaussian_filter(count, SMOOTH_CELLS, mode="constant")
    known = weight > 0.02
    heights = np.where(known, gaussian_filter(total, SMOOTH_CELLS, mode="constant") / np.maximum(weight, 1e-9), np.nan)
    slope_x, slope_y = np.gradient(heights, CELL_M)
    slopes = np.stack([slope_x, slope_y], axis=-1)
    return Road(corner, np.where(np.isfinite(slopes).all(axis=-1), heights + base, np.nan), np.nan_to_num(slopes))


@kernel
def _height(heights: Any, slopes: Any, corner: Any, x: float, y: float) -> Any:
    """Height and slopes at a place; NaN beyond the road."""
    u, v = (x - corner[0]) / CELL_M, (y - corner[1]) / CELL_M
    i, j = int(np.floor(u)), int(np.floor(v))
    if i < 0 or j < 0 or i + 1 >= heights.shape[0] or j + 1 >= heights.shape[1]:
        return np.nan, 0.0, 0.0
    a, b = u - i, v - j
    z, sx, sy = 0.0, 0.0, 0.0
    for side in range(4):
        p, q = i + side // 2, j + side % 2
        share = (a if side // 2 else 1.0 - a) * (b if side % 2 else 1.0 - b)
        z += share * heights[p, q]
        sx += share * slopes[p, q, 0]
        sy += share * slopes[p, q, 1]
    return z, sx, sy


@kernel
def _above(means: Any, heights: Any, slopes: Any, corner: Any) -> Any:
    out = np.empty(means.shape[0])
    for i in range(means.shape[0]):
        z, _, _ = _height(heights, slopes, corner, means[i, 0], means[i, 1])
        out[i] = means[i, 2] - z
    return out


def above_road(means: FloatArray, road: Road) -> Array:
    """How far points (N, 3) lie above the road [m]; NaN beyond it."""
    return np.asarray(_above(means, road.heights, road.slopes, road.corner))


@kernel
def _lay(
    means: Any,
    quats: Any,
    log_scales: Any,
    rows: Any,
    heights: Any,
    slopes: Any,
    corner: Any,
    thick: float,
    longest: float,
) -> None:
    for k in range(rows.shape[0]):
        i = rows[k]
        z, sx, sy = _height(heights, slopes, corner, means[i, 0], means[i, 1])
        if z != z:
            continue
        means[i, 2] = min(max(means[i, 2], z - SLACK_M), z + SLACK_M)
        for axis in range(3):
            log_scales[i, axis] = min(log_scales[i, axis], thick if axis == 2 else longest)
        # Turn the third axis onto the normal the shortest way: q' = (1 + a.n, a x n) q.
        w, x, y, s = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        length = np.sqrt(w * w + x * x + y * y + s * s)
        w, x, y, s = w / length, x / length, y / length, s / length
        ax, ay, az = 2.0 * (x * s + w * y), 2.0 * (y * s - w * x), 1.0 - 2.0 * (x * x + y * y)
        norm = 1.0 / np.sqrt(1.0 + sx * sx + sy * sy)
        nx, ny, nz = -sx * norm, -sy * norm, norm
        if ax * nx + ay * ny + az * nz < 0.0:  # the other face of the disc
            nx, ny, nz = -nx, -ny, -nz
        tw, tx, ty, tz = 1.0 + ax * nx + ay * ny + az * nz, ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
        norm = 1.0 / np.sqrt(tw * tw + tx * tx + ty * ty + tz * tz)
        tw, tx, ty, tz = tw * norm, tx * norm, ty * norm, tz * norm
        quats[i, 0] = tw * w - tx * x - ty * y - tz * s
        quats[i, 1] = tw * x + tx * w + ty * s - tz * y
        quats[i, 2] = tw * y - tx * s + ty * w + tz * x
        quats[i, 3] = tw * s + tx * y - ty * x + tz * w


def lay_flat(means: F32, quats: F32, log_scales: F32, rows: Ints, road: Road) -> None:
    """Puts Gaussians at `rows` onto the road, in place: at most SLACK_M off it, no thicker than THICKNESS_M and
    no longer than LONGEST_M, their third axis along its normal. Those beyond the road stay as they are."""
    _lay(means, quats, log_scales, rows, road.heights, road.slopes, road.corner, *np.log([THICKNESS_M, LONGEST_M]))

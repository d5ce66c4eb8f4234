"""A dense depth image from lidar points: z-buffer, removal of points seen through others, closing of the gaps.

Inverse depth is linear on the image of a plane, so gaps are interpolated in inverse depth between the nearest returns
above, below, left and right; across a depth edge only the side that the pixel's colour belongs to is used.
"""

from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import F32, Array, ShortInts

NEAR_M = 0.5
MAX_GAP_PX = (12, 24)  # columns, rows that are interpolated between returns
SEE_THROUGH_PX = 5  # how far around a pixel its occluders are looked for
OCCLUDED_RATIO = 0.85  # a return is hidden when returns on both sides are nearer than this share of its depth
EDGE_RATIO = 1.25  # depths further apart than this belong to two surfaces
MAX_BEYOND_PX = 2  # a pixel that is not between two returns is not the same surface much further
SMOOTH_PX = 2  # window of 5 x 5: noise of the lidar and of its poses, a few cm, ripples the road
SMOOTH_RATIO = 1.06  # depths further apart are not averaged
COLOUR_SIGMA = 0.06  # rgb distance that makes a neighbour half as trustworthy


def sparse_depth(
    points: Array, labels: ShortInts, intrinsics: Array, world_from_camera: Array, width: int, height: int
) -> tuple[F32, ShortInts]:
    """Depth [m] of the nearest point per pixel and its label; 0 and -2 where no point falls.

    `points` (M, 3) world, `labels` (M,). Points that are seen only through gaps between nearer ones are removed.
    """
    depth, label = _zbuffer(
        points, labels, np.ascontiguousarray(np.linalg.inv(world_from_camera)), intrinsics, width, height
    )
    hidden = _hidden(depth)
    depth[hidden], label[hidden] = 0.0, -2
    return depth, label


def dense_depth(depth: F32, label: ShortInts, rgb: F32) -> tuple[F32, ShortInts]:
    """Closes gaps of a sparse depth image (H, W) up to MAX_GAP_PX to the nearest returns.

    `rgb` (H, W, 3) in [0, 1]. Where nothing is near enough the depth stays 0 and the label -2.
    """
    colours = np.ascontiguousarray(rgb, np.float32)
    filled, labels = depth, label
    for _ in range(2):  # the first pass fills rows and columns that hold returns, the second what lies between them
        filled, labels = _fill(filled, labels, colours, *MAX_GAP_PX)
    return _smooth(filled, labels), labels


@kernel
def _zbuffer(points: Any, labels: Any, camera_from_world: Any, k: Any, width: int, height: int) -> Any:
    depth = np.zeros((height, width), np.float32)
    label = np.full((height, width), -2, np.int32)
    r = camera_from_world
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
        if z < NEAR_M:
            continue
        u = k[0, 0] * (r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]) / z + k[0, 2]
        v = k[1, 1] * (r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]) / z + k[1, 2]
        if u < 0.0 or v < 0.0 or u >= width or v >= height:
            continue
        x, y = int(u), int(v)
        if depth[y, x] == 0.0 or z < depth[y, x]:
            depth[y, x] = z
            label[y, x] = labels[i]
    return depth, label


@kernel
def _nearer(depth: Any, y: int, x: int, dy: int, dx: int, limit: float) -> bool:
    """Whether a strip of three pixels' width in direction (dy, dx) holds a return nearer than `limit`."""
    height, width = depth.shape
    for step in range(1, SEE_THROUGH_PX + 1):
        for side in range(-1, 2):
            yy, xx = y + dy * step + dx * side, x + dx * step + dy * side
            if 0 <= yy < height and 0 <= xx < width and 0.0 < depth[yy, xx] < limit:
                return True
    return False


@kernel
def _hidden(depth: Any) -> Any:
    """Returns with nearer ones on opposite sides. One side alone is a depth edge, or the road further down."""
    height, width = depth.shape
    hidden = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if z == 0.0:
                continue
            limit = z * OCCLUDED_RATIO
            across = _nearer(depth, y, x, 0, -1, limit) and _nearer(depth, y, x, 0, 1, limit)
            hidden[y, x] = across or (_nearer(depth, y, x, -1, 0, limit) and _nearer(depth, y, x, 1, 0, limit))
    return hidden


@kernel
def _fill(depth: Any, label: Any, rgb: Any, gap_x: int, gap_y: int) -> Any:
    height, width = depth.shape
    out, out_label = depth.copy(), label.copy()
    zs, trust, near, labels = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4, np.int32)
    for y in range(height):
        for x in range(width):
            if depth[y, x] > 0.0:
                continue
            best = -1
            for side in range(4):
                dy = -1 if side == 0 else (1 if side == 1 else 0)
                dx = -1 if side == 2 else (1 if side == 3 else 0)
                trust[side] = 0.0
                for step in range(1, (gap_x if dy == 0 else gap_y) + 1):
                    yy, xx = y + dy * step, x + dx * step
                    if yy < 0 or xx < 0 or yy >= height or xx >= width:
                        break
                    if depth[yy, xx] > 0.0:
                        apart = 0.0
                        for c in range(3):
                            apart += (rgb[yy, xx, c] - rgb[y, x, c]) ** 2
                        zs[side], near[side], labels[side] = depth[yy, xx], 1.0 / step, label[yy, xx]
                        trust[side] = near[side] / (1.0 + apart / COLOUR_SIGMA**2)
                        break
                if trust[side] > 0.0 and (best < 0 or trust[side] > trust[best]):
                    best = side
            between = (trust[0] > 0.0 and trust[1] > 0.0) or (trust[2] > 0.0 and trust[3] > 0.0)
            if best < 0 or not (between or near[best] * MAX_BEYOND_PX >= 1.0):
                continue
            total, inverse = 0.0, 0.0
            for side in range(4):
                if trust[side] == 0.0 or labels[side] != labels[best]:
                    continue
                if max(zs[side], zs[best]) > EDGE_RATIO * min(zs[side], zs[best]):
                    continue
                total += near[side]  # by distance alone: exact on a plane
                inverse += near[side] / zs[side]
            out[y, x] = total / inverse
            out_label[y, x] = labels[best]
    return out, out_label


@kernel
def _smooth(depth: Any, label: Any) -> Any:
    """Mean inverse depth over symmetric pairs of pixels of the same surface: leaves planes as they are."""
    height, width = depth.shape
    out = depth.copy()
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if z == 0.0:
                continue
            total, inverse = 1.0, 1.0 / z
            for dy in range(SMOOTH_PX + 1):
                for dx in range(-SMOOTH_PX, SMOOTH_PX + 1):
                    if dy == 0 and dx <= 0:
                        continue
                    y0, y1, x0, x1 = y - dy, y + dy, x - dx, x + dx
                    if y0 < 0 or y1 >= height or min(x0, x1) < 0 or max(x0, x1) >= width:
                        continue
                    a, b = depth[y0, x0], depth[y1, x1]
                    if a == 0.0 or b == 0.0 or label[y0, x0] != label[y, x] or label[y1, x1] != label[y, x]:
                        continue
                    mean = 0.5 * (1.0 / a + 1.0 / b)
                    if max(mean * z, 1.0 / (mean * z)) < SMOOTH_RATIO and max(a, b) < EDGE_RATIO * min(a, b):
                        total += 2.0
                        inverse += 2.0 * mean
            out[y, x] = total / inverse
    return out

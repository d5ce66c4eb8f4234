"""Depth where lidar does not reach (upper storeys, trees, sky), from how well other photos agree.

A plane sweep (Collins 1996): each hypothesis of a pixel's depth says where neighbouring photos see the same thing; the
hypothesis under which the colours agree best, over a small window, wins.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import F32, Array, Bools

FAR_M = 1.0e4  # stands for the sky
LEVELS_M = (*(float(z) for z in 1.0 / np.linspace(1.0 / 5.0, 1.0 / 160.0, 28)), FAR_M)
WINDOW_PX = 7
MIN_BASELINE_M, MAX_BASELINE_M = 0.3, 6.0  # less: no parallax; more: nothing in common
Compared = tuple[F32, Array, Array]  # a photo's rgb (H, W, 3) in [0, 1], intrinsics, world_from_camera
UNSEEN_COST = 0.25  # of a pixel whose hypothesis lies outside the other photo


def sweep_depth(
    rgb: F32,
    hints: F32,
    others: Sequence[Compared],
    intrinsics: Array,
    world_from_camera: Array,
    wanted: Bools,
) -> tuple[F32, F32, F32]:
    """Best depth (H, W) [m], its cost, and the cost of the sky hypothesis (mean absolute rgb difference).

    `rgb` (H, W, 3) in [0, 1]; `hints` (J, H, W) extra hypotheses per pixel, 0 = none; `others` (rgb of the same size,
    intrinsics, world_from_camera) of at least one other photo. Pixels that are not `wanted` (H, W) hold nothing of use.
    """
    height, width = rgb.shape[:2]
    best, best_cost = np.zeros((height, width), np.float32), np.full((height, width), np.inf, np.float32)
    sky_cost = best_cost
    for hypothesis in (*hints, *LEVELS_M):
        depth = np.broadcast_to(np.asarray(hypothesis, np.float32), (height, width))
        cost = with_cost(rgb, others, intrinsics, world_from_camera, depth, wanted, WINDOW_PX)
        better = cost < best_cost
        best, best_cost = np.where(better, depth, best), np.where(better, cost, best_cost)
        if isinstance(hypothesis, float) and hypothesis == FAR_M:
            sky_cost = cost
    return best, best_cost, sky_cost


def with_cost(
    rgb: F32,
    others: Sequence[Compared],
    intrinsics: Array,
    world_from_camera: Array,
    depth: F32,
    wanted: Bools,
    window: int,
) -> F32:
    """(H, W) disagreement over a window of pixels where these are as deep as `depth` (H, W); infinite where it is 0."""
    around = cv2.dilate(wanted.astype(np.uint8), np.ones((window, window), np.uint8)).astype(np.bool_)
    raw = disagreement(rgb, others, intrinsics, world_from_camera, depth, around)
    return np.asarray(np.where(depth > 0, cv2.blur(raw, (window, window)), np.float32(np.inf)))


def disagreement(
    rgb: F32,
    others: Sequence[Compared],
    intrinsics: Array,
    world_from_camera: Array,
    depth: F32,
    wanted: Bools,
) -> F32:
    """(H, W) what `_disagreement` says, pixel by pixel."""
    photos = np.stack([other_rgb for other_rgb, _, _ in others])
    from_here = [np.linalg.inv(pose) @ world_from_camera for _, _, pose in others]
    turned = np.stack([k @ pose[:3, :3] for (_, k, _), pose in zip(others, from_here)])
    shifts = np.stack([k @ pose[:3, 3] for (_, k, _), pose in zip(others, from_here)])
    return np.asarray(
        _disagreement(rgb, photos, turned, shifts, intrinsics, np.ascontiguousarray(depth, np.float32), wanted)
    )


@kernel
def _disagreement(rgb: Any, photos: Any, turned: Any, shifts: Any, k: Any, depth: Any, wanted: Any) -> Any:
    """(H, W) mean absolute colour difference to the better half of the other photos (n, H, W, 3), pixel by pixel.

    An occluder rarely hides a point from two photos on opposite sides: the half that agrees is trusted.
    """
    n, height, width = photos.shape[:3]
    out = np.zeros((height, width), np.float32)
    costs = np.empty(n)
    for row in range(height):
        for column in range(width):
            if not wanted[row, column]:
                continue
            z0 = depth[row, column] if depth[row, column] > 0.0 else 1.0
            a, b = z0 * (column + 0.5 - k[0, 2]) / k[0, 0], z0 * (row + 0.5 - k[1, 2]) / k[1, 1]
            for j in range(n):
                m = turned[j]
                z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * z0 + shifts[j, 2]
                cost = UNSEEN_COST
                if z > 0.1:
                    x = (m[0, 0] * a + m[0, 1] * b + m[0, 2] * z0 + shifts[j, 0]) / z - 0.5
                    y = (m[1, 0] * a + m[1, 1] * b + m[1, 2] * z0 + shifts[j, 1]) / z - 0.5
                    if 0.0 <= x < width - 1 and 0.0 <= y < height - 1:
                        x0, y0 = int(x), int(y)
                        fx, fy = x - x0, y - y0
                        cost = 0.0
                        for c in range(3):
                            top = photos[j, y0, x0, c] * (1 - fx) + photos[j, y0, x0 + 1, c] * fx
                            bottom = photos[j, y0 + 1, x0, c] * (1 - fx) + photos[j, y0 + 1, x0 + 1, c] * fx
                            cost += abs(top * (1 - fy) + bottom * fy - rgb[row, column, c]) / 3.0
                place = j
                while place > 0 and costs[place - 1] > cost:
                    costs[place] = costs[place - 1]
                    place -= 1
                costs[place] = cost
            half = (n + 1) // 2
            total = 0.0
            for j in range(half):
                total += costs[j]
            out[row, column] = total / half
    return out

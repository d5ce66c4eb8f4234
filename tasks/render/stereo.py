"""Depth where lidar does not reach (upper storeys, trees, sky), from how well other photos agree.

A plane sweep (Collins 1996): each hypothesis of a pixel's depth says where neighbouring photos see the same thing; the
hypothesis under which the colours agree best, over a small window, wins.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from tasks.render.gaussians import F32, F64

FAR_M = 1.0e4  # stands for the sky
LEVELS_M = (*(float(z) for z in 1.0 / np.linspace(1.0 / 5.0, 1.0 / 160.0, 28)), FAR_M)
WINDOW_PX = 7
MIN_BASELINE_M, MAX_BASELINE_M = 0.3, 6.0  # less: no parallax; more: nothing in common
UNSEEN_COST = 0.25  # of a pixel whose hypothesis lies outside the other photo


def sweep_depth(
    rgb: F32,
    hints: NDArray[np.float32],
    others: list[tuple[F32, F64, F64]],
    intrinsics: F64,
    world_from_camera: F64,
) -> tuple[F32, F32, F32]:
    """Best depth (H, W) [m], its cost, and the cost of the sky hypothesis (mean absolute rgb difference).

    `rgb` (H, W, 3) in [0, 1]; `hints` (J, H, W) extra hypotheses per pixel, 0 = none; `others` (rgb, intrinsics,
    world_from_camera) of at least one other photo.
    """
    height, width = rgb.shape[:2]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack(
        [(u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1], np.ones_like(u)], axis=-1
    )
    warps = []
    for other_rgb, other_k, other_pose in others:
        other_from_here = np.linalg.inv(other_pose) @ world_from_camera
        warps.append((other_rgb, rays @ (other_k @ other_from_here[:3, :3]).T, other_k @ other_from_here[:3, 3]))
    best, best_cost = np.zeros((height, width), np.float32), np.full((height, width), np.inf, np.float32)
    sky_cost = best_cost
    for hypothesis in (*hints, *LEVELS_M):
        known = np.asarray(hypothesis) > 0
        depth = np.where(known, hypothesis, 1.0).astype(np.float64)
        cost = np.where(known, _disagreement(rgb, warps, depth), np.inf).astype(np.float32)
        better = cost < best_cost
        best = np.where(better, depth, best).astype(np.float32)
        best_cost = np.where(better, cost, best_cost)
        if isinstance(hypothesis, float) and hypothesis == FAR_M:
            sky_cost = cost
    return best, best_cost, sky_cost


def _disagreement(rgb: F32, warps: list[tuple[F32, F64, F64]], depth: F64) -> F32:
    """(H, W) mean absolute colour difference in a window, of the better half of the other photos."""
    costs = []
    for other_rgb, directions, shift in warps:
        x = directions[..., 0] * depth + shift[0]
        y = directions[..., 1] * depth + shift[1]
        z = directions[..., 2] * depth + shift[2]
        z_safe = np.where(z > 0.1, z, 1.0)
        # cv2 counts pixel centres from 0, the project from 0.5.
        map_x = np.where(z > 0.1, x / z_safe - 0.5, -1e4).astype(np.float32)
        map_y = np.where(z > 0.1, y / z_safe - 0.5, -1e4).astype(np.float32)
        seen = cv2.remap(
            other_rgb, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(-1.0, -1.0, -1.0)
        )
        difference = np.abs(seen - rgb).mean(axis=-1)
        costs.append(np.where(seen[..., 0] >= 0.0, difference, UNSEEN_COST).astype(np.float32))
    # An occluder rarely hides a point from two photos on opposite sides: trust the half that agrees.
    kept = np.sort(np.stack(costs), axis=0)[: (len(costs) + 1) // 2].mean(axis=0)
    return np.asarray(cv2.blur(kept, (WINDOW_PX, WINDOW_PX)), np.float32)

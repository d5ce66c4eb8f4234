"""The road where the ego drove, for blocks without lidar: its wheels stood on it.

Asphalt has few corners that photos could be matched by, and those found lie anywhere below the cameras. Fitted from
them, a road is painted by what lies metres below it, and its paint breaks from half a metre beside the drive.
"""

import numpy as np
from scipy.spatial import cKDTree

from tasks.world.arrays import Array

SPACING_M = 0.2  # of the points
WIDE_M = 3.0  # to either side: nothing else stood where the ego drove
AHEAD_M = 20.0  # straight on from where it was last
CLEAR_M = 0.25  # a corner this high above the road stands on it
BESIDE_M = 10.0  # from the drive, as far as the road is taken to go on; below it is nothing


def driven_road(world_from_ego: Array, ground_m: float, spacing_m: float = SPACING_M) -> Array:
    """Points (M, 3) of the road under a drive: poses (F, 4, 4) in order of time, the road at z = ground_m of each.

    In rows across the drive, of as many points each.
    """
    poses = [world_from_ego[0]]
    for pose in world_from_ego[1:]:
        if np.linalg.norm(pose[:3, 3] - poses[-1][:3, 3]) >= SPACING_M:
            poses.append(pose)
    last = poses[-1].copy()
    last[:3, 3] += AHEAD_M * last[:3, 0]
    across = np.arange(-WIDE_M, WIDE_M + spacing_m / 2, spacing_m)
    parts = []
    for pose, following in zip(poses, [*poses[1:], last]):
        way = following[:3, 3] - pose[:3, 3]
        along = np.arange(0.0, 1.0, spacing_m / np.linalg.norm(way))
        middle = pose[:3, 3] + ground_m * pose[:3, 2] + along[:, None] * way
        parts.append((middle[:, None] + across[:, None] * pose[:3, 1]).reshape(-1, 3))
    return np.concatenate(parts)


def beside_road(points: Array, road: Array) -> Array:
    """Those of `points` (N, 3) that stand above the road (M, 3) or are beside it, not below."""
    away, nearest = cKDTree(road[:, :2]).query(points[:, :2])
    above = points[:, 2] - road[nearest, 2]
    return points[(above > CLEAR_M) | (away > BESIDE_M) | ((away > SPACING_M) & (above > -CLEAR_M))]

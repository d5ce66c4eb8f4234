"""The road where the ego drove, for blocks without lidar: its wheels stood on it.

Asphalt has few corners that photos could be matched by, and those found lie anywhere below the cameras. Fitted from
them, a road is painted by what lies metres below it, and its paint breaks from half a metre beside the drive.
"""

import cv2
import numpy as np
from scipy.spatial import cKDTree

from tasks.render.scene.stereo import FAR_M
from tasks.world.arrays import F32, Array
from tasks.world.clip import DRIVES_APART_S

SPACING_M = 0.2  # of the points
WIDE_M = 3.0  # to either side: nothing else stood where the ego drove
AHEAD_M = 20.0  # straight on from where it was last
CLEAR_M = 0.25  # a corner this high above the road stands on it
COLUMNS_PX, STEPS_ALONG = 32, 40  # between rays that are followed to the road, and how they are
SOME = 3000  # points that say how high it is
NEAR_M, SEEN_M = 0.5, 200.0  # from where, and how far
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


def driven_roads(world_from_ego: Array, times_s: Array, ground_m: float, spacing_m: float = SPACING_M) -> Array:
    """Points (M, 3) of the road under the drives through a block: poses (F, 4, 4) at times (F,) [s], in any order.

    What is `DRIVES_APART_S` apart on the block's clock are two drives, and between them is no road.
    """
    order = np.argsort(times_s, kind="stable")
    ends = np.flatnonzero(np.diff(times_s[order]) > DRIVES_APART_S / 2.0) + 1
    return np.concatenate([driven_road(world_from_ego[d], ground_m, spacing_m) for d in np.split(order, ends)])


def road_depth(road: Array, eye: Array, rays: Array) -> F32:
    """Depth (H, W) [m], FAR_M at most, at which `rays` (H, W, 3) from `eye` (3,) meet the `road` (M, 3); 0 above the
    horizon.

    Wherever it is looked at the road is as high as where the drive came nearest. Without one there is nothing below the
    horizon that is too far.
    """
    height, width = rays.shape[:2]
    if len(road) == 0:
        return np.where(rays[..., 2] < 0.0, np.float32(FAR_M), np.float32(0.0))
    few, road = rays[:, ::COLUMNS_PX], road[:: max(1, len(road) // SOME)]
    along = np.geomspace(NEAR_M, SEEN_M, STEPS_ALONG)[:, None, None]
    _, nearest = cKDTree(road[:, :2]).query(eye[:2] + along[..., None] * few[..., :2])
    over = eye[2] + along * few[..., 2] - road[nearest, 2]
    after = np.argmax(over <= 0.0, axis=0)[None]
    before = np.maximum(after - 1, 0)
    high, low = (np.take_along_axis(over, rows, axis=0) for rows in (before, after))
    share = np.clip(high / np.maximum(high - low, 1e-9), 0.0, 1.0)
    depth = (along[before[0], 0, 0] * (1.0 - share) + along[after[0], 0, 0] * share)[0]
    # As high a plane everywhere would be met there, and planes can be taken between pixels.
    met = np.where(low[0] <= 0.0, eye[2] + depth * few[..., 2], road[nearest[-1], 2])
    u, v = np.meshgrid(np.arange(width, dtype=np.float32) / COLUMNS_PX, np.arange(height, dtype=np.float32))
    plane = cv2.remap(met.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    depth = np.clip((eye[2] - plane) / np.maximum(-rays[..., 2], 1e-6), 0.0, FAR_M)
    return np.where(rays[..., 2] < 0.0, depth, 0.0).astype(np.float32)


def beside_road(points: Array, road: Array) -> Array:
    """Those of `points` (N, 3) that stand above the road (M, 3) or are beside it, not below."""
    away, nearest = cKDTree(road[:, :2]).query(points[:, :2])
    above = points[:, 2] - road[nearest, 2]
    return points[(above > CLEAR_M) | (away > BESIDE_M) | ((away > SPACING_M) & (above > -CLEAR_M))]

"""Points without lidar: corners found in two photos whose poses are known, and where their rays meet."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from tasks.render.scene.movers import box_of_points
from tasks.render.scene.sensed import Photo, Tracks, voxel_rows
from tasks.render.scene.stereo import FAR_M, MAX_BASELINE_M, MIN_BASELINE_M
from tasks.world.arrays import F32, Array, Indices
from tasks.world.clip import DRIVES_APART_S

# The road where the ego drove, for blocks without lidar: its wheels stood on it.
#
# Asphalt has few corners that photos could be matched by, and those found lie anywhere below the cameras. Fitted from
# them, a road is painted by what lies metres below it, and its paint breaks from half a metre beside the drive.

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


def drop_below_road(points: Array, road: Array) -> Array:
    """Those of `points` (N, 3) that stand above the road (M, 3) or are beside it, not below."""
    away, nearest = cKDTree(road[:, :2]).query(points[:, :2])
    above = points[:, 2] - road[nearest, 2]
    return points[(above > CLEAR_M) | (away > BESIDE_M) | ((away > SPACING_M) & (above > -CLEAR_M))]


BEST_M = 1.5  # baseline that partners are chosen near
PARTNERS = 3  # later photos of the same camera that a photo is matched with
FEATURES = 3000  # a photo
RATIO = 0.8  # Lowe 2004: the second best match must be this much worse
OFF_PX = 1.0  # a point may miss its corner by this much in either photo
LEAST_PARALLAX_DEG = 0.7
FARTHEST_M = 80.0


@dataclass(frozen=True)
class KnownPoints:
    """Points of a block that are known without lidar."""

    road: Array | None = None  # (K, 3) where the ego drove
    corners: Array | None = None  # (M, 3) of the rig's adjustment; None: photos of one camera are matched in pairs

    def shifted(self, by: Array) -> "KnownPoints":
        """Moved by (3,)."""
        return KnownPoints(*(None if points is None else points + by for points in (self.road, self.corners)))


NOTHING_KNOWN = KnownPoints()


@dataclass(frozen=True)
class SurfacePoints:
    """Where surfaces are, for sure."""

    dense: Array  # (M, 3) between which surfaces go on
    corners: Array | None = None  # (K, 3) of a rig's adjustment: between them nothing is known

    @property
    def every(self) -> Array:
        """(M + K, 3)"""
        return self.dense if self.corners is None else np.concatenate([self.corners, self.dense])


def points_without_lidar(photos: Sequence[Photo], tracks: Tracks, known: KnownPoints) -> SurfacePoints:
    """What is known of a block without lidar, in the photos' frame."""
    corners = triangulate_matches(photos, tracks) if known.corners is None else known.corners
    road = np.zeros((0, 3)) if known.road is None else known.road
    if len(road):
        corners = drop_below_road(corners, road)
    return SurfacePoints(np.concatenate([corners, road])) if known.corners is None else SurfacePoints(road, corners)


def triangulate_matches(photos: Sequence[Photo], tracks: Tracks) -> Array:
    """Points (M, 3) that stay, in the photos' frame: SIFT corners matched between photos of one camera.

    A match counts where the rays meet: at least LEAST_PARALLAX_DEG apart, in front of both cameras, OFF_PX off at most,
    and not inside the box of something that can move.
    """
    sift = cv2.SIFT_create(nfeatures=FEATURES)  # type: ignore[attr-defined]
    found = [sift.detectAndCompute(cv2.cvtColor(p.rgb, cv2.COLOR_RGB2GRAY), None) for p in photos]
    corners = [np.array([c.pt for c in points], np.float64).reshape(-1, 2) + 0.5 for points, _ in found]
    parts = [np.zeros((0, 3))]
    for i, photo in enumerate(photos):
        for j in _partners(photos, i):
            first, second = _matches(found[i][1], found[j][1])
            points = _intersect_rays(photo, photos[j], corners[i][first], corners[j][second])
            for time_s in (photo.time_s, photos[j].time_s):
                boxes, valid = tracks.at(time_s)
                points = points[box_of_points(points, boxes, valid) < 0]
            parts.append(points)
    every = np.concatenate(parts)
    return every[voxel_rows(every)] if len(every) else every


def _partners(photos: Sequence[Photo], i: int) -> list[int]:
    mine, candidates = photos[i], []
    for j in range(i + 1, len(photos)):
        other = photos[j]
        baseline = float(np.linalg.norm(other.world_from_camera[:3, 3] - mine.world_from_camera[:3, 3]))
        if other.camera == mine.camera and MIN_BASELINE_M <= baseline <= MAX_BASELINE_M:
            candidates.append((abs(np.log(baseline / BEST_M)), j))
    return [j for _, j in sorted(candidates)[:PARTNERS]]


def _matches(first: F32 | None, second: F32 | None) -> tuple[Indices, Indices]:
    """Rows of descriptors that are each other's best, clearly better than the second best."""
    if first is None or second is None or min(len(first), len(second)) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    there = {a.queryIdx: a.trainIdx for a, b in pairs if a.distance < RATIO * b.distance}
    back = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher(cv2.NORM_L2).match(second, first)}
    mutual = [(a, b) for a, b in there.items() if back.get(b) == a]
    rows = np.array(mutual, np.intp).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def _intersect_rays(a: Photo, b: Photo, at_a: Array, at_b: Array) -> Array:
    """Where the rays of matched pixels (M, 2) meet; only those that do (K, 3)."""
    if len(at_a) == 0:
        return np.zeros((0, 3))
    projections = [p.intrinsics @ np.linalg.inv(p.world_from_camera)[:3] for p in (a, b)]
    homogeneous = cv2.triangulatePoints(projections[0], projections[1], at_a.T, at_b.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = (homogeneous[:3] / homogeneous[3]).T
    keep = np.isfinite(points).all(axis=1)
    rays = []
    for photo, projection, pixels in ((a, projections[0], at_a), (b, projections[1], at_b)):
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, z = projection @ np.column_stack([points, np.ones(len(points))]).T
            keep &= (z > 0.0) & (z < FARTHEST_M) & (np.hypot(u / z - pixels[:, 0], v / z - pixels[:, 1]) < OFF_PX)
            ray = points - photo.world_from_camera[:3, 3]
            rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    with np.errstate(invalid="ignore"):
        keep &= (rays[0] * rays[1]).sum(axis=1) < np.cos(np.radians(LEAST_PARALLAX_DEG))
    return np.asarray(points[keep], np.float64)

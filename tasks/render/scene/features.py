"""Points without lidar: corners found in two photos whose poses are known, and where their rays meet."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tasks.render.scene.driven_road import beside_road
from tasks.render.scene.movers import owners
from tasks.render.scene.sensed import Photo, Tracks, voxel_rows
from tasks.render.scene.stereo import MAX_BASELINE_M, MIN_BASELINE_M
from tasks.world.arrays import F32, Array, Indices

BEST_M = 1.5  # baseline that partners are chosen near
PARTNERS = 3  # later photos of the same camera that a photo is matched with
FEATURES = 3000  # a photo
RATIO = 0.8  # Lowe 2004: the second best match must be this much worse
OFF_PX = 1.0  # a point may miss its corner by this much in either photo
LEAST_PARALLAX_DEG = 0.7
FARTHEST_M = 80.0


@dataclass(frozen=True)
class Known:
    """Points of a block that are known without lidar."""

    road: Array | None = None  # (K, 3) where the ego drove
    corners: Array | None = None  # (M, 3) of the rig's adjustment; None: photos of one camera are matched in pairs

    def shifted(self, by: Array) -> "Known":
        """Moved by (3,)."""
        return Known(*(None if points is None else points + by for points in (self.road, self.corners)))


NOTHING_KNOWN = Known()


@dataclass(frozen=True)
class Points:
    """Where surfaces are, for sure."""

    dense: Array  # (M, 3) between which surfaces go on
    corners: Array | None = None  # (K, 3) of a rig's adjustment: between them nothing is known

    @property
    def every(self) -> Array:
        """(M + K, 3)"""
        return self.dense if self.corners is None else np.concatenate([self.corners, self.dense])


def known_without_lidar(photos: Sequence[Photo], tracks: Tracks, known: Known) -> Points:
    """What is known of a block without lidar, in the photos' frame."""
    corners = triangulated(photos, tracks) if known.corners is None else known.corners
    road = np.zeros((0, 3)) if known.road is None else known.road
    if len(road):
        corners = beside_road(corners, road)
    return Points(np.concatenate([corners, road])) if known.corners is None else Points(road, corners)


def triangulated(photos: Sequence[Photo], tracks: Tracks) -> Array:
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
            points = _meeting(photo, photos[j], corners[i][first], corners[j][second])
            for time_s in (photo.taken_s, photos[j].taken_s):
                boxes, valid = tracks.at(time_s)
                points = points[owners(points, boxes, valid) < 0]
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


def _meeting(a: Photo, b: Photo, at_a: Array, at_b: Array) -> Array:
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

"""A polyline that can be driven by arc length (METRIC.md section 4)."""

from dataclasses import dataclass

import numpy as np
import shapely
import shapely.ops
from numpy.typing import NDArray

from tasks.world.frames import wrap_angle

Array = NDArray[np.float64]
MIN_PROGRESS_M = 1e-5  # interpolation never asks for the very first point: joints may repeat it


@dataclass(frozen=True)
class DrivePath:
    """A path by arc length."""

    poses: Array  # (P, 3) x, y [m], unwrapped heading [rad], world frame
    progress: Array  # (P,) arc length of each pose [m], not decreasing (lane joints repeat a point)
    line: shapely.LineString

    @property
    def length_m(self) -> float:
        return float(self.progress[-1])

    def at(self, progress: Array) -> Array:
        """Poses (..., 3) at arc lengths (...) [m]: linear in x, y and unwrapped heading, clipped to the path's ends."""
        distance = np.clip(progress, MIN_PROGRESS_M, self.length_m)
        # side="left": the segment found starts strictly before the distance, so a repeated point divides by nothing
        above = np.clip(np.searchsorted(self.progress, distance), 1, len(self.progress) - 1)
        below = above - 1
        slope = (self.poses[above] - self.poses[below]) / (self.progress[above] - self.progress[below])[..., None]
        out = slope * (distance - self.progress[below])[..., None] + self.poses[below]
        out[..., 2] = np.arctan2(np.sin(out[..., 2]), np.cos(out[..., 2]))
        return out

    def project(self, points: Array) -> Array:
        """Arc length [m] of the nearest point of the path to each of `points` (..., 2)."""
        found: Array = shapely.line_locate_point(self.line, shapely.points(points))
        return found

    def ahead(self, start_m: float, stop_m: float) -> shapely.LineString:
        """The part between two arc lengths, made of the path's own points where at least two lie inside."""
        start_m, stop_m = float(np.clip(start_m, 0.0, self.length_m)), float(np.clip(stop_m, 0.0, self.length_m))
        inside = (start_m <= self.progress) & (self.progress <= stop_m)
        if np.count_nonzero(inside) > 1:
            return shapely.LineString(self.poses[inside, :2])
        return shapely.ops.substring(self.line, start_m, stop_m)


def path_length_m(poses: Array) -> float:
    """Length [m] of the polyline through `poses` (P, >= 2)."""
    return float(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum())


def drive_path(poses: Array) -> DrivePath:
    """The path through `poses` (P, 3). Raises ValueError where it has no length."""
    poses = np.array(poses, dtype=np.float64)
    if poses.ndim != 2 or poses.shape[1] != 3 or len(poses) < 2:
        raise ValueError(f"a path needs poses of shape (P >= 2, 3), got {poses.shape}")
    poses[:, 2] = np.unwrap(poses[:, 2])
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    progress = np.concatenate([[0.0], np.cumsum(steps)])
    if progress[-1] <= MIN_PROGRESS_M:
        raise ValueError("a path needs a length")
    return DrivePath(poses, progress, shapely.LineString(poses[:, :2]))


def parallel(poses: Array, offset_m: float) -> Array:
    """`poses` (P, 3) moved sideways, to the left where `offset_m` > 0; headings stay."""
    side = poses[:, 2] + np.pi / 2.0
    moved = poses.copy()
    moved[:, 0] += np.cos(side) * offset_m
    moved[:, 1] += np.sin(side) * offset_m
    moved[:, 2] = wrap_angle(moved[:, 2])
    return moved

"""The public traffic's paths: a lane's baseline, and where along it a vehicle is.

As nuplan-devkit's `InterpolatedPath` is made of a baseline by `create_path_from_se2` and read by `trim_path`
(nuplan/planning/simulation/path, nuplan/planning/simulation/observation/idm/utils.py): in the order of their
operations, the point that is lost at the end included.
"""

import math
from dataclasses import dataclass

import numpy as np
import shapely

from tasks.world.arrays import Array
from tasks.world.polygons import with_headings

Pose = tuple[float, float, float]  # x, y [m], heading [rad]
LOOK_M = 0.5  # along a baseline, to tell its direction at a point (polyline_map_object.py)


@dataclass(frozen=True)
class BaselinePath:
    """P >= 2 points of a baseline, all but its last and those that stand twice."""

    at: Array  # (P,) path length [m]
    rows: Array  # (P, 3) x, y [m], heading [rad] of the segment that starts there, unwrapped along the path

    @property
    def end(self) -> float:
        return float(self.at[-1])

    def pose(self, progress: float) -> Pose:
        """x, y, heading in [-pi, pi) at a path length; linear between points, beyond the ends as there."""
        progress = self._clamped(progress)
        k = min(max(int(self.at.searchsorted(progress)), 1), len(self.at) - 1)
        low, high = self.rows[k - 1], self.rows[k]
        x, y, heading = (high - low) / (self.at[k] - self.at[k - 1]) * (progress - self.at[k - 1]) + low
        return float(x), float(y), float((heading + np.pi) % (2.0 * np.pi) - np.pi)

    def ahead(self, progress: float) -> Array:
        """(K >= 2, 2) the path from a path length on; from its end on its last two points."""
        progress = self._clamped(progress)
        first = int(self.at.searchsorted(progress, side="right"))
        if first == len(self.at):
            return self.rows[-2:, :2]
        return np.concatenate([[self.pose(progress)[:2]], self.rows[first:, :2]])

    def between(self, start: float, stop: float) -> Array:
        """(K >= 2, 2) the path between two path lengths; where both are at one of its ends, the two points there."""
        start, stop = self._clamped(start), self._clamped(stop)
        first, last = int(self.at.searchsorted(start, side="right")), int(self.at.searchsorted(stop))
        if first == len(self.at):
            return self.rows[-2:, :2]
        if last == 0:
            return self.rows[:2, :2]
        return np.concatenate([[self.pose(start)[:2]], self.rows[first:last, :2], [self.pose(stop)[:2]]])

    def _clamped(self, progress: float) -> float:
        return max(float(self.at[0]), min(progress, self.end))


def baseline_path(centerline: Array) -> BaselinePath | None:
    """The path along a baseline (P, >= 2); None where fewer than two points are left of it."""
    points = with_headings(centerline[:, :2])
    steps = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    at = np.cumsum(np.append(0.0, steps))
    kept = np.append(~np.isclose(np.diff(at), 0.0), False)  # the last has no step of its own and is lost
    rows = points[kept]
    if len(rows) < 2:
        return None
    rows[:, 2] = np.unwrap(rows[:, 2])
    return BaselinePath(at[kept], rows)


def nearest_pose(baseline: shapely.LineString, xy: Array) -> tuple[Pose, float]:
    """The pose of the point of a baseline nearest to `xy` (2,), and its path length [m]."""
    at = float(shapely.line_locate_point(baseline, shapely.Point(xy)))
    here, there = _point(baseline, at), _point(baseline, at + LOOK_M)
    start, stop = (here, there) if here != there else (_point(baseline, at - LOOK_M), here)
    return (*here, math.atan2(stop[1] - start[1], stop[0] - start[0])), at


def _point(line: shapely.LineString, at: float) -> tuple[float, float]:
    point = shapely.line_interpolate_point(line, at)
    return float(shapely.get_x(point)), float(shapely.get_y(point))

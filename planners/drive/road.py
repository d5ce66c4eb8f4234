"""The road ahead of a drive: how far along it a place lies, and where it ends."""

from dataclasses import dataclass

import numpy as np

from tasks.world.arrays import Array
from tasks.world.polygons import arc_lengths
from tasks.world.vehicle import PACIFICA

SPACING_M = 0.5  # the road is looked at this densely, however few points its lanes came with
BACK_M, AHEAD_M = 10.0, 30.0  # of the place before, that the next one is looked for in: a road may cross itself


@dataclass(frozen=True)
class RouteAhead:
    """A route's centreline from a drive's start on."""

    xy: Array  # (P, 2) world [m]
    along_m: Array  # (P,) arc length [m]
    start_m: float  # of the ego's rear axle
    end_m: float  # of the rear axle where the front bumper is at the road's end
    known_m: float  # as far as the world is known, at most `end_m`

    @property
    def length_m(self) -> float:
        """Of the route: from the start to where the road, or what is known of it, ends; 0 or more."""
        return max(0.0, self.known_m - self.start_m)

    def place_m(self, xy: Array, before_m: float) -> float:
        """Arc length of the point nearest to a place (2,), the place before having been at `before_m`."""
        near = np.flatnonzero((self.along_m >= before_m - BACK_M) & (self.along_m <= before_m + AHEAD_M))
        first = max(int(near[0]) - 1, 0) if len(near) else max(len(self.xy) - 2, 0)
        last = min(int(near[-1]) + 1, len(self.xy) - 1) if len(near) else len(self.xy) - 1
        a, b = self.xy[first:last], self.xy[first + 1 : last + 1]
        edge = b - a
        square = np.maximum((edge**2).sum(axis=1), 1e-12)
        share = np.clip(((xy - a) * edge).sum(axis=1) / square, 0.0, 1.0)
        i = int(np.argmin(((a + share[:, None] * edge - xy) ** 2).sum(axis=1)))
        return float(self.along_m[first + i] + share[i] * np.sqrt(square[i]))


def road_from(centerline: Array, pose: Array, known: Array, bound_m: float) -> RouteAhead:
    """The road along a centreline (P, >= 2) from a rear-axle pose (3,).

    It is known as far as all of it lies within `bound_m` of the places `known` (K, 2).
    """
    line = centerline[:, :2]
    raw = arc_lengths(line)
    along = np.append(np.arange(0.0, raw[-1], SPACING_M), raw[-1])
    xy = np.stack([np.interp(along, raw, line[:, c]) for c in (0, 1)], axis=-1)
    distances = np.hypot(*(xy - pose[:2]).T)
    start_m = RouteAhead(xy, along, 0.0, 0.0, 0.0).place_m(pose[:2], float(along[int(np.argmin(distances))]))
    end_m = float(raw[-1]) - PACIFICA.front_length
    beyond = (along >= start_m) & (distance_m(xy, known) > bound_m)
    known_m = min(end_m, float(along[max(int(np.argmax(beyond)) - 1, 0)])) if beyond.any() else end_m
    return RouteAhead(xy, along, start_m, end_m, known_m)


def distance_m(places: Array, known: Array) -> Array:
    """(N,) of places (N, 2) to the nearest of the known ones (K, 2) [m]."""
    nearest: Array = np.hypot(*np.moveaxis(places[:, None] - known, -1, 0)).min(axis=1)
    return nearest

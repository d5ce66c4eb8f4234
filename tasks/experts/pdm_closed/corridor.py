"""Who stands in the corridor that the ego may sweep along a path, when, and how far along (docs/reward.md 4).

The corridor itself is made by GEOS, as for the public planner: its buffer drops shallow bends of the path and cuts its
round joins into chords, which moves the edge by up to 5 mm from where half a width would put it, and an object that
reaches into those millimetres must be a lead, or none, as it is for the public one. Who lies in it is then compiled.
"""

import math
from typing import NamedTuple

import numpy as np
import shapely
import shapely.ops

from tasks.experts.pdm_closed.forecast import Things
from tasks.experts.pdm_closed.path import DrivePaths, project
from tasks.kernels.compiled import kernel
from tasks.rollout.polylines import extent
from tasks.world.arrays import Array, Ints
from tasks.world.geometry import ring_contains, segments_touch, to_line

ROUNDING_M = 1e-9  # what is decided by circles stays this far from the edge


class Corridors(NamedTuple):
    """One polygon, with holes where the path closes on itself, around a stretch of each of L paths."""

    first: Ints  # (L + 1,) polygon l: edges first[l] .. first[l + 1] - 1, of all its rings
    ax: Array  # (E,) start of each edge [m], world frame
    ay: Array  # (E,)
    bx: Array  # (E,) its end
    by: Array  # (E,)
    inverse_square: Array  # (E,) 1 / squared length [1/m2]
    bounds: Array  # (L, 4) min x, min y, max x, max y [m]


def corridors(paths: DrivePaths, start_m: Array, reach_m: float, half_width_m: float) -> Corridors:
    """The corridor of each path from `start_m` (L,) [m] on over `reach_m`, with square ends."""
    lines = np.array([ahead(paths, index, start, start + reach_m) for index, start in enumerate(start_m)], dtype=object)
    polygons = shapely.buffer(lines, half_width_m, cap_style="square")
    rings, of_polygon = shapely.get_rings(polygons, return_index=True)
    points, of_ring = shapely.get_coordinates(rings, return_index=True)
    edge = np.flatnonzero(of_ring[1:] == of_ring[:-1])
    (ax, ay), (bx, by) = points[edge].T.copy(), points[edge + 1].T.copy()
    return Corridors(
        first=np.searchsorted(of_polygon[of_ring[edge]], np.arange(len(lines) + 1)),
        ax=ax,
        ay=ay,
        bx=bx,
        by=by,
        inverse_square=1.0 / ((bx - ax) ** 2 + (by - ay) ** 2),
        bounds=shapely.bounds(polygons),
    )


def ahead(paths: DrivePaths, path: int, start_m: float, stop_m: float) -> shapely.LineString | shapely.Point:
    """The part of a path between two arc lengths, made of its own points where at least two lie inside."""
    along, x, y = paths.progress[path], paths.x[path], paths.y[path]
    start_m, stop_m = max(start_m, 0.0), min(stop_m, along[-1])
    inside = slice(np.searchsorted(along, start_m), np.searchsorted(along, stop_m, side="right"))
    if inside.stop - inside.start > 1:
        return shapely.linestrings(x[inside], y[inside])
    return shapely.ops.substring(shapely.linestrings(x, y), start_m, stop_m)


@kernel
def lead_progress(paths: DrivePaths, swept: Corridors, things: Things) -> Array:
    """(L, S, M) arc length of each thing's centroid [m] at each sample; NaN where it is not in the path's corridor."""
    n_paths, (n_samples, n_things) = paths.x.shape[0], things.center_x.shape
    out = np.full((n_paths, n_samples, n_things), np.nan)
    for path in range(n_paths):
        squares = np.empty(swept.first[path + 1] - swept.first[path])
        for m in range(n_things):
            inside, clearance = False, -1.0  # [m] it can move before it reaches the corridor's edge
            for sample in range(n_samples):
                if sample > 0 and things.pace[m] == 0.0:
                    out[path, sample, m] = out[path, 0, m]
                    continue
                clearance -= things.pace[m]
                if clearance < 0.0:
                    inside, clearance = _in_corridor(swept, path, things, m, sample, squares)
                if inside:
                    out[path, sample, m] = project(paths, path, things.center_x[sample, m], things.center_y[sample, m])
    return out


@kernel
def _in_corridor(
    swept: Corridors, path: int, things: Things, m: int, sample: int, squares: Array
) -> tuple[bool, float]:
    """Whether thing m has a point in common with a path's corridor, and its clearance to the corridor's edge [m].

    squares: scratch, one for each edge of the corridor. The clearance is negative where the edge runs through the
    thing's circle, and never more than there is.
    """
    x, y, radius = things.center_x[sample, m], things.center_y[sample, m], things.radius[m]
    low_x, low_y, high_x, high_y = swept.bounds[path]
    outside = max(low_x - x, x - high_x, low_y - y, y - high_y) - radius - ROUNDING_M
    if not outside < 0.0:  # also where the corridor is empty (NaN)
        return False, outside
    inside = _edges_around(swept, path, x, y, squares)
    clearance = math.sqrt(extent(squares)[0]) - radius - ROUNDING_M
    if clearance >= 0.0:
        return inside, clearance
    ring_x = things.x[sample, things.first[m] : things.first[m + 1]]
    ring_y = things.y[sample, things.first[m] : things.first[m + 1]]
    return _ring_touches(swept, path, ring_x, ring_y, (radius + ROUNDING_M) ** 2, squares), clearance


@kernel
def _ring_touches(swept: Corridors, path: int, x: Array, y: Array, limit: float, squares: Array) -> bool:
    """Whether a ring has a point in common with a path's corridor, edge by edge.

    squares: the squared distance of the ring's centroid to each edge [m2]; the edges up to `limit` are looked at.
    """
    first = swept.first[path]
    for e in range(squares.shape[0]):
        if squares[e] <= limit:
            ax, ay, bx, by = swept.ax[first + e], swept.ay[first + e], swept.bx[first + e], swept.by[first + e]
            j = x.shape[0] - 1
            for i in range(x.shape[0]):
                if segments_touch(ax, ay, bx, by, x[j], y[j], x[i], y[i]):
                    return True
                j = i
    corridor_in_ring = ring_contains(x, y, swept.ax[first], swept.ay[first])
    return corridor_in_ring or _edges_around(swept, path, x[0], y[0], squares)


@kernel
def _edges_around(swept: Corridors, path: int, x: float, y: float, squares: Array) -> bool:
    """Whether (x, y) is in a path's corridor, by the even-odd rule; fills the squared distance to each edge [m2]."""
    first, stop = swept.first[path], swept.first[path + 1]
    ax, ay, bx, by = swept.ax[first:stop], swept.ay[first:stop], swept.bx[first:stop], swept.by[first:stop]
    inverse_square = swept.inverse_square[first:stop]
    crossings = 0
    for e in range(squares.shape[0]):
        ex, ey = bx[e] - ax[e], by[e] - ay[e]
        ux, uy = x - ax[e], y - ay[e]
        squares[e] = to_line(ux, uy, ex, ey, (ux * ex + uy * ey) * inverse_square[e])[1]
        straddles = (ay[e] > y) != (by[e] > y)
        crossings += straddles & ((ux * ey < uy * ex) == (ey > 0.0))
    return crossings % 2 == 1

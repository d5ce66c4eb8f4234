"""Map polygons as edges, and what is refused of them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.world.arrays import Array, Ints
from tasks.world.bounds import LARGEST, all_within
from tasks.world.lanes import MapPolygon

MIN_WIDTH = 1e-12  # area of a ring over its squared perimeter; what is below is rounding


class Outlines(NamedTuple):
    """E edges of the R rings of some polygons, in order."""

    edges: Array  # (E, 4) x, y of the start, x, y of the end [m]; none of length zero
    first: Ints  # (R + 1,) where the edges of a ring begin
    owner: Ints  # (R,) the polygon of a ring


def outlines(polygons: Sequence[MapPolygon]) -> Outlines:
    """The edges of polygons, holes included; an open ring is closed, repeated points are left out.

    Raises ValueError naming the polygon when a ring is no (M, 2) array, is not finite, has fewer than three distinct
    points or, unless it crosses itself, bounds no area.
    """
    rings, owner = [], []
    for i, polygon in enumerate(polygons):
        for ring in (polygon.ring, *polygon.holes):
            if ring.ndim != 2 or ring.shape[1] != 2:
                raise refused(polygon, f"a ring must be (M, 2), got {ring.shape}")
            rings.append(ring)
            owner.append(i)
    points = np.concatenate([np.empty((0, 2)), *rings])
    edges, first = _edges(points, np.cumsum([0, *map(len, rings)]))
    if not all_within(points):
        bad = next(i for i, ring in zip(owner, rings) if not all_within(ring))
        raise refused(polygons[bad], f"its ring is not finite or farther than {LARGEST:g} m")
    few = np.flatnonzero(np.diff(first) < 3)
    if few.size:
        raise refused(polygons[owner[few[0]]], "its ring has fewer than three distinct points")
    return Outlines(edges, first, np.array(owner, dtype=np.int64))


def refused(polygon: MapPolygon, problem: str) -> ValueError:
    """The error that names a polygon, what is wrong with it and how to fix it."""
    return ValueError(
        f"polygons: {polygon.layer} {polygon.token!r}: {problem} (tasks.world.polygons.valid_ring repairs)"
    )


@kernel
def _edges(points: Array, ends: Ints) -> tuple[Array, Ints]:
    """Edges (E, 4) between successive distinct points of rings ends[i] .. ends[i + 1], and where each ring's begin."""
    edges = np.empty((points.shape[0], 4))
    first = np.zeros(ends.size, np.int64)
    n = 0
    for i in range(ends.size - 1):
        last = ends[i + 1] - 1
        for k in range(ends[i], ends[i + 1]):
            if points[k, 0] != points[last, 0] or points[k, 1] != points[last, 1]:
                edges[n, 0], edges[n, 1] = points[last, 0], points[last, 1]
                edges[n, 2], edges[n, 3] = points[k, 0], points[k, 1]
                n += 1
                last = k
        first[i + 1] = n
    return edges[:n], first


@kernel
def first_flat(edges: Array, first: Ints) -> int:
    """The first ring without an area, -1: every ring has one."""
    for i in range(first.size - 1):
        x, y = edges[first[i], 0], edges[first[i], 1]
        doubled_area = perimeter = 0.0
        for ax, ay, bx, by in edges[first[i] : first[i + 1]]:
            doubled_area += (ax - x) * (by - y) - (ay - y) * (bx - x)
            perimeter += np.hypot(bx - ax, by - ay)
        if abs(doubled_area) <= 2.0 * MIN_WIDTH * perimeter**2:
            return i
    return -1

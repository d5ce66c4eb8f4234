"""Whether the ego's body is on a lane connector whose light is red (docs/reward.md 2d)."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.reward.rules.ego import Body
from tasks.reward.rules.map_index import outlines
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.road_map import MapPolygon


class RedLanes(NamedTuple):
    """L lanes that are red at some time, with E edges. Few arrays, as compiled calls pay for each."""

    is_red: Bools  # (T, L)
    bounds: Array  # (L, 4) min x, min y, max x, max y [m]
    first: Ints  # (L + 1,) where the edges of a lane begin
    edges: Array  # (4, E) start x, start y, end x, end y [m]


NEVER_RED = RedLanes(np.empty((0, 0), np.bool_), np.empty((0, 4)), np.zeros(1, np.int64), np.empty((4, 0)))


def index_red_lanes(polygons: Sequence[MapPolygon], is_red: Bools) -> RedLanes:
    """Lanes laid out for `first_red`; is_red: (T, L) whether each of the L polygons is red at each instant.

    Raises ValueError for a mask that has another number of columns, or a ring that is no ring.
    """
    if is_red.ndim != 2 or is_red.shape[1] != len(polygons):
        raise ValueError(f"the mask of red lanes must be (T, {len(polygons)}), got {is_red.shape}")
    columns = np.flatnonzero(is_red.any(axis=0)).tolist()
    if not columns:
        return NEVER_RED
    edges, first, owner = outlines([polygons[i] for i in columns])
    lane = np.repeat(owner, np.diff(first))
    bounds = [[*edges[lane == i, :2].min(axis=0), *edges[lane == i, :2].max(axis=0)] for i in range(len(columns))]
    return RedLanes(
        np.ascontiguousarray(is_red[:, columns]),
        np.array(bounds, dtype=np.float64).reshape(-1, 4),
        np.searchsorted(lane, np.arange(len(columns) + 1)),
        np.ascontiguousarray(edges.T),
    )


@kernel
def first_red(red: RedLanes, body: Body, half_length: float, half_width: float) -> float:
    """The first instant at which a placed body touches a lane that is red then, inf: never. Standing on it counts."""
    radius = math.hypot(half_length, half_width)
    for t in range(red.is_red.shape[0]):
        x, y = body.x[t], body.y[t]
        for lane in range(red.is_red.shape[1]):
            low_x, low_y, high_x, high_y = red.bounds[lane]
            if not red.is_red[t, lane] or x + radius < low_x or x - radius > high_x:
                continue
            if y + radius < low_y or y - radius > high_y:
                continue
            if _on_lane(red, lane, x, y, body.cos[t], body.sin[t], half_length, half_width):
                return float(t)
    return math.inf


@kernel
def _on_lane(
    red: RedLanes, lane: int, x: float, y: float, cos: float, sin: float, half_length: float, half_width: float
) -> bool:
    """Whether a box and a lane share a point: an edge touches the box, or else the box's centre is in the lane."""
    ax, ay, bx, by = red.edges[0], red.edges[1], red.edges[2], red.edges[3]
    n_touching = 0
    n_right_of_center = 0
    for e in range(red.first[lane], red.first[lane + 1]):
        # the edge in the box's frame
        au, av = cos * (ax[e] - x) + sin * (ay[e] - y), cos * (ay[e] - y) - sin * (ax[e] - x)
        bu, bv = cos * (bx[e] - x) + sin * (by[e] - y), cos * (by[e] - y) - sin * (bx[e] - x)
        du, dv = bu - au, bv - av
        turn = au * bv - av * bu
        apart = abs(au + bu) > 2.0 * half_length + abs(du)
        apart |= abs(av + bv) > 2.0 * half_width + abs(dv)
        apart |= abs(turn) > half_length * abs(dv) + half_width * abs(du)
        n_touching += not apart
        n_right_of_center += ((av > 0.0) != (bv > 0.0)) & ((turn > 0.0) == (dv > 0.0))
    return n_touching > 0 or n_right_of_center % 2 == 1

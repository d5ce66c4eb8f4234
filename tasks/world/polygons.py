"""Lane geometry from boundaries, point queries on many rings at once, and the map layers near a point.

Plain numpy: a query on a route's dozen lanes costs less than one shapely call per lane, and `tasks.world` stays light.
"""

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np

from tasks.world.arrays import Array, Bools
from tasks.world.lanes import MapLayer, MapPolygon, RoadMap

CENTERLINE_SPACING_M = 0.75  # docs/reward.md 0
MAX_LANE_M = 20_000.0  # longer is a broken coordinate, and would ask for any amount of points
PLACES_KEPT = 8  # of each map
MAP_RADIUS_M = 100.0  # docs/reward.md 0


def arc_lengths(polyline: Array) -> Array:
    """Arc length [m] at each point of a polyline (P, 2+), measured in x, y; starts at 0."""
    steps = np.hypot(*np.diff(polyline[:, :2], axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resample(polyline: Array, n_points: int) -> Array:
    """A polyline (P, C) resampled uniformly by arc length in x, y to (n_points, C)."""
    along = arc_lengths(polyline)
    at = np.linspace(0.0, along[-1], n_points)
    return np.stack([np.interp(at, along, column) for column in polyline.T], axis=1)


def n_spaced(length_m: float) -> int:
    """Points of a centreline of that length. Raises ValueError beyond MAX_LANE_M."""
    if not length_m <= MAX_LANE_M:
        raise ValueError(f"a lane of {length_m:.0f} m")
    return max(2, int(np.ceil(length_m / CENTERLINE_SPACING_M)) + 1)


def with_headings(points: Array) -> Array:
    """Points (P, 2), P >= 2, with the direction [rad] of the segment that starts there; the last repeats: (P, 3)."""
    steps = np.diff(points, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    return np.column_stack([points, np.append(heading, heading[-1])])


def centerline_from_boundaries(left: Array, right: Array) -> Array:
    """Centreline (P, 3) x, y, heading: mean of the two boundaries (B, 2+), P = max(2, ceil(L / 0.75) + 1).

    L is the mean of the two lengths; each boundary is resampled uniformly by arc length (docs/reward.md 0). Raises
    ValueError where L is beyond MAX_LANE_M.
    """
    length = (arc_lengths(left)[-1] + arc_lengths(right)[-1]) / 2.0
    n_points = n_spaced(length)
    return with_headings((resample(left[:, :2], n_points) + resample(right[:, :2], n_points)) / 2.0)


def ring_from_boundaries(left: Array, right: Array) -> Array:
    """Closed ring (M, 2): left boundary, reversed right boundary; made valid if it is not, largest part kept."""
    ring = np.concatenate([left[:, :2], right[::-1, :2], left[:1, :2]])
    return valid_ring(ring)


def valid_ring(ring: Array) -> Array:
    """The closed ring (M, 2) itself when it bounds a valid polygon, else the largest part of the repaired one.

    Raises ValueError where nothing of any area is left.
    """
    import shapely  # here alone: importing the map types must stay cheap

    polygon = shapely.Polygon(ring)
    if polygon.is_valid and not polygon.is_empty:
        return ring
    repaired = shapely.make_valid(polygon)
    parts = [part for part in shapely.get_parts(shapely.get_parts(repaired)) if part.geom_type == "Polygon"]
    if not parts:
        raise ValueError("the ring bounds no area")
    return np.asarray(max(parts, key=lambda part: part.area).exterior.coords, dtype=np.float64)[:, :2]


class Rings:
    """Point queries against N closed rings at once; a point on an edge may count as inside or outside."""

    def __init__(self, rings: Sequence[Array]) -> None:
        """rings: N >= 1 arrays (M_i, 2), M_i >= 2, closed."""
        self._start = np.concatenate([ring[:-1] for ring in rings])
        self._step = np.concatenate([np.diff(ring, axis=0) for ring in rings])
        self._square = np.maximum((self._step**2).sum(axis=1), 1e-300)  # a repeated point is a segment of length 0
        self._first = np.cumsum([0] + [len(ring) - 1 for ring in rings[:-1]])

    def contains(self, point: Array) -> Bools:
        """(N,) whether the point (2,) is inside each ring, by the even-odd rule."""
        y0 = self._start[:, 1] - point[1]
        y1 = y0 + self._step[:, 1]
        crosses = (y0 > 0.0) != (y1 > 0.0)
        rise = np.where(crosses, self._step[:, 1], 1.0)
        right_of_point = self._start[:, 0] - point[0] - y0 * self._step[:, 0] / rise > 0.0
        count = np.add.reduceat((crosses & right_of_point).astype(np.int64), self._first)
        return count % 2 == 1

    def distances(self, point: Array) -> Array:
        """(N,) distance [m] from the point (2,) to each polygon; 0 inside."""
        offset = point - self._start
        along = np.clip((offset * self._step).sum(axis=1) / self._square, 0.0, 1.0)
        to_edge = np.hypot(*(offset - along[:, None] * self._step).T)
        return np.where(self.contains(point), 0.0, np.minimum.reduceat(to_edge, self._first))


def polygons_near(road_map: RoadMap, center_xy: Array, radius_m: float = MAP_RADIUS_M) -> tuple[MapPolygon, ...]:
    """Every polygon of the drivable map within `radius_m` of a point (2,), in the reference's order.

    LANE, LANE_CONNECTOR, INTERSECTION (the map's own, else one per intersection lane), drivable areas, each in file
    order; only lanes that cars drive (docs/reward.md 0). The same map gives the same objects again.
    """
    if road_map not in _DRIVABLE:
        every = _drivable_map(road_map)
        _DRIVABLE[road_map] = every, Rings([polygon.ring for polygon in every]) if every else None, {}
    every, rings, known = _DRIVABLE[road_map]
    if rings is None:
        return ()
    around = float(center_xy[0]), float(center_xy[1]), float(radius_m)
    found = known.get(around)
    if found is None:
        near = rings.distances(np.array(around[:2])) <= radius_m
        found = tuple(polygon for polygon, is_near in zip(every, near, strict=True) if is_near)
        if len(known) >= PLACES_KEPT:
            known.clear()
        known[around] = found
    return found


# Laid out once per map; and an attempt asks for the same place several times: its planner and its score.
_Known = dict[tuple[float, float, float], tuple[MapPolygon, ...]]
_DRIVABLE: WeakKeyDictionary[RoadMap, tuple[tuple[MapPolygon, ...], Rings | None, _Known]] = WeakKeyDictionary()


def _drivable_map(road_map: RoadMap) -> tuple[MapPolygon, ...]:
    lanes = [lane for lane in road_map.lanes.values() if lane.drives_cars]
    connectors = [lane for lane in lanes if lane.is_intersection]
    own = road_map.intersections
    each = (MapPolygon(f"int_{lane.lane_id}", MapLayer.INTERSECTION, lane.ring) for lane in connectors)
    return (
        *(MapPolygon(lane.lane_id, MapLayer.LANE, lane.ring) for lane in lanes if not lane.is_intersection),
        *(MapPolygon(lane.lane_id, MapLayer.LANE_CONNECTOR, lane.ring) for lane in connectors),
        *(each if own is None else own),
        *road_map.drivable_areas,
    )

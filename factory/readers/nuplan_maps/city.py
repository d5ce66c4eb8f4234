"""A nuPlan city, and the part of it around a drive as a RoadMap."""

from collections import defaultdict
from collections.abc import Collection
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from factory.readers.base import BadClip
from factory.readers.nuplan_maps.geopackage import Table, map_file
from factory.readers.nuplan_maps.kept import kept_tables
from tasks.world.arrays import Array
from tasks.world.lanes import Lane, MapLayer, MapPolygon, RoadMap
from tasks.world.roadblocks import Roadblocks

LANES, CONNECTORS = "lanes_polygons", "lane_connectors"
CONNECTOR_POLYGONS = "gen_lane_connectors_scaled_width_polygons"
GROUPS, GROUP_CONNECTORS = "lane_groups_polygons", "lane_group_connectors"
AREAS = {  # what the public reward loads beside lanes (navsim, pdm_occupancy_map.py)
    GROUPS: MapLayer.ROADBLOCK,
    "carpark_areas": MapLayer.CARPARK_AREA,
    "intersections": MapLayer.INTERSECTION,
}


def open_city(maps_root: Path, location: str) -> "City":
    """The city's map, opened once in a process and again where its file has changed. Raises BadClip, ImportError."""
    path = map_file(Path(maps_root), location)
    told = path.stat()
    return _opened(path.resolve(), location, told.st_size, told.st_mtime_ns)


@lru_cache(maxsize=8)
def _opened(path: Path, location: str, size: int, changed_ns: int) -> "City":
    return City(location, path, kept_tables(path))


class City:
    """All lanes and areas of one city, found by place.

    `tables` also hold what the reward does not see, as in the public code: generic drivable areas, which the public
    metric never loads, walkways and stop polygons.
    """

    def __init__(self, location: str, path: Path, tables: dict[str, Table]) -> None:
        """`path` is what errors name. Raises BadClip where lanes lack a polygon or a baseline, or share an id."""
        self.location, self.path, self.tables = location, path, tables
        lanes, connectors = tables[LANES], tables[CONNECTORS]
        polygons = tables[CONNECTOR_POLYGONS]
        row_of = self._rows_of(CONNECTOR_POLYGONS, "lane_connector_fid", connectors)
        fids = np.concatenate([lanes.fid, connectors.fid])
        self._index_of = {str(fid): i for i, fid in enumerate(fids.tolist())}
        if len(self._index_of) != len(fids):
            values, counts = np.unique(fids, return_counts=True)
            raise BadClip(str(path), f"layers {LANES} and {CONNECTORS}, fid {values[counts > 1][0]}", "stands twice")
        self._ids = list(self._index_of)
        self._n_lanes = len(lanes.fid)
        self._polygon_rows = row_of
        of_lane = self._rows_of("baseline_paths", "lane_fid", lanes)
        of_connector = self._rows_of("baseline_paths", "lane_connector_fid", connectors)
        self._baselines, self._centerlines = np.concatenate([of_lane, of_connector]), _headed(tables["baseline_paths"])
        sides = [f"{side}_boundary_fid" for side in ("left", "right")]
        self._sides = [self._side(np.concatenate([lanes.columns[s], polygons.columns[s][row_of]])) for s in sides]
        edges = tables["boundaries"].xy
        self._edges = np.column_stack([edges, np.zeros(len(edges))])  # heights are not in the map
        self._blocks = np.concatenate([lanes.columns["lane_group_fid"], connectors.columns["lane_group_connector_fid"]])
        self._speeds = np.concatenate([t.columns["speed_limit_mps"] for t in (lanes, connectors)])
        self._before, self._after = self._graph()
        self._beside = self._neighbours()
        self._tree = shapely.STRtree(np.concatenate([lanes.shapes, polygons.shapes[row_of]]))
        self._area_trees = {layer: shapely.STRtree(tables[layer].shapes) for layer in (*AREAS, "crosswalks")}
        self._lanes: dict[int, Lane] = {}
        self._areas: dict[tuple[str, int], MapPolygon] = {}

    def road_map(self, along_xy: Array, radius_m: float, lane_ids: Collection[str] = ()) -> RoadMap:
        """All within `radius_m` [m] of any of the points (S, 2), in file order: lanes, then connectors.

        lane_ids: further lanes, wherever they are, as those of a route. Raises KeyError for one that is none.

        Lane ids are nuPlan's fids; neighbours and successors may name lanes outside the map. Centrelines are the
        baselines' own points, as nuPlan's `discrete_path`. Drivable are lane groups and car parks, and intersections:
        generic drivable areas are what the public metric never loads.
        """
        around = shapely.multipoints(np.asarray(along_xy, dtype=np.float64).reshape(-1, 2))
        rows = {*_near(self._tree, around, radius_m), *(self._index_of[lane_id] for lane_id in lane_ids)}
        lanes = {lane.lane_id: lane for lane in map(self._lane, sorted(rows))}
        areas: dict[str, list[MapPolygon]] = {
            layer: [self._area(layer, row) for row in _near(self._area_trees[layer], around, radius_m)]
            for layer in AREAS
        }
        crossings = self.tables["crosswalks"]
        return RoadMap(
            lanes=lanes,
            drivable_areas=(*areas[GROUPS], *areas["carpark_areas"]),
            crossings=tuple(crossings.outline(i) for i in _near(self._area_trees["crosswalks"], around, radius_m)),
            roadblock_of={lane_id: str(self._blocks[self._index_of[lane_id]]) for lane_id in lanes},
            location=self.location,
            intersections=tuple(areas["intersections"]),
        )

    @cached_property
    def roadblocks(self) -> Roadblocks:
        """Every lane group and lane group connector of the city, for `tasks.world.roadblocks`."""
        groups, connectors = self.tables[GROUPS], self.tables[GROUP_CONNECTORS]
        shapes: dict[str, Any] = {}
        for table in (groups, connectors):
            for fid, shape in zip(table.fid.tolist(), table.shapes):
                shapes.setdefault(str(fid), shape)  # the largest part comes first
        lanes_of: dict[str, list[str]] = defaultdict(list)
        for lane_id, block in zip(self._ids, self._blocks.tolist()):
            lanes_of[str(block)].append(lane_id)
        joins = {
            str(fid): (str(before), str(after))
            for fid, before, after in zip(
                connectors.fid.tolist(),
                connectors.columns["from_lane_group_fid"].tolist(),
                connectors.columns["to_lane_group_fid"].tolist(),
            )
        }
        return Roadblocks(shapes, {block: tuple(ids) for block, ids in lanes_of.items()}, joins, self.centerline)

    def centerline(self, lane_id: str) -> Array:
        """(P, 3) x, y, heading of a lane or connector. Raises KeyError."""
        return self._lane(self._index_of[lane_id]).centerline

    def _rows_of(self, layer: str, column: str, owners: Table) -> NDArray[np.int64]:
        """(N,) the one row of a layer that names each of the owners. Raises BadClip."""
        named = self.tables[layer].columns[column].astype(np.float64)
        rows = np.flatnonzero(np.isfinite(named))
        order = rows[np.argsort(named[rows], kind="stable")]
        at = np.searchsorted(named[order], owners.fid, "left")
        count = np.searchsorted(named[order], owners.fid, "right") - at
        wrong = np.flatnonzero(count != 1)
        if wrong.size:
            where = f"layer {layer}, column {column}, {owners.fid[wrong[0]]}"
            raise BadClip(str(self.path), where, f"must stand in one row, it stands in {count[wrong[0]]}")
        return np.asarray(order[at], dtype=np.int64)

    def _graph(self) -> tuple[list[tuple[str, ...]], list[tuple[str, ...]]]:
        """Predecessors and successors of each lane, connectors in file order, as nuplan-devkit reads them.

        A connector leaves `exit_lane_fid` and enters `entry_lane_fid` (lane_connector.py, incoming_edges).
        """
        connectors = self.tables[CONNECTORS]
        left, entered = (connectors.columns[f"{way}_lane_fid"].tolist() for way in ("exit", "entry"))
        before: list[list[str]] = [[] for _ in self._ids]
        after: list[list[str]] = [[] for _ in self._ids]
        for i, (origin, target) in enumerate(zip(map(str, left), map(str, entered)), start=self._n_lanes):
            before[i].append(origin)
            after[i].append(target)
            if origin in self._index_of:
                after[self._index_of[origin]].append(self._ids[i])
            if target in self._index_of:
                before[self._index_of[target]].append(self._ids[i])
        return [tuple(ids) for ids in before], [tuple(ids) for ids in after]

    def _neighbours(self) -> list[tuple[str | None, str | None]]:
        """Left and right neighbour: one less and one more `lane_index` in the same lane group; connectors have none."""
        lanes = self.tables[LANES]
        places = list(zip(lanes.columns["lane_group_fid"].tolist(), lanes.columns["lane_index"].tolist()))
        at = dict(zip(places, self._ids))
        beside = [(at.get((group, index - 1)), at.get((group, index + 1))) for group, index in places]
        return beside + [(None, None)] * (len(self._ids) - len(places))

    def _lane(self, i: int) -> Lane:
        if i not in self._lanes:
            lines, row = self.tables["baseline_paths"].offsets[0], int(self._baselines[i])
            speed = float(self._speeds[i])
            self._lanes[i] = Lane(
                lane_id=self._ids[i],
                ring=self._ring(i),
                centerline=self._centerlines[lines[row] : lines[row + 1]],
                is_intersection=i >= self._n_lanes,
                drives_cars=True,  # the public metric makes no difference between lanes
                successors=self._after[i],
                predecessors=self._before[i],
                left_neighbor=self._beside[i][0],
                right_neighbor=self._beside[i][1],
                speed_limit_mps=None if np.isnan(speed) else speed,
                left_boundary=self._boundary(0, i),
                right_boundary=self._boundary(1, i),
            )
        return self._lanes[i]

    def _ring(self, i: int) -> Array:
        if i < self._n_lanes:
            return self.tables[LANES].outline(i)
        return self.tables[CONNECTOR_POLYGONS].outline(int(self._polygon_rows[i - self._n_lanes]))

    def _side(self, fids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Of each lane the row of its boundary, -1 where no row has that fid, and whether that runs against it."""
        table, lines = self.tables["boundaries"], self.tables["baseline_paths"]
        if not len(table.fid):
            return np.full(len(fids), -1), np.zeros(len(fids), np.bool_)
        order = np.argsort(table.fid, kind="stable")
        at = np.minimum(np.searchsorted(table.fid[order], fids), len(order) - 1)
        rows = np.where(table.fid[order][at] == fids, order[at], -1)
        ends, own = _ends(table, np.maximum(rows, 0)), _ends(lines, self._baselines)
        along = np.hypot(*(ends - own).T).sum(axis=0)
        return rows, (rows >= 0) & (along > np.hypot(*(ends[:, ::-1] - own).T).sum(axis=0))

    def _boundary(self, side: int, i: int) -> Array | None:
        """(B, 3) in the lane's direction; None where the map has none."""
        rows, against = self._sides[side]
        if rows[i] < 0:
            return None
        first, last = self.tables["boundaries"].offsets[0][rows[i] : rows[i] + 2]
        points = self._edges[first:last]
        return points[::-1] if against[i] else points

    def _area(self, layer: str, row: int) -> MapPolygon:
        """An area; parts of one fid after the largest are named <fid>_1, <fid>_2 and so on."""
        key = layer, row
        if key not in self._areas:
            fids = self.tables[layer].fid
            part = 0
            while part < row and fids[row - part - 1] == fids[row]:
                part += 1
            token = f"{fids[row]}_{part}" if part else str(fids[row])
            table = self.tables[layer]
            self._areas[key] = MapPolygon(token, AREAS[layer], table.outline(row), table.holes(row))
        return self._areas[key]


def _near(tree: shapely.STRtree, around: Any, radius_m: float) -> list[int]:
    """Rows within a distance, in file order."""
    return sorted(tree.query(around, predicate="dwithin", distance=radius_m).tolist())


def _headed(table: Table) -> Array:
    """(T, 3) the points of a layer of lines with the direction of the segment that starts there; a last one repeats."""
    steps = np.diff(table.xy, axis=0, append=0.0)
    heading, last = np.arctan2(steps[:, 1], steps[:, 0]), table.offsets[0][1:] - 1
    heading[last] = heading[last - 1]
    return np.column_stack([table.xy, heading])


def _ends(table: Table, rows: NDArray[np.int64]) -> Array:
    """(N, 2, 2) first and last point of lines."""
    points = table.offsets[0]
    return np.stack([table.xy[points[rows]], table.xy[points[rows + 1] - 1]], axis=1)

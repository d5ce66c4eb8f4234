"""A nuPlan city, and the part of it around a drive as a RoadMap."""

import hashlib
import io
import json
import logging
from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from factory.files import broken_link, is_named, matching
from factory.readers.base import BadClip
from tasks.caches import Damaged, user_cache, verify_checksum, with_checksum
from tasks.kernels.compiled import write_whole
from tasks.world.arrays import Array, Ints
from tasks.world.repair.records import Repair
from tasks.world.repair.road import map_repair, simple_crossing
from tasks.world.road_map import Lane, MapLayer, MapPolygon, RoadMap
from tasks.world.roadblocks import Roadblocks

# One nuPlan GeoPackage as tables of arrays in the city's UTM zone. Layers and columns: nuplan-devkit,
# maps/nuplan_map.
#
# Polygons and lines may lie in degrees (as nuPlan ships them) or in any other system that the file names; what is
# kept is metres of the zone that the layer `meta` names under `projectedCoordSystem`, the frame of nuPlan's ego
# poses.

log = logging.getLogger(__name__)

INDEX = "nuplan-maps-v1.0.json"  # the name is part of nuPlan's code; the maps of release 1.1 come with it, too
DOWNLOAD = "download nuPlan's nuplan-maps-v1.1.zip, whose folder nuplan-maps-v1.0 is the root"
INSTALL = "nuPlan's maps are read by pyogrio and pyproj: pip install 'driving-data-factory[navsim]'"
KEYS: Mapping[str, tuple[str, ...]] = {  # layer -> columns of integers that must not be NULL
    "lanes_polygons": ("lane_group_fid", "lane_index", "left_boundary_fid", "right_boundary_fid"),
    "lane_connectors": ("exit_lane_fid", "entry_lane_fid", "lane_group_connector_fid"),
    "gen_lane_connectors_scaled_width_polygons": ("lane_connector_fid", "left_boundary_fid", "right_boundary_fid"),
    "baseline_paths": (),
    "boundaries": (),
    "lane_groups_polygons": (),
    "lane_group_connectors": ("from_lane_group_fid", "to_lane_group_fid"),
    "intersections": (),
    "crosswalks": (),
    "carpark_areas": (),
}
NUMBERS: Mapping[str, tuple[str, ...]] = {  # columns where NULL is NaN
    "lanes_polygons": ("speed_limit_mps",),
    "lane_connectors": ("speed_limit_mps",),
    "baseline_paths": ("lane_fid", "lane_connector_fid"),
}
MADE: Mapping[str, tuple[str, ...]] = {"crosswalks": ("was_m2",)}  # [m2] of an outline that crossed itself; NaN
LINES = {"baseline_paths", "boundaries", "lane_connectors"}
ONE_PART = {"lanes_polygons", "gen_lane_connectors_scaled_width_polygons"}  # of several parts the largest is kept


@dataclass(frozen=True)
class LayerTable:
    """One layer: N rows in file order; an area of several parts has a row for each, the largest first."""

    fid: Ints  # (N,)
    columns: Mapping[str, NDArray[np.generic]]  # (N,) each
    xy: Array  # (T, 2) points of all shapes [m]
    offsets: tuple[Ints, ...]  # shapely's: where lines or rings begin in xy; then where polygons begin in rings

    @cached_property
    def shapes(self) -> NDArray[np.object_]:
        """(N,) shapely polygons or lines."""
        if not len(self.fid):
            return np.empty(0, dtype=object)
        kind = shapely.GeometryType.LINESTRING if len(self.offsets) == 1 else shapely.GeometryType.POLYGON
        return np.asarray(shapely.from_ragged_array(kind, self.xy, self.offsets), dtype=object)

    def outline(self, row: int) -> Array:
        """(P, 2) a line, or a polygon's closed exterior ring."""
        first = row if len(self.offsets) == 1 else int(self.offsets[1][row])
        points = self.offsets[0]
        return self.xy[points[first] : points[first + 1]]

    def holes(self, row: int) -> tuple[Array, ...]:
        """The closed rings of a polygon's holes."""
        rings, points = self.offsets[1], self.offsets[0]
        return tuple(self.xy[points[i] : points[i + 1]] for i in range(rings[row] + 1, rings[row + 1]))


def map_file(maps_root: Path, location: str) -> Path:
    """<maps_root>/<location>/<version>/map.gpkg. Raises BadClip."""
    folder, index = maps_root / location, maps_root / INDEX
    if not folder.is_dir():
        problem = f"{broken_link(folder) or 'no such folder'}; the maps' root holds one for each city"
        raise BadClip(str(folder), "location", f"{problem}: {DOWNLOAD}")
    if is_named(index):
        try:
            version = str(json.loads(index.read_text(encoding="utf-8"))[location]["version"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise BadClip(str(index), f"{location}.version", f"cannot be read: {error!r}") from error
    else:
        versions = [path.parent.name for path in matching(folder, "*/map.gpkg")]
        if len(versions) != 1:
            raise BadClip(str(folder), "version", f"without {INDEX} it must hold one version, it holds {versions}")
        version = versions[0]
    path = folder / version / "map.gpkg"
    if not path.is_file():
        raise BadClip(str(path), "map.gpkg", f"{broken_link(path) or 'no such file'}; {DOWNLOAD}")
    return path


def read_geopackage(path: Path) -> dict[str, LayerTable]:
    """Every layer of KEYS by its name. Raises BadClip naming layer, column and fid, ImportError naming the extra."""
    try:
        import pyogrio
    except ImportError as error:
        raise ImportError(INSTALL) from error
    try:
        known = {str(name) for name, _ in pyogrio.list_layers(path)}
    except Exception as error:  # GDAL's own kinds differ between builds: all of them mean that the file is none
        raise BadClip(str(path), "GeoPackage", f"cannot be opened: {error}") from error
    missing = sorted({*KEYS, "meta"} - known)
    if missing:
        raise BadClip(str(path), f"layer {missing[0]}", "is missing; is this one of nuPlan's maps, copied whole?")
    meta, _, _, values = _read(path, "meta", ["key", "value"])
    found = dict(zip(meta["fields"].tolist(), values))
    if found.keys() != {"key", "value"}:
        raise BadClip(str(path), "layer meta", "needs the columns key and value")
    system = dict(zip(found["key"].tolist(), found["value"].tolist())).get("projectedCoordSystem")
    if not system:
        raise BadClip(str(path), "layer meta, key projectedCoordSystem", "is missing: it names the UTM zone")
    return {layer: _table(path, layer, str(system)) for layer in KEYS}


def _read(path: Path, layer: str, columns: list[str] | None) -> tuple[dict[str, Any], Ints, Any, list[Any]]:
    """Of one layer: what GDAL says of it, fids, WKB of its geometry (None: it has none), its columns."""
    from pyogrio import raw

    try:
        meta, fids, wkb, values = raw.read(path, layer=layer, columns=columns, force_2d=True, return_fids=True)
    except Exception as error:  # see above
        raise BadClip(str(path), f"layer {layer}", f"cannot be read: {error}") from error
    return meta, fids, wkb, values


def _table(path: Path, layer: str, target: str) -> LayerTable:
    wanted = [*KEYS[layer], *NUMBERS.get(layer, ())]
    meta, fids, wkb, values = _read(path, layer, wanted)
    given = dict(zip(meta["fields"].tolist(), values))
    columns: dict[str, NDArray[np.generic]] = {}
    for name in wanted:
        where = f"layer {layer}, column {name}"
        if name not in given:
            raise BadClip(str(path), where, "is missing")
        try:
            numbers = given[name].astype(np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise BadClip(str(path), where, f"is not a column of numbers ({error})") from error
        if name in KEYS[layer]:
            null = np.flatnonzero(~np.isfinite(numbers))
            if null.size:
                raise BadClip(str(path), f"{where}, fid {fids[null[0]]}", "is NULL; it has to name a row")
            columns[name] = numbers.astype(np.int64)
        else:
            columns[name] = numbers
    if layer == "crosswalks" and wkb is not None:  # which no other layer names and no metric looks at
        whole = shapely.area(shapely.make_valid(shapely.from_wkb(wkb))) > 0.0  # the area of no shape is NaN
        for fid in fids[~whole]:
            log.warning("%s: layer %s, fid %d: encloses no area, left out", path, layer, fid)
        fids, wkb, columns = fids[whole], wkb[whole], {name: column[whole] for name, column in columns.items()}
    shapes = _projected(path, layer, meta["crs"], target, fids, wkb)
    if layer in LINES:  # a point that stands twice has no heading
        shapes = shapely.remove_repeated_points(shapes)
    if "was_m2" in MADE.get(layer, ()):
        shapes, columns["was_m2"] = _ordered(shapes)
    rows, parts = _parts(path, layer, fids, shapes)
    kept = {name: column[rows] for name, column in columns.items()}
    if not len(rows):
        nothing = np.zeros(1, dtype=np.int64)
        return LayerTable(fids[rows], kept, np.empty((0, 2)), (nothing,) if layer in LINES else (nothing, nothing))
    _, xy, offsets = shapely.to_ragged_array(parts)
    return LayerTable(fids[rows], kept, xy, tuple(offsets))


def _projected(path: Path, layer: str, source: str | None, target: str, fids: Ints, wkb: Any) -> NDArray[np.object_]:
    import pyproj

    if wkb is None or (source is None and len(fids)):
        raise BadClip(str(path), f"layer {layer}", "has no geometry, or does not say in which coordinates it lies")
    shapes = shapely.from_wkb(wkb)
    none = np.flatnonzero(shapely.is_missing(shapes) | shapely.is_empty(shapes))
    if none.size:
        raise BadClip(str(path), f"layer {layer}, column geom, fid {fids[none[0]]}", "is NULL or empty")
    if not len(fids):
        return np.asarray(shapes, dtype=object)
    try:
        projection = pyproj.Transformer.from_crs(source, target, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise BadClip(str(path), f"layer {layer}", f"no way from {source} to {target}: {error}") from error
    moved = shapely.transform(shapes, lambda xy: np.column_stack(projection.transform(xy[:, 0], xy[:, 1])))
    coordinates, owner = shapely.get_coordinates(moved, return_index=True)
    wild = np.flatnonzero(~np.isfinite(coordinates).all(axis=1))
    if wild.size:
        raise BadClip(str(path), f"layer {layer}, column geom, fid {fids[owner[wild[0]]]}", "lies outside the UTM zone")
    return np.asarray(moved, dtype=object)


def _ordered(shapes: NDArray[np.object_]) -> tuple[NDArray[np.object_], Array]:
    """Crossings, with a simple outline where theirs crosses itself; and the area [m2] (N,) of theirs, else NaN."""
    out, was_m2 = shapes.copy(), np.full(len(shapes), np.nan)
    plain = (shapely.get_type_id(shapes) == 3) & (shapely.get_num_interior_rings(shapes) == 0)
    for i in np.flatnonzero(plain & ~shapely.is_valid(shapes)).tolist():
        ring, _ = simple_crossing(shapely.get_coordinates(shapes[i]), "")
        if ring is not None:
            out[i], was_m2[i] = shapely.Polygon(ring), shapely.make_valid(shapes[i]).area
    return out, was_m2


def _parts(path: Path, layer: str, fids: Ints, shapes: NDArray[np.object_]) -> tuple[Ints, NDArray[np.object_]]:
    """(N,) rows and their plain polygons or lines; invalid polygons are repaired, slivers of a repair are left out."""
    rows: list[int] = []
    parts: list[Any] = []
    kind = "LineString" if layer in LINES else "Polygon"
    bent = np.zeros(len(shapes), bool) if layer in LINES else ~shapely.is_valid(shapes)
    plain = shapely.get_type_id(shapes) == (1 if layer in LINES else 3)
    for i, shape in enumerate(shapes):
        if plain[i] and not bent[i]:
            found = [shape]
        else:
            whole = shapely.make_valid(shape) if bent[i] else shape
            if kind == "LineString":
                whole = shapely.line_merge(whole)
            pieces = shapely.get_parts(shapely.get_parts(whole))
            found = [piece for piece in pieces if piece.geom_type == kind and (piece.area or piece.length) > 0.0]
            found.sort(key=lambda piece: -(piece.area or piece.length))
            if not found or (kind == "LineString" and len(found) > 1):
                raise BadClip(str(path), f"layer {layer}, column geom, fid {fids[i]}", f"is not one {kind}")
            if layer in ONE_PART and len(found) > 1:
                log.warning("%s: layer %s, fid %d: the largest of %d parts is kept", path, layer, fids[i], len(found))
                found = found[:1]
        rows += [i] * len(found)
        parts += found
    out = np.empty(len(parts), dtype=object)
    out[:] = parts
    return np.array(rows, dtype=np.int64), out


# A city's tables on disk, in the user's cache: read from the GeoPackage once, then within a fraction of a second.

FORMAT = 5  # raise by hand whenever a GeoPackage gives other tables, or they are kept otherwise


def cached_tables_path(path: Path) -> Path:
    """Named by the GeoPackage's place, size and time of change, and by this format."""
    told = path.stat()
    name = f"{path.resolve()}|{told.st_size}|{told.st_mtime_ns}|{FORMAT}"
    return user_cache() / "maps" / f"{path.parent.parent.name}-{hashlib.sha256(name.encode()).hexdigest()[:16]}.npz"


def cached_tables(path: Path) -> dict[str, LayerTable]:
    """The tables of a GeoPackage, from the cache where it is in order. Raises BadClip, ImportError."""
    kept = cached_tables_path(path)
    if kept.is_file():
        try:
            verify_checksum(kept, kept.name)
            with np.load(kept, allow_pickle=False) as stored:
                return {layer: _kept_table(stored, layer) for layer in KEYS}
        except (Damaged, OSError) as error:
            log.warning("%s: damaged (%s); %s is read again", kept, error, path)
    tables = read_geopackage(path)
    arrays: dict[str, NDArray[np.generic]] = {}
    for layer, table in tables.items():
        arrays |= {f"{layer}.fid": table.fid, f"{layer}.xy": table.xy}
        arrays |= {f"{layer}.{name}": column for name, column in table.columns.items()}
        arrays |= {f"{layer}.offsets{i}": offset for i, offset in enumerate(table.offsets)}
    data = io.BytesIO()
    np.savez(data, allow_pickle=False, **arrays)
    write_whole(kept, with_checksum(data.getvalue(), kept.name))
    return tables


def _kept_table(stored: np.lib.npyio.NpzFile, layer: str) -> LayerTable:
    names = (*KEYS[layer], *NUMBERS.get(layer, ()), *MADE.get(layer, ()))
    columns = {name: stored[f"{layer}.{name}"] for name in names}
    offsets = tuple(stored[f"{layer}.offsets{i}"] for i in range(1 if layer in LINES else 2))
    return LayerTable(stored[f"{layer}.fid"], columns, stored[f"{layer}.xy"], offsets)


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
    return City(location, path, cached_tables(path))


class City:
    """All lanes and areas of one city, found by place."""

    def __init__(self, location: str, path: Path, tables: dict[str, LayerTable]) -> None:
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
        lines = tables["baseline_paths"]
        steps = np.diff(lines.xy, axis=0, append=0.0)
        heading, last = np.arctan2(steps[:, 1], steps[:, 0]), lines.offsets[0][1:] - 1
        heading[last] = heading[last - 1]  # each point has that of the segment that starts there
        self._baselines = np.concatenate([of_lane, of_connector])
        self._centerlines = np.column_stack([lines.xy, heading])
        sides = [f"{side}_boundary_fid" for side in ("left", "right")]
        self._sides = [self._side(np.concatenate([lanes.columns[s], polygons.columns[s][row_of]])) for s in sides]
        edges = tables["boundaries"].xy
        self._edges = np.column_stack([edges, np.zeros(len(edges))])  # heights are not in the map
        self._blocks = np.concatenate([lanes.columns["lane_group_fid"], connectors.columns["lane_group_connector_fid"]])
        self._speeds = np.concatenate([t.columns["speed_limit_mps"] for t in (lanes, connectors)])
        self._before, self._after = self._graph()
        # One less and one more `lane_index` in the same lane group; connectors have no neighbours.
        places = list(zip(lanes.columns["lane_group_fid"].tolist(), lanes.columns["lane_index"].tolist()))
        at = dict(zip(places, self._ids))
        self._beside = [(at.get((group, index - 1)), at.get((group, index + 1))) for group, index in places]
        self._beside += [(None, None)] * (len(self._ids) - len(places))
        self._tree = shapely.STRtree(np.concatenate([lanes.shapes, polygons.shapes[row_of]]))
        self._area_trees = {layer: shapely.STRtree(tables[layer].shapes) for layer in (*AREAS, "crosswalks")}
        self._lanes: dict[int, Lane] = {}
        self._areas: dict[tuple[str, int], MapPolygon] = {}

    def road_map(
        self, along_xy: Array, radius_m: float, lane_ids: Collection[str] = ()
    ) -> tuple[RoadMap, tuple[Repair, ...]]:
        """All within `radius_m` [m] of any of the points (S, 2), in file order: lanes, then connectors.

        lane_ids: further lanes, wherever they are, as those of a route. Raises KeyError for one that is none.

        Lane ids are nuPlan's fids; neighbours and successors may name lanes outside the map. Centrelines are the
        baselines' own points, as nuPlan's `discrete_path`. Drivable are lane groups and car parks, and intersections:
        generic drivable areas are what the public metric never loads. With it comes what is not as the file has it:
        crossings alone, which no metric looks at; of all else the public reward takes what is there.
        """
        around = shapely.multipoints(np.asarray(along_xy, dtype=np.float64).reshape(-1, 2))
        rows = {*_near(self._tree, around, radius_m), *(self._index_of[lane_id] for lane_id in lane_ids)}
        lanes = {lane.lane_id: lane for lane in map(self._lane, sorted(rows))}
        areas: dict[str, list[MapPolygon]] = {
            layer: [self._area(layer, row) for row in _near(self._area_trees[layer], around, radius_m)]
            for layer in AREAS
        }
        crossings, near = self.tables["crosswalks"], _near(self._area_trees["crosswalks"], around, radius_m)
        found = RoadMap(
            lanes=lanes,
            drivable_areas=(*areas[GROUPS], *areas["carpark_areas"]),
            crossings=tuple(crossings.outline(i) for i in near),
            roadblock_of={lane_id: str(self._blocks[self._index_of[lane_id]]) for lane_id in lanes},
            location=self.location,
            intersections=tuple(areas["intersections"]),
        )
        repairs = (
            map_repair(
                "crossing",
                str(crossings.fid[i]),
                f"crosses itself, {crossings.columns['was_m2'][i]:.1f} m2",
                f"a simple outline, {crossings.shapes[i].area:.1f} m2",
            )
            for i in near
            if np.isfinite(crossings.columns["was_m2"][i])
        )
        return found, tuple(repairs)

    @property
    def lane_ids(self) -> Collection[str]:
        """Of every lane and connector of the city."""
        return self._index_of.keys()

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

    def _rows_of(self, layer: str, column: str, owners: LayerTable) -> NDArray[np.int64]:
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

    def _lane(self, i: int) -> Lane:
        if i not in self._lanes:
            lines, row = self.tables["baseline_paths"].offsets[0], int(self._baselines[i])
            polygons, n = self.tables[CONNECTOR_POLYGONS], self._n_lanes
            speed = float(self._speeds[i])
            self._lanes[i] = Lane(
                lane_id=self._ids[i],
                ring=self.tables[LANES].outline(i) if i < n else polygons.outline(int(self._polygon_rows[i - n])),
                centerline=self._centerlines[lines[row] : lines[row + 1]],
                is_intersection=i >= n,
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


def _ends(table: LayerTable, rows: NDArray[np.int64]) -> Array:
    """(N, 2, 2) first and last point of lines."""
    points = table.offsets[0]
    return np.stack([table.xy[points[rows]], table.xy[points[rows + 1] - 1]], axis=1)

"""One nuPlan GeoPackage as tables of arrays in the city's UTM zone. Layers and columns: nuplan-devkit, maps/nuplan_map.

Polygons and lines may lie in degrees (as nuPlan ships them) or in any other system that the file names; what is kept
is metres of the zone that the layer `meta` names under `projectedCoordSystem`, the frame of nuPlan's ego poses.
"""

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from factory.files import matching
from factory.readers.base import BadClip
from tasks.world.arrays import Array, Ints

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
    "stop_polygons": (),
    "crosswalks": (),
    "walkways": (),
    "carpark_areas": (),
    "generic_drivable_areas": (),
}
NUMBERS: Mapping[str, tuple[str, ...]] = {  # columns where NULL is NaN
    "lanes_polygons": ("speed_limit_mps",),
    "lane_connectors": ("speed_limit_mps",),
    "baseline_paths": ("lane_fid", "lane_connector_fid"),
}
LINES = {"baseline_paths", "boundaries", "lane_connectors"}
ONE_PART = {"lanes_polygons", "gen_lane_connectors_scaled_width_polygons"}  # of several parts the largest is kept


@dataclass(frozen=True)
class Table:
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
        problem = "no such folder; the maps' root holds one for each city"
        raise BadClip(str(folder), "location", f"{problem}: {DOWNLOAD}")
    if index.is_file():
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
        raise BadClip(str(path), "map.gpkg", f"no such file; {DOWNLOAD}")
    return path


def read_geopackage(path: Path) -> dict[str, Table]:
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
    target = _projected_system(path)
    return {layer: _table(path, layer, target) for layer in KEYS}


def _read(path: Path, layer: str, columns: list[str] | None) -> tuple[dict[str, Any], Ints, Any, list[Any]]:
    """Of one layer: what GDAL says of it, fids, WKB of its geometry (None: it has none), its columns."""
    from pyogrio import raw

    try:
        meta, fids, wkb, values = raw.read(path, layer=layer, columns=columns, force_2d=True, return_fids=True)
    except Exception as error:  # see above
        raise BadClip(str(path), f"layer {layer}", f"cannot be read: {error}") from error
    return meta, fids, wkb, values


def _projected_system(path: Path) -> str:
    meta, _, _, values = _read(path, "meta", ["key", "value"])
    found = dict(zip(meta["fields"].tolist(), values))
    if found.keys() != {"key", "value"}:
        raise BadClip(str(path), "layer meta", "needs the columns key and value")
    systems = dict(zip(found["key"].tolist(), found["value"].tolist()))
    if not systems.get("projectedCoordSystem"):
        raise BadClip(str(path), "layer meta, key projectedCoordSystem", "is missing: it names the UTM zone")
    return str(systems["projectedCoordSystem"])


def _table(path: Path, layer: str, target: str) -> Table:
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
    shapes = _projected(path, layer, meta["crs"], target, fids, wkb)
    rows, parts = _parts(path, layer, fids, shapes)
    kept = {name: column[rows] for name, column in columns.items()}
    if not len(rows):
        nothing = np.zeros(1, dtype=np.int64)
        return Table(fids[rows], kept, np.empty((0, 2)), (nothing,) if layer in LINES else (nothing, nothing))
    _, xy, offsets = shapely.to_ragged_array(parts)
    return Table(fids[rows], kept, xy, tuple(offsets))


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

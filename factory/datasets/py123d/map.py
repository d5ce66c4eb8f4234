"""A map of 123D as a RoadMap: one row an object, its polygon as WKB, what else is known of it as msgpack.

Where a map belongs to one log (Argoverse 2, Waymo) it lies in the log's folder; those of whole cities (nuPlan,
nuScenes) lie in `maps/`, and what is near the drive is taken of them.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon

from factory.datasets.py123d.arrow import (
    ArrowFile,
    ConvertedSet,
    check_version,
    column_without_nulls,
    open_file,
    unpack_msgpack,
)
from factory.datasets.scenarionet.map import (
    RawLane,
    closed_ring,
    connector_ids,
    neighbours,
    paved_areas,
    resampled_line,
)
from factory.readers.base import BadClip, id_text
from factory.wording import shown
from tasks.world.arrays import Array, Indices
from tasks.world.road_map import (
    Lane,
    MapLayer,
    MapPolygon,
    RoadMap,
    centerline_from_boundaries,
    roadblocks_of,
    valid_ring,
    with_headings,
)

LANE, LANE_GROUP, INTERSECTION, CROSSWALK, CARPARK, GENERIC_DRIVABLE = 0, 1, 2, 3, 5, 6  # numbers of layers
BIKE_LANE, BIKE = 3, "LANE_BIKE_LANE"  # of the lane types; as raw lanes name it
AROUND_DRIVE_M = 250.0  # of a city's map: sight of the planners, and how far a route goes on past the log's end


@dataclass(frozen=True)
class MapObjects:
    """The rows of a map file near the drive."""

    file: ArrowFile
    ids: tuple[str, ...]
    layers: NDArray[np.int64]  # (n,)
    shapes: NDArray[np.object_]  # (n,) shapely geometries
    features: pa.Array  # (n,) msgpack

    def rows(self, layer: int) -> Indices:
        """Of a layer, in the file's order."""
        return np.flatnonzero(self.layers == layer)

    def content(self, row: int) -> dict[str, Any]:
        """What the row says besides its polygon. Raises BadClip."""
        return unpack_msgpack(self.file.path, f"features of {self.where(row)}", self.features[row].as_py())

    def where(self, row: int) -> str:
        """Names the row in errors."""
        return f"object {self.ids[row]} of layer {self.layers[row]}"


def read_map(path: Path, source: ConvertedSet, drive: Array) -> RoadMap:
    """The map in this file. drive: (S, 2) where the ego was. Raises BadClip naming the object that is broken."""
    objects = _objects(path, drive)
    groups = {objects.ids[row]: objects.content(row) for row in objects.rows(LANE_GROUP)}
    contents = {objects.ids[row]: objects.content(row) for row in objects.rows(LANE)}
    junction = {group_id for group_id, group in groups.items() if group.get("intersection_id") is not None}
    raw = {}
    for row in objects.rows(LANE):
        lane_id = objects.ids[row]
        in_junction = id_text(contents[lane_id].get("lane_group_id")) in junction if junction else None
        if (lane := _raw_lane(objects, row, contents[lane_id], in_junction)) is not None:
            raw[lane_id] = lane
    if all(lane.kind == BIKE for lane in raw.values()):
        raise BadClip(str(path), "map_layer", "no lane for cars, or none within 250 m of the drive")
    connectors = connector_ids(raw, frozenset())
    left, right = neighbours(raw, connectors)
    lanes = {
        lane_id: Lane(
            lane_id=lane_id,
            ring=lane.ring,
            centerline=_centerline(objects, lane, contents[lane_id], source),
            is_intersection=lane_id in connectors,
            drives_cars=lane.kind != BIKE,
            successors=lane.exit or (),
            predecessors=lane.entry or (),
            left_neighbor=left.get(lane_id),
            right_neighbor=right.get(lane_id),
            speed_limit_mps=lane.speed_limit_mps,
            left_boundary=_line(objects, lane_id, contents[lane_id], "left_boundary"),
            right_boundary=_line(objects, lane_id, contents[lane_id], "right_boundary"),
        )
        for lane_id, lane in raw.items()
    }
    own = tuple(_layer(objects, INTERSECTION, "int", MapLayer.INTERSECTION)) if source.own_intersections else None
    return RoadMap(
        lanes=lanes,
        drivable_areas=_drivable_areas(objects, source, junction, lanes),
        crossings=tuple(
            _exterior(objects, row, part) for row in objects.rows(CROSSWALK) for part in _parts(objects, row)
        ),
        roadblock_of=_roadblocks(path, contents, lanes) if source.own_roadblocks else roadblocks_of(lanes),
        location=str(objects.file.metadata.get("location") or ""),
        intersections=own,
    )


def _objects(path: Path, drive: Array) -> MapObjects:
    """What the map holds; of a city's, what is near the drive. Raises BadClip."""
    file = open_file(path)
    check_version(file)
    ids, layers, packed, wkb = (
        column_without_nulls(path, file.table, name) for name in ("object_id", "map_layer", "features", "wkb")
    )
    try:
        shapes = np.asarray(shapely.from_wkb(wkb.to_pylist()), object)
        numbers = np.asarray(layers, np.int64)
    except (shapely.errors.GEOSException, TypeError, ValueError, pa.ArrowException) as error:
        raise BadClip(str(path), "wkb map_layer", f"no shapes or no layers ({error})") from error
    near = np.arange(len(shapes))
    if not file.value("map_is_per_log", bool):
        driven = LineString(drive).simplify(1.0)
        near = np.flatnonzero(shapely.dwithin(shapes, driven, AROUND_DRIVE_M))
    names = tuple(str(number) for number in ids.take(pa.array(near)).to_pylist())
    return MapObjects(file, names, numbers[near], shapes[near], packed.take(pa.array(near)))


def _raw_lane(objects: MapObjects, row: int, content: Mapping[str, Any], in_junction: bool | None) -> RawLane | None:
    """The lane of this row, its line from the file; None where that is shorter than a centimetre. Raises BadClip."""
    lane_id, file = objects.ids[row], str(objects.file.path)
    center = _line(objects, lane_id, content, "centerline")
    line = resampled_line(center[:, :2], file, f"centerline of lane {lane_id}")
    if line is None:
        return None
    parts = _rings(objects, row)
    speed = content.get("speed_limit_mps")
    return RawLane(
        lane_id=lane_id,
        kind=BIKE if content.get("lane_type") == BIKE_LANE else "LANE_SURFACE_STREET",
        line=line,
        ring=max(parts, key=lambda part: Polygon(part[0]).area)[0],
        has_polygon=True,
        interpolating=in_junction,
        entry=_names(objects, lane_id, content, "predecessor_ids"),
        exit=_names(objects, lane_id, content, "successor_ids"),
        left=id_text(content.get("left_lane_id")),
        right=id_text(content.get("right_lane_id")),
        speed_limit_mps=float(speed) if isinstance(speed, int | float) and 0.0 < speed < np.inf else None,
    )


def _centerline(objects: MapObjects, lane: RawLane, content: Mapping[str, Any], source: ConvertedSet) -> Array:
    if source.own_centerlines:
        return with_headings(lane.line)
    sides = (_line(objects, lane.lane_id, content, f"{side}_boundary") for side in ("left", "right"))
    try:
        return centerline_from_boundaries(*sides)
    except ValueError as error:
        raise BadClip(str(objects.file.path), f"boundaries of lane {lane.lane_id}", str(error)) from error


def _drivable_areas(
    objects: MapObjects, source: ConvertedSet, junction: set[str], lanes: Mapping[str, Lane]
) -> tuple[MapPolygon, ...]:
    """The data set's own surfaces; the union of its lanes where it has none (Waymo's driveways lead off the road).

    Groups within a junction are no surface: its intersection is (docs/reward.md 2a).
    """
    areas = list(_layer(objects, GENERIC_DRIVABLE, "da", MapLayer.DRIVABLE_AREA))
    roadblocks = [row for row in objects.rows(LANE_GROUP) if objects.ids[row] not in junction]
    if source.own_roadblocks:
        areas += [area for row in roadblocks for area in _polygons(objects, row, "rb", MapLayer.ROADBLOCK)]
    if not areas:
        areas += paved_areas([Polygon(lane.ring) for lane in lanes.values() if lane.drives_cars])
    return (*areas, *_layer(objects, CARPARK, "cp", MapLayer.CARPARK_AREA))


def _roadblocks(path: Path, contents: Mapping[str, Mapping[str, Any]], lanes: Mapping[str, Lane]) -> dict[str, str]:
    """Lane id -> the data set's own roadblock. Raises BadClip for a car lane without one."""
    blocks = {}
    for lane_id in (lane_id for lane_id, lane in lanes.items() if lane.drives_cars):
        group = id_text(contents[lane_id].get("lane_group_id"))
        if group is None:
            raise BadClip(str(path), f"lane_group_id of lane {lane_id}", "missing")
        blocks[lane_id] = group
    return blocks


def _layer(objects: MapObjects, layer: int, prefix: str, as_layer: MapLayer) -> Iterator[MapPolygon]:
    for row in objects.rows(layer):
        yield from _polygons(objects, row, prefix, as_layer)


def _polygons(objects: MapObjects, row: int, prefix: str, as_layer: MapLayer) -> Iterator[MapPolygon]:
    for part, (ring, holes) in enumerate(_rings(objects, row)):
        yield MapPolygon(f"{prefix}_{objects.ids[row]}" + f"_{part}" * bool(part), as_layer, ring, holes)


def _parts(objects: MapObjects, row: int) -> list[Polygon]:
    """The polygons of the row's shape. Raises BadClip where there is none."""
    parts = [part for part in shapely.get_parts(objects.shapes[row]) if part.geom_type == "Polygon"]
    if not parts or any(part.is_empty for part in parts):
        raise BadClip(str(objects.file.path), f"wkb of {objects.where(row)}", "no polygon")
    return parts


def _exterior(objects: MapObjects, row: int, part: Polygon) -> Array:
    points = np.asarray(part.exterior.coords, np.float64)[:, :2]
    if not np.isfinite(points).all():
        raise BadClip(str(objects.file.path), f"wkb of {objects.where(row)}", "holds NaN or infinity")
    return points


def _rings(objects: MapObjects, row: int) -> list[tuple[Array, tuple[Array, ...]]]:
    """Exterior and holes of each polygon of the row's shape, made valid. Raises BadClip where one bounds no area."""
    out = []
    for part in _parts(objects, row):
        try:
            ring = valid_ring(_exterior(objects, row, part))
        except ValueError as error:
            raise BadClip(str(objects.file.path), f"wkb of {objects.where(row)}", str(error)) from error
        holes = (closed_ring(np.asarray(hole.coords, np.float64)[:, :2]) for hole in part.interiors)
        out.append((ring, tuple(hole for hole in holes if hole is not None)))
    return out


def _line(objects: MapObjects, lane_id: str, content: Mapping[str, Any], name: str) -> Array:
    """(P, 3) x, y, z, P >= 2; z is 0 where the map is flat. Raises BadClip."""
    line = content.get(name)
    if not isinstance(line, np.ndarray) or line.ndim != 2 or line.shape[1] not in (2, 3) or len(line) < 2:
        raise BadClip(str(objects.file.path), f"{name} of lane {lane_id}", "not a line of two or three coordinates")
    if not np.isfinite(line).all():
        raise BadClip(str(objects.file.path), f"{name} of lane {lane_id}", "holds NaN or infinity")
    return line if line.shape[1] == 3 else np.column_stack([line, np.zeros(len(line))])


def _names(objects: MapObjects, lane_id: str, content: Mapping[str, Any], name: str) -> tuple[str, ...]:
    ids = content.get(name)
    if not isinstance(ids, list):
        raise BadClip(str(objects.file.path), f"{name} of lane {lane_id}", f"not a list: {shown(ids)}")
    return tuple(named for named in map(id_text, ids) if named is not None)

"""A map of 123D as a RoadMap: one row an object, its polygon as WKB, what else is known of it as msgpack.

Where a map belongs to one log (Argoverse 2, Waymo) it lies in the log's folder; those of whole cities (nuPlan,
nuScenes) lie in `maps/`, and what is near the drive is taken of them.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
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
from factory.datasets.scenarionet.map import RawLane, connector_ids, neighbours, paved_areas, resampled_line
from factory.readers.base import BadClip, id_text
from factory.wording import shown
from tasks.world.arrays import Array, Indices
from tasks.world.repair.records import Repair
from tasks.world.repair.road import (
    LaneSides,
    finite_points,
    left_out_lanes,
    map_repair,
    simple_area,
    simple_crossing,
    sound_lanes,
)
from tasks.world.road_map import (
    Lane,
    MapLayer,
    MapPolygon,
    RoadMap,
    centerline_from_boundaries,
    ring_from_boundaries,
    roadblocks_of,
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
    far_lanes: frozenset[str]  # ids of lanes that are on the map, but not near

    def rows(self, layer: int) -> Indices:
        """Of a layer, in the file's order."""
        return np.flatnonzero(self.layers == layer)

    def content(self, row: int) -> dict[str, Any]:
        """What the row says besides its polygon. Raises BadClip."""
        return unpack_msgpack(self.file.path, f"features of {self.where(row)}", self.features[row].as_py())

    def where(self, row: int) -> str:
        """Names the row in errors."""
        return f"object {self.ids[row]} of layer {self.layers[row]}"


@dataclass(frozen=True)
class MapOfDrive:
    """What is near a drive, and what of it is not as the file has it."""

    road_map: RoadMap
    far_lanes: frozenset[str]  # ids of lanes that are on the map, but not near
    repairs: tuple[Repair, ...]


def read_map(path: Path, source: ConvertedSet, drive: Array) -> MapOfDrive:
    """The map in this file. drive: (S, 2) where the ego was. Raises BadClip naming the object that is broken."""
    objects, doubled = _objects(path, drive)
    repairs = list(doubled)
    groups = {objects.ids[row]: objects.content(row) for row in objects.rows(LANE_GROUP)}
    contents = {objects.ids[row]: objects.content(row) for row in objects.rows(LANE)}
    sides, of_sides = sound_lanes(
        {lane_id: _sides(objects, lane_id, content, source) for lane_id, content in contents.items()}
    )
    repairs += of_sides
    junction = {group_id for group_id, group in groups.items() if group.get("intersection_id") is not None}
    raw = {}
    for row in objects.rows(LANE):
        lane_id = objects.ids[row]
        if lane_id in sides:
            in_junction = id_text(contents[lane_id].get("lane_group_id")) in junction if junction else None
            lane, of_lane = _raw_lane(objects, row, contents[lane_id], sides[lane_id], in_junction)
            repairs += of_lane
            if lane is not None:
                raw[lane_id] = lane
    if all(lane.kind == BIKE for lane in raw.values()):
        problem = f"no lane for cars, or none within 250 m of the drive{left_out_lanes(repairs)}"
        raise BadClip(str(path), "map_layer", problem)
    connectors = connector_ids(raw, frozenset())
    left, right = neighbours(raw, connectors)
    lanes = {
        lane_id: Lane(
            lane_id=lane_id,
            ring=lane.ring,
            centerline=(
                with_headings(lane.line)
                if source.own_centerlines
                else centerline_from_boundaries(sides[lane_id].left, sides[lane_id].right)
            ),
            is_intersection=lane_id in connectors,
            drives_cars=lane.kind != BIKE,
            successors=lane.exit or (),
            predecessors=lane.entry or (),
            left_neighbor=left.get(lane_id),
            right_neighbor=right.get(lane_id),
            speed_limit_mps=lane.speed_limit_mps,
            left_boundary=sides[lane_id].left,
            right_boundary=sides[lane_id].right,
        )
        for lane_id, lane in raw.items()
    }
    areas, of_areas = _drivable_areas(objects, source, junction, lanes)
    junctions = objects.rows(INTERSECTION) if source.own_intersections else ()
    own, of_own = _areas(objects, junctions, "int", MapLayer.INTERSECTION)
    crossings, of_crossings = _crossings(objects)
    road_map = RoadMap(
        lanes=lanes,
        drivable_areas=areas,
        crossings=crossings,
        roadblock_of=_roadblocks(path, contents, lanes) if source.own_roadblocks else roadblocks_of(lanes),
        location=str(objects.file.metadata.get("location") or ""),
        intersections=own if source.own_intersections else None,
    )
    return MapOfDrive(road_map, objects.far_lanes, (*repairs, *of_areas, *of_own, *of_crossings))


def _objects(path: Path, drive: Array) -> tuple[MapObjects, tuple[Repair, ...]]:
    """What the map holds; of a city's, what is near the drive. Of a thing that is listed twice the first row counts.

    Raises BadClip.
    """
    file = open_file(path)
    check_version(file)
    ids, layers, packed, wkb = (
        column_without_nulls(path, file.table, name) for name in ("object_id", "map_layer", "features", "wkb")
    )
    try:
        with np.errstate(invalid="ignore"):  # NaN is looked for later
            shapes = np.asarray(shapely.from_wkb(wkb.to_pylist()), object)
        numbers = np.asarray(layers, np.int64)
    except (shapely.errors.GEOSException, TypeError, ValueError, pa.ArrowException) as error:
        raise BadClip(str(path), "wkb map_layer", f"no shapes or no layers ({error})") from error
    near = np.arange(len(shapes))
    if not file.value("map_is_per_log", bool):
        driven = LineString(drive).simplify(1.0)
        near = np.flatnonzero(shapely.dwithin(_finite(shapes), driven, AROUND_DRIVE_M))
    first: dict[tuple[int, str], int] = {}
    repairs = []
    names = [str(number) for number in ids.to_pylist()]
    for row in near.tolist():
        thing = int(numbers[row]), names[row]
        if first.setdefault(thing, row) != row:
            what = {LANE: "lane", CROSSWALK: "crossing"}.get(thing[0], "area")
            repairs.append(map_repair(what, names[row], "listed twice", "its first row"))
    near = np.array(list(first.values()), np.int64)
    kept = tuple(names[row] for row in near)
    far = frozenset(names[row] for row in np.flatnonzero(numbers == LANE)) - set(kept)
    return MapObjects(file, kept, numbers[near], shapes[near], packed.take(pa.array(near)), far), tuple(repairs)


def _finite(shapes: NDArray[np.object_]) -> NDArray[np.object_]:
    """The shapes; of those that hold NaN or infinity, near to which nothing is, the other points."""
    points, owner = shapely.get_coordinates(shapes, return_index=True)
    finite = np.isfinite(points).all(axis=1)
    out = shapes.copy()
    for row in np.unique(owner[~finite]).tolist():
        out[row] = shapely.multipoints(points[finite & (owner == row)])
    return out


def _sides(objects: MapObjects, lane_id: str, content: Mapping[str, Any], source: ConvertedSet) -> LaneSides:
    center = _line(objects, lane_id, content, "centerline") if source.own_centerlines else None
    if center is not None:
        center = center[np.isfinite(center).all(axis=1)]
    return LaneSides(
        _line(objects, lane_id, content, "left_boundary"),
        _line(objects, lane_id, content, "right_boundary"),
        _names(objects, lane_id, content, "predecessor_ids"),
        _names(objects, lane_id, content, "successor_ids"),
        center if center is not None and len(center) else None,
    )


def _raw_lane(
    objects: MapObjects, row: int, content: Mapping[str, Any], sides: LaneSides, in_junction: bool | None
) -> tuple[RawLane | None, tuple[Repair, ...]]:
    """The lane of this row, its line from the file; None where that is no line. Raises BadClip."""
    lane_id = objects.ids[row]
    lost: tuple[Repair, ...] = ()
    if sides.turned and sides.centerline is None:  # the converter made it from the boundaries as they were
        finite = centerline_from_boundaries(sides.left, sides.right)
    else:
        finite, lost = finite_points(_line(objects, lane_id, content, "centerline"), "lane", lane_id, "centerline")
    try:
        line = resampled_line(finite[:, :2])
    except ValueError as error:
        return None, (map_repair("lane", lane_id, str(error)),)
    ring, of_ring = _lane_ring(objects, row, sides)
    speed = content.get("speed_limit_mps")
    lane = RawLane(
        lane_id=lane_id,
        kind=BIKE if content.get("lane_type") == BIKE_LANE else "LANE_SURFACE_STREET",
        line=line,
        ring=ring,
        has_polygon=True,
        interpolating=in_junction,
        entry=sides.predecessors,
        exit=sides.successors,
        left=id_text(content.get("left_lane_id")),
        right=id_text(content.get("right_lane_id")),
        speed_limit_mps=float(speed) if isinstance(speed, int | float) and 0.0 < speed < np.inf else None,
    )
    return lane, (*lost, *of_ring)


def _lane_ring(objects: MapObjects, row: int, sides: LaneSides) -> tuple[Array, tuple[Repair, ...]]:
    """The largest part of the lane's polygon; between its boundaries where there is none, or one was turned."""
    parts, found = _rings(objects, row, "lane")
    if parts and not (sides.turned and found):
        return max((ring for ring, _ in parts), key=lambda ring: float(Polygon(ring).area)), found
    ring = ring_from_boundaries(sides.left, sides.right)
    return ring, () if sides.turned else (map_repair("lane", objects.ids[row], found[0].was, "between its boundaries"),)


def _drivable_areas(
    objects: MapObjects, source: ConvertedSet, junction: set[str], lanes: Mapping[str, Lane]
) -> tuple[tuple[MapPolygon, ...], tuple[Repair, ...]]:
    """The data set's own surfaces; the union of its lanes where it has none (Waymo's driveways lead off the road).

    Groups within a junction are no surface: its intersection is (docs/reward.md 2a).
    """
    own = _areas(objects, objects.rows(GENERIC_DRIVABLE), "da", MapLayer.DRIVABLE_AREA)
    groups = [row for row in objects.rows(LANE_GROUP) if source.own_roadblocks and objects.ids[row] not in junction]
    roadblocks = _areas(objects, groups, "rb", MapLayer.ROADBLOCK)
    parks = _areas(objects, objects.rows(CARPARK), "cp", MapLayer.CARPARK_AREA)
    surfaces = (*own[0], *roadblocks[0])
    if not surfaces:
        surfaces = paved_areas([Polygon(lane.ring) for lane in lanes.values() if lane.drives_cars])
    return (*surfaces, *parks[0]), (*own[1], *roadblocks[1], *parks[1])


def _roadblocks(path: Path, contents: Mapping[str, Mapping[str, Any]], lanes: Mapping[str, Lane]) -> dict[str, str]:
    """Lane id -> the data set's own roadblock. Raises BadClip for a car lane without one."""
    blocks = {}
    for lane_id in (lane_id for lane_id, lane in lanes.items() if lane.drives_cars):
        group = id_text(contents[lane_id].get("lane_group_id"))
        if group is None:
            raise BadClip(str(path), f"lane_group_id of lane {lane_id}", "missing")
        blocks[lane_id] = group
    return blocks


def _crossings(objects: MapObjects) -> tuple[tuple[Array, ...], tuple[Repair, ...]]:
    """The rings (M, 2) of all crossings."""
    found = [
        simple_crossing(shapely.get_coordinates(part.exterior), objects.ids[row])
        for row in objects.rows(CROSSWALK)
        for part in _parts(objects, row) or [Polygon()]
    ]
    return tuple(ring for ring, _ in found if ring is not None), tuple(chain(*(repairs for _, repairs in found)))


def _areas(
    objects: MapObjects, rows: Iterable[int], prefix: str, layer: MapLayer
) -> tuple[tuple[MapPolygon, ...], tuple[Repair, ...]]:
    """The polygons of some rows, those of one row after its first numbered."""
    areas: list[MapPolygon] = []
    repairs: list[Repair] = []
    for row in rows:
        parts, found = _rings(objects, row, "area")
        repairs += found
        for part, (ring, holes) in enumerate(parts):
            areas.append(MapPolygon(f"{prefix}_{objects.ids[row]}" + f"_{part}" * bool(part), layer, ring, holes))
    return tuple(areas), tuple(repairs)


def _parts(objects: MapObjects, row: int) -> list[Polygon]:
    """The polygons of the row's shape."""
    parts = shapely.get_parts(objects.shapes[row])
    return [part for part in parts if part.geom_type == "Polygon" and not part.is_empty]


def _rings(
    objects: MapObjects, row: int, what: str
) -> tuple[list[tuple[Array, tuple[Array, ...]]], tuple[Repair, ...]]:
    """Exterior and holes of each polygon of the row's shape that has an area."""
    out, repairs = [], list[Repair]()
    for part in _parts(objects, row) or [Polygon()]:
        ring, found = simple_area(shapely.get_coordinates(part.exterior), objects.ids[row], what)
        repairs += found
        if ring is not None:
            holes = [simple_area(shapely.get_coordinates(hole), objects.ids[row], what) for hole in part.interiors]
            repairs += chain(*(of_hole for _, of_hole in holes))
            out.append((ring, tuple(hole for hole, _ in holes if hole is not None)))
    return out, tuple(repairs)


def _line(objects: MapObjects, lane_id: str, content: Mapping[str, Any], name: str) -> Array:
    """(P, 3) x, y, z; z is 0 where the map is flat. Raises BadClip."""
    line = content.get(name)
    if not isinstance(line, np.ndarray) or line.ndim != 2 or line.shape[1] not in (2, 3):
        raise BadClip(str(objects.file.path), f"{name} of lane {lane_id}", "not a line of two or three coordinates")
    return line if line.shape[1] == 3 else np.column_stack([line, np.zeros(len(line))])


def _names(objects: MapObjects, lane_id: str, content: Mapping[str, Any], name: str) -> tuple[str, ...]:
    ids = content.get(name)
    if not isinstance(ids, list):
        raise BadClip(str(objects.file.path), f"{name} of lane {lane_id}", f"not a list: {shown(ids)}")
    return tuple(named for named in map(id_text, ids) if named is not None)

"""An Argoverse 2 vector map (log_map_archive_*.json) as a RoadMap. Format: Wilson et al. 2021, argoverse/av2-api."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from factory.files import matching
from factory.readers.base import BadClip
from factory.readers.plain_values import id_text
from tasks.world.arrays import Array
from tasks.world.lanes import Lane, MapLayer, MapPolygon, RoadMap
from tasks.world.polygons import centerline_from_boundaries, ring_from_boundaries, valid_ring
from tasks.world.route import roadblocks_of

CAR_LANE_TYPES = {"VEHICLE": True, "BUS": True, "BIKE": False}


def map_file(log_folder: Path) -> Path:
    """The one vector map of a log. Raises BadClip."""
    found = matching(log_folder / "map", "log_map_archive_*.json")
    if len(found) != 1:
        raise BadClip(str(log_folder / "map"), "log_map_archive_*.json", f"expected one vector map, found {len(found)}")
    return found[0]


def read_map(path: Path) -> RoadMap:
    """The log's map, lanes in file order, roadblocks named. Raises BadClip naming the lane or area at fault."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadClip(str(path), "json", f"cannot be read: {error}") from error
    segments = _section(path, content, "lane_segments")
    lanes = {str(key): _lane(path, str(key), value) for key, value in segments.items()}
    if not any(lane.drives_cars for lane in lanes.values()):
        raise BadClip(str(path), "lane_segments", "the map has no VEHICLE or BUS lane")
    areas = tuple(
        MapPolygon(f"da_{key}", MapLayer.DRIVABLE_AREA, _area_ring(path, f"drivable_areas[{key}]", value))
        for key, value in _section(path, content, "drivable_areas").items()
    )
    crossings = tuple(
        _crossing_ring(path, f"pedestrian_crossings[{key}]", value)
        for key, value in _section(path, content, "pedestrian_crossings").items()
    )
    location = path.stem.partition("____")[2]  # e.g. PIT_city_47896
    return RoadMap(lanes, areas, crossings, roadblocks_of(lanes), location)


def _section(path: Path, content: Any, name: str) -> dict[str, Any]:
    section = content.get(name) if isinstance(content, dict) else None
    if not isinstance(section, dict):
        raise BadClip(str(path), name, "missing or not an object")
    return section


def _lane(path: Path, key: str, raw: Any) -> Lane:
    field = f"lane_segments[{key}]"
    try:
        beside = [id_text(raw["left_neighbor_id"]), id_text(raw["right_neighbor_id"])]
        left = _points(path, f"{field}.left_lane_boundary", raw["left_lane_boundary"])
        right = _points(path, f"{field}.right_lane_boundary", raw["right_lane_boundary"])
        return Lane(
            lane_id=key,
            ring=ring_from_boundaries(left, right),
            centerline=centerline_from_boundaries(left, right),
            is_intersection=bool(raw["is_intersection"]),
            drives_cars=CAR_LANE_TYPES[raw["lane_type"]],
            successors=tuple(lane for lane in map(id_text, raw["successors"]) if lane is not None),
            predecessors=tuple(lane for lane in map(id_text, raw["predecessors"]) if lane is not None),
            left_neighbor=beside[0],
            right_neighbor=beside[1],
            left_boundary=left,
            right_boundary=right,
            left_mark=str(raw["left_lane_mark_type"]),
            right_mark=str(raw["right_lane_mark_type"]),
        )
    except KeyError as error:
        raise BadClip(str(path), field, f"missing key or unknown lane type {error}") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise BadClip(str(path), field, str(error)) from error


def _points(path: Path, field: str, raw: Any) -> Array:
    """(B, 3) x, y, z [m], B >= 2."""
    try:
        points = np.array([[point["x"], point["y"], point["z"]] for point in raw], dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BadClip(str(path), field, f"not a list of x, y, z points ({error})") from error
    if len(points) < 2 or not np.isfinite(points).all():
        raise BadClip(str(path), field, "needs at least two finite points")
    return points


def _closed(points: Array) -> Array:
    return points if np.array_equal(points[0], points[-1]) else np.concatenate([points, points[:1]])


def _area_ring(path: Path, field: str, raw: Any) -> Array:
    try:
        return valid_ring(_closed(_points(path, f"{field}.area_boundary", raw["area_boundary"])[:, :2]))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BadClip(str(path), f"{field}.area_boundary", f"not a polygon ({error})") from error


def _crossing_ring(path: Path, field: str, raw: Any) -> Array:
    try:
        edges = [_points(path, f"{field}.{name}", raw[name])[:, :2] for name in ("edge1", "edge2")]
    except (KeyError, TypeError) as error:
        raise BadClip(str(path), field, f"needs edge1 and edge2 ({error})") from error
    return _closed(np.concatenate([edges[0], edges[1][::-1]]))

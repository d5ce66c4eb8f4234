"""ScenarioNet's map features as plain lanes, and which of them are connectors inside a junction.

The public format stores per feature a `type` and a `polyline` and/or `polygon`; what else is there depends on the
converter and its age:

| source   | lane polygon | graph         | neighbours                | connectors                       |
|----------|--------------|---------------|---------------------------|----------------------------------|
| nuScenes | lanes only   | newer files   | never (empty lists)       | no polygon; newer: UNSTRUCTURE   |
| Waymo    | never        | always (ints) | dicts with index ranges   | `interpolating`                  |
| nuPlan   | always       | newer files   | newer: ids, left to right | newer: UNSTRUCTURE               |
(UNSTRUCTURE: type LANE_SURFACE_UNSTRUCTURE)

Where a file marks no connectors at all (older nuPlan conversions), a lane is one when it forks from, merges into or
crosses another lane; in any file a lane that a traffic light governs is one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from scipy.spatial import cKDTree
from shapely.geometry import LineString, Polygon

from factory.readers.base import BadClip
from factory.readers.plain_values import id_text
from factory.readers.scenarionet.tracks import floats
from factory.wording import shown
from tasks.world.arrays import Array
from tasks.world.polygons import arc_lengths, n_spaced, resample

CAR_LANE_KINDS = frozenset({"LANE_SURFACE_STREET", "LANE_SURFACE_UNSTRUCTURE", "LANE_FREEWAY", "LANE_UNKNOWN"})
LANE_KINDS = CAR_LANE_KINDS | {"LANE_BIKE_LANE"}
HALF_WIDTH_M = 1.75  # of a lane that comes without a polygon (FORMATS: connectors buffered by ~1.75 m)
BIKE_HALF_WIDTH_M = 0.75
JOINT_M = 0.5  # end-to-start distance of joined lanes: precision 1.00, recall 0.99-1.00 on two known scenes
MPH = 0.44704


@dataclass(frozen=True)
class RawLane:
    """One lane as the file has it; ids as text."""

    lane_id: str
    kind: str
    line: Array  # (P, 2) centreline, uniformly resampled, metres
    ring: Array  # (M, 2) closed
    has_polygon: bool
    interpolating: bool | None  # Waymo's flag; None where the file has none
    entry: tuple[str, ...] | None  # None where the file has no graph
    exit: tuple[str, ...] | None
    left: str | None
    right: str | None
    speed_limit_mps: float | None


def raw_lanes(features: Mapping[str, Any], source: str, file: str) -> dict[str, RawLane]:
    """All LANE_* features by id, in file order. Raises BadClip for an unknown kind, a lane without a line, or none."""
    lanes: dict[str, RawLane] = {}
    for key, feature in features.items():
        lane_id = id_text(key)
        field = f"map_features[{shown(key) if lane_id is None else lane_id}]"
        if not isinstance(feature, dict) or not isinstance(feature.get("type"), str):
            raise BadClip(file, f"{field}.type", "missing")
        kind = feature["type"]
        if not kind.startswith("LANE_"):
            continue
        if lane_id is None:
            raise BadClip(file, field, "is no id of a lane, expected text or a number")
        if kind not in LANE_KINDS:
            raise BadClip(file, f"{field}.type", f"unknown lane class {shown(kind)}")
        line = resampled_line(points(feature, "polyline", file, field), file, f"{field}.polyline")
        if line is None:  # a lane shorter than a centimetre leads nowhere
            continue
        ring = _ring(feature, line, kind, file, field)
        lanes[lane_id] = RawLane(
            lane_id=lane_id,
            kind=kind,
            line=line,
            ring=ring,
            has_polygon="polygon" in feature,
            interpolating=_flag(feature, "interpolating", file, field),
            entry=_ids(feature.get("entry_lanes")),
            exit=_ids(feature.get("exit_lanes")),
            left=_neighbour(feature, "left_neighbor", -1, file, field),
            right=_neighbour(feature, "right_neighbor", 0, file, field),
            speed_limit_mps=_speed_limit(feature, source),
        )
    if not any(lane.kind in CAR_LANE_KINDS for lane in lanes.values()):
        raise BadClip(file, "map_features", "the map is empty: no lane for cars")
    return lanes


def points(feature: Mapping[str, Any], name: str, file: str, field: str) -> Array:
    """(N, 2) finite points of a polyline or polygon. Raises BadClip."""
    if name not in feature:
        raise BadClip(file, f"{field}.{name}", "missing")
    try:
        array = np.asarray(feature[name], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadClip(file, f"{field}.{name}", f"not an array of points ({error})") from error
    if array.ndim != 2 or array.shape[1] < 2 or len(array) == 0:
        raise BadClip(file, f"{field}.{name}", f"shape {array.shape}, expected (N, 2) or (N, 3)")
    if not np.isfinite(array[:, :2]).all():
        raise BadClip(file, f"{field}.{name}", "NaN or infinite coordinate")
    return array[:, :2]


def closed_ring(polygon: Array) -> Array | None:
    """(M, 2) closed exterior of the largest valid part; None where no area is left."""
    if len(polygon) < 3:
        return None
    shape = Polygon(polygon)
    if not shape.is_valid:
        parts = shapely.get_parts(shapely.make_valid(shape, method="structure", keep_collapsed=False))
        if len(parts) == 0:
            return None
        shape = max(parts, key=lambda part: part.area)
    return np.asarray(shape.exterior.coords)[:, :2] if shape.area > 0.0 else None


def connector_ids(lanes: Mapping[str, RawLane], lit: frozenset[str]) -> frozenset[str]:
    """Lanes inside a junction, by the rules at the top of this file; `lit` = lanes that a traffic light governs."""
    cars = {lane_id: lane for lane_id, lane in lanes.items() if lane.kind in CAR_LANE_KINDS}
    some_polygons = any(lane.has_polygon for lane in cars.values())
    marked = {
        lane_id
        for lane_id, lane in cars.items()
        if lane.kind == "LANE_SURFACE_UNSTRUCTURE" or lane.interpolating or (some_polygons and not lane.has_polygon)
    }
    if not marked and not any(lane.interpolating is not None for lane in cars.values()):
        marked = _forking_merging_crossing(cars)
    return frozenset(marked | (lit & cars.keys()))


def _forking_merging_crossing(lanes: Mapping[str, RawLane]) -> set[str]:
    """Lanes that share a start or an end with another lane, or cross one."""
    ids = list(lanes)
    found: set[str] = set()
    for end in (0, -1):
        shared = cKDTree([lanes[i].line[end] for i in ids]).query_pairs(JOINT_M)
        found.update(ids[k] for pair in shared for k in pair)
    inner = [LineString(lanes[i].line[1:-1] if len(lanes[i].line) > 3 else lanes[i].line) for i in ids]
    crossing, _ = shapely.STRtree(inner).query(inner, predicate="crosses")
    return found | {ids[k] for k in crossing}


def _ring(feature: Mapping[str, Any], line: Array, kind: str, file: str, field: str) -> Array:
    if "polygon" in feature:
        ring = closed_ring(points(feature, "polygon", file, field))
        if ring is not None:
            return ring
    half = BIKE_HALF_WIDTH_M if kind == "LANE_BIKE_LANE" else _half_width(feature, file, field)
    return np.asarray(LineString(line).buffer(half, cap_style="flat").exterior.coords)


def _half_width(feature: Mapping[str, Any], file: str, field: str) -> float:
    """Half of the lane's median width where Waymo's converter measured it to the painted lines, else the default."""
    if "width" not in feature:
        return HALF_WIDTH_M
    widths = floats(feature["width"], file, f"{field}.width")
    measured = widths[(widths > 1.0) & (widths < 3.0)]  # zeros: no line on that side; more: not this lane's line
    return float(np.median(measured)) if len(measured) else HALF_WIDTH_M


def resampled_line(line: Array, file: str, field: str) -> Array | None:
    """The line (P, 2) at uniform arc length, <= 0.75 m apart; None when it has no length. Raises BadClip over 20 km."""
    line = line[np.concatenate([[True], np.hypot(*np.diff(line, axis=0).T) > 1e-6])]
    length = arc_lengths(line)[-1]
    if length < 0.01:
        return None
    try:
        return resample(line, n_spaced(length))
    except ValueError as error:
        raise BadClip(file, field, str(error)) from error


def _ids(value: object) -> tuple[str, ...] | None:
    if not isinstance(value, list | tuple | set | np.ndarray):
        return None
    return tuple(name for name in map(id_text, value) if name is not None)


def _flag(feature: Mapping[str, Any], name: str, file: str, field: str) -> bool | None:
    value = feature.get(name)
    if not isinstance(value, bool | np.bool_ | None):
        raise BadClip(file, f"{field}.{name}", f"{shown(value)} is neither true nor false")
    return None if value is None else bool(value)


def _neighbour(feature: Mapping[str, Any], name: str, nearest: int, file: str, field: str) -> str | None:
    """Nearest neighbour: nuPlan lists ids from left to right, Waymo dicts with index ranges (the longest counts)."""
    value = feature.get(name)
    if not isinstance(value, Sequence) or isinstance(value, str | bytes) or not value:
        return None
    if not isinstance(value[nearest], dict):
        return id_text(value[nearest])
    try:
        longest = max(value, key=lambda item: int(item["self_end_index"]) - int(item["self_start_index"]))
        return id_text(longest["feature_id"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BadClip(
            file, f"{field}.{name}", f"no feature_id with an index range ({type(error).__name__}: {error})"
        ) from error


def _speed_limit(feature: Mapping[str, Any], source: str) -> float | None:
    """m/s. nuScenes has none: its converter writes a constant 100 km/h on connectors."""
    if source == "nuscenes":
        return None
    for name, unit in (("speed_limit_mph", MPH), ("speed_limit_kmh", 1.0 / 3.6)):
        value = feature.get(name)
        if isinstance(value, int | float | np.number) and np.isfinite(value) and value > 0:
            return float(value) * unit
    return None

"""From ScenarioNet's map features to a RoadMap: lane graph, neighbours, drivable area, crossings, lights."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import chain
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely.geometry import LineString, Polygon

from factory.readers.base import BadClip, id_text
from factory.wording import shown
from tasks.world.arrays import Array
from tasks.world.repair.records import Repair
from tasks.world.repair.road import finite_points, left_out_lanes, line_fault, map_repair, simple_area, simple_crossing
from tasks.world.repair.tracks import MOST
from tasks.world.road_map import (
    Lane,
    LightState,
    MapLayer,
    MapPolygon,
    RoadMap,
    TrafficLights,
    arc_lengths,
    n_spaced,
    resample,
    roadblocks_of,
    with_headings,
)

# ScenarioNet's map features as plain lanes, and which of them are connectors inside a junction.
#
# The public format stores per feature a `type` and a `polyline` and/or `polygon`; what else is there depends on the
# converter and its age:
#
# | source   | lane polygon | graph         | neighbours                | connectors                       |
# |----------|--------------|---------------|---------------------------|----------------------------------|
# | nuScenes | lanes only   | newer files   | never (empty lists)       | no polygon; newer: UNSTRUCTURE   |
# | Waymo    | never        | always (ints) | dicts with index ranges   | `interpolating`                  |
# | nuPlan   | always       | newer files   | newer: ids, left to right | newer: UNSTRUCTURE               |
# (UNSTRUCTURE: type LANE_SURFACE_UNSTRUCTURE)
#
# Where a file marks no connectors at all (older nuPlan conversions), a lane is one when it forks from, merges into or
# crosses another lane; in any file a lane that a traffic light governs is one.

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


def raw_lanes(features: Mapping[str, Any], source: str, file: str) -> tuple[dict[str, RawLane], tuple[Repair, ...]]:
    """All LANE_* features by id, in file order; and what is not as the file has it.

    Doubled points of a centreline are no repair: it is resampled, and they change nothing. Raises BadClip for an
    unknown kind, a lane without a polyline, and where no lane for cars is left.
    """
    lanes: dict[str, RawLane] = {}
    repairs: list[Repair] = []
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
        finite, lost = finite_points(points(feature, "polyline", file, field), "lane", lane_id, "polyline")
        try:
            line = resampled_line(finite)
        except ValueError as error:
            repairs.append(map_repair("lane", lane_id, str(error)))
            continue
        ring, of_ring = _ring(feature, line, lane_id, kind, file, field)
        repairs += (*lost, *of_ring)
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
        raise BadClip(file, "map_features", f"the map is empty: no lane for cars{left_out_lanes(repairs)}")
    return lanes, tuple(repairs)


def points(feature: Mapping[str, Any], name: str, file: str, field: str) -> Array:
    """(N, 2) points of a polyline or polygon. Raises BadClip."""
    if name not in feature:
        raise BadClip(file, f"{field}.{name}", "missing")
    try:
        array = np.asarray(feature[name], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadClip(file, f"{field}.{name}", f"not an array of points ({error})") from error
    if array.size == 0:
        return np.empty((0, 2))
    if array.ndim != 2 or array.shape[1] < 2:
        raise BadClip(file, f"{field}.{name}", f"shape {array.shape}, expected (N, 2) or (N, 3)")
    return array[:, :2]


def as_floats(value: object, file: str, field: str) -> Array:
    """The value as an array. Raises BadClip where it is none of numbers."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadClip(file, field, f"not numbers ({error})") from error


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


def _ring(
    feature: Mapping[str, Any], line: Array, lane_id: str, kind: str, file: str, field: str
) -> tuple[Array, tuple[Repair, ...]]:
    half = BIKE_HALF_WIDTH_M if kind == "LANE_BIKE_LANE" else _half_width(feature, file, field)
    found: tuple[Repair, ...] = ()
    if "polygon" in feature:
        outline, found = finite_points(points(feature, "polygon", file, field), "lane", lane_id, "polygon")
        ring = closed_ring(outline)
        if ring is not None:
            return ring, found
        found = (map_repair("lane", lane_id, "polygon of no area", f"{2.0 * half:g} m wide along its centreline"),)
    return np.asarray(LineString(line).buffer(half, cap_style="flat").exterior.coords), found


def _half_width(feature: Mapping[str, Any], file: str, field: str) -> float:
    """Half of the lane's median width where Waymo's converter measured it to the painted lines, else the default."""
    if "width" not in feature:
        return HALF_WIDTH_M
    widths = as_floats(feature["width"], file, f"{field}.width")
    measured = widths[(widths > 1.0) & (widths < 3.0)]  # zeros: no line on that side; more: not this lane's line
    return float(np.median(measured)) if len(measured) else HALF_WIDTH_M


def resampled_line(line: Array) -> Array:
    """The line (N, 2) at uniform arc length, <= 0.75 m apart: (P, 2). Raises ValueError where it is no lane's."""
    line = line[np.concatenate([[True], np.hypot(*np.diff(line, axis=0).T) > 1e-6])[: len(line)]]
    if fault := line_fault(line):
        raise ValueError(fault)
    return resample(line, n_spaced(arc_lengths(line)[-1]))


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


SEAM_M = 0.3  # gaps up to twice this between neighbouring lane polygons are closed in the drivable area
SIMPLIFY_M = 0.05
SURFACE_MARGIN_M = 50.0
PIECE_POINTS, PIECE_M, SEAM_OVERLAP_M = 256, 10.0, 0.1  # see pieces()
NEIGHBOUR_GAP_M = 0.6  # between the edges of two lanes that lie side by side
NEIGHBOUR_REACH_M = 8.0
NEIGHBOUR_PROBES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])  # fractions of the lane's length
NEIGHBOUR_VOTES = 2  # of the five probes

# Waymo's signal states and MetaDrive's four; a flashing red is a stop sign, not a phase.
_LIGHTS = {
    LightState.GREEN: ("LANE_STATE_GO", "LANE_STATE_ARROW_GO", "TRAFFIC_LIGHT_GREEN"),
    LightState.YELLOW: (*(f"LANE_STATE_{kind}CAUTION" for kind in ("", "ARROW_", "FLASHING_")), "TRAFFIC_LIGHT_YELLOW"),
    LightState.RED: ("LANE_STATE_STOP", "LANE_STATE_ARROW_STOP", "TRAFFIC_LIGHT_RED"),
    LightState.UNKNOWN: (None, "None", "LANE_STATE_UNKNOWN", "LANE_STATE_FLASHING_STOP", "TRAFFIC_LIGHT_UNKNOWN"),
}
LIGHT_STATES: dict[object, LightState] = {name: state for state, names in _LIGHTS.items() for name in names}


def road_map(
    features: Mapping[str, Any], lit_lanes: tuple[str, ...], source: str, location: str, file: str
) -> tuple[RoadMap, tuple[Repair, ...]]:
    """The vector map of one scenario, and what is not as the file has it. Raises BadClip naming the broken feature."""
    raw, repairs = raw_lanes(features, source, file)
    connectors = connector_ids(raw, frozenset(lit_lanes))
    successors = lane_graph(raw)
    predecessors: dict[str, list[str]] = {lane_id: [] for lane_id in raw}
    for lane_id, exits in successors.items():
        for successor in exits:
            predecessors[successor].append(lane_id)
    left, right = neighbours(raw, connectors)
    lanes = {
        lane_id: Lane(
            lane_id=lane_id,
            ring=lane.ring,
            centerline=with_headings(lane.line),
            is_intersection=lane_id in connectors,
            drives_cars=lane.kind in CAR_LANE_KINDS,
            successors=successors[lane_id],
            predecessors=tuple(predecessors[lane_id]),
            left_neighbor=left.get(lane_id),
            right_neighbor=right.get(lane_id),
            speed_limit_mps=lane.speed_limit_mps,
        )
        for lane_id, lane in raw.items()
    }
    areas, of_areas = _drivable_areas(features, raw, file)
    crossings, of_crossings = _crossings(features, file)
    return RoadMap(lanes, areas, crossings, roadblocks_of(lanes), location), (*repairs, *of_areas, *of_crossings)


def lane_graph(raw: Mapping[str, RawLane]) -> dict[str, tuple[str, ...]]:
    """Lane id -> successors: the file's own exit and entry lanes, else every lane that starts < 0.5 m from its end."""
    if any(lane.exit or lane.entry for lane in raw.values()):
        exits = {lane_id: dict.fromkeys(e for e in lane.exit or () if e in raw) for lane_id, lane in raw.items()}
        for lane_id, lane in raw.items():
            for entry in lane.entry or ():
                if entry in raw:
                    exits[entry].setdefault(lane_id)
        return {lane_id: tuple(found) for lane_id, found in exits.items()}
    ids = list(raw)
    joined = cKDTree([raw[i].line[0] for i in ids]).query_ball_point([raw[i].line[-1] for i in ids], JOINT_M)
    drives = [raw[i].kind in CAR_LANE_KINDS for i in ids]  # a car lane does not lead onto a bicycle lane
    return {
        lane_id: tuple(ids[k] for k in sorted(joined[row]) if k != row and drives[k] == drives[row])
        for row, lane_id in enumerate(ids)
    }


def neighbours(raw: Mapping[str, RawLane], connectors: frozenset[str]) -> tuple[dict[str, str], dict[str, str]]:
    """(left, right) lane id -> the lane beside it, in either driving direction.

    The file's own links where it has any, else by geometry: rays to the side from five points of a lane; the lane whose
    polygon begins where its own ends, seen by at least two of the rays. Connectors have none (docs/reward.md 0 joins
    them by what they connect).
    """
    left = {lane_id: lane.left for lane_id, lane in raw.items() if lane.left}
    right = {lane_id: lane.right for lane_id, lane in raw.items() if lane.right}
    if left or right:
        return left, right
    lanes = [lane for lane in raw.values() if lane.kind in CAR_LANE_KINDS and lane.lane_id not in connectors]
    return _beside(lanes, side=1.0), _beside(lanes, side=-1.0)


def _beside(lanes: list[RawLane], side: float) -> dict[str, str]:
    """Lane id -> lane seen to the left (side 1) or right (side -1)."""
    if not lanes:
        return {}
    shapes = np.array([Polygon(lane.ring) for lane in lanes])
    rows = np.array([np.rint(NEIGHBOUR_PROBES * (len(lane.line) - 2)).astype(int) for lane in lanes])
    origin, after = (
        np.concatenate([lane.line[row + step] for lane, row in zip(lanes, rows, strict=True)]) for step in (0, 1)
    )
    ahead = after - origin
    across = side * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.hypot(*ahead.T)[:, None]
    rays = shapely.linestrings(np.stack([origin, origin + NEIGHBOUR_REACH_M * across], axis=1))
    starts = shapely.points(origin)
    owner = np.repeat(np.arange(len(lanes)), len(NEIGHBOUR_PROBES))
    own_edge = shapely.distance(starts, shapely.intersection(rays, shapely.boundary(shapes[owner])))
    ray, other = shapely.STRtree(shapes).query(rays, predicate="intersects")
    gap = shapely.distance(starts[ray], shapely.intersection(rays[ray], shapes[other])) - own_edge[ray]
    seen = (other != owner[ray]) & (np.abs(gap) < NEIGHBOUR_GAP_M)
    pairs, votes = np.unique(np.stack([owner[ray[seen]], other[seen]]), axis=1, return_counts=True)
    best: dict[int, tuple[int, int]] = {}  # lane -> (votes, the lane beside it)
    for (row, beside), count in zip(pairs.T.tolist(), votes.tolist(), strict=True):
        if count >= NEIGHBOUR_VOTES and count > best.get(row, (0, 0))[0]:
            best[row] = (count, beside)
    return {lanes[row].lane_id: lanes[beside].lane_id for row, (_, beside) in best.items()}


def traffic_lights(states: Mapping[str, Any], times_s: Array, file: str) -> tuple[TrafficLights, tuple[Repair, ...]]:
    """Lights over the log's own frames, at times (T,); two lights of one lane count as the more restrictive.

    A state that is none is unknown, and told. Raises BadClip, also where most of a light's are none.
    """
    of_lane: dict[str, NDArray[np.int8]] = {}
    done: list[Repair] = []
    for key, light in states.items():
        field = f"dynamic_map_states[{id_text(key) or shown(key)}]"
        try:
            lane_id, names = id_text(light["lane"]), list(light["state"]["object_state"])
        except (KeyError, TypeError, IndexError) as error:
            said = f"{type(error).__name__}: {error}"
            raise BadClip(file, field, f"no lane or no state.object_state ({said})") from error
        if lane_id is None:
            raise BadClip(file, field, f"its lane is {shown(light['lane'])}, expected an id")
        if len(names) != len(times_s):
            raise BadClip(file, f"{field}.state.object_state", f"{len(names)} steps, the log has {len(times_s)}")
        of_names = [LIGHT_STATES.get(name) if isinstance(name, str | None) else None for name in names]
        unknown = [k for k, state in enumerate(of_names) if state is None]
        if len(unknown) > MOST * len(names):
            raise BadClip(
                file, f"{field}.state.object_state", f"unknown light states, first {shown(names[unknown[0]])}"
            )
        for k in unknown:
            done.append(Repair("light", lane_id, float(times_s[k]), f"the state {shown(names[k])}", "unknown"))
        row = np.array([LightState.UNKNOWN if state is None else state for state in of_names], np.int8)
        of_lane[lane_id] = np.maximum(of_lane[lane_id], row) if lane_id in of_lane else row
    columns = list(of_lane.values())
    stacked = np.stack(columns, axis=1) if columns else np.zeros((len(times_s), 0), np.int8)
    return TrafficLights(tuple(of_lane), stacked), tuple(done)


def _drivable_areas(
    features: Mapping[str, Any], raw: Mapping[str, RawLane], file: str
) -> tuple[tuple[MapPolygon, ...], tuple[Repair, ...]]:
    """Union of all car lanes, connectors buffered, and of the drivable surface where the file has its outline.

    nuScenes' and nuPlan's converters write that outline as closed `boundary_<i>` rings, islands and outer rings alike:
    a point is drivable where an odd number of them encloses it. On the seven nuScenes scenes they hold 100.0 % of the
    lane polygons' area, and parking, shoulders and mouths of side streets besides. A nuScenes outline may go on for
    kilometres beyond the lanes of the file: what is further than 50 m from their convex hull is left out.
    """
    shapes = [Polygon(lane.ring) for lane in raw.values() if lane.kind in CAR_LANE_KINDS]
    named = [
        (str(key), feature)
        for key, feature in features.items()
        if str(key).startswith("boundary_") and isinstance(feature, dict) and "polyline" in feature
    ]
    outline, repairs = _outlines(named, "polyline", "area", file)
    closed = (  # as far as the points at the lines' ends are finite
        len(line) > 3 and (not np.isfinite(line[[0, -1]]).all() or np.allclose(line[0], line[-1]))
        for line in outline.values()
    )
    if outline and all(closed):
        found = [simple_area(line, key) for key, line in outline.items()]
        rings = [ring for ring, _ in found if ring is not None]
        repairs = (*repairs, *chain(*(of_ring for _, of_ring in found)))
        surface = reduce(shapely.symmetric_difference, [Polygon(ring) for ring in rings], Polygon())
        near = shapely.convex_hull(shapely.MultiPolygon(shapes)).buffer(SURFACE_MARGIN_M)
        shapes.append(shapely.intersection(surface, near))
    return paved_areas(shapes), repairs


def _outlines(
    named: Iterable[tuple[str, Mapping[str, Any]]], part: str, what: str, file: str
) -> tuple[dict[str, Array], tuple[Repair, ...]]:
    """The points (N, 2) of some features by name; those that have none are left out."""
    outlines, found = dict[str, Array](), list[Repair]()
    for key, feature in named:
        try:
            outline = points(feature, part, file, key)
        except BadClip as error:
            found.append(map_repair(what, key, f"{part}: {error.problem}"))
            continue
        if len(outline):
            outlines[key] = outline
        else:
            found.append(map_repair(what, key, f"{part} without a point"))
    return outlines, tuple(found)


def paved_areas(shapes: Sequence[Polygon]) -> tuple[MapPolygon, ...]:
    """The union of polygons, gaps of up to 0.6 m between them closed, in pieces, largest first."""
    merged = shapely.union_all(shapes).buffer(SEAM_M, join_style="mitre").buffer(-SEAM_M, join_style="mitre")
    whole = sorted(shapely.get_parts(merged.simplify(SIMPLIFY_M)), key=lambda part: -part.area)
    parts = [piece for part in whole for piece in pieces(part)]
    return tuple(
        MapPolygon(
            token=f"da_{index}",
            layer=MapLayer.DRIVABLE_AREA,
            ring=np.asarray(part.exterior.coords)[:, :2],
            holes=tuple(np.asarray(hole.coords)[:, :2] for hole in part.interiors),
        )
        for index, part in enumerate(parts)
    )


def pieces(polygon: Polygon) -> list[Polygon]:
    """The polygon halved across its longer side until no piece has more than 256 points; halves overlap by 0.1 m.

    A town's surface is one polygon of 5,000 points: whole, it would be tested and stored with every clip.
    """
    x0, y0, x1, y1 = polygon.bounds
    if shapely.get_num_coordinates(polygon) <= PIECE_POINTS or max(x1 - x0, y1 - y0) < PIECE_M:
        return [polygon]
    x, y = ((x0 + x1) / 2.0, y1) if x1 - x0 >= y1 - y0 else (x1, (y0 + y1) / 2.0)
    low = shapely.box(x0, y0, x + SEAM_OVERLAP_M, y + SEAM_OVERLAP_M)
    high = shapely.box(x0 if x == x1 else x, y0 if y == y1 else y, x1, y1)
    found = [part for half in (low, high) for part in shapely.get_parts(shapely.intersection(polygon, half))]
    return [piece for part in found if part.geom_type == "Polygon" for piece in pieces(part)]


def _crossings(features: Mapping[str, Any], file: str) -> tuple[tuple[Array, ...], tuple[Repair, ...]]:
    named = ((str(key), feature) for key, feature in features.items() if feature["type"] == "CROSSWALK")
    outlines, repairs = _outlines(named, "polygon", "crossing", file)
    found = [simple_crossing(outline, key) for key, outline in outlines.items()]
    rings = tuple(ring for ring, _ in found if ring is not None)
    return rings, (*repairs, *chain(*(of_ring for _, of_ring in found)))

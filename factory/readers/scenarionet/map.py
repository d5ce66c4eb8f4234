"""From ScenarioNet's map features to a RoadMap: lane graph, neighbours, drivable area, crossings, lights."""

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely.geometry import Polygon

from factory.readers.base import BadClip
from factory.readers.plain_values import id_text
from factory.readers.scenarionet.lanes import (
    CAR_LANE_KINDS,
    JOINT_M,
    RawLane,
    closed_ring,
    connector_ids,
    points,
    raw_lanes,
)
from factory.wording import shown
from tasks.world.arrays import Array
from tasks.world.lanes import Lane, LightState, MapLayer, MapPolygon, RoadMap, TrafficLights
from tasks.world.polygons import with_headings
from tasks.world.route import roadblocks_of

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
    LightState.YELLOW: (
        *(f"LANE_STATE_{kind}CAUTION" for kind in ("", "ARROW_", "FLASHING_")),
        "TRAFFIC_LIGHT_YELLOW",
    ),
    LightState.RED: ("LANE_STATE_STOP", "LANE_STATE_ARROW_STOP", "TRAFFIC_LIGHT_RED"),
    LightState.UNKNOWN: (None, "None", "LANE_STATE_UNKNOWN", "LANE_STATE_FLASHING_STOP", "TRAFFIC_LIGHT_UNKNOWN"),
}
LIGHT_STATES: dict[object, LightState] = {name: state for state, names in _LIGHTS.items() for name in names}


def road_map(features: Mapping[str, Any], lit_lanes: tuple[str, ...], source: str, location: str, file: str) -> RoadMap:
    """The vector map of one scenario. Raises BadClip naming the feature that is broken."""
    raw = raw_lanes(features, source, file)
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
    return RoadMap(
        lanes=lanes,
        drivable_areas=_drivable_areas(features, raw, file),
        crossings=_crossings(features, file),
        roadblock_of=roadblocks_of(lanes),
        location=location,
    )


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


def traffic_lights(states: Mapping[str, Any], n_steps: int, file: str) -> TrafficLights:
    """Lights over the log's own steps; two lights of one lane count as the more restrictive. Raises BadClip."""
    of_lane: dict[str, NDArray[np.int8]] = {}
    for key, light in states.items():
        field = f"dynamic_map_states[{id_text(key) or shown(key)}]"
        try:
            lane_id, names = id_text(light["lane"]), list(light["state"]["object_state"])
        except (KeyError, TypeError, IndexError) as error:
            said = f"{type(error).__name__}: {error}"
            raise BadClip(file, field, f"no lane or no state.object_state ({said})") from error
        if lane_id is None:
            raise BadClip(file, field, f"its lane is {shown(light['lane'])}, expected an id")
        if len(names) != n_steps:
            raise BadClip(file, f"{field}.state.object_state", f"{len(names)} steps, the log has {n_steps}")
        unknown = [name for name in names if not isinstance(name, str | None) or name not in LIGHT_STATES]
        if unknown:
            raise BadClip(file, f"{field}.state.object_state", f"unknown light states, first {shown(unknown[0])}")
        row = np.array([LIGHT_STATES[name] for name in names], np.int8)
        of_lane[lane_id] = np.maximum(of_lane[lane_id], row) if lane_id in of_lane else row
    columns = list(of_lane.values())
    return TrafficLights(tuple(of_lane), np.stack(columns, axis=1) if columns else np.zeros((n_steps, 0), np.int8))


def _drivable_areas(features: Mapping[str, Any], raw: Mapping[str, RawLane], file: str) -> tuple[MapPolygon, ...]:
    """Union of all car lanes, connectors buffered, and of the drivable surface where the file has its outline.

    nuScenes' and nuPlan's converters write that outline as closed `boundary_<i>` rings, islands and outer rings alike:
    a point is drivable where an odd number of them encloses it. On the seven nuScenes scenes they hold 100.0 % of the
    lane polygons' area, and parking, shoulders and mouths of side streets besides. A nuScenes outline may go on for
    kilometres beyond the lanes of the file: what is further than 50 m from their convex hull is left out.
    """
    shapes = [Polygon(lane.ring) for lane in raw.values() if lane.kind in CAR_LANE_KINDS]
    outline = [points(f, "polyline", file, f"map_features[{k}]") for k, f in features.items() if _is_outline(k, f)]
    if outline and all(len(ring) > 3 and np.allclose(ring[0], ring[-1]) for ring in outline):
        rings = [ring for ring in map(closed_ring, outline) if ring is not None]
        surface = reduce(shapely.symmetric_difference, [Polygon(ring) for ring in rings], Polygon())
        near = shapely.convex_hull(shapely.MultiPolygon(shapes)).buffer(SURFACE_MARGIN_M)
        shapes.append(shapely.intersection(surface, near))
    return paved_areas(shapes)


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


def _is_outline(key: object, feature: object) -> bool:
    return str(key).startswith("boundary_") and isinstance(feature, dict) and "polyline" in feature


def _crossings(features: Mapping[str, Any], file: str) -> tuple[Array, ...]:
    rings = (
        closed_ring(points(feature, "polygon", file, f"map_features[{key}]"))
        for key, feature in features.items()
        if feature["type"] == "CROSSWALK"
    )
    return tuple(ring for ring in rings if ring is not None)

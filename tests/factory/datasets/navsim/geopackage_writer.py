"""Any RoadMap as a root of nuPlan's maps, layer by layer and column by column, for tests.

The reader's opposite, with every layer of nuplan-devkit's `maps/nuplan_map`, unread columns included. Lanes keep their
numeric ids as fids where they have one. Drivable areas become car parks and each connector gets an intersection of its
own shape, so that the reward sees the same polygons. nuPlan joins lanes by connectors alone: a lane that follows a
lane directly is not joined to it here.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyproj
import shapely

from tasks.world.arrays import Array
from tasks.world.road_map import Lane, RoadMap

CITIES = {  # location -> version folder, UTM zone
    "sg-one-north": ("9.17.1964", 32648),
    "us-ma-boston": ("9.12.1817", 32619),
    "us-nv-las-vegas-strip": ("9.15.1915", 32611),
    "us-pa-pittsburgh-hazelwood": ("9.17.1937", 32617),
}
ORIGIN = np.array([664_500.0, 3_998_000.0])  # [m] where a map's (0, 0) lies in the zone
SIDES = "left_boundary_fid right_boundary_fid"
LAYERS = {  # -> kind of its geometry, integer columns, columns of numbers, columns of text
    "lanes_polygons": (
        "Polygon",
        f"lane_fid lane_group_fid lane_index lane_type_fid {SIDES} road_type_fid creator_id from_edge_fid to_edge_fid",
        "speed_limit_mps min_speed max_speed width left_offset right_offset",
        "name",
    ),
    "lane_connectors": (
        "LineString",
        "exit_lane_fid entry_lane_fid exit_lane_group_fid entry_lane_group_fid lane_group_connector_fid "
        "intersection_fid turn_type_fid overlap creator_id",
        "speed_limit_mps",
        "traffic_light_stop_line_fids bulb_fids",
    ),
    "gen_lane_connectors_scaled_width_polygons": ("Polygon", f"lane_connector_fid {SIDES}", "", ""),
    "baseline_paths": ("LineString", "lane_fid lane_connector_fid path_type_fid", "", "dubins_node_fids"),
    "boundaries": ("LineString", "boundary_type_fid has_reflectors", "", "boundary_segment_fids"),
    "lane_groups_polygons": ("Polygon", f"{SIDES} from_edge_fid to_edge_fid creator_id", "", ""),
    "lane_group_connectors": ("Polygon", "from_lane_group_fid to_lane_group_fid intersection_fid", "", ""),
    "intersections": ("Polygon", "intersection_type_fid is_mini", "", ""),
    "stop_polygons": ("Polygon", "stop_polygon_type_fid", "", ""),
    "crosswalks": ("Polygon", "is_marked", "", "intersection_fids lane_fids"),
    "walkways": ("Polygon", "", "", ""),
    "carpark_areas": ("Polygon", "", "heading", ""),
    "generic_drivable_areas": ("Polygon", "", "", ""),
    "road_segments": ("Polygon", "", "", "lane_group_fids"),
    "traffic_lights": ("Point", "", "", ""),
    "dubins_nodes": ("Point", "", "radius heading", ""),
}
Row = dict[str, Any]  # fid, shape, and columns; those not given are 0, NaN or ""; None is NULL


class Fids:
    """Whole numbers for names: a name's own digits where they are free, else the next free ones."""

    def __init__(self, lanes: Sequence[str]) -> None:
        self._of = {("lane", name): int(name) for name in lanes if name.isdigit()}
        self._next = max(self._of.values(), default=0) + 1

    def __call__(self, kind: str, name: str) -> int:
        if (kind, name) not in self._of:
            self._of[kind, name] = self._next
            self._next += 1
        return self._of[kind, name]


def town_rows(road_map: RoadMap, origin: Array = ORIGIN, merged: bool = False) -> dict[str, list[Row]]:
    """Layer -> rows of a map, shapes shifted by `origin`; merged: touching connectors share an intersection."""
    fids = Fids(list(road_map.lanes))
    rows: dict[str, list[Row]] = {layer: [] for layer in LAYERS}
    lanes = [lane for lane in road_map.lanes.values() if lane.drives_cars]
    plain = [lane for lane in lanes if not lane.is_intersection]
    connectors = [lane for lane in lanes if lane.is_intersection and _joined(road_map, lane)]
    block_fid = {lane.lane_id: fids("block", road_map.roadblock_of[lane.lane_id]) for lane in lanes}
    ring = lambda points: shapely.Polygon(points + origin)  # noqa: E731
    areas = _intersections([ring(lane.ring) for lane in connectors], merged)
    for k, (shape, _) in enumerate(areas):
        rows["intersections"].append({"fid": fids("intersection", str(k)), "shape": shape})
    crossed = {connectors[i].lane_id: fids("intersection", str(k)) for k, (_, held) in enumerate(areas) for i in held}
    for lane in (*plain, *connectors):
        fid = fids("lane", lane.lane_id)
        sides = {}
        for side, line in (("left", lane.left_boundary), ("right", lane.right_boundary)):
            sides[f"{side}_boundary_fid"] = fids("boundary", f"{side} {lane.lane_id}")
            points = (lane.centerline if line is None else line)[:, :2] + origin
            shape = shapely.LineString(points if fid % 2 else points[::-1])  # nuPlan's run either way
            rows["boundaries"].append({"fid": sides[f"{side}_boundary_fid"], "shape": shape})
        line = shapely.LineString(lane.centerline[:, :2] + origin)
        owner = {"lane_fid": None, "lane_connector_fid": None}
        owner["lane_connector_fid" if lane.is_intersection else "lane_fid"] = fid
        rows["baseline_paths"].append({"fid": fids("baseline", lane.lane_id), "shape": line, **owner})
        speed = np.nan if lane.speed_limit_mps is None else lane.speed_limit_mps
        if not lane.is_intersection:
            group = {"lane_fid": fid, "lane_group_fid": block_fid[lane.lane_id], "lane_index": _index(road_map, lane)}
            shared = {"fid": fid, "shape": ring(lane.ring), "speed_limit_mps": speed, **sides}
            rows["lanes_polygons"].append(shared | group)
            continue
        before, after = lane.predecessors[0], lane.successors[0]
        ends = {"exit_lane_fid": fids("lane", before), "entry_lane_fid": fids("lane", after)}
        ends |= {"exit_lane_group_fid": block_fid[before], "entry_lane_group_fid": block_fid[after]}
        ends |= {"lane_group_connector_fid": block_fid[lane.lane_id], "intersection_fid": crossed[lane.lane_id]}
        rows["lane_connectors"].append({"fid": fid, "shape": line, "speed_limit_mps": speed, **ends})
        polygon = {"fid": fids("polygon", lane.lane_id), "shape": ring(lane.ring), "lane_connector_fid": fid}
        rows["gen_lane_connectors_scaled_width_polygons"].append(polygon | sides)
    _add_groups(rows, road_map, plain, connectors, block_fid, crossed, ring)
    for k, area in enumerate(road_map.drivable_areas):
        shape = shapely.Polygon(area.ring + origin, [hole + origin for hole in area.holes])
        rows["carpark_areas"].append({"fid": fids("carpark", str(k)), "shape": shape, "heading": 0.0})
    for k, crossing in enumerate(road_map.crossings):
        rows["crosswalks"].append({"fid": fids("crosswalk", str(k)), "shape": ring(crossing), "is_marked": 1})
    return rows


def _joined(road_map: RoadMap, lane: Lane) -> bool:
    """Whether a connector joins two lanes of the map."""
    return bool(
        lane.predecessors
        and lane.successors
        and lane.predecessors[0] in road_map.lanes
        and lane.successors[0] in road_map.lanes
    )


def _index(road_map: RoadMap, lane: Lane) -> int:
    """Lanes of the same roadblock to the left of it."""
    block, index = road_map.roadblock_of[lane.lane_id], 0
    beside = road_map.lanes.get(lane.left_neighbor or "")
    while beside is not None and road_map.roadblock_of.get(beside.lane_id) == block:
        index += 1
        beside = road_map.lanes.get(beside.left_neighbor or "")
    return index


def _intersections(rings: Sequence[Any], merged: bool) -> list[tuple[Any, list[int]]]:
    """Shapes of intersections and which of the connectors' rings each holds."""
    if not merged:
        return [(ring, [i]) for i, ring in enumerate(rings)]
    whole = shapely.get_parts(shapely.union_all([shapely.make_valid(ring) for ring in rings]))
    return [(part, [i for i, ring in enumerate(rings) if part.intersects(ring)]) for part in whole]


def _add_groups(
    rows: dict[str, list[Row]],
    road_map: RoadMap,
    plain: Sequence[Lane],
    connectors: Sequence[Lane],
    block_fid: Mapping[str, int],
    crossed: Mapping[str, int],
    ring: Any,
) -> None:
    """Lane groups and their connectors: the union of their lanes, its hull where that is in several parts."""
    for layer, lanes in (("lane_groups_polygons", plain), ("lane_group_connectors", connectors)):
        for fid in dict.fromkeys(block_fid[lane.lane_id] for lane in lanes):
            held = [lane for lane in lanes if block_fid[lane.lane_id] == fid]
            shape = shapely.union_all([shapely.make_valid(ring(lane.ring)) for lane in held])
            row: Row = {"fid": fid, "shape": shape if shape.geom_type == "Polygon" else shape.convex_hull}
            if layer == "lane_group_connectors":
                row["from_lane_group_fid"] = block_fid[held[0].predecessors[0]]
                row["to_lane_group_fid"] = block_fid[held[0].successors[0]]
                row["intersection_fid"] = crossed[held[0].lane_id]
            rows[layer].append(row)


def stub_rows(origin: Array = ORIGIN, scale: float = 1.0) -> dict[str, list[Row]]:
    """One straight road of two lanes and the connector between them: enough for nuPlan's code to open the city.

    scale: of its 110 m. Above 1 its lines have a point every 5 m or so, as nuPlan's traffic needs to drive on it.
    """
    rows: dict[str, list[Row]] = {layer: [] for layer in LAYERS}
    spans = {1: (0.0, 50.0), 2: (60.0, 110.0), 3: (50.0, 60.0)}
    for k, (x0, x1) in ((k, (scale * x0, scale * x1)) for k, (x0, x1) in spans.items()):
        box = shapely.box(origin[0] + x0, origin[1] - 2.0, origin[0] + x1, origin[1] + 2.0)
        along = np.linspace(x0, x1, 2 if scale == 1.0 else int((x1 - x0) / 5.0) + 1)
        line = shapely.LineString(np.column_stack([along, np.zeros(len(along))]) + origin)
        rows["boundaries"].append({"fid": 10 + k, "shape": line})
        owner = {"lane_fid": k if k < 3 else None, "lane_connector_fid": k if k == 3 else None}
        rows["baseline_paths"].append({"fid": 20 + k, "shape": line, **owner})
        sides = {"left_boundary_fid": 10 + k, "right_boundary_fid": 10 + k}
        if k < 3:
            rows["lanes_polygons"].append({"fid": k, "shape": box, "lane_fid": k, "lane_group_fid": 30 + k} | sides)
            rows["lane_groups_polygons"].append({"fid": 30 + k, "shape": box})
            continue
        ends = {"exit_lane_fid": 1, "entry_lane_fid": 2, "lane_group_connector_fid": 33, "intersection_fid": 50}
        rows["lane_connectors"].append({"fid": 3, "shape": line, **ends})
        polygon = {"fid": 40, "shape": box, "lane_connector_fid": 3}
        rows["gen_lane_connectors_scaled_width_polygons"].append(polygon | sides)
        groups = {"from_lane_group_fid": 31, "to_lane_group_fid": 32, "intersection_fid": 50}
        rows["lane_group_connectors"].append({"fid": 33, "shape": box, **groups})
        rows["intersections"].append({"fid": 50, "shape": box})
    return rows


def write_root(root: Path, location: str, rows: Mapping[str, Sequence[Row]]) -> Path:
    """A maps' root with the city's rows and the other three cities as stubs; returns the city's map.gpkg."""
    root.mkdir(parents=True, exist_ok=True)
    index = {name: {"version": version, "layers": {}} for name, (version, _) in CITIES.items()}
    (root / "nuplan-maps-v1.0.json").write_text(json.dumps(index), encoding="utf-8")
    for name, (version, zone) in CITIES.items():
        write_geopackage(root / name / version / "map.gpkg", rows if name == location else stub_rows(), zone)
    return root / location / CITIES[location][0] / "map.gpkg"


def write_geopackage(path: Path, rows: Mapping[str, Sequence[Row]], zone: int, stored_in: int = 4326) -> None:
    """Shapes are given in UTM `zone` (EPSG) and stored in `stored_in`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    keys = np.array(["projectedCoordSystem", "geographicCoordSystem"], dtype=object)
    values = np.array([f"epsg:{zone}", f"epsg:{stored_in}"], dtype=object)
    pyogrio.raw.write(path, None, [keys, values], ["key", "value"], layer="meta", driver="GPKG")
    to_stored = pyproj.Transformer.from_crs(zone, stored_in, always_xy=True)
    for layer, held in rows.items():
        kind, whole, numbers, texts = LAYERS[layer]
        shapes = shapely.transform(
            np.array([row["shape"] for row in held], dtype=object),
            lambda xy: np.column_stack(to_stored.transform(xy[:, 0], xy[:, 1])),
        )
        fields = ["fid", *whole.split(), *numbers.split(), *texts.split()]
        data, masks = [], []
        for field in fields:
            blank, dtype = (0, np.int64) if field in ("fid", *whole.split()) else (np.nan, np.float64)
            if field in texts.split():
                blank, dtype = "", np.dtype(object)
            found = [row.get(field, blank) for row in held]
            masks.append(np.array([value is None for value in found], dtype=bool))
            data.append(np.array([blank if value is None else value for value in found], dtype=dtype))
        pyogrio.raw.write(
            path, np.array(shapely.to_wkb(shapes), dtype=object), data, fields, field_mask=masks, layer=layer,
            driver="GPKG", geometry_type=kind, crs=f"EPSG:{stored_in}", append=True, layer_options={"FID": "fid"},
        )  # fmt: skip

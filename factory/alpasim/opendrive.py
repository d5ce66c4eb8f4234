"""A road map as OpenDRIVE 1.7 (ASAM), in the way that AlpaSim reads it: a road of one lane for each lane of cars.

AlpaSim reads with NVlabs/trajdata a2a54e5 (src/trajdata/dataset_specific/xodr): lines and arcs alone, two samples of
each up to 1 m, and edges around every road, so also between lanes side by side. Its score asks whether lanes together
contain the body before it looks at an edge: so that there is no gap between two, lanes overlap.
"""

import xml.etree.ElementTree as ET

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon

from tasks.world.arrays import Array
from tasks.world.road_map import Lane, RoadMap

SAMPLE_M = 0.99  # along a lane, and no arc between two is longer than 1 m
OVERLAP_M = 0.05  # that a lane is wider on either side
TOLERANCE_M = 0.01  # of widths and heights
LEAST_CURVATURE = 1e-6  # [1/m] less is a line


def opendrive(road_map: RoadMap, origin: Array) -> bytes:
    """The file's bytes, of metres from `origin` (3,); heights are 0 where the map has none."""
    lanes = [lane for lane in road_map.lanes.values() if lane.drives_cars and lane.length_m > SAMPLE_M / 10.0]
    number = {lane.lane_id: k for k, lane in enumerate(lanes)}
    edges = {(number[a.lane_id], number[b]) for a in lanes for b in a.successors if b in number}
    edges |= {(number[a], number[b.lane_id]) for b in lanes for a in b.predecessors if a in number}
    after = [sorted(b for a, b in edges if a == k) for k in range(len(lanes))]
    before = [sorted(a for a, b in edges if b == k) for k in range(len(lanes))]
    forks = [k for k, bs in enumerate(after) if len(bs) > 1 or any(lanes[b].is_intersection for b in bs)]
    junction_of = {b: len(lanes) + k for k in reversed(forks) for b in after[k]}  # ids of roads and junctions differ
    root = ET.Element("OpenDRIVE")
    (west, south), (east, north) = (
        reach([reach(lane.ring, axis=0) for lane in lanes], axis=0) - origin[:2] for reach in (np.min, np.max)
    )
    extent = {"north": north, "south": south, "east": east, "west": west}
    ends = {name: f"{value:.3f}" for name, value in extent.items()}
    ET.SubElement(root, "header", ends, revMajor="1", revMinor="7", name=road_map.location)
    has_heights = any(line is not None and line[:, 2].any() for lane in lanes for line in _sides(lane))
    for k, lane in enumerate(lanes):
        road, only = _road(lane, origin, k, has_heights)
        road.set("junction", str(junction_of.get(k, -1)))
        root.append(road)
        for end, others in (("predecessor", before[k]), ("successor", after[k])):
            if end == "successor" and k in forks:
                ET.SubElement(_within(road, "link"), end, elementType="junction", elementId=str(len(lanes) + k))
            elif len(others) == 1:
                point = "start" if end == "successor" else "end"
                told = {"elementType": "road", "elementId": str(others[0]), "contactPoint": point}
                ET.SubElement(_within(road, "link"), end, told)
                ET.SubElement(_within(only, "link"), end, id="-1")
    for k in forks:
        junction = ET.SubElement(root, "junction", id=str(len(lanes) + k), name="")
        for row, b in enumerate(after[k]):
            ends = {"incomingRoad": str(k), "connectingRoad": str(b), "contactPoint": "start"}
            connection = ET.SubElement(junction, "connection", ends, id=str(row))
            ET.SubElement(connection, "laneLink", {"from": "-1", "to": "-1"})
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


def _within(parent: ET.Element, name: str) -> ET.Element:
    """The child of that name, the first to stand there."""
    child = parent.find(name)
    if child is None:
        child = ET.Element(name)
        parent.insert(0, child)
    return child


def _road(lane: Lane, origin: Array, number: int, has_heights: bool) -> tuple[ET.Element, ET.Element]:
    """A road that runs along the lane's centreline, and its one lane."""
    line = LineString(lane.centerline[:, :2] - origin[:2])
    apart = np.append(np.arange(0.0, line.length - 1e-3, SAMPLE_M), line.length)
    points = shapely.get_coordinates(line.interpolate(apart))
    chords = np.diff(points, axis=0)
    ways = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
    joints = np.pad((ways[1:] + ways[:-1]) / 2.0, 1)  # headings: of the two chords that meet, an arc's at the ends
    inner = joints[[1, -2]] if len(ways) > 1 else ways[[0, 0]]
    joints[[0, -1]] = 2.0 * ways[[0, -1]] - inner
    turns = np.diff(joints)
    lengths = np.hypot(*chords.T) / np.sinc(turns / 2.0 / np.pi)
    s = np.concatenate([[0.0], np.cumsum(lengths)])
    road = ET.Element("road", id=str(number), name=lane.lane_id, length=f"{s[-1]:.6f}")
    plan = ET.SubElement(road, "planView")
    for at, (x, y), heading, length, turn in zip(s, points, ways - turns / 2.0, lengths, turns):
        told = {"s": at, "x": x, "y": y, "hdg": heading, "length": length}
        piece = ET.SubElement(plan, "geometry", {name: f"{value:.6f}" for name, value in told.items()})
        bends = abs(turn / length) >= LEAST_CURVATURE
        ET.SubElement(piece, "arc" if bends else "line", {"curvature": f"{turn / length:.8f}"} if bends else {})
    width = np.sum([_reach(lane, side, points + origin[:2]) + OVERLAP_M for side in _sides(lane)], axis=0)
    _linear(
        ET.SubElement(road, "elevationProfile"), "elevation", s, _heights(lane, s, origin) if has_heights else 0.0 * s
    )
    lanes = ET.SubElement(road, "lanes")
    _linear(lanes, "laneOffset", s, width / 2.0)
    section = ET.SubElement(lanes, "laneSection", s="0.0")
    ET.SubElement(ET.SubElement(section, "center"), "lane", id="0", type="none", level="false")
    only = ET.SubElement(ET.SubElement(section, "right"), "lane", id="-1", type="driving", level="false")
    _linear(only, "width", s, width, "sOffset")
    return road, only


def _sides(lane: Lane) -> tuple[Array | None, Array | None]:
    return lane.left_boundary, lane.right_boundary


def _reach(lane: Lane, side: Array | None, points: Array) -> Array:
    """(n,) from points of the centreline to a side of the lane [m]; by its area where the map has no sides."""
    if side is None or len(side) < 2:
        return np.full(len(points), Polygon(lane.ring).area / lane.length_m / 2.0)
    return np.asarray(shapely.distance(shapely.points(points), LineString(side[:, :2])), np.float64)


def _heights(lane: Lane, s: Array, origin: Array) -> Array:
    """(n,) above the origin, midway between the sides; level with it where a lane has none."""
    found = []
    for side in (side for side in _sides(lane) if side is not None):
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(side[:, :2], axis=0).T))])
        found.append(np.interp(s / s[-1] * along[-1], along, side[:, 2]))
    return np.mean(found, axis=0) - origin[2] if found else 0.0 * s


def _linear(parent: ET.Element, name: str, s: Array, values: Array, at: str = "s") -> None:
    """Values along a road as polynomials of the first degree, as few as come within the tolerance."""
    knots = shapely.get_coordinates(LineString(np.column_stack([s, values])).simplify(TOLERANCE_M))
    slopes = np.append(np.diff(knots[:, 1]) / np.diff(knots[:, 0]), 0.0)
    for (where, a), b in zip(knots[:-1], slopes):
        ET.SubElement(parent, name, {at: f"{where:.6f}", "a": f"{a:.6f}", "b": f"{b:.8f}", "c": "0", "d": "0"})

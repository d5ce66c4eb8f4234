"""The map in OpenDRIVE lies where the lanes do, evaluated as the standard says (ASAM OpenDRIVE 1.7, 9 and 11)."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString

from factory.alpasim.opendrive import OVERLAP_M, opendrive
from factory.datasets.av2.reader import map_file, read_map
from tasks.world.road_map import Lane, RoadMap
from tests.factory.datasets.av2.test_av2 import write_log
from tests.tasks.streets import street_clip

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def town(small_town: Path) -> RoadMap:
    """Streets that bend, junctions, forks and merges."""
    return read_map(map_file(next(folder for folder in sorted(small_town.iterdir()) if folder.is_dir())))[0]


def number(element: ET.Element, name: str) -> float:
    return float(element.attrib[name])


def polynomial(pieces: list[ET.Element], s: Array, at: str = "s") -> Array:
    which = np.searchsorted([number(piece, at) for piece in pieces], s, side="right") - 1
    a, b, begin = (np.array([number(piece, name) for piece in pieces])[which] for name in ("a", "b", at))
    return np.asarray(a + b * (s - begin))


def walked(road: ET.Element, step: float = 0.05) -> tuple[Array, Array, Array]:
    """s, places (n, 2) and headings along the reference line, every arc walked in small steps."""
    s, places, headings = [], [], []
    for piece in road.findall("planView/geometry"):
        (shape,) = piece
        along = np.linspace(0.0, number(piece, "length"), max(2, round(number(piece, "length") / step)))
        turned = number(piece, "hdg") + float(shape.attrib.get("curvature", 0.0)) * along
        middle = (turned[1:] + turned[:-1]) / 2.0
        moved = np.diff(along)[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
        begin = np.array([number(piece, "x"), number(piece, "y")])
        s.append(number(piece, "s") + along)
        places.append(begin + np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)]))
        headings.append(turned)
    return np.concatenate(s), np.concatenate(places), np.concatenate(headings)


def drawn(road: ET.Element) -> tuple[Array, Array, Array]:
    """Left edge, middle and right edge (n, 2) of the road's one lane."""
    s, places, heading = walked(road)
    across = np.column_stack([-np.sin(heading), np.cos(heading)])
    left = polynomial(road.findall("lanes/laneOffset"), s)
    width = polynomial(road.findall("lanes/laneSection/right/lane/width"), s, "sOffset")
    return tuple(places + t[:, None] * across for t in (left, left - width / 2.0, left - width))  # type: ignore[return-value]


def roads(road_map: RoadMap, origin: Array) -> tuple[ET.Element, dict[str, ET.Element]]:
    root = ET.fromstring(opendrive(road_map, origin))
    return root, {road.attrib["name"]: road for road in root.findall("road")}


def links(root: ET.Element) -> set[tuple[str, str]]:
    """From lane to lane, as roads, lanes and junctions say; ids are those of the map."""
    name = {road.attrib["id"]: road.attrib["name"] for road in root.findall("road")}
    found = set()
    for road in root.findall("road"):
        for end in road.findall("link/*[@elementType='road']"):
            assert road.find(f"lanes/laneSection/right/lane/link/{end.tag}[@id='-1']") is not None
            pair = name[road.attrib["id"]], name[end.attrib["elementId"]]
            found.add(pair if end.tag == "successor" else pair[::-1])
    for way in root.findall("junction/connection"):
        found.add((name[way.attrib["incomingRoad"]], name[way.attrib["connectingRoad"]]))
    return found


def test_lanes_of_a_town_are_where_they_are_and_lead_where_they_lead(town: RoadMap) -> None:
    origin = np.append(next(iter(town.lanes.values())).centerline[0, :2], 2.0)
    root, made = roads(town, origin)
    cars = {lane_id: lane for lane_id, lane in town.lanes.items() if lane.drives_cars}
    assert set(made) == set(cars) and len(cars) > 20
    for lane_id, lane in cars.items():
        left, middle, right = drawn(made[lane_id])
        own = LineString(lane.centerline[:, :2] - origin[:2])
        assert shapely.hausdorff_distance(own, LineString(middle), densify=0.1) < 0.1
        width = np.hypot(*(left - right).T)
        assert np.median(width) == pytest.approx(lane_width(lane) + 2.0 * OVERLAP_M, abs=0.05)
    said = {(a, b) for a, lane in cars.items() for b in lane.successors if b in cars}
    said |= {(a, b) for b, lane in cars.items() for a in lane.predecessors if a in cars}
    assert links(root) == said
    assert {made[b].attrib["junction"] != "-1" for a, b in said if cars[b].is_intersection} == {True}


def lane_width(lane: Lane) -> float:
    assert lane.left_boundary is not None and lane.right_boundary is not None
    middle = shapely.points(lane.centerline[:, :2])
    sides = (lane.left_boundary, lane.right_boundary)
    return float(np.median(sum(shapely.distance(middle, LineString(side[:, :2])) for side in sides)))


def test_heights_are_above_the_origin_and_0_where_the_map_is_flat(tmp_path: Path) -> None:
    road_map = read_map(map_file(write_log(tmp_path / "log-a")))[0]
    for height, above in ((0.0, 0.0), (30.0, 25.0)):
        lanes = {lane_id: lane_at(lane, height * k) for k, (lane_id, lane) in enumerate(sorted(road_map.lanes.items()))}
        _, made = roads(RoadMap(lanes, road_map.drivable_areas), np.array([0.0, 0.0, 5.0]))
        assert number(made["2"].findall("elevationProfile/elevation")[0], "a") == above


def lane_at(lane: Lane, height: float) -> Lane:
    def lift(line: Array | None) -> Array:
        assert line is not None
        return np.column_stack([line[:, :2], np.full(len(line), height)])

    return replace(lane, left_boundary=lift(lane.left_boundary), right_boundary=lift(lane.right_boundary))


def test_a_lane_without_sides_is_as_wide_as_its_area_says() -> None:
    road_map = street_clip().road_map
    lanes = {
        lane_id: replace(lane, left_boundary=None, right_boundary=None)
        for lane_id, lane in road_map.lanes.items()
        if lane.drives_cars
    }
    _, made = roads(replace(road_map, lanes=lanes), np.zeros(3))
    for lane_id, lane in lanes.items():
        left, _, right = drawn(made[lane_id])
        area = shapely.Polygon(np.concatenate([left, right[::-1]])).area
        assert area == pytest.approx(shapely.Polygon(lane.ring).area + 2.0 * OVERLAP_M * lane.length_m, rel=0.02)

"""Argoverse 2 maps that are wrong in one place: put right or left out there, with a record, and the log is read."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely

from factory.datasets.av2.reader import AV2Reader
from tasks.world.clip import Clip
from tasks.world.repair.records import LEFT_OUT, RepairCount, repair_counts
from tasks.world.road_map import LightState
from tests.factory.datasets.av2.test_av2 import START_NS, boundary, edit_map, write_log, write_table

NAN = float("nan")


def lanes_of(content: dict) -> dict:
    return content["lane_segments"]


def bicycle_lane(**changed: object) -> Callable[[dict], object]:
    """A third lane, beside the way, with one thing wrong."""

    def change(content: dict) -> None:
        lane = lanes_of(content)["1"] | {"lane_type": "BIKE", "successors": [], "predecessors": []}
        sides = {"left_lane_boundary": boundary(-20, 60, 4.0), "right_lane_boundary": boundary(-20, 60, 2.0)}
        lanes_of(content)["3"] = lane | sides | changed
        lanes_of(content)["1"]["left_neighbor_id"] = 3
        lanes_of(content)["1"]["successors"] = [2, 3]

    return change


def add_point(content: dict, boundary_points: list[dict], value: float) -> None:
    boundary_points.insert(1, {"x": value, "y": 0.0, "z": 0.0})


def crossing(**changed: object) -> Callable[[dict], object]:
    return lambda content: content["pedestrian_crossings"]["5"].update(changed)


def area(points: object) -> Callable[[dict], object]:
    return lambda content: content["drivable_areas"].update({"8": {"area_boundary": points, "id": 8}})


FAULTS = {
    "edge2 listed the other way round": (crossing(edge2=boundary(53, 50, -2.0)), ("crossing", "5", False)),
    "an edge of one point": (crossing(edge2=boundary(53, 50, -2.0)[:1]), ("crossing", "5", True)),
    "an edge of no points": (crossing(edge1=[]), ("crossing", "5", True)),
    "an edge that is text": (crossing(edge1="edge"), ("crossing", "5", True)),
    "no edge": (lambda c: c["pedestrian_crossings"]["5"].pop("edge1"), ("crossing", "5", True)),
    "left boundary the other way round": (
        lambda c: lanes_of(c)["1"]["left_lane_boundary"].reverse(),
        ("boundary", "1", False),
    ),
    "right boundary the other way round": (
        lambda c: lanes_of(c)["2"]["right_lane_boundary"].reverse(),
        ("boundary", "2", False),
    ),
    "an endless point": (
        lambda c: add_point(c, lanes_of(c)["1"]["left_lane_boundary"], NAN),
        ("boundary", "1", False),
    ),
    "a doubled point": (
        lambda c: lanes_of(c)["1"]["left_lane_boundary"].insert(0, lanes_of(c)["1"]["left_lane_boundary"][0]),
        ("boundary", "1", False),
    ),
    "a lane of one place": (
        bicycle_lane(left_lane_boundary=boundary(5, 5, 4.0), right_lane_boundary=boundary(5, 5, 4.0)),
        ("lane", "3", True),
    ),
    "a boundary of one point": (bicycle_lane(left_lane_boundary=boundary(5, 9, 4.0)[:1]), ("lane", "3", True)),
    "a boundary of none": (bicycle_lane(right_lane_boundary=[]), ("lane", "3", True)),
    "boundaries that are the same": (bicycle_lane(right_lane_boundary=boundary(-20, 60, 4.0)), ("lane", "3", True)),
    "a lane to the moon": (bicycle_lane(right_lane_boundary=boundary(-20, 4e8, 2.0)), ("lane", "3", True)),
    "an area of two points": (area(boundary(0, 9, 0.0)), ("area", "8", True)),
    "an area of text": (area("far"), ("area", "8", True)),
    "an area with an endless point": (
        area([*boundary(0, 9, 4.0), {"x": NAN, "y": 1.0, "z": 0.0}, *boundary(9, 0, 8.0)]),
        ("area", "8", False),
    ),
}


def read(log: Path) -> Clip:
    reader = AV2Reader(log)
    return reader.read(reader.index().refs[0])


@pytest.mark.parametrize("fault", FAULTS)
def test_one_broken_thing_is_put_right_or_left_out_alone_and_told(tmp_path: Path, fault: str) -> None:
    log, sound = write_log(tmp_path / "log-a"), read(write_log(tmp_path / "log-b"))
    assert sound.repairs == ()
    change, (what, thing, left_out) = FAULTS[fault]
    edit_map(log, change)
    clip = read(log)
    assert {(repair.what, repair.thing, repair.now == LEFT_OUT) for repair in clip.repairs} == {(what, thing, left_out)}
    assert clip.route == sound.route and np.array_equal(clip.centerline, sound.centerline)
    for lane_id, lane in sound.road_map.lanes.items():
        assert np.array_equal(clip.road_map.lanes[lane_id].ring, lane.ring)
        assert np.array_equal(clip.road_map.lanes[lane_id].left_boundary, lane.left_boundary)
    assert set(clip.road_map.lanes) == {"1", "2"}
    assert len(clip.road_map.crossings) == (what != "crossing" or not left_out)
    assert [shapely.Polygon(ring).area for ring in clip.road_map.crossings] == pytest.approx(
        [12.0] * len(clip.road_map.crossings)
    )
    areas = [shapely.Polygon(area.ring).area for area in clip.road_map.drivable_areas]
    assert areas == pytest.approx([2560.0, 36.0] if (what, left_out) == ("area", False) else [2560.0])


def test_lights_of_no_lane_and_of_a_lane_left_out_are_left_out_and_counted(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log-a")
    edit_map(log, bicycle_lane(right_lane_boundary=[]))
    lights = {"timestamp_ns": [START_NS] * 3, "lane_id": [77, 2, 3], "state": ["RED", "GREEN", "RED"]}
    write_table(log / "traffic_lights.feather", lights)
    clip = read(log)
    assert clip.lights.lane_ids == ("2",)
    assert repair_counts(clip.repairs) == (RepairCount("lane", 0, 1), RepairCount("light", 0, 2))


def test_a_state_that_no_light_has_is_unknown_until_the_next_and_told(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log-a")
    stamps = [START_NS + round(t * 1e9) for t in (0.0, 2.0, 4.0)]
    rows = {"timestamp_ns": stamps, "lane_id": [2] * 3, "state": ["GREEN", "PURPLE", "RED"]}
    write_table(log / "traffic_lights.feather", rows)
    clip = read(log)
    states = clip.lights.states[:, 0]
    assert [*np.unique(states[:20]), *np.unique(states[20:40]), *np.unique(states[40:])] == [
        LightState.GREEN,
        LightState.UNKNOWN,
        LightState.RED,
    ]
    (told,) = (repair for repair in clip.repairs if repair.what == "light")
    assert (told.thing, told.time_s, told.until_s, told.now) == ("2", 2.0, 4.0, "unknown") and "PURPLE" in told.was

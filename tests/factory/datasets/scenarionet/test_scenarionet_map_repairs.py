"""ScenarioNet maps and lights that are wrong in one place: put right or left out there, with a record."""

import numpy as np
import pytest
import shapely

from factory.datasets.scenarionet.reader import ScenarioNetReader
from tasks.world.repair.records import LEFT_OUT
from tasks.world.road_map import LightState
from tests.factory.datasets.scenarionet import scenarionet_scenarios as town

NAN = float("nan")
ZEBRA = np.array([(98, -7), (100, -7), (100, 3.5), (98, 3.5)])  # 21 m2


def feature(name, **changed):
    return lambda scenario: scenario["map_features"].setdefault(name, {}).update(changed)


def with_nan(points):
    return np.insert(np.asarray(points, float), 3, NAN, axis=0)


def add_light(lane):
    light = {"lane": lane, "state": {"object_state": ["LANE_STATE_STOP"] * town.N_FRAMES}}
    return lambda scenario: scenario["dynamic_map_states"].update({"x": light})


FAULTS = {
    "a crossing in another order": (feature("zebra", polygon=ZEBRA[[0, 1, 3, 2]]), ("crossing", "zebra", False)),
    "a crossing with an endless point": (feature("zebra", polygon=with_nan(ZEBRA)), ("crossing", "zebra", False)),
    "a crossing of two points": (feature("zebra", polygon=ZEBRA[:2]), ("crossing", "zebra", True)),
    "a crossing of text": (feature("zebra", polygon="zebra"), ("crossing", "zebra", True)),
    "a crossing of nothing": (lambda s: s["map_features"]["zebra"].pop("polygon"), ("crossing", "zebra", True)),
    "a lane of one place": (
        feature("X", type="LANE_SURFACE_STREET", polyline=[(5.0, 5.0)] * 4, polygon=ZEBRA),
        ("lane", "X", True),
    ),
    "a lane of one point": (feature("X", type="LANE_SURFACE_STREET", polyline=[(5.0, 5.0)]), ("lane", "X", True)),
    "a lane of none": (feature("X", type="LANE_SURFACE_STREET", polyline=[]), ("lane", "X", True)),
    "a lane to the moon": (
        feature("X", type="LANE_SURFACE_STREET", polyline=[(0.0, 0.0), (4e8, 0.0)]),
        ("lane", "X", True),
    ),
    "an endless point of a lane": (
        feature("E2", polyline=with_nan(town.centerline("E2")), polygon=with_nan(town.polygon("E2"))),
        ("lane", "E2", False),
    ),
    "an endless end of the surface": (
        feature("boundary_0", polyline=[(NAN, NAN), (320, -12), (320, 10), (0, 10), (0, -12)]),
        ("area", "boundary_0", False),
    ),
    "an island of text": (feature("boundary_2", type="ROAD_LINE", polyline="island"), ("area", "boundary_2", True)),
    "an island of one place": (
        feature("boundary_2", type="ROAD_LINE", polyline=[(5.0, 5.0)] * 5),
        ("area", "boundary_2", True),
    ),
    "a light of no lane": (add_light("lane of elsewhere"), ("light", "lane of elsewhere", True)),
}


def read(scenario, folder, name):
    reader = ScenarioNetReader(town.save(scenario, folder, name))
    return reader.read(reader.index().refs[0])


@pytest.mark.parametrize("fault", FAULTS)
def test_one_broken_thing_is_put_right_or_left_out_alone_and_told(tmp_path, fault):
    change, (what, thing, left_out) = FAULTS[fault]
    sound, scenario = read(town.nuscenes(), tmp_path, "sd_sound.pkl"), town.nuscenes()
    assert sound.repairs == ()
    change(scenario)
    clip = read(scenario, tmp_path, "sd_broken.pkl")
    assert {(repair.what, repair.thing, repair.now == LEFT_OUT) for repair in clip.repairs} == {(what, thing, left_out)}
    assert clip.route == sound.route and np.array_equal(clip.centerline, sound.centerline)
    assert list(clip.road_map.lanes) == list(sound.road_map.lanes)
    for lane_id, lane in sound.road_map.lanes.items():
        assert np.array_equal(clip.road_map.lanes[lane_id].ring, lane.ring)
    crossings = [shapely.Polygon(ring).area for ring in clip.road_map.crossings]
    assert crossings == ([] if (what, left_out) == ("crossing", True) else [21.0])
    assert clip.lights.lane_ids == ()
    surface, whole = (
        shapely.union_all([shapely.Polygon(area.ring, area.holes) for area in one.road_map.drivable_areas])
        for one in (clip, sound)
    )
    lost = 0.5 * 320 * 22 if what == "area" and not left_out else 0.0  # of the surface's rectangle a corner
    assert whole.area - surface.area <= lost + 1e-6 and surface.difference(whole).area < 1e-6


def test_a_light_of_a_lane_that_is_left_out_goes_with_it(tmp_path):
    scenario = town.waymo()
    lit = str(town.INT_ID["C2"])
    scenario["map_features"]["999"] = {"type": "LANE_SURFACE_STREET", "polyline": [(5.0, 5.0)] * 3}
    scenario["dynamic_map_states"]["999"] = scenario["dynamic_map_states"][lit] | {"lane": 999}
    clip = read(scenario, tmp_path, "sd_lights.pkl")
    assert clip.lights.lane_ids == (lit,) and "999" not in clip.road_map.lanes
    assert {(repair.what, repair.thing, repair.now) for repair in clip.repairs} == {
        ("lane", "999", LEFT_OUT),
        ("light", "999", LEFT_OUT),
    }


def test_links_to_a_lane_that_is_left_out_hurt_nobody(tmp_path):
    scenario = town.waymo()
    gone = str(town.INT_ID["CL"])
    scenario["map_features"][gone]["polyline"] = np.zeros((4, 3), np.float32)
    clip = read(scenario, tmp_path, "sd_links.pkl")
    assert gone not in clip.road_map.lanes
    assert all(gone not in (*lane.successors, *lane.predecessors) for lane in clip.road_map.lanes.values())
    assert [(repair.what, repair.thing) for repair in clip.repairs] == [("lane", gone)]


def test_a_lane_whose_polygon_has_no_area_is_as_wide_as_one_without(tmp_path):
    scenario = town.nuscenes(newer=True)
    scenario["map_features"]["E1"]["polygon"] = [(0.0, 0.0), (1.0, 1.0), (2.0, 2.0)]
    clip = read(scenario, tmp_path, "sd_flat.pkl")
    assert shapely.Polygon(clip.road_map.lanes["E1"].ring).area == pytest.approx(100.0 * 3.5)
    assert [(repair.what, repair.thing) for repair in clip.repairs] == [("lane", "E1")]


def test_a_state_that_no_light_has_is_unknown_in_that_frame_and_told(tmp_path):
    scenario = town.nuscenes()
    states = ["LANE_STATE_STOP"] * town.N_FRAMES
    states[20] = "PURPLE"
    scenario["dynamic_map_states"]["x"] = {"lane": "C2", "state": {"object_state": states}}
    clip = read(scenario, tmp_path, "sd_purple.pkl")
    red = clip.lights.states[:, clip.lights.lane_ids.index("C2")]
    assert np.flatnonzero(red == LightState.UNKNOWN).tolist() == [20] and (np.delete(red, 20) == LightState.RED).all()
    (told,) = (repair for repair in clip.repairs if repair.what == "light")
    assert (told.thing, told.was, told.now) == ("C2", "the state 'PURPLE'", "unknown")
    assert told.time_s == pytest.approx(2.0)

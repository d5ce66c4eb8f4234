"""Maps of 123D that are wrong in one place: put right or left out there, with a record, and the log is read."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely

from factory.datasets.av2.reader import map_file, read_map
from factory.datasets.py123d.reader import Py123dReader
from tasks.world.clip import Clip
from tasks.world.repair.records import LEFT_OUT
from tests.factory.datasets.av2.test_av2 import write_log
from tests.factory.datasets.py123d.py123d_logs import (
    CARPARK,
    CROSSWALK,
    GENERIC_DRIVABLE,
    LANE,
    Made,
    MapObject,
    convert,
    lane,
    objects_of,
    surface,
)
from tests.factory.datasets.py123d.test_py123d import NUPLAN, area, strip
from tests.factory.datasets.py123d.test_py123d_faults import lights

Change = Callable[[list[MapObject]], object]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("source") / "log-a")


def of(objects: list[MapObject], layer: int, object_id: int) -> int:
    return next(i for i, one in enumerate(objects) if (one.layer, one.object_id) == (layer, object_id))


def rebuilt_lane(object_id: int, **sides: Callable[[np.ndarray], np.ndarray]) -> Change:
    """The lane as a converter makes it of boundaries that were changed: its outline and centreline are of them."""

    def change(objects: list[MapObject]) -> None:
        i = of(objects, LANE, object_id)
        told = objects[i].features
        left, right = (
            sides.get(side, lambda line: line)(told[f"{side}_boundary"][:, :3]) for side in ("left", "right")
        )
        made = lane(object_id, left, right)
        derived = {name: made.features[name] for name in ("left_boundary", "right_boundary", "centerline", "outline")}
        objects[i] = replace(objects[i], shape=made.shape, features=told | derived)

    return change


def reshaped(layer: int, object_id: int, shape: shapely.Geometry) -> Change:
    def change(objects: list[MapObject]) -> None:
        i = of(objects, layer, object_id)
        objects[i] = replace(objects[i], shape=shape)

    return change


def add(one: MapObject) -> Change:
    return lambda objects: objects.append(one)


def doubled(layer: int, object_id: int) -> Change:
    def change(objects: list[MapObject]) -> None:
        first = objects[of(objects, layer, object_id)]
        objects.append(replace(first, shape=shapely.affinity.translate(first.shape, 500.0)))

    return change


BOW_TIE = shapely.Polygon(strip(50, 53, 2.0, 2).tolist() + strip(50, 53, -2.0, 2).tolist())
ENDLESS = shapely.Polygon([*strip(0, 9, 4.0, 2), (np.nan, 3.0), *strip(9, 0, 8.0, 2)])
FAULTS: dict[str, tuple[Change, tuple[str, str, bool]]] = {
    "left boundary the other way round": (rebuilt_lane(1, left=lambda line: line[::-1]), ("boundary", "1", False)),
    "right boundary the other way round": (rebuilt_lane(2, right=lambda line: line[::-1]), ("boundary", "2", False)),
    "an endless point": (
        rebuilt_lane(1, right=lambda line: np.insert(line, 1, np.nan, axis=0)),
        ("boundary", "1", False),
    ),
    "a lane of one place": (add(lane(3, strip(5, 5, 4.0), strip(5, 5, 4.0))), ("lane", "3", True)),
    "a boundary of one point": (add(lane(3, strip(5, 9, 4.0), strip(5, 9, 6.0)[:1])), ("lane", "3", True)),
    "a lane listed twice": (doubled(LANE, 1), ("lane", "1", False)),
    "a lane without a polygon": (reshaped(LANE, 1, shapely.Point(0, 0)), ("lane", "1", False)),
    "a crossing in another order": (reshaped(CROSSWALK, 501, BOW_TIE), ("crossing", "501", False)),
    "a crossing without a polygon": (reshaped(CROSSWALK, 501, shapely.Point(0, 0)), ("crossing", "501", True)),
    "a crossing listed twice": (doubled(CROSSWALK, 501), ("crossing", "501", False)),
    "an area that is empty": (add(surface(GENERIC_DRIVABLE, 8, shapely.Polygon())), ("area", "8", True)),
    "an area of no area": (add(surface(CARPARK, 8, shapely.Polygon(strip(0, 9, 0.0, 4)))), ("area", "8", True)),
    "an area with an endless point": (add(surface(CARPARK, 8, ENDLESS)), ("area", "8", False)),
}


def read(log: Path, root: Path, change: Change | None = None, made: Made | None = None) -> Clip:
    objects = objects_of(read_map(map_file(log))[0])
    if change is not None:
        change(objects)
    folder = convert(log, root, made, objects)
    if made is None:
        lights(folder, 2)
    reader = Py123dReader(root)
    return reader.read(reader.index().refs[0])


@pytest.mark.parametrize("fault", FAULTS)
def test_one_broken_thing_is_put_right_or_left_out_alone_and_told(source: Path, tmp_path: Path, fault: str) -> None:
    change, (what, thing, left_out) = FAULTS[fault]
    sound, clip = read(source, tmp_path / "sound"), read(source, tmp_path / "broken", change)
    assert sound.repairs == ()
    assert {(repair.what, repair.thing, repair.now == LEFT_OUT) for repair in clip.repairs} >= {(what, thing, left_out)}
    assert all(repair.thing == thing for repair in clip.repairs)
    assert clip.route == sound.route and np.array_equal(clip.centerline, sound.centerline)
    assert list(clip.road_map.lanes) == ["1", "2"]
    for lane_id, one in sound.road_map.lanes.items():
        other = clip.road_map.lanes[lane_id]
        assert shapely.Polygon(other.ring).equals(shapely.Polygon(one.ring))
        assert np.array_equal(other.left_boundary, one.left_boundary)
        assert np.array_equal(other.right_boundary, one.right_boundary)
        assert (other.is_intersection, other.successors) == (one.is_intersection, one.successors)
    assert [shapely.Polygon(ring).area for ring in clip.road_map.crossings] == pytest.approx(
        [] if (what, left_out) == ("crossing", True) else [12.0]
    )
    assert clip.lights.lane_ids == ("2",)


def test_boundaries_against_a_centreline_of_the_data_set_are_laid_along_it(source: Path, tmp_path: Path) -> None:
    def change(objects: list[MapObject]) -> None:
        told = objects[of(objects, LANE, 1)].features
        for side in ("left_boundary", "right_boundary"):
            told[side] = told[side][::-1]

    sound, clip = read(source, tmp_path / "a", None, NUPLAN), read(source, tmp_path / "b", change, NUPLAN)
    assert [(repair.thing, repair.now) for repair in clip.repairs] == [("1", "left and right turned")]
    assert np.array_equal(clip.road_map.lanes["1"].left_boundary, sound.road_map.lanes["1"].left_boundary)


def test_lights_of_lanes_far_away_are_no_fault_and_those_of_no_lane_are(source: Path, tmp_path: Path) -> None:
    folder = convert(
        source,
        tmp_path,
        NUPLAN,
        [
            *objects_of(read_map(map_file(source))[0]),
            lane(3, strip(5000, 5100, 2.0), strip(5000, 5100, -2.0), lane_group_id=9),
        ],
    )
    seen = []
    for lane_id in (3, 77):
        lights(folder, 2, lane_id=lane_id)
        reader = Py123dReader(tmp_path)
        clip = reader.read(reader.index().refs[0])
        assert clip.lights.lane_ids == ()
        seen.append([(repair.what, repair.thing, repair.now) for repair in clip.repairs])
    assert seen == [[], [("light", "77", LEFT_OUT)]]


def test_a_city_s_area_with_an_endless_point_is_found_by_its_other_points(source: Path, tmp_path: Path) -> None:
    assert shapely.Polygon(ENDLESS).is_valid is False and area(0, 9, 4.0, 8.0).area == pytest.approx(36.0)
    clip = read(source, tmp_path, add(surface(CARPARK, 8, ENDLESS)), NUPLAN)
    (park,) = [one for one in clip.road_map.drivable_areas if one.token == "cp_8"]
    assert shapely.Polygon(park.ring).area == pytest.approx(36.0)
    assert [(repair.what, repair.thing) for repair in clip.repairs] == [("area", "8")]

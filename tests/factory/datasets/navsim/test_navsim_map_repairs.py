"""nuPlan's maps and lights: a crossing that crosses itself is put right, a light of no lane left out, with a record."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from factory.datasets.navsim.maps import City, read_geopackage
from tasks.world.clip import Clip
from tasks.world.repair.records import LEFT_OUT
from tests.factory.datasets.navsim.geopackage_writer import CITIES, ORIGIN, stub_rows, write_geopackage
from tests.factory.datasets.navsim.small import CITY, reader_of, road_frames, write_city, write_log

pytestmark = pytest.mark.slow  # each writes a city

SQUARE = ORIGIN + np.array([[60.0, -3.0], [64.0, -3.0], [64.0, 3.0], [60.0, 3.0]])


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def read(root: Path, lights: list[tuple[int, bool]]) -> Clip:
    frames = road_frames()
    for frame in frames:
        frame["traffic_lights"] = lights
    write_log(root, frames)
    reader = reader_of(root, sensors=None)
    return reader.read(reader.index().refs[0])


def test_a_crossing_in_another_order_is_the_square_and_told_from_the_kept_tables_too(tmp_path: Path) -> None:
    crossings = [{"fid": 7, "shape": shapely.Polygon(SQUARE[[0, 1, 3, 2]]), "is_marked": 1}]
    crossings.append({"fid": 8, "shape": shapely.Polygon(SQUARE + 20.0), "is_marked": 1})
    version, zone = CITIES[CITY]
    rows = stub_rows() | {"crosswalks": crossings}
    write_geopackage(tmp_path / "maps" / CITY / version / "map.gpkg", rows, zone)
    for _ in ("from the file", "from the tables that are kept"):
        clip = read(tmp_path, [])
        areas = [shapely.Polygon(ring).area for ring in clip.road_map.crossings]
        assert areas == pytest.approx([24.0, 24.0], abs=1e-3)
        (repair,) = clip.repairs
        assert (repair.what, repair.thing) == ("crossing", "7")
        assert "12.0 m2" in repair.was and "24.0 m2" in repair.now


def test_crossings_that_enclose_nothing_are_left_out_and_the_city_is_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shapes = [shapely.Polygon(SQUARE[[0, 1, 0]]), shapely.Polygon(SQUARE), shapely.Polygon()]
    version, zone = CITIES[CITY]
    crossings = [{"fid": 7 + k, "shape": shape, "is_marked": 1} for k, shape in enumerate(shapes)]
    rows = stub_rows() | {"crosswalks": crossings}
    write_geopackage(tmp_path / "maps" / CITY / version / "map.gpkg", rows, zone)
    (ring,) = read(tmp_path, []).road_map.crossings
    assert shapely.Polygon(ring).area == pytest.approx(24.0, abs=1e-3)
    assert [fid for fid in (7, 8, 9) if f"layer crosswalks, fid {fid}: encloses no area" in caplog.text] == [7, 9]


def test_a_light_of_no_lane_of_the_city_is_left_out_and_told(tmp_path: Path) -> None:
    write_city(tmp_path)
    assert read(tmp_path, [(3, True)]).repairs == ()
    clip = read(tmp_path, [(3, True), (77, True)])
    assert clip.lights.lane_ids == ("3",)
    assert [(repair.what, repair.thing, repair.now) for repair in clip.repairs] == [("light", "77", LEFT_OUT)]


def test_points_that_stand_twice_in_a_lane_s_line_give_it_no_other_heading(tmp_path: Path) -> None:
    lines = []
    for name in ("sound", "doubled"):
        rows = stub_rows()
        for row in rows["baseline_paths"] if name == "doubled" else ():
            row["shape"] = shapely.LineString(np.repeat(shapely.get_coordinates(row["shape"]), 2, axis=0))
        path = tmp_path / name / "map.gpkg"
        write_geopackage(path, rows, CITIES[CITY][1])
        lines.append(City(CITY, path, read_geopackage(path)).centerline("1"))
    assert np.array_equal(*lines)

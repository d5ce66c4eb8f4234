"""nuPlan's maps: what a town's map is after it was written as a GeoPackage, faults, and the kept tables."""

import json
import sqlite3
from pathlib import Path

import numpy as np
import pytest
import shapely

from factory.datasets.av2.reader import read_map
from factory.datasets.navsim.maps import City, cached_tables, cached_tables_path, open_city
from factory.datasets.town.town import _vector_map, plan_log
from factory.readers.base import BadClip
from tasks.world.road_map import MapLayer, RoadMap
from tests.factory.datasets.navsim.geopackage_writer import ORIGIN, Row, town_rows, write_geopackage, write_root

pytestmark = pytest.mark.slow  # the first test builds a town

CITY, ZONE = "us-nv-las-vegas-strip", 32611
PROJECTION_M = 1e-6  # what going to degrees and back may cost; measured: 4e-9


@pytest.fixture(scope="session")
def town(tmp_path_factory: pytest.TempPathFactory) -> RoadMap:
    """The map of the synthetic town's first log, nothing painted."""
    built, drive = plan_log(0, 0)
    file = tmp_path_factory.mktemp("town") / "log_map_archive_x____SYN.json"
    file.write_text(json.dumps(_vector_map(built.streets, drive)))
    return read_map(file)[0]


@pytest.fixture(scope="session")
def rows(town: RoadMap) -> dict[str, list[Row]]:
    return town_rows(town)


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory, rows: dict[str, list[Row]]) -> Path:
    folder = tmp_path_factory.mktemp("maps")
    write_root(folder, CITY, rows)
    return folder


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def whole(city: City) -> RoadMap:
    return city.road_map(ORIGIN[None], 50_000.0)[0]


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two closed rings run through the same points, from wherever and whichever way round."""
    return bool(shapely.Polygon(one).normalize().equals_exact(shapely.Polygon(other).normalize(), PROJECTION_M))


def test_a_town_written_and_read_has_the_same_lanes_graph_and_areas(town: RoadMap, root: Path) -> None:
    read = whole(open_city(root, CITY))
    lanes = {k: v for k, v in town.lanes.items() if v.drives_cars}
    assert read.lanes.keys() == lanes.keys()
    for lane_id, lane in lanes.items():
        mine = read.lanes[lane_id]
        assert same(mine.ring - ORIGIN, lane.ring)
        np.testing.assert_allclose(mine.centerline[:, :2] - ORIGIN, lane.centerline[:, :2], atol=PROJECTION_M)
        np.testing.assert_allclose(mine.centerline[:, 2], lane.centerline[:, 2], atol=1e-5)
        assert mine.is_intersection == lane.is_intersection
        for side in ("left_boundary", "right_boundary"):  # half of them are written backwards
            np.testing.assert_allclose(
                getattr(mine, side)[:, :2] - ORIGIN, getattr(lane, side)[:, :2], atol=PROJECTION_M
            )
        if lane.is_intersection:
            assert (mine.successors, mine.predecessors) == (lane.successors, lane.predecessors)
        for side in ("left_neighbor", "right_neighbor"):
            beside = getattr(lane, side)
            known = beside in lanes and town.roadblock_of[beside] == town.roadblock_of[lane_id]
            assert getattr(mine, side) == (beside if known and not lane.is_intersection else None)
    blocks = {(town.roadblock_of[k], read.roadblock_of[k]) for k in lanes}
    assert len(blocks) == len({a for a, _ in blocks}) == len({b for _, b in blocks})
    parks = [area for area in read.drivable_areas if area.layer == MapLayer.CARPARK_AREA]
    assert len(parks) == len(town.drivable_areas)
    assert all(same(a.ring - ORIGIN, b.ring) for a, b in zip(parks, town.drivable_areas))
    assert len(read.crossings) == len(town.crossings)
    connectors = [lane for lane in read.lanes.values() if lane.is_intersection]
    assert all(same(a.ring, lane.ring) for a, lane in zip(read.intersections, connectors))


def test_a_file_in_metres_is_read_without_a_projection(tmp_path: Path, rows: dict[str, list[Row]], root: Path) -> None:
    write_geopackage(tmp_path / "maps" / CITY / "9" / "map.gpkg", rows, ZONE, stored_in=ZONE)
    here, there = whole(open_city(tmp_path / "maps", CITY)), whole(open_city(root, CITY))
    assert here.lanes.keys() == there.lanes.keys()
    for lane_id, lane in here.lanes.items():
        np.testing.assert_allclose(lane.ring, there.lanes[lane_id].ring, atol=PROJECTION_M)


def test_a_road_map_holds_what_lies_within_the_radius_of_any_point(root: Path) -> None:
    city = open_city(root, CITY)
    lanes = whole(city).lanes
    along = np.array([lane.centerline[0, :2] for lane in list(lanes.values())[:2]]) + 5.0
    found, _ = city.road_map(along, 40.0)
    distance = {k: shapely.Polygon(v.ring).distance(shapely.MultiPoint(along)) for k, v in lanes.items()}
    assert list(found.lanes) == [k for k, d in distance.items() if d <= 40.0]
    assert 0 < len(found.lanes) < len(lanes)
    assert found.location == CITY


def test_kept_tables_are_the_file_s_and_damage_is_mended(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = next((root / CITY).glob("*/map.gpkg"))
    fresh, kept = cached_tables(path), cached_tables(path)
    assert not caplog.records
    for layer, table in fresh.items():
        np.testing.assert_array_equal(table.fid, kept[layer].fid)
        assert shapely.equals_identical(table.shapes, kept[layer].shapes).all()
        for name, column in table.columns.items():
            np.testing.assert_array_equal(column, kept[layer].columns[name])
    file = cached_tables_path(path)
    whole_bytes = file.read_bytes()
    file.write_bytes(whole_bytes[: len(whole_bytes) // 2])
    assert cached_tables(path).keys() == fresh.keys()
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert len(file.read_bytes()) == len(whole_bytes)


def changed(tmp_path: Path, rows: dict[str, list[Row]], layer: str, **columns: object) -> Path:
    """A root whose first row of a layer has other columns."""
    other = rows | {layer: [rows[layer][0] | columns, *rows[layer][1:]]}
    write_geopackage(tmp_path / "maps" / CITY / "9" / "map.gpkg", other, ZONE)
    return tmp_path / "maps"


@pytest.mark.parametrize(
    ("layer", "column", "value", "said"),
    [
        ("lanes_polygons", "lane_group_fid", None, "column lane_group_fid, fid {fid}: is NULL"),
        ("lane_connectors", "exit_lane_fid", None, "column exit_lane_fid, fid {fid}: is NULL"),
        ("lane_connectors", "lane_group_connector_fid", None, "column lane_group_connector_fid, fid {fid}: is NULL"),
        ("baseline_paths", "lane_fid", None, "column lane_fid, {fid}: must stand in one row, it stands in 0"),
        ("gen_lane_connectors_scaled_width_polygons", "lane_connector_fid", 1, "must stand in one row"),
    ],
)
def test_a_broken_key_names_file_layer_column_and_fid(
    tmp_path: Path, rows: dict[str, list[Row]], layer: str, column: str, value: object, said: str
) -> None:
    root = changed(tmp_path, rows, layer, **{column: value})
    fid = rows[layer][0]["lane_fid"] if layer == "baseline_paths" else rows[layer][0]["fid"]
    with pytest.raises(BadClip) as told:
        open_city(root, CITY)
    assert f"layer {layer}" in str(told.value) and said.format(fid=fid) in str(told.value)
    assert "map.gpkg" in told.value.file


def test_a_missing_layer_a_cut_file_and_a_wrong_folder_are_told(tmp_path: Path, root: Path) -> None:
    path = tmp_path / "maps" / CITY / "9" / "map.gpkg"
    path.parent.mkdir(parents=True)
    good = next((root / CITY).glob("*/map.gpkg")).read_bytes()
    path.write_bytes(good)
    with sqlite3.connect(path) as file:
        file.execute("DELETE FROM gpkg_contents WHERE table_name = 'intersections'")
        file.execute("DELETE FROM gpkg_geometry_columns WHERE table_name = 'intersections'")
        file.execute("DROP TABLE intersections")
    with pytest.raises(BadClip, match="layer intersections: is missing"):
        open_city(tmp_path / "maps", CITY)
    path.write_bytes(good[: len(good) // 3])
    with pytest.raises(BadClip, match=r"map\.gpkg"):
        open_city(tmp_path / "maps", CITY)
    with pytest.raises(BadClip, match="no such folder"):
        open_city(tmp_path / "maps", "sg-one-north")


def test_every_part_of_an_area_and_its_holes_are_kept(tmp_path: Path, rows: dict[str, list[Row]]) -> None:
    middle = rows["carpark_areas"][0]["shape"].centroid
    big = middle.buffer(20.0, quad_segs=2)
    holed = shapely.difference(big, middle.buffer(5.0, quad_segs=2))
    beside = shapely.transform(middle, lambda xy: xy + 30.0).buffer(1.0)
    two = shapely.MultiPolygon([beside, holed])
    root = changed(tmp_path, rows, "carpark_areas", shape=two)
    fid = rows["carpark_areas"][0]["fid"]
    areas = {area.token: area for area in whole(open_city(root, CITY)).drivable_areas}
    assert len(areas[str(fid)].holes) == 1
    assert shapely.Polygon(areas[f"{fid}_1"].ring).area < 10.0

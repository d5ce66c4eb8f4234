"""Whole real maps, drivable surfaces with holes included: every ring is accepted, every point found as by shapely."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from factory.datasets.av2.reader import log_folders, map_file, read_map
from factory.datasets.scenarionet.reader import read_log, scenario_files
from tasks.reward.rules.area_flags import regions_at
from tasks.reward.rules.map_index import DRIVABLE, INTERSECTION, LANE, PARTS_OF_LAYER, index_map
from tasks.world.lanes import RoadMap
from tasks.world.polygons import polygons_near


@pytest.fixture(scope="module")
def road_maps(shared_root: Path) -> list[RoadMap]:
    argoverse = [read_map(map_file(log)) for log in log_folders(shared_root / "data/av2/sensor/val").values()]
    nuscenes = [read_log(path).road_map for path in scenario_files(shared_root / "data/scenarionet/nuscenes").values()]
    return [*argoverse, *nuscenes]


def test_points_of_real_maps_are_where_shapely_says(road_maps: list[RoadMap]) -> None:
    assert len(road_maps) == 9
    rng = np.random.default_rng(0)
    for road_map in road_maps:
        polygons = polygons_near(road_map, np.zeros(2), radius_m=np.inf)
        corners = np.concatenate([polygon.ring for polygon in polygons])
        points = corners[rng.integers(len(corners), size=3_000)] + rng.normal(0.0, 2.0, (3_000, 2))
        expected = np.zeros(len(points), dtype=np.uint8)
        for polygon in polygons:
            shape = shapely.Polygon(polygon.ring, polygon.holes)
            shapely.prepare(shape)
            inside = shapely.contains_xy(shape, points[:, 0], points[:, 1])
            for part, is_played in zip((LANE, DRIVABLE, INTERSECTION), PARTS_OF_LAYER[polygon.layer]):
                expected |= (inside & is_played).astype(np.uint8) << part
        found = regions_at(index_map(polygons, frozenset()), *np.ascontiguousarray(points.T))
        assert np.array_equal(found.parts, expected)
        assert len(np.unique(expected)) > 3

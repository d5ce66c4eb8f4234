"""The real Argoverse 2 maps: nothing is put right in them, and what is turned in them by hand is found again."""

import json
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely

from factory.datasets.av2.reader import read_map
from tasks.world.repair.records import Repair
from tasks.world.road_map import RoadMap

WHOLE = {"7fab2350": 428.9, "adcf7d18": 928.7}  # log -> area of its 11 crossings [m2]


@pytest.fixture(params=list(WHOLE))
def file(request: pytest.FixtureRequest, shared_root: Path) -> Path:
    return next((shared_root / "data/av2/sensor/val").glob(f"{request.param}*/map/log_map_archive_*.json"))


def changed(file: Path, folder: Path, change: Callable[[dict], object]) -> tuple[RoadMap, tuple[Repair, ...]]:
    content = json.loads(file.read_text())
    change(content)
    (folder / file.name).write_text(json.dumps(content))
    return read_map(folder / file.name)


def test_a_real_map_needs_no_repair(file: Path) -> None:
    assert read_map(file)[1] == ()


def test_crossings_whose_second_edge_is_listed_the_other_way_round_keep_their_area(file: Path, tmp_path: Path) -> None:
    whole, _ = read_map(file)
    found, repairs = changed(
        file, tmp_path, lambda content: [c["edge2"].reverse() for c in content["pedestrian_crossings"].values()]
    )
    assert all(np.array_equal(a, b) for a, b in zip(found.crossings, whole.crossings, strict=True))
    area = sum(shapely.Polygon(ring).area for ring in found.crossings)
    assert area == pytest.approx(WHOLE[file.parent.parent.name[:8]], abs=0.1)
    assert [repair.what for repair in repairs] == ["crossing"] * 11


def test_a_right_boundary_that_runs_against_the_left_leaves_its_lane_17_4_m_long(
    shared_root: Path, tmp_path: Path
) -> None:
    file = next((shared_root / "data/av2/sensor/val").glob("7fab2350*/map/log_map_archive_*.json"))
    lane_id = "38109167"
    found, repairs = changed(
        file, tmp_path, lambda content: content["lane_segments"][lane_id]["right_lane_boundary"].reverse()
    )
    assert found.lanes[lane_id].length_m == pytest.approx(17.364, abs=1e-3)
    assert [(repair.what, repair.thing, repair.now) for repair in repairs] == [("boundary", lane_id, "right turned")]


@pytest.mark.parametrize("choice", [("left",), ("right",), ("left", "right"), ("left", "right", None, None)])
def test_whatever_boundaries_are_turned_the_map_is_the_whole_one(
    file: Path, tmp_path: Path, choice: tuple[str | None, ...]
) -> None:
    whole, _ = read_map(file)
    draw = random.Random(0)
    turned = {lane_id: draw.choice(choice) for lane_id in whole.lanes}
    found, repairs = changed(
        file,
        tmp_path,
        lambda content: [
            content["lane_segments"][lane_id][f"{side}_lane_boundary"].reverse()
            for lane_id, side in turned.items()
            if side
        ],
    )
    assert {repair.thing: repair.now for repair in repairs} == {
        k: f"{side} turned" for k, side in turned.items() if side
    }
    assert found.roadblock_of == whole.roadblock_of
    for lane_id, lane in whole.lanes.items():
        for name in ("ring", "centerline", "left_boundary", "right_boundary"):
            assert np.array_equal(getattr(found.lanes[lane_id], name), getattr(lane, name))

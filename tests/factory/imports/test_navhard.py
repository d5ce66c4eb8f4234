"""NAVSIM's two-stage files as a benchmark: a town's log is stage one, its own frames 4 s later are stage two."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from factory.__main__ import main as factory
from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.readers.av2.reader import read_log
from factory.readers.restricted_pickle import load_plain
from factory.readers.settings import TownSettings
from factory.readers.town.write import write_logs
from factory.store.samples import Store
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.scoring import drive, prepare_frame
from tasks.experts.pdm_closed.planner import PdmSettings
from tasks.rollout.simulate import TrafficSettings
from tasks.subscores import JUDGED
from tests.factory.readers.geopackage_writer import CITIES, ORIGIN, stub_rows, town_rows, write_geopackage, write_root
from tests.factory.readers.navsim import scene_pickles
from tests.factory.readers.openscene_writer import Place, write_openscene

pytestmark = pytest.mark.slow  # a town, a city's map, PDM-Closed
NOW, TOKENS = 4, ("0000000000005a00c", "0000000000005a00b")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log, its city and one group: frames 4 and 3 of the log, then 12 and 11."""
    root = tmp_path_factory.mktemp("navhard")
    location = next(iter(CITIES))
    write_root(root / "maps", "sg-one-north", stub_rows())
    (folder,) = write_logs(root / "av2", (1,), 0, TownSettings(cameras=(), lidar_beams=0))
    log = read_log(folder)
    rows = town_rows(log.road_map)
    version, zone = CITIES[location]
    (root / "maps" / location / version / "map.gpkg").unlink(missing_ok=True)
    write_geopackage(root / "maps" / location / version / "map.gpkg", rows, zone)
    blocks = log.road_map.roadblock_of
    number = {blocks[str(row["fid"])]: str(row["lane_group_fid"]) for row in rows["lanes_polygons"]}
    number |= {blocks[str(row["fid"])]: str(row["lane_group_connector_fid"]) for row in rows["lane_connectors"]}
    place = Place(location, np.append(ORIGIN, 0.0), roadblock_number=number.__getitem__)
    path = write_openscene(root, "test", folder.name, log, place)
    frames = frames_of(path)
    scenes = root / "navhard_two_stage" / "synthetic_scene_pickles"
    scenes.mkdir(parents=True)
    for token, at in zip(TOKENS, (NOW + 8, NOW + 7)):
        scene_pickles.write_scene(scenes, scene_pickles.scene_of_log(frames, at, token))
    write_split(root, frames)
    return root


def frames_of(path: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = load_plain(path.read_bytes(), str(path))
    return found


def write_split(root: Path, frames: list[dict[str, Any]], *further: Any) -> None:
    now, before = frames[NOW]["token"], frames[NOW - 1]["token"]
    mapping = [[now, before, [list(TOKENS)]], *further]
    split = {"defaults": [{"scene_filter": "small"}], "data_split": "test", "reactive_all_mapping": mapping}
    (root / "split.yaml").write_text(yaml.safe_dump(split))
    (root / "scene_filter").mkdir(exist_ok=True)
    (root / "scene_filter" / "small.yaml").write_text(yaml.safe_dump({"tokens": [now, before]}))


def imported(root: Path, out: Path) -> int:
    words = [f"root={root / 'navhard_two_stage'}", f"logs={root / 'navsim_logs' / 'test'}", f"maps={root / 'maps'}"]
    return factory(["import", "navhard", *words, f"split={root / 'split.yaml'}", "pictures=false", f"out={out}"])


def test_a_scene_that_repeats_the_log_is_scored_as_the_log(installed: Path, tmp_path: Path) -> None:
    """Stage two of one group and stage one of another are the same instant: every sub-score of a plan agrees."""
    (path,) = (installed / "navsim_logs" / "test").glob("*.pkl")
    frames = frames_of(path)
    later = [frames[NOW + 8]["token"], frames[NOW + 7]["token"], [list(TOKENS)]]
    write_split(installed, frames, later)
    assert imported(installed, tmp_path / "out") == COMPLETE
    benchmark = BenchmarkFolder(str(tmp_path / "out"))
    assert len(benchmark.keys) == 2 * 4
    first, second = (benchmark.scenes(clip_id) for clip_id in dict.fromkeys(key.clip_id for key in benchmark.keys))
    for given, logged in zip(first.follow_ups[0], second.logged):
        np.testing.assert_allclose(given.ego_history[:, :3], logged.ego_history[:, :3], atol=1e-9)
        frame, twin = (
            prepare_frame(scene, TrafficSettings(mode="replay"), PdmSettings(), logged=False)
            for scene in (given, logged)
        )
        for speed in (0.0, 5.0, 15.0):
            plan = np.column_stack([speed * 0.1 * np.arange(1, 41), np.zeros((40, 2))])
            found, wanted = drive(frame, plan).scores, drive(twin, plan).scores
            for name in JUDGED:
                np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)
            np.testing.assert_allclose(found.ep_raw_m, wanted.ep_raw_m, atol=1e-6)


def test_a_group_counts_whole_or_not_at_all(installed: Path, tmp_path: Path) -> None:
    (path,) = (installed / "navsim_logs" / "test").glob("*.pkl")
    frames = frames_of(path)
    lacking = [frames[NOW + 2]["token"], frames[NOW + 1]["token"], [list(TOKENS), ["0" * 17, "1" * 17]]]
    write_split(installed, frames, lacking)
    assert imported(installed, tmp_path / "out") == COMPLETE_WITH_FAILURES
    document = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert [len(clip["follow_ups"]) for clip in document["clips"]] == [1]
    assert [clip["follow_ups"] for clip in document["left_out"]] == [2]
    failed = Store(tmp_path / "out").outcomes.read().to_pylist()
    assert len(failed) == 2 + 4 and all("0" * 17 in row["error"] for row in failed)


def test_a_split_without_a_second_stage_is_refused(
    installed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (installed / "split.yaml").write_text(
        yaml.safe_dump({"defaults": [{"scene_filter": "small"}], "data_split": "test"})
    )
    assert imported(installed, tmp_path / "out") == 2
    assert "names no scenes of a second stage" in capsys.readouterr().err

"""NAVSIM's files of groups with several follow-ups as a benchmark: scores are NAVSIM's own, pictures the files' bytes.

What PUBLIC, STAGES and FINAL hold was printed by run_metric_caching.py and run_pdm_score.py of autonomousvision/navsim
@ 0a380a9 (Python 3.11, numpy 1.26) with its constant_velocity_agent, of the files that several_follow_ups.py writes.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from factory.__main__ import main as factory
from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.store.reader import SampleTable
from factory.store.samples import Store
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.evaluate import EvaluateSettings, evaluate
from planners.evaluation.planner_names import find_planner
from planners.evaluation.score_rows import read_rows
from tasks.reward.aggregate import COLUMNS
from tests.factory.datasets.navsim.geopackage_writer import CITIES, stub_rows, write_geopackage
from tests.factory.datasets.navsim.several_follow_ups import (
    CITY,
    FOLLOW_UPS,
    GROUPS,
    SCALE,
    log_frames,
    pairs_of,
    picture,
    write,
)
from tests.pictures import turned

pytestmark = pytest.mark.slow  # PDM-Closed from every scene
PUBLIC = {  # group, frame, follow-up -> nc, dac, tlc, ddc, ep, ttc, lk, hc, ec, score
    (0, "follow_up", 0): (1, 1, 1, 1, 0.984743564259018, 1, 1, 1, 1, 0.995232363830943),
    (0, "follow_up", 1): (0, 1, 1, 1, 1, 0, 1, 1, 1, 0),
    (0, "follow_up", 2): (1, 1, 1, 1, 0.9166249237232821, 1, 0, 1, 1, 0.8489452886635256),
    (0, "follow_up_before", 0): (1, 1, 1, 1, 0.9847435642519623, 1, 1, 1, 1, 0.9952323638287381),
    (0, "follow_up_before", 1): (0, 1, 1, 1, 1, 0, 1, 1, 1, 0),
    (0, "follow_up_before", 2): (1, 1, 1, 1, 0.9187470123867325, 1, 0, 1, 1, 0.8496084413708539),
    (0, "human", -1): (1, 1, 1, 1, 0.9847324671981632, 1, 1, 1, 1, 0.995228895999426),
    (0, "human_before", -1): (1, 1, 1, 1, 0.9847324671981632, 1, 1, 1, 1, 0.995228895999426),
    (1, "follow_up", 0): (1, 0, 1, 1, 1, 1, 0, 1, 1, 0),
    (1, "follow_up", 1): (1, 1, 1, 1, 0.8182639142713487, 1, 1, 1, 1, 0.9432074732097965),
    (1, "follow_up_before", 0): (1, 0, 1, 1, 1, 1, 0, 1, 1, 0),
    (1, "follow_up_before", 1): (1, 1, 1, 1, 0.8271679191404883, 1, 1, 1, 1, 0.9459899747314026),
    (1, "human", -1): (1, 1, 1, 1, 0.9847324671840523, 1, 1, 1, 1, 0.9952288959950164),
    (1, "human_before", -1): (1, 1, 1, 1, 0.9847324671840523, 1, 1, 1, 1, 0.9952288959950164),
}
STAGES = {
    "stage_one": (1, 1, 1, 1, 0.9847324671911077, 1, 1, 1, 1, 0.9952288959972212),
    "stage_two": (
        *(0.9065676372357101, 0.9117797196432668, 1, 1, 0.9163410148367294, 0.9065676372357101, 0.8502617449873057),
        *(1, 1, 0.7845141771834597),
    ),
}
FINAL = 0.780771178452478
CLOSE = {"rtol": 0.0, "atol": 1e-11}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files, and below `out` their benchmark: made once without a picture of the last group, then whole."""
    root = tmp_path_factory.mktemp("groups")
    write(root, pictures=True)
    version, zone = CITIES[CITY]
    write_geopackage(root / "maps" / CITY / version / "map.gpkg", stub_rows(scale=SCALE), zone)
    photo = root / "sensor_blobs/test" / log_frames()[max(GROUPS) - 1]["cams"]["CAM_B0"]["data_path"]
    photo.write_bytes(turned(photo.read_bytes(), 3))
    lost = root / "navhard_two_stage/sensor_blobs" / log_frames()[max(GROUPS) + 8]["cams"]["CAM_B0"]["data_path"]
    data = lost.read_bytes()
    lost.unlink()
    assert imported(root) == COMPLETE_WITH_FAILURES
    document = json.loads((root / "out/benchmark.json").read_text())
    assert [len(clip["follow_ups"]) for clip in document["clips"]] == [len(pairs_of(GROUPS[0]))]
    errors = [row["error"] for row in Store(root / "out").outcomes.read().to_pylist()]
    assert len(errors) == 2 + 2 * len(pairs_of(GROUPS[1])) and all(f"{lost}: image: missing" in one for one in errors)
    lost.write_bytes(data)
    assert imported(root) == COMPLETE
    return root


def imported(root: Path) -> int:
    words = [f"root={root / 'navhard_two_stage'}", f"logs={root / 'navsim_logs/test'}", f"maps={root / 'maps'}"]
    words += [f"sensors={root / 'sensor_blobs/test'}", f"split={root / 'train_test_split/groups.yaml'}"]
    return factory(["import", "navhard", *words, f"out={root / 'out'}"])


def test_rows_weights_and_final_score_are_the_public_code_s(made: Path, tmp_path: Path) -> None:
    assert COLUMNS == ("nc", "dac", "tlc", "ddc", "ep", "ttc", "lk", "hc", "ec", "score")
    benchmark = BenchmarkFolder(str(made / "out"))
    settings = EvaluateSettings(str(made / "out"), out=str(tmp_path / "eval"), bounds=False, tables=False)
    lines = evaluate(benchmark, [find_planner("constant_velocity")], settings)
    clips = list(dict.fromkeys(key.clip_id for key in benchmark.keys))  # in the order of the split's groups
    rows = [row for row in read_rows(tmp_path / "eval/constant_velocity") if row.stage != "one_stage"]
    ours = {(clips.index(r.key.clip_id), r.key.kind, r.key.candidate_index): r.scores.filtered for r in rows}
    assert ours.keys() == PUBLIC.keys()
    for key, scores in ours.items():
        np.testing.assert_allclose(scores, PUBLIC[key], **CLOSE, err_msg=str(key))
    found = {(line.stage, line.human_filter): line.columns for line in lines}
    np.testing.assert_allclose(found["stage_one", "filtered"], STAGES["stage_one"], **CLOSE)
    np.testing.assert_allclose(found["stage_two", "none"], STAGES["stage_two"], **CLOSE)
    assert found["final", "filtered"][-1] == pytest.approx(FINAL, rel=0.0, abs=1e-11)
    assert abs(found["follow_ups", "none"][-1] - STAGES["stage_two"][-1]) > 0.1, "weights matter here"


def test_every_frame_has_the_pictures_of_its_own_history(made: Path) -> None:
    """Stage one those of the log, stage two those of the synthetic scenes, byte for byte, with their own rig.

    But for Exif data, by which whoever opens a row's JPEG would turn it.
    """
    clips = [clip["clip_id"] for clip in json.loads((made / "out/benchmark.json").read_text())["clips"]]
    rig, rows = log_frames()[0]["cams"], list(SampleTable(made / "out"))
    assert len(rows) == 2 * len(GROUPS) + 2 * sum(map(len, FOLLOW_UPS.values()))
    for row in rows:
        logged = row["expert"].startswith("human")
        at = GROUPS[clips.index(row["clip_id"])] - row["expert"].endswith("before") + (0 if logged else 8)
        assert row["image_source"] == ("photo" if logged else "render")
        found = {(image["camera"], round(2 * image["time_s"])): image["jpeg"] for image in row["images"]}
        stage = "sensor_blobs" if logged else "navhard_two_stage"
        assert found == {(camera, k): picture(stage, camera, at + k) for camera in rig for k in (-3, -2, -1, 0)}
        for camera in row["cameras"]:
            own = rig[camera["name"]]
            assert (camera["width"], camera["height"]) == (32, 18)
            np.testing.assert_array_equal(camera["intrinsics"].reshape(3, 3), own["cam_intrinsic"])
            np.testing.assert_array_equal(camera["distortion"], own["distortion"])
            pose = camera["ego_from_camera"].reshape(4, 4)
            np.testing.assert_array_equal(pose[:3, :3], own["sensor2lidar_rotation"])
            np.testing.assert_array_equal(pose[:3, 3], own["sensor2lidar_translation"])

"""NAVSIM's two-stage files as a benchmark: a town's log is stage one, its own frames 4 s later are stage two."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from factory.__main__ import main as factory
from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.store.samples import Store
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.scoring import drive, prepare_frame
from tasks.experts.pdm_closed.planner import PdmSettings
from tasks.rollout.simulate import TrafficSettings
from tasks.subscores import JUDGED
from tests.factory.datasets.navsim.navsim_town import NOW, TOKENS, frames_of, write_installation, write_split

pytestmark = pytest.mark.slow  # a town, a city's map, PDM-Closed


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_installation(tmp_path_factory.mktemp("navhard"))


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

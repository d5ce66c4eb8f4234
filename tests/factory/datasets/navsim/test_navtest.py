"""NAVSIM's one-stage benchmark: which frames count, what they are compared with, and their scores."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from factory.__main__ import main as factory
from factory.exits import COMPLETE
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.evaluate import main as evaluate
from planners.evaluation.frames import FrameKey
from planners.evaluation.score_rows import read_rows
from tasks.reward.aggregate import COLUMNS
from tests.factory.datasets.navsim.navsim_town import NOW, frames_of, write_installation

pytestmark = pytest.mark.slow  # a town, a city's map, PDM-Closed
EC = COLUMNS.index("ec")
ABSENT = "f" * 16


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_installation(tmp_path_factory.mktemp("navtest"))


@pytest.fixture(scope="module")
def tokens(installed: Path) -> list[str]:
    """Of two frames in a row, one on its own, and one that no log has."""
    (path,) = (installed / "navsim_logs" / "test").glob("*.pkl")
    frames = frames_of(path)
    return [frames[NOW]["token"], ABSENT, frames[NOW + 2]["token"], frames[NOW - 1]["token"]]


@pytest.fixture(scope="module")
def made(installed: Path, tokens: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "navtest"
    split = installed / "lone.yaml"
    split.write_text(yaml.safe_dump({"tokens": tokens, "frame_interval": 1, "num_future_frames": 8}))
    words = [f"root={installed / 'navsim_logs' / 'test'}", f"maps={installed / 'maps'}", f"split={split}"]
    assert factory(["import", "navtest", *words, "pictures=false", f"out={out}"]) == COMPLETE
    return out


def test_each_token_is_a_clip_that_names_the_one_before_it(made: Path, tokens: list[str]) -> None:
    benchmark = BenchmarkFolder(str(made))
    assert benchmark.one_stage and benchmark.left_out == 1
    assert list(benchmark.tokens.values()) == [tokens[3], tokens[0], tokens[2]]
    first, second, third = (key.clip_id for key in benchmark.keys)
    assert [benchmark.before_of(clip_id) for clip_id in (first, second, third)] == [None, first, None]
    (left_out,) = json.loads((made / "benchmark.json").read_text())["left_out"]
    assert left_out == {"token": ABSENT, "why": "absent_token"}
    np.testing.assert_allclose(
        benchmark.scene(second).ego_history[-6], benchmark.scene(first).ego_state, atol=1e-6
    )  # 0.5 s apart


def test_a_frame_scores_as_in_one_stage_of_a_pair(
    installed: Path, made: Path, tokens: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The frame with one before it is the logged frame of a navhard group; the others go without extended comfort."""
    assert evaluate([f"benchmark={made}", "planner=constant_velocity", f"out={tmp_path / 'lone'}"]) == 0
    assert "1 of its 4 clips are left out" in capsys.readouterr().out
    logs = f"logs={installed / 'navsim_logs' / 'test'}"
    words = [f"root={installed / 'navhard_two_stage'}", logs, f"maps={installed / 'maps'}"]
    pair = tmp_path / "pair"
    assert (
        factory(["import", "navhard", *words, f"split={installed / 'split.yaml'}", "pictures=false", f"out={pair}"])
        == COMPLETE
    )
    assert evaluate([f"benchmark={pair}", "planner=constant_velocity", f"out={tmp_path / 'two'}"]) == 0
    named = BenchmarkFolder(str(made)).tokens
    for who in ("human", "pdm_closed", "constant_velocity"):
        rows = {named[row.key]: row for row in read_rows(tmp_path / "lone" / who)}
        assert set(rows) == {tokens[0], tokens[2], tokens[3]}
        (twin,) = (row for row in read_rows(tmp_path / "two" / who) if row.stage == "one_stage")
        assert twin.key.kind == FrameKey.logged("").now.kind
        np.testing.assert_array_equal(rows[tokens[0]].scores.unfiltered, twin.scores.unfiltered)
        np.testing.assert_array_equal(rows[tokens[0]].scores.filtered, twin.scores.filtered)
        assert np.isnan([rows[token].scores.filtered[EC] for token in tokens[2:]]).all()
        assert not np.isnan(twin.scores.filtered[EC])
        with (tmp_path / "lone" / who / "navsim_filtered.csv").open() as file:
            table = list(csv.DictReader(file))
        assert [row["token"] for row in table] == [tokens[3], tokens[0], tokens[2], "average_all_frames"]
        mean = np.mean([row.scores.filtered[-1] for row in rows.values()])
        assert float(table[-1]["score"]) == pytest.approx(mean, abs=1e-15)


def test_a_split_without_a_second_stage_is_no_navhard(
    installed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    split = installed / "one_stage.yaml"
    split.write_text(yaml.safe_dump({"defaults": [{"scene_filter": "small"}], "data_split": "test"}))
    logs = f"logs={installed / 'navsim_logs' / 'test'}"
    words = [f"root={installed / 'navhard_two_stage'}", logs, f"maps={installed / 'maps'}", "pictures=false"]
    assert factory(["import", "navhard", *words, f"split={split}", f"out={tmp_path / 'out'}"]) == 2
    assert "names no scenes of a second stage" in capsys.readouterr().err

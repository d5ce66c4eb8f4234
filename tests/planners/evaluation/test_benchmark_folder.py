"""A benchmark on disk gives the frames of the one in memory, and says what it lacks."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

from factory.config.compose import ConfigError
from factory.config.run import load_config
from planners.evaluation.benchmark_folder import MADE_BY, BenchmarkFolder
from planners.evaluation.evaluate import EvaluateSettings, evaluate, main
from planners.evaluation.planner_names import find_planners
from planners.evaluation.score_rows import read_rows
from planners.evaluation.scoring import Rules, prepare_clip, score_clip
from tests.pages import commands
from tests.planners.small_benchmark import StreetBenchmark, straight, write_benchmark_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_benchmark_folder(tmp_path_factory.mktemp("benchmark"))


def test_frames_scenes_and_samples_are_those_that_were_stored(folder: Path) -> None:
    stored, memory = BenchmarkFolder(str(folder)), StreetBenchmark()
    assert stored.keys == memory.keys
    assert {stored.image_source(key) for key in stored.keys} == {"none"}
    seen = dict(stored.stream(["ego_status", "attempt_id"]))
    assert set(seen) == set(stored.keys)
    for key, sample in seen.items():
        assert sample["attempt_id"] == stored.sample(key)["attempt_id"] == memory.sample(key)["attempt_id"]
        np.testing.assert_allclose(sample["ego_status"], memory.sample(key)["ego_status"], rtol=1e-6)
    plans = {key: straight(8.0) for key in stored.keys}
    for ours, theirs in zip(
        score_clip(prepare_clip(stored.scenes("a"), Rules()), plans),
        score_clip(prepare_clip(memory.scenes("a"), Rules()), plans),
    ):
        np.testing.assert_array_equal(ours.scores.unfiltered, theirs.scores.unfiltered)
        assert ours.key == theirs.key


def test_the_command_scores_a_benchmark_on_disk(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planners = "planners=[human,pdm_closed]"
    assert main([f"benchmark={folder}", planners, "bounds=false", f"out={tmp_path}", "only_logs=[log-a]"]) == 0
    assert "pdm_closed" in capsys.readouterr().out
    rows = read_rows(tmp_path / "pdm_closed")
    assert {row.key.clip_id for row in rows} == {"a"} and len(rows) == 7
    memory = StreetBenchmark(("a",))
    evaluate(
        memory, find_planners("pdm_closed", None, bounds=False), EvaluateSettings("", out=str(tmp_path / "memory"))
    )
    for stored, kept in zip(rows, read_rows(tmp_path / "memory" / "pdm_closed")):
        np.testing.assert_allclose(stored.scores.filtered, kept.scores.filtered)
        assert stored.tags == kept.tags
        assert stored.log_id == kept.log_id == "log-a"
    assert main([f"benchmark={folder}", planners, f"out={tmp_path}", "only_logs=[log-c]"]) == 2
    assert "only_logs=log-c: no clip of benchmark=" in capsys.readouterr().err


def test_its_digest_is_that_of_its_content(folder: Path, tmp_path: Path) -> None:
    assert BenchmarkFolder(str(folder)).digest == BenchmarkFolder(str(folder)).digest
    other = write_benchmark_folder(tmp_path / "other", ("a",))
    assert BenchmarkFolder(str(other)).digest != BenchmarkFolder(str(folder)).digest


def test_what_is_missing_is_named_at_once(tmp_path: Path) -> None:
    def refused(message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            BenchmarkFolder(str(tmp_path))

    refused(r"no benchmark.json here: make it, .*python -m factory.run preset=hard_benchmark .*out=/")
    write_benchmark_folder(tmp_path, ("a",))
    document = json.loads((tmp_path / "benchmark.json").read_text())

    def rewritten(**changes: object) -> None:
        (tmp_path / "benchmark.json").write_text(json.dumps(document | changes))

    rewritten(clips=[{"clip_id": "a", "log_id": "log-a", "follow_ups": [0, 5]}])
    refused("clip a, frame follow_up 5 has no sample")
    rewritten(clips=[], left_out=[{"why": "few_follow_ups"}])
    refused("none of its clips counts: few_follow_ups")
    rewritten(format=99)
    refused("format 99")
    (tmp_path / "benchmark.json").write_text("{")
    refused("cannot be read")
    rewritten()
    data = (tmp_path / "scenes" / "a.clip").read_bytes()
    (tmp_path / "scenes" / "a.clip").write_bytes(data[: len(data) // 2])
    with pytest.raises(ConfigError, match="scenes of clip a"):
        BenchmarkFolder(str(tmp_path)).scenes("a")
    (tmp_path / "scenes" / "a.clip").unlink()
    refused("no scenes of 1 clips, such as a")


def test_a_page_names_the_command_that_a_refusal_does_and_the_factory_takes_it() -> None:
    made_by = tuple(shlex.split(MADE_BY))
    assert [command for command in commands("docs/training.md") if command.words[: len(made_by)] == made_by]
    assert "follow_up" in load_config([*made_by[3:], "out=x"]).experts

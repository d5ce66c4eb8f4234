"""NAVSIM's benchmarks by their names: one command from its folders to the table, made once, refused by what lacks."""

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from factory.config.compose import ConfigError
from factory.datasets.navsim.commands import IN_DEVKIT
from planners.drive.drivers import make_driver
from planners.evaluation.benchmark_folder import BenchmarkFolder
from planners.evaluation.evaluate import main
from planners.evaluation.navsim import LONG, read_table, score_of_columns
from planners.evaluation.navsim_check import solver_line
from planners.evaluation.planner_names import find_planner
from planners.evaluation.planning import read_plans
from planners.navsim.submit import submission_bytes
from tasks.reward.aggregate import COLUMNS
from tasks.subscores import OF_ONE_PLAN
from tests.factory.datasets.navsim.navsim_town import NOW, TOKENS, frames_of, write_installation

pytestmark = pytest.mark.slow  # a town, a city's map, PDM-Closed


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """NAVSIM's folders and a checkout with the two splits."""
    root = write_installation(tmp_path_factory.mktemp("openscene"))
    (path,) = (root / "navsim_logs" / "test").glob("*.pkl")
    frames = frames_of(path)
    splits = root / "devkit" / IN_DEVKIT
    (splits / "scene_filter").mkdir(parents=True)
    shutil.move(root / "split.yaml", splits / "navhard_two_stage.yaml")
    shutil.move(root / "scene_filter" / "small.yaml", splits / "scene_filter" / "small.yaml")
    lone = {"tokens": [frames[at]["token"] for at in (NOW - 1, NOW)], "frame_interval": 1, "num_future_frames": 8}
    (splits / "scene_filter" / "navtest.yaml").write_text(yaml.safe_dump(lone))
    split = {"defaults": [{"scene_filter": "navtest"}], "data_split": "test"}
    (splits / "navtest.yaml").write_text(yaml.safe_dump(split))
    return root


@pytest.fixture(autouse=True)
def variables(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OPENSCENE_DATA_ROOT", "NUPLAN_MAPS_ROOT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NAVSIM_DEVKIT_ROOT", str(root / "devkit"))


def words(root: Path, name: str, out: Path) -> list[str]:
    who = ["planner=constant_velocity", "bounds=false", "pictures=false"]
    return [f"benchmark={name}", f"data={root}", *who, f"made={out / 'made'}", f"out={out / 'out'}"]


def test_navhard_and_navtest_are_one_command_each_and_made_once(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = {
        "navhard": ["stage_one", "stage_one", "stage_two", "follow_ups", "final", "final"],
        "navtest": ["one_stage", "one_stage"],
    }
    for name, stages in lines.items():
        out = tmp_path / name
        assert main(words(root, name, out)) == 0
        said = capsys.readouterr().out
        assert f"benchmark {out}/made/{name}: " in said and "left out 0" in said
        told = [line.split()[1] for line in said.splitlines() if line.startswith("constant_velocity ")]
        assert told[-len(stages) :] == stages
        table = read_table(out / "out" / "constant_velocity" / "navsim_filtered.csv")
        assert set(table.follow_ups) == (set(TOKENS) if name == "navhard" else set())
        assert len(table.logged) == 2
        # by NAVSIM's own variables, and what is whole is not made again
        monkeypatch.setenv("OPENSCENE_DATA_ROOT", str(root))
        assert main([word for word in words(root, name, out) if not word.startswith("data=")]) == 0
        assert "left out" not in capsys.readouterr().out


def test_the_plans_that_an_agent_of_navsim_s_submitted_are_scored_as_the_agent(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of both stages, without asking it; a submission that lacks a scene is refused by the scene's token."""
    assert main(words(root, "navhard", tmp_path)) == 0
    tokens = BenchmarkFolder(str(tmp_path / "made" / "navhard")).tokens
    made = read_plans(tmp_path / "out" / "constant_velocity")
    assert made is not None
    plans = {tokens[key]: plan[4::5].astype(np.float32) for key, plan in made.items()}
    second = {token: plans.pop(token) for token in TOKENS}
    submission = tmp_path / "submission.pkl"
    submission.write_bytes(submission_bytes({}, plans, second))
    asked = [word for word in words(root, "navhard", tmp_path) if not word.startswith("planner=")]
    assert main([*asked, "planners={submitted: " + str(submission) + "}"]) == 0
    mine, theirs = (
        read_table(tmp_path / "out" / who / "navsim_filtered.csv") for who in ("constant_velocity", "submitted")
    )
    for stage in ("logged", "follow_ups"):
        here, there = getattr(mine, stage), getattr(theirs, stage)
        assert here.keys() == there.keys() and here
        for token in here:  # float32 poses of the submission
            np.testing.assert_allclose(here[token], there[token], atol=1e-5)
    capsys.readouterr()
    lacking = min(second)
    submission.write_bytes(submission_bytes({}, plans, {t: plan for t, plan in second.items() if t != lacking}))
    assert main([*asked, f"planner={submission}"]) == 2
    assert f"no plan for 1 of {len(made)} frames, such as token {lacking}" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="plans nothing but what it holds"):
        make_driver(find_planner(str(submission)))


def test_a_benchmark_of_other_files_is_not_taken_for_this_one(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words(root, "navtest", tmp_path)) == 0
    (log,) = (root / "navsim_logs" / "test").glob("*.pkl")
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    (copy / log.relative_to(root)).touch()
    assert main(words(copy, "navtest", tmp_path)) == 2
    assert "was made of other files than these: remove it, or choose another made=" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"data": None}, "give data=... or set OPENSCENE_DATA_ROOT"),
        ({"data": "nowhere"}, "data nowhere is missing: the folder of navsim_logs"),
        ({"maps": "nowhere"}, "maps nowhere is missing: nuPlan's maps"),
        ({"split": "nowhere.yaml"}, "split nowhere.yaml is missing"),
        ({"pictures": "true"}, "sensor_blobs/test is missing: the pictures of its logs (pictures=false"),
        ({"benchmark": "runs/hard"}, "are of benchmark=navhard or navtest alone"),
    ],
)
def test_what_is_missing_is_named(
    root: Path, tmp_path: Path, change: dict[str, str | None], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = dict(word.split("=", 1) for word in words(root, "navhard", tmp_path))
    asked = {name: value for name, value in (given | change).items() if value is not None}
    assert main([f"{name}={value}" for name, value in asked.items()]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "made").exists()


def test_a_folder_without_logs_or_scenes_is_named(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    empty = tmp_path / "empty"
    (empty / "maps").mkdir(parents=True)
    assert main(words(empty, "navtest", tmp_path)) == 2
    assert f"{empty}/navsim_logs/test is missing: its logs" in capsys.readouterr().err
    (empty / "navsim_logs" / "test").mkdir(parents=True)
    assert main(words(empty, "navhard", tmp_path)) == 2
    assert "synthetic_scene_pickles is missing: the scenes of its second stage" in capsys.readouterr().err
    monkeypatch.delenv("NAVSIM_DEVKIT_ROOT")
    assert main(words(root, "navtest", tmp_path)) == 2
    assert "give split=... or set NAVSIM_DEVKIT_ROOT" in capsys.readouterr().err


def test_navtest_is_checked_against_published_rows_on_one_page(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows of the audit have no extended comfort; what differs is counted, and drawn first."""
    told = [*words(root, "navtest", tmp_path), "limit=1"]
    assert main(told) == 0
    with (tmp_path / "out" / "constant_velocity" / "navsim_unfiltered.csv").open() as file:
        (row, _) = csv.DictReader(file)
    ours = {name: float(row[name]) for name in (LONG[name] for name in OF_ONE_PLAN)}
    named = np.full(len(COLUMNS), np.nan)
    for name in OF_ONE_PLAN:
        named[COLUMNS.index(name)] = ours[LONG[name]]
    published = tmp_path / "rows.csv"
    capsys.readouterr()
    for changed, n in ((0.0, 0), (0.25, 1)):
        line = {**ours, LONG["ep"]: ours[LONG["ep"]] - changed, "score": score_of_columns(named[None])[0]}
        with published.open("w") as file:
            table = csv.DictWriter(file, ["token", *line])
            table.writeheader()
            table.writerows({"token": token, **line} for token in (row["token"], "f" * 16))
        assert main([*told, f"check={published}"]) == 0
        said = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines() if line}
        assert said["numpy"][-4:] == ["sound", "in", "501", "plans"] and said["1"][1] == "tokens"
        assert [said[LONG[name]][-2] for name in ("ep", "nc")] == [str(n), "0"] and said["score"][-2] == "0"
        page = (tmp_path / "out" / "constant_velocity" / ".." / "check.html").read_text()
        assert row["token"] in page and page.count("data:image/jpeg") == 1
    assert main([*told, f"check={published}", "navsim_python=/bin/false"]) == 2
    assert "navsim_python=/bin/false: no message: give the python of" in capsys.readouterr().err
    published.write_text("token,score\nf,1.0\n")
    assert main([*told, f"check={published}"]) == 2
    assert "no column 'no_at_fault_collisions'" in capsys.readouterr().err


def test_an_affected_solver_is_named_with_what_it_makes_of_a_speed() -> None:
    found = {"numpy": "1.23.4", "python": "3.9", "machine": "x", "plans": 501, "wrong": 2, "worst_mps": -491.2}
    line = solver_line({**found, "speed_mps": 12.533835468245853})
    assert "IS AFFECTED: 2 of 501 speeds are wrong, such as -491.2 m/s for 12.5338; OPENBLAS_CORETYPE=" in line

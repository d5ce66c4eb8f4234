"""A sweep's tables: each setup is held against real samples alone of its own planner, seed by seed."""

import csv
import re
from pathlib import Path

import pytest

from factory.exits import BAD_CONFIG
from planners.evaluation.aggregation import scores_of
from planners.evaluation.frames_file import FRAMES
from planners.evaluation.score_rows import read_rows, write_rows
from planners.study.report import StudyFrames, compared, main, read_study, write_study, write_tables
from planners.study.scaling import ScalingSettings, SweepData, comparisons_of, trainings_of
from tests.planners.made_rows import clip_rows

LOGS = Path(__file__).parents[3] / "docs" / "study" / "logs"
SCORES = {0: 0.5, 1: 0.6, 2: 0.75}  # by rounds


def sweep(tmp_path: Path, rounds: tuple[int, ...], end_m: float = 0.0) -> StudyFrames:
    """The rows of two planners and seeds on three clips; the second planner and seed are better by 0.01 and 0.02."""
    settings = ScalingSettings(
        data=SweepData(("real",), ("sim",)),
        benchmark="bench",
        out=str(tmp_path),
        planners=("ltf", "ego_mlp"),
        experts=("recovery", "pdm_closed"),
        rounds=rounds,
        sim_ratios=("natural",),
        imitation=("all",),
        real_shares=(1.0,),
        seeds=2,
    )
    trainings = trainings_of(settings)
    for training in trainings:
        facts = training.facts
        score = SCORES[facts["rounds"]] + 0.01 * (facts["planner"] == "ego_mlp") + 0.02 * facts["seed"]
        evaluated(tmp_path / training.label, score, end_m)
    evaluated(tmp_path / "pdm_closed", 0.8)
    facts = [{"training": training.label, **training.facts, "real": 10, "simulated": 5} for training in trainings]
    labels = [*(training.label for training in trainings), "pdm_closed"]
    write_study(
        tmp_path / FRAMES, ((label, read_rows(tmp_path / label)) for label in labels), facts, comparisons_of(settings)
    )
    return read_study(tmp_path / FRAMES)


def evaluated(folder: Path, score: float, end_m: float = 0.0) -> None:
    folder.mkdir()
    follow_ups = [((score, score), (0.0, 0.0), (0.0, 0.0))]
    ends = ((end_m, 0.0), (end_m, 0.0))
    write_rows(folder, [row for clip in "abc" for row in clip_rows(clip, score, (score, score), ends, follow_ups)])


@pytest.mark.slow
def test_every_setup_is_held_against_real_samples_alone_of_its_planner(tmp_path: Path) -> None:
    rows = compared(sweep(tmp_path, (0, 1, 2)))
    assert len(rows) == 2 * (1 + 2 * 2) * 8
    for row in rows:
        assert row["seeds"] == 2
        if row["rounds"] == 0:
            assert row["difference"] == row["low"] == row["high"] == ""
        elif row["stage"] != "final":  # the product of both stages
            expected = 100.0 * (SCORES[row["rounds"]] - SCORES[0])
            assert [row["difference"], row["low"], row["high"]] == pytest.approx([expected] * 3)
    (one, _) = [r for r in rows if (r["planner"], r["rounds"], r["stage"]) == ("ego_mlp", 0, "one_stage")]
    assert (one["epdms"], one["each"]) == (pytest.approx(52.0), "51.0 53.0")
    said = write_tables(tmp_path, tmp_path, "unfiltered")
    assert re.search(r"ltf-recovery2-epochs +epochs +2 +57\.77 +\+31\.75 ", said) and "pdm_closed" in said


def test_a_sweep_without_real_samples_alone_has_no_differences(tmp_path: Path) -> None:
    rows = compared(sweep(tmp_path, (1, 2)))
    assert rows and all(row["difference"] == "" for row in rows)


def test_plans_that_end_far_from_every_follow_up_are_counted(tmp_path: Path) -> None:
    for end_m, share in ((0.0, 0.0), (50.0, 1.0)):
        folder = tmp_path / str(end_m)
        folder.mkdir()
        sweep(folder, (0,), end_m)
        write_tables(folder, folder, "unfiltered")
        assert {float(row["uniform_share"]) for row in csv.DictReader((folder / "trainings.csv").open())} == {share}


def test_bounds_are_those_that_were_evaluated(tmp_path: Path) -> None:
    sweep(tmp_path, (0,))
    write_tables(tmp_path, tmp_path, "unfiltered")
    (row,) = csv.DictReader((tmp_path / "bounds.csv").open())
    assert row["planner"] == "pdm_closed" and float(row["stage_two"]) == pytest.approx(80.0)


@pytest.mark.parametrize("table", ["trainings", "comparisons", "bounds"])
def test_the_committed_tables_are_those_of_the_committed_rows(tmp_path: Path, table: str) -> None:
    folder = LOGS / "av2_7fab2350" / "stage_two"
    write_tables(folder, tmp_path, "unfiltered")
    kept, made = ((where / f"{table}.csv").read_text().splitlines() for where in (folder, tmp_path))
    assert len(kept) == len(made) > 1 and kept[0] == made[0]
    for line, again in zip(kept[1:], made[1:]):
        for cell, other in zip(line.split(","), again.split(","), strict=True):
            assert cell == other or float(cell) == pytest.approx(float(other), abs=2e-3)


@pytest.mark.slow
def test_the_tables_are_made_again_to_the_byte_of_the_rows_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep(tmp_path, (0, 1))
    write_tables(tmp_path, tmp_path, "unfiltered")
    rows = list(csv.DictReader((tmp_path / "trainings.csv").open()))
    again = tmp_path / "again"
    assert main([f"folder={tmp_path}", f"out={again}"]) == 0
    assert {"bounds.csv", "comparisons.csv", "trainings.csv", "clips.csv"} < {path.name for path in again.iterdir()}
    for path in again.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes()
    folder = tmp_path / "ltf-recovery1-epochs-0"
    (mine,) = (row for row in rows if (row["planner"], row["data"], row["seed"]) == ("ltf", "recovery", "0"))
    for name, score in scores_of(folder).items():
        assert float(mine[name]) == pytest.approx(score, abs=1e-4)
    assert main([f"folder={again}"]) == BAD_CONFIG
    assert "frames.parquet" in capsys.readouterr().err

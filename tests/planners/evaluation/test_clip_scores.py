"""A study's clips.csv: intervals drawn from it are those drawn from the runs themselves."""

import csv
from pathlib import Path

import numpy as np
import pytest

from factory.exits import BAD_CONFIG
from planners.evaluation.aggregation import MEASURES
from planners.evaluation.clip_scores import FACTS, measured, read_clips, write_clips
from planners.evaluation.compare import CompareSettings, compare, intervals, main
from tests.planners.evaluation.test_bootstrap import run

SETTINGS = CompareSettings(a="", b="", draws=500)
RUNS = {"real-0": run(), "real-1": run(0.05), "sim-0": run(0.11), "sim-1": run(0.02)}


@pytest.fixture
def table(tmp_path: Path) -> Path:
    write_clips(tmp_path / "clips.csv", RUNS)
    return tmp_path / "clips.csv"


def test_what_is_read_is_what_was_scored(table: Path) -> None:
    found, scored = read_clips(table, ["sim-0", "real-1"]), measured([RUNS["sim-0"], RUNS["real-1"]], "score")
    assert tuple(found) == MEASURES
    for name, values in found.items():
        assert (values.clips, values.logs) == (scored[name].clips, scored[name].logs)
        np.testing.assert_allclose(values.scores, scored[name].scores, atol=1e-6)
        np.testing.assert_array_equal(values.weights, scored[name].weights)


def test_intervals_of_the_table_are_those_of_the_runs(table: Path) -> None:
    sides = ["real-0", "real-1"], ["sim-0", "sim-1"]
    of_runs = compare(*([RUNS[label] for label in side] for side in sides), SETTINGS)
    of_table = intervals(*(read_clips(table, side) for side in sides), SETTINGS)
    for name, by_level in of_table.items():
        assert list(by_level) == list(of_runs[name]) == ["clip", "log", "town"]
        for level, found in by_level.items():
            for what in ("a", "b", "difference", "low", "high"):
                assert getattr(found, what) == pytest.approx(getattr(of_runs[name][level], what), abs=2e-6)


def test_the_command_compares_columns_and_refuses_what_is_none(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sides = [f"table={table}", "a=[real-0,real-1]", "b=[sim-0,sim-1]"]
    assert main([*sides, f"out={table.parent / 'out.csv'}"]) == 0
    assert "stage_two" in capsys.readouterr().out
    assert (table.parent / "out.csv").read_text().count("\n") == 1 + len(MEASURES)
    assert main([f"table={table}", "a=real-0", "b=sim-7"]) == BAD_CONFIG
    assert "no run sim-7; it has real-0, real-1, sim-0, sim-1" in capsys.readouterr().err
    assert main([*sides, "column=nc"]) == BAD_CONFIG
    assert "holds scores alone" in capsys.readouterr().err
    assert main([f"table={table.parent / 'none.csv'}", "a=real-0", "b=sim-0"]) == BAD_CONFIG
    assert "none.csv" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("planner,score\na,1\n", "its columns must begin with"),
        ("", "its columns"),
        ("{head},a\nfinal,filtered,log,c,1,x\n", "'x'"),
    ],
)
def test_what_is_no_such_table_is_said(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "clips.csv"
    path.write_text(text.format(head=",".join(FACTS)))
    with pytest.raises(ValueError, match=f"clips.csv.*{said}"):
        read_clips(path, ["a"])


STUDY = Path(__file__).parents[3] / "docs" / "study"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("study", "least"),
    [(STUDY, 64), (STUDY / "again", 300), (STUDY / "long", 12), (STUDY / "published", 40)],
    ids=["study", "again", "long", "published"],
)
def test_the_studys_comparisons_are_those_of_its_clips(study: Path, least: int) -> None:
    with (study / "comparisons.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    with (study / "clips.csv").open(newline="") as file:
        there = set(next(csv.reader(file)))
    checked, drawn = 0, 0
    for row in rows:
        a, b = ([f"{row[side]}-{seed}" for seed in range(int(row["seeds"]))] for side in ("reference", "setup"))
        if not row["reference"] or not there.issuperset([*a, *b]):
            continue
        name = row["stage"], row["human_filter"]
        of_a, of_b = (read_clips(study / "clips.csv", side)[name] for side in (a, b))
        mean_a, mean_b = (100.0 * (x.scores * x.weights).sum() / x.weights.sum() for x in (of_a, of_b))
        assert mean_b == pytest.approx(float(row["epdms"]), abs=1e-3)
        assert mean_b - mean_a == pytest.approx(float(row["difference"]), abs=2e-3)
        checked += 1
        if row["stage"] == "final" and drawn < 3:  # with all draws, of which each takes a second
            found = intervals({name: of_a}, {name: of_b}, CompareSettings(a="", b=""))[name]["clip"]
            assert 100.0 * found.low == pytest.approx(float(row["low"]), abs=2e-3)
            assert 100.0 * found.high == pytest.approx(float(row["high"]), abs=2e-3)
            drawn += 1
    assert checked >= least and drawn == 3

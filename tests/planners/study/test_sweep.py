"""What a sweep reports on: all that is trained and evaluated as it is now, whatever was interrupted."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from factory.exits import Stopped
from planners.evaluation.aggregation import group_by_clip, scores_in_percent
from planners.evaluation.evaluate import EvaluateSettings, evaluate
from planners.evaluation.planner_names import find_planner
from planners.evaluation.score_rows import read_rows
from planners.study import sweep as sweep_module
from planners.study.setups import Comparison, Setup
from planners.study.sweep import EVALUATIONS, SweepSettings, evaluated_labels, run
from planners.training.checkpoint import save_checkpoint
from planners.training.many import DONE, Training, folder_of
from tests.planners.evaluation.test_evaluate import settings
from tests.planners.small_benchmark import StreetBenchmark, write_benchmark_folder
from tests.planners.toy import Toy, ToySettings


def train(out: Path, training: Training, weight: float = 0.0, step: int = 1) -> None:
    toy = Toy(ToySettings(), {})
    for parameter in toy.parameters():
        torch.nn.init.constant_(parameter, weight)
    record = {"parameters": 2, "trained": {"steps": step}, "samples": {"real": 3, "simulated": 4}}
    save_checkpoint(folder_of(out, training), step, toy, record, {})
    (folder_of(out, training) / DONE).write_text(json.dumps(list(training.overrides)))


def score(out: Path, rules: EvaluateSettings, *trainings: Training) -> None:
    trained = [find_planner(str(folder_of(out, one)), one.label) for one in trainings]
    evaluate(StreetBenchmark(), [find_planner("constant_velocity"), *trained], rules)


def test_what_is_evaluated_is_reported_and_what_changed_since_is_not(tmp_path: Path) -> None:
    rules = settings(tmp_path / EVALUATIONS)
    a, b, c = (Training(label, (f"seed={label}",)) for label in "abc")
    planned = [a, b, c, Training("ab", members=("a", "b"))]
    assert evaluated_labels(planned, tmp_path) == set()
    train(tmp_path, a)
    assert evaluated_labels(planned, tmp_path) == set(), "nothing is evaluated yet"
    score(tmp_path, rules, a)
    assert evaluated_labels(planned, tmp_path) == {"a"}
    train(tmp_path, c)
    score(tmp_path, rules, c)
    assert evaluated_labels(planned, tmp_path) == {"a", "c"}, "a part behind one that is not done counts"

    other_overrides = [replace(a, overrides=("seed=9",)), *planned[1:]]
    assert evaluated_labels(other_overrides, tmp_path) == {"c"}
    train(tmp_path, a, weight=0.1, step=2)
    assert evaluated_labels(planned, tmp_path) == {"c"}, "it was trained again since"
    score(tmp_path, rules, a)
    assert evaluated_labels(planned, tmp_path) == {"a", "c"}
    score(tmp_path, replace(rules, one_stage_traffic=rules.two_stage_traffic), c)
    assert evaluated_labels(planned, tmp_path) == {"c"}, "the other was evaluated by other rules"


@pytest.mark.slow
def test_a_sweep_stops_where_something_is_missing_and_is_reported_when_all_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    benchmark = write_benchmark_folder(tmp_path / "benchmark")
    sweep = SweepSettings(benchmark=str(benchmark), out=str(tmp_path), report=str(tmp_path / "report"))
    setups = [Setup("ltf", data, rounds, "steps") for data, rounds in (("real", 0), ("recovery", 1))]
    asked = first, second = [Training(one.label_of(0), ("seed=0",), {**vars(one), "seed": 0}) for one in setups]
    wanted = [Comparison("main", setups[0], None, 1, "steps"), Comparison("main", setups[1], setups[0], 1, "steps")]

    def cut_short(*_: object) -> None:
        raise Stopped("out of minutes")

    monkeypatch.setattr(sweep_module, "train_all", cut_short)
    train(tmp_path, first)
    score(tmp_path, settings(tmp_path / EVALUATIONS), first)
    with pytest.raises(Stopped, match="1 of 2 planners are evaluated: the same command goes on"):
        run(sweep, asked, asked, wanted)
    report = tmp_path / "report"
    assert not report.exists()

    monkeypatch.setattr(sweep_module, "train_all", lambda trainings, out, means: train(out, second, weight=0.1))
    monkeypatch.setattr(
        sweep_module, "evaluate_all", lambda who, out, *_: score(out, settings(out / EVALUATIONS), first, second)
    )
    run(sweep, asked, asked, wanted)
    assert "tables.md" in capsys.readouterr().out
    alone, more = csv.DictReader((report / "trainings.csv").open())
    assert (alone["data"], alone["optimiser_steps"], more["data"]) == ("real", "1", "recovery")
    assert (alone["real"], more["simulated"]) == ("3", "4")
    for row, training in ((alone, first), (more, second)):
        rows = read_rows(tmp_path / EVALUATIONS / training.label)
        for name, found in scores_in_percent(group_by_clip(rows)).items():
            assert float(row[name]) == pytest.approx(found, abs=1e-4)
    differences = [row["difference"] for row in csv.DictReader((report / "comparisons.csv").open())]
    assert "" in differences[: len(differences) // 2] and "" not in differences[len(differences) // 2 :]
    made = {path.name: path.read_bytes() for path in report.iterdir()}
    assert {"frames.parquet", "tables.md", "bounds.csv"} < set(made)
    run(sweep, asked, asked, wanted)
    assert {path.name: path.read_bytes() for path in report.iterdir()} == made

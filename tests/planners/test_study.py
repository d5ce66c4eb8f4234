"""What the study reports on: all that is trained and evaluated as it is now, whatever was interrupted."""

import json
from dataclasses import replace
from pathlib import Path

import torch

from planners.checkpoint import save_checkpoint
from planners.contenders import contender
from planners.evaluate import EvaluateSettings, evaluate
from planners.study import evaluated
from planners.study_plan import Portion
from planners.sweep import DONE, EVALUATIONS, Training, folder_of
from tests.planners.small_benchmark import StreetBenchmark
from tests.planners.test_evaluate import settings
from tests.planners.toy import Toy, ToySettings


def train(out: Path, training: Training, weight: float = 0.0, step: int = 1) -> None:
    toy = Toy(ToySettings(), {})
    for parameter in toy.parameters():
        torch.nn.init.constant_(parameter, weight)
    save_checkpoint(folder_of(out, training), step, toy, {}, {})
    (folder_of(out, training) / DONE).write_text(json.dumps(list(training.overrides)))


def score(out: Path, rules: EvaluateSettings, *trainings: Training) -> None:
    trained = [contender(str(folder_of(out, one)), one.label) for one in trainings]
    evaluate(StreetBenchmark(), [contender("constant_velocity"), *trained], rules)


def test_what_is_evaluated_is_reported_and_what_changed_since_is_not(tmp_path: Path) -> None:
    rules = settings(tmp_path / EVALUATIONS)
    a, b, c = (Training(label, (f"seed={label}",)) for label in "abc")
    joined = {"ab": f"{folder_of(tmp_path, a)}+{folder_of(tmp_path, b)}"}
    planned = [Portion("main", 0, (a, b), {}), Portion("ensemble", 0, (c,), joined)]
    assert evaluated(planned, tmp_path) == set()
    train(tmp_path, a)
    assert evaluated(planned, tmp_path) == set(), "nothing is evaluated yet"
    score(tmp_path, rules, a)
    assert evaluated(planned, tmp_path) == {"a"}
    train(tmp_path, c)
    score(tmp_path, rules, c)
    assert evaluated(planned, tmp_path) == {"a", "c"}, "a part behind one that is not done counts"

    other_overrides = [Portion("main", 0, (replace(a, overrides=("seed=9",)), b), {}), planned[1]]
    assert evaluated(other_overrides, tmp_path) == {"c"}
    train(tmp_path, a, weight=0.1, step=2)
    assert evaluated(planned, tmp_path) == {"c"}, "it was trained again since"
    score(tmp_path, rules, a)
    assert evaluated(planned, tmp_path) == {"a", "c"}
    score(tmp_path, replace(rules, one_stage_traffic=rules.two_stage_traffic), c)
    assert evaluated(planned, tmp_path) == {"c"}, "the other was evaluated by other rules"

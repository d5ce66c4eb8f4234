"""The moving average of weights: its closed form, and that a training goes on from both kinds of weights."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from factory.exits import Stopped
from planners.training.checkpoint import load_planner, load_training, newest
from planners.training.fit import Loop, fit
from planners.training.optim import RAW, Averaged, TrainingSettings
from tests.planners.toy import Toy, ToyBatches, ToySettings
from tests.planners.training.test_fit import ALONE, Interrupted, measured, rows

STEPS = 7


def settings(ema: float) -> TrainingSettings:
    return TrainingSettings(epochs=9, batch_size=4, learning_rate=0.05, ema=ema)


def trained(out: Path, ema: float, steps: int = STEPS, batches: Any = None, resume: Path | None = None) -> Toy:
    torch.manual_seed(0)
    planner = Toy(ToySettings(), {})
    loop = Loop(1, steps, validate_every=3)
    fit(planner, batches or ToyBatches(20, 4), settings(ema), loop, ALONE, out, {}, resume, measured)
    return planner


def saved(out: Path) -> dict[str, Tensor]:
    return load_planner(out).state_dict()


def test_saved_weights_are_the_average_of_those_of_all_steps(tmp_path: Path) -> None:
    """Decays 2/11, 3/12, then 0.3, by hand, over the weights of trainings of 0, 1, 2, ... steps."""
    torch.manual_seed(0)
    expected = {name: value.double() for name, value in Toy(ToySettings(), {}).state_dict().items()}
    for n in range(1, STEPS + 1):
        decay = [2 / 11, 3 / 12, 0.3, 0.3, 0.3, 0.3, 0.3][n - 1]
        now = trained(tmp_path / str(n), 0.0, n).state_dict()
        expected = {name: decay * value + (1 - decay) * now[name].double() for name, value in expected.items()}
    ends_with = trained(tmp_path / "averaged", 0.3)
    for name, value in saved(tmp_path / "averaged").items():
        torch.testing.assert_close(value.double(), expected[name], rtol=1e-5, atol=1e-7)
        assert torch.equal(ends_with.state_dict()[name], now[name]), "averaging changes nothing of the training"
    validated = rows(tmp_path / "averaged" / "validation.csv")
    assert float(validated[-1]["weight"]) == pytest.approx(float(expected["net.0.weight"].sum()), rel=1e-4)


@pytest.mark.parametrize("stop_after", [1, 5])
def test_an_interrupted_training_resumes_to_the_identical_weights_of_both_kinds(
    tmp_path: Path, stop_after: int
) -> None:
    whole, out = tmp_path / "whole", tmp_path / "cut"
    raw = trained(whole, 0.9).state_dict()
    with pytest.raises(Stopped):
        trained(out, 0.9, batches=Interrupted(20, 4, stop_after))
    with pytest.raises(ValueError, match="trained with ema, not with ema=0"):
        trained(out, 0.0, resume=newest(out))
    resumed = trained(out, 0.9, resume=newest(out)).state_dict()
    for name, value in saved(whole).items():
        assert torch.equal(saved(out)[name], value) and torch.equal(resumed[name], raw[name])
        assert not torch.equal(value, raw[name])
        assert torch.equal(load_training(newest(out))[RAW][name], raw[name])
    for file in ("losses.csv", "validation.csv"):
        assert (out / file).read_text() == (whole / file).read_text()


def test_running_statistics_are_averaged_and_counts_are_the_newest() -> None:
    planner = Toy(ToySettings(), {})
    planner.norm = torch.nn.BatchNorm1d(1)
    averaged = Averaged(planner, 0.75)
    planner.norm.running_mean.fill_(8.0)
    planner.norm.num_batches_tracked.fill_(5)
    averaged.update(1000)
    with averaged.in_planner() as raw:
        assert (float(planner.norm.running_mean), int(planner.norm.num_batches_tracked)) == (2.0, 5)
        assert float(raw[RAW]["norm.running_mean"]) == 8.0
    assert float(planner.norm.running_mean) == 8.0

"""Trainings in half precision: the scale of their loss, what overflows, and how near they stay to fp32."""

from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from factory.exits import Stopped
from planners.data.batch import Batch
from planners.models.planner import Planner
from planners.training.callbacks import LOSSES
from planners.training.checkpoint import load_training, newest_checkpoint
from planners.training.fit import SCALER, StepSettings, fit
from planners.training.optim import TrainingSettings
from tests.planners.models import test_gtrs_dense, test_ltf
from tests.planners.toy import Toy, ToyBatches, ToySettings
from tests.planners.training.test_fit import ALONE, Interrupted, rows

TRAINING = TrainingSettings(epochs=3, batch_size=4, learning_rate=0.01, optimiser="adamw")
FIRST_SCALE = 65536.0  # torch.amp.GradScaler's, as in Lightning's 16-mixed


class Loud(Toy):
    """The loss of a batch with sample 7 is a thousand times too large: times the scale, no half number holds it."""

    name = "tests.planners.training.test_fp16:Loud"

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        factor = 1e3 if "7" in batch.attempt_ids else 1.0
        return {name: factor * term for name, term in super().losses(batch).items()}


def loud_steps() -> list[int]:
    """Of three epochs of 20 samples in batches of 4."""
    batches = chain.from_iterable(ToyBatches(20, 4).epoch(epoch) for epoch in range(3))
    return [i for i, batch in enumerate(batches) if "7" in batch.attempt_ids]


def train(out: Path, planner: Toy, steps: int, batches: Any = None, resume: Path | None = None) -> Toy:
    fit(
        planner,
        batches or ToyBatches(20, 4),
        TRAINING,
        StepSettings(1, steps, precision="fp16"),
        ALONE,
        out,
        {},
        resume,
    )
    return planner


def loud() -> Loud:
    torch.manual_seed(0)
    return Loud(ToySettings(), {})


def test_a_step_that_overflows_is_left_out_and_the_scale_halved(tmp_path: Path) -> None:
    first = loud_steps()[0]
    before, after, behind = (train(tmp_path / str(n), loud(), n) for n in (first, first + 1, first + 2))
    for name, weights in before.state_dict().items():
        assert torch.equal(after.state_dict()[name], weights), name
        assert not torch.equal(behind.state_dict()[name], weights), name
    steps = load_training(newest_checkpoint(tmp_path / str(first + 1)))["optimiser"]["state"].values()
    assert {int(state["step"]) for state in steps} <= {first}, "Adam has not counted it either"
    train(tmp_path / "all", loud(), 15)
    curve = rows(tmp_path / "all" / LOSSES)
    assert [i for i, row in enumerate(curve) if float(row["skipped"])] == loud_steps()
    halved = [sum(i < at for i in loud_steps()) for at in range(15)]
    assert [float(row["loss_scale"]) for row in curve] == [FIRST_SCALE / 2**n for n in halved]
    for row in curve:
        assert float(row["total"]) == pytest.approx(float(row["imitation"]) + float(row["size"]))


def test_a_resumed_training_has_the_scale_it_had(tmp_path: Path) -> None:
    whole, out = train(tmp_path / "whole", loud(), 15), tmp_path / "cut"
    stop = loud_steps()[0] + 1
    with pytest.raises(Stopped):
        train(out, loud(), 15, Interrupted(20, 4, stop))
    assert load_training(newest_checkpoint(out))[SCALER]["scale"] == FIRST_SCALE / 2
    resumed = train(out, loud(), 15, resume=newest_checkpoint(out))
    assert (out / LOSSES).read_text() == (tmp_path / "whole" / LOSSES).read_text()
    for name, weights in whole.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], weights), name
    with pytest.raises(ValueError, match="trained in fp16: go on in the same precision"):
        fit(loud(), ToyBatches(20, 4), TRAINING, StepSettings(1, 15), ALONE, out, {}, newest_checkpoint(out))


class Again(ToyBatches):
    """The same batch in every step."""

    def __init__(self, batch: Batch) -> None:
        super().__init__(1, 1)
        self.batch = batch

    def epoch(self, epoch: int) -> Iterator[Batch]:
        yield self.batch
        self.at = {"epoch": epoch + 1, "next": 0}


LEARNERS: dict[str, Callable[[], tuple[Planner, Batch]]] = {
    "ltf": lambda: (test_ltf.planner(), test_ltf.batch(8)),
    "gtrs_dense": lambda: (test_gtrs_dense.planner(), test_gtrs_dense.labelled(8)[0]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ltf", "gtrs_dense"])
def test_the_loss_follows_that_of_fp32(tmp_path: Path, name: str) -> None:
    """Within 0.1 % at the start and 6 % behind 30 steps, the first few of which are left out to find the scale."""
    curves = []
    for precision in ("fp32", "fp16"):
        planner, batch = LEARNERS[name]()
        training = TrainingSettings(epochs=1, batch_size=8, learning_rate=3e-4, optimiser="adamw", gradient_clip=1.0)
        loop = StepSettings(1, 30, precision=precision)  # type: ignore[arg-type]
        fit(planner, Again(batch), training, loop, ALONE, tmp_path / precision, {})
        curves.append(np.array([float(row["total"]) for row in rows(tmp_path / precision / LOSSES)]))
    full, half = curves
    assert full[-5:].mean() < 0.95 * full[0], "it learns"
    assert half[0] == pytest.approx(full[0], rel=1e-3)
    assert half[-5:].mean() == pytest.approx(full[-5:].mean(), rel=0.06)
    skipped = [bool(float(row["skipped"])) for row in rows(tmp_path / "fp16" / LOSSES)]
    assert sum(skipped) < 10 and not any(skipped[20:])

"""Batch normalisation over processes: halves of a batch in two are the batch in one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Tensor, nn

from planners.data.batch import Batch
from planners.models.backbones import BackboneSettings, build_backbone
from planners.training.checkpoint import load_planner
from planners.training.fit import Loop, fit
from planners.training.optim import TrainingSettings
from planners.training.processes import TrainingProcess, joined, synchronise
from tests.planners.toy import Toy, ToyBatches, ToySettings
from tests.planners.training.test_world import in_two, sgd


class Normed(Toy):
    """Both kinds of batch normalisation, and nothing random."""

    name = "tests.planners.training.test_sync_norm:Normed"

    def __init__(self, settings: ToySettings, arrays: Mapping[str, Any]) -> None:
        super().__init__(settings, arrays)
        self.net = nn.Sequential(
            nn.Linear(8, 16),
            nn.BatchNorm1d(16),
            nn.Unflatten(1, (4, 2, 2)),
            nn.Conv2d(4, 4, 3, padding=1),
            nn.BatchNorm2d(4),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(16, 24),
        )

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        return {"imitation": (self.plan(batch) - batch.plan_2hz).square().mean()}


def train(world: TrainingProcess, out: Path, sync: bool) -> Normed:
    torch.manual_seed(0)
    planner = Normed(ToySettings(), {})
    training = TrainingSettings(epochs=2, batch_size=10, learning_rate=0.05, sync_batch_norm=sync)
    batches = ToyBatches(20, 10, world.rank, world.size)
    with patch("planners.training.fit.build_optimiser", sgd):
        fit(planner, batches, training, Loop(1, 8), world, out, {})
    return planner


def synchronised(rank: int, out: Path) -> None:
    with joined("cpu") as world:
        train(world, out, True)


def each_for_itself(rank: int, out: Path) -> None:
    with joined("cpu") as world:
        train(world, out, False)


def furthest(a: nn.Module, b: nn.Module) -> float:
    ours, theirs = a.state_dict(), b.state_dict()
    assert ours.keys() == theirs.keys()
    return max(float((ours[name] - theirs[name]).abs().max()) for name in ours)


@pytest.mark.slow
def test_two_processes_end_with_the_weights_and_statistics_of_one(tmp_path: Path) -> None:
    with joined("cpu") as world:
        alone = train(world, tmp_path / "one", True)
    in_two(synchronised, tmp_path / "synchronised")
    in_two(each_for_itself, tmp_path / "each")
    assert furthest(load_planner(tmp_path / "synchronised"), alone) < 1e-5
    assert furthest(load_planner(tmp_path / "each"), alone) > 1e-3, "halves have other statistics than the whole"


def layer(rank: int, out: Path) -> None:
    """Output, gradients, running statistics of a rank's part against those of the whole batch in PyTorch's layer."""
    cases: list[tuple[type[nn.Module], tuple[int, ...], dict[str, Any]]] = [
        (nn.BatchNorm2d, (8, 3, 4, 5), {}),
        (nn.BatchNorm2d, (8, 3, 4, 5), {"momentum": None, "affine": False}),
        (nn.BatchNorm1d, (8, 3), {"track_running_stats": False}),
        (nn.BatchNorm1d, (8, 3, 7), {"momentum": 0.5}),
    ]
    with joined("cpu") as world:
        for kind, shape, settings in cases:
            torch.manual_seed(1)
            x, towards = 3.0 * torch.randn(shape).double() + 7.0, torch.randn(shape).double()
            whole, model = (nn.Sequential(kind(3, **settings)).double() for _ in range(2))
            synchronise(model)
            mine = slice(0, 3) if rank == 0 else slice(3, 8)  # parts need not be of one size
            for _ in range(2):
                before = x.clone().requires_grad_()
                expected = whole(before)
                (expected * towards).sum().backward()
                part = x[mine].clone().requires_grad_()
                found = model(part)
                (found * towards[mine]).sum().backward()
                torch.testing.assert_close(found, expected[mine])
                torch.testing.assert_close(part.grad, before.grad[mine])  # type: ignore[index]
            for own, reference in zip(model.parameters(), whole.parameters()):
                torch.testing.assert_close(world.mean(own.grad) * world.size, reference.grad)  # type: ignore[arg-type]
            for name, value in model.named_buffers():
                torch.testing.assert_close(value, whole.get_buffer(name))
            torch.testing.assert_close(model.eval()(x), whole.eval()(x))
            half = nn.Sequential(nn.BatchNorm2d(3))
            synchronise(half)
            assert half(torch.rand(2, 3, 4, 2, dtype=torch.float16)).dtype == torch.float16


@pytest.mark.slow
def test_parts_of_a_batch_are_normalised_as_the_whole_is(tmp_path: Path) -> None:
    in_two(layer, tmp_path)


def test_one_process_and_normalisations_that_are_frozen_compute_as_ever() -> None:
    settings = BackboneSettings(name="small", widths=(2, 2, 2, 2), frozen_norm=True)
    torch.manual_seed(0)
    backbone = build_backbone(settings)
    names, picture = list(backbone.state_dict()), torch.randn(2, 3, 32, 32)
    before = backbone.train()(picture)
    synchronise(backbone)
    synchronise(backbone)
    assert list(backbone.state_dict()) == names
    assert not backbone.train().bn1.training
    assert all(torch.equal(a, b) for a, b in zip(before, backbone(picture)))
    free, same = nn.BatchNorm1d(3), nn.BatchNorm1d(3)
    synchronise(nn.Sequential(free))
    x = torch.randn(5, 3)
    assert torch.equal(free(x), same(x)) and torch.equal(free.get_buffer("running_var"), same.get_buffer("running_var"))


def test_what_cannot_be_synchronised_is_refused(tmp_path: Path) -> None:
    alone = TrainingProcess(0, 1, torch.device("cpu"))
    training = TrainingSettings(epochs=1, batch_size=4, learning_rate=0.1, sync_batch_norm=True)
    with pytest.raises(ValueError, match="sync_batch_norm=true, but the planner has no batch normalisation"):
        fit(Toy(ToySettings(), {}), ToyBatches(4, 4), training, Loop(1, 1), alone, tmp_path / "out", {})
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="0 is a BatchNorm3d"):
        synchronise(nn.Sequential(nn.BatchNorm3d(2)))

"""Two processes (gloo) train as one: the same weights in both, and the same curve after a restart."""

import socket
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
import torch.multiprocessing as mp

from planners.training.checkpoint import newest, read_record
from planners.training.curves import LOSSES
from planners.training.fit import Loop, fit
from planners.training.optim import TrainingSettings
from planners.training.processes import joined
from planners.training.train import main
from tests.planners.samples import sample, write_table
from tests.planners.toy import Toy, ToyBatches, ToySettings

TRAINING = TrainingSettings(epochs=2, batch_size=4, learning_rate=0.01)


def in_two(part: Any, out: Path) -> None:
    """Run part(rank, out) in two processes of one group."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    mp.spawn(_started, (port, part, out), nprocs=2)


def _started(rank: int, port: int, part: Any, out: Path) -> None:
    import os

    os.environ |= {
        "RANK": str(rank),
        "LOCAL_RANK": str(rank),
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }
    torch.set_num_threads(1)
    part(rank, out)


def _train(rank: int, out: Path, steps: int, dropout: float = 0.5) -> None:
    with joined("cpu") as world:
        assert (world.rank, world.size) == (rank, 2)
        torch.manual_seed(0)
        planner = Toy(ToySettings(dropout=dropout), {})
        resume = newest(out) if (out / "checkpoints").exists() else None
        world.wait()
        batches = ToyBatches(20, 4, world.rank, world.size)
        fit(planner, batches, TRAINING, Loop(1, steps, log_every=3), world, out, {}, resume)
        weights = torch.cat([p.detach().flatten() for p in planner.parameters()])
        torch.testing.assert_close(world.mean(weights), weights)
        assert world.anyone(rank == 1) and not world.anyone(False)


def whole(rank: int, out: Path) -> None:
    _train(rank, out, 10)


def first_half(rank: int, out: Path) -> None:
    _train(rank, out, 5)


def without_chance(rank: int, out: Path) -> None:
    with patch("planners.training.fit.build_optimiser", sgd):
        _train(rank, out, 10, dropout=0.0)


def sgd(training: TrainingSettings, planner: torch.nn.Module) -> torch.optim.Optimizer:
    """Steps by the gradient as long as it is: Adam does not tell the sum over processes from their mean."""
    return torch.optim.SGD(planner.parameters(), lr=training.learning_rate)


@pytest.mark.slow
def test_two_processes_resume_to_the_identical_curve(tmp_path: Path) -> None:
    in_two(whole, tmp_path / "whole")
    in_two(first_half, tmp_path / "cut")
    in_two(whole, tmp_path / "cut")
    assert (tmp_path / "cut" / LOSSES).read_text() == (tmp_path / "whole" / LOSSES).read_text()


@pytest.mark.slow
def test_two_processes_compute_what_one_does(tmp_path: Path) -> None:
    """Nothing random in the model: halves of a batch in two processes have the gradient of the whole."""
    in_two(without_chance, tmp_path / "two")
    torch.manual_seed(0)
    alone = Toy(ToySettings(dropout=0.0), {})
    with joined("cpu") as world, patch("planners.training.fit.build_optimiser", sgd):
        fit(alone, ToyBatches(20, 4), TRAINING, Loop(1, 10, log_every=3), world, tmp_path / "one", {})

    def totals(folder: str) -> list[float]:
        lines = (tmp_path / folder / LOSSES).read_text().splitlines()[1:]
        return [float(line.split(",")[1]) for line in lines]

    torch.testing.assert_close(torch.tensor(totals("two")), torch.tensor(totals("one")), rtol=1e-4, atol=1e-6)


def half_of_a_command(rank: int, out: Path) -> None:
    assert main(command(out, "half", "steps=5")) == 0


def command(out: Path, name: str, *more: str) -> list[str]:
    planner = ["planner=custom", "planner.name=tests.planners.toy:Toy", "+planner.settings.dropout=0.0"]
    sizes = ["planner.training.batch_size=4", "planner.training.learning_rate=0.01", "device=cpu"]
    return [*planner, *sizes, f"data.real=[{out / 'table'}]", f"out={out / name}", *more]


@pytest.mark.slow
def test_what_two_processes_began_one_goes_on_with_and_sees_the_same_samples(tmp_path: Path) -> None:
    write_table(tmp_path / "table", [sample(i) for i in range(12)], shard_rows=10, group_rows=4)
    in_two(half_of_a_command, tmp_path)
    assert main(command(tmp_path, "half", "steps=9")) == 2
    assert main(command(tmp_path, "half", "steps=9", "resume=further")) == 0
    assert main(command(tmp_path, "alone", "steps=9")) == 0
    assert read_record(tmp_path / "half")["earlier"] == [{"until_step": 5, "processes": 2, "steps": 5}]
    curves = [np.loadtxt(tmp_path / name / LOSSES, delimiter=",", skiprows=1) for name in ("half", "alone")]
    np.testing.assert_allclose(*curves, rtol=1e-4, atol=1e-6)

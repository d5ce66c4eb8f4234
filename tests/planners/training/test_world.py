"""Two processes (gloo) train as one: the same weights in both."""

import socket
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import torch
import torch.multiprocessing as mp

from planners.training.callbacks import LOSSES, Callback
from planners.training.checkpoint import ENDED, best_checkpoint, checkpoints, read_record
from planners.training.fit import StepSettings, fit
from planners.training.optim import TrainingSettings
from planners.training.processes import join_process_group
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


def without_chance(rank: int, out: Path) -> None:
    with join_process_group("cpu") as world:
        assert (world.rank, world.size) == (rank, 2)
        torch.manual_seed(0)
        planner = Toy(ToySettings(dropout=0.0), {})
        world.wait()
        batches = ToyBatches(20, 4, world.rank, world.size)
        with patch("planners.training.fit.build_optimiser", sgd):
            fit(planner, batches, TRAINING, StepSettings(1, 10, log_every=3), world, out, {})
        weights = torch.cat([p.detach().flatten() for p in planner.parameters()])
        torch.testing.assert_close(world.mean(weights), weights)
        assert world.any_process(rank == 1) and not world.any_process(False)


def sgd(training: TrainingSettings, planner: torch.nn.Module) -> torch.optim.Optimizer:
    """Steps by the gradient as long as it is: Adam does not tell the sum over processes from their mean."""
    return torch.optim.SGD(planner.parameters(), lr=training.learning_rate)


@pytest.mark.slow
def test_two_processes_compute_what_one_does(tmp_path: Path) -> None:
    """Nothing random in the model: halves of a batch in two processes have the gradient of the whole."""
    in_two(without_chance, tmp_path / "two")
    torch.manual_seed(0)
    alone = Toy(ToySettings(dropout=0.0), {})
    with join_process_group("cpu") as world, patch("planners.training.fit.build_optimiser", sgd):
        fit(alone, ToyBatches(20, 4), TRAINING, StepSettings(1, 10, log_every=3), world, tmp_path / "one", {})

    def totals(folder: str) -> list[float]:
        lines = (tmp_path / folder / LOSSES).read_text().splitlines()[1:]
        return [float(line.split(",")[1]) for line in lines]

    torch.testing.assert_close(torch.tensor(totals("two")), torch.tensor(totals("one")), rtol=1e-4, atol=1e-6)


WORTH = {2: 0.5, 4: 0.75, 6: 0.5, 8: 0.25, 10: 0.9}


def ended_early(rank: int, out: Path) -> None:
    """By the validation, which is the first process's alone."""
    with join_process_group("cpu") as world:
        at = iter(WORTH.values())
        batches = ToyBatches(20, 4, world.rank, world.size)
        loop = StepSettings(1, 10, log_every=3, validate_every=2, keep_best="epdms", patience=2)
        watcher = Counts()
        fit(
            *(Toy(ToySettings(), {}), batches, TRAINING, loop, world, out, {}),
            validate=None if rank else lambda planner: {"epdms": next(at)},
            callbacks={"mine": watcher},
        )
        assert watcher.steps == [1, 2, 3, 4, 5, 6, 7, 8], "in every process"


class Counts(Callback):
    def __init__(self) -> None:
        self.steps: list[int] = []

    def on_step_end(self, step: int, planner: Any, losses: Any) -> None:
        self.steps.append(step)


@pytest.mark.slow
def test_two_processes_end_at_the_step_that_one_ends_at(tmp_path: Path) -> None:
    ended_early(0, tmp_path / "one")
    in_two(ended_early, tmp_path / "two")
    for out in (tmp_path / "one", tmp_path / "two"):
        assert [path.name for path in checkpoints(out)] == ["00000004", "00000008"]
        assert best_checkpoint(out).name == "00000004" and read_record(out)[ENDED].startswith("2 validations without")

"""Trainings of 1 and 3 processes, killed on their way: what the same and what other numbers of them go on to."""

import multiprocessing
import os
import shutil
import signal
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from planners.data.batch import Batch
from planners.training.callbacks import LOSSES
from planners.training.checkpoint import WEIGHTS, checkpoints, load_training, newest_checkpoint, read_record
from planners.training.train import main
from tests.planners.samples import sample, write_table
from tests.planners.toy import Toy, ToySettings

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]  # processes start one after the other

SAMPLES, BATCH, STEPS = 60, 9, 16  # two epochs of 6 batches and a part of the next
EPOCH = SAMPLES // BATCH
NUMBERS = (1, 3)  # of two the sum is the same in any order
NOTES, NAP_S = "TESTS_NOTES", "TESTS_NAP_S"


class Noting(Toy):
    """Random, with running statistics, wide enough for several buckets of gradients; notes what it is shown."""

    name = "tests.planners.training.test_killed:Noting"

    def __init__(self, settings: ToySettings, arrays: Mapping[str, Any]) -> None:
        super().__init__(settings, arrays)
        self.net = nn.Sequential(
            nn.Linear(8, 700),
            nn.BatchNorm1d(700),
            nn.ReLU(),
            nn.Dropout(settings.dropout),
            nn.Linear(700, 700),
            nn.ReLU(),
            nn.Linear(700, 24),
        )

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        with (Path(os.environ[NOTES]) / os.environ.get("RANK", "0")).open("a") as notes:
            print(*batch.attempt_ids, file=notes)
        time.sleep(float(os.environ.get(NAP_S, 0.0)))
        return super().losses(batch)


FORKS = multiprocessing.get_context("forkserver")  # of a process that has imported all that a training does
FORKS.set_forkserver_preload([Noting.name.partition(":")[0], "torch._dynamo", "torch.utils.tensorboard"])


def train(arguments: list[str], environment: dict[str, str], said: Path) -> None:
    """`python -m planners train` in a process that is there already."""
    os.environ.update(environment)
    torch.set_num_threads(1)
    with said.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.exit(main(arguments))


def started(processes: int, out: Path, table: Path, notes: Path, *more: str, nap_s: float = 0.0) -> list[Any]:
    """The processes of a training, as torchrun would start them."""
    notes.mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1]), "WORLD_SIZE": str(processes)}
    arguments = ["planner=custom", f"planner.name={Noting.name}"]
    training = [f"batch_size={BATCH}", "learning_rate=0.001", "optimiser=adamw", "schedule=cosine"]
    arguments += [f"planner.training.{setting}" for setting in training]
    arguments += [f"steps={STEPS}", "checkpoint_every=4", "device=cpu"]
    arguments += [f"data.real=[{table}]", f"data.sim=[{table}]", f"out={out}", *more]
    told = {NOTES: str(notes), NAP_S: str(nap_s), **place}
    parts = []
    for rank in range(processes):
        its_own = {**told, "RANK": str(rank), "LOCAL_RANK": str(rank)}
        parts.append(FORKS.Process(target=train, args=(arguments, its_own, notes.with_suffix(f".{rank}.said"))))
        parts[-1].start()
    return parts


def codes(parts: list[Any]) -> list[int]:
    """What the processes end with."""
    for part in parts:
        part.join()
    return [part.exitcode for part in parts]


def seen(notes: Path) -> list[list[str]]:
    """The samples of each step, of all processes together, in the order of their names."""
    each = [path.read_text().splitlines() for path in sorted(notes.iterdir())]
    return [sorted(" ".join(lines).split()) for lines in zip(*each)]


class Trainings:
    """Each is run once, however many tests look at it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.table = folder, folder / "table"
        rows = [sample(i) if i % 3 else sample(i, "recovery") for i in range(SAMPLES)]
        write_table(self.table, rows, shard_rows=25, group_rows=10)
        self.whole: Callable[[int], Path] = cache(self._whole)
        self.killed: Callable[[int], Path] = cache(self._killed)

    def run(self, name: str, processes: int, *more: str) -> Path:
        """Trains in folder/name to the end, on from what lies there."""
        out = self.folder / name
        parts = started(processes, out, self.table, self.folder / f"{name}-notes", *more)
        assert codes(parts) == [0] * processes, [path.read_text() for path in self.folder.glob(f"{name}-notes.*.said")]
        return out

    def notes(self, out: Path) -> list[list[str]]:
        return seen(out.with_name(f"{out.name}-notes"))

    def goes_on(self, before: int, after: int) -> Path:
        """A copy of the killed training of so many processes, ended by so many."""
        name = f"{before}-to-{after}"
        shutil.copytree(self.killed(before), self.folder / name)
        return self.run(name, after, *(["resume=further"] if before != after else []))

    def _whole(self, processes: int) -> Path:
        return self.run(f"whole-{processes}", processes)

    def _killed(self, processes: int) -> Path:
        name = f"killed-{processes}"
        out = self.folder / name
        parts = started(processes, out, self.table, self.folder / f"{name}-notes", nap_s=0.1)
        while len(checkpoints(out)) < 2 and all(part.exitcode is None for part in parts):
            time.sleep(0.02)
        time.sleep(0.25)  # on into steps that no checkpoint knows of
        for part in parts:
            part.kill()
        assert codes(parts) == [-signal.SIGKILL] * processes
        done = int(newest_checkpoint(out).name)
        assert 0 < done < len(self.notes(out)) < STEPS, "it was to be killed on its way, behind a checkpoint"
        return out


@pytest.fixture(scope="module")
def trainings(tmp_path_factory: pytest.TempPathFactory) -> Trainings:
    return Trainings(tmp_path_factory.mktemp("killed"))


@pytest.mark.parametrize("processes", NUMBERS)
def test_the_same_number_goes_on_to_the_same_weights_to_the_last_bit(trainings: Trainings, processes: int) -> None:
    whole, resumed = trainings.whole(processes), trainings.goes_on(processes, processes)
    assert (resumed / LOSSES).read_text() == (whole / LOSSES).read_text()
    assert (newest_checkpoint(resumed) / WEIGHTS).read_bytes() == (newest_checkpoint(whole) / WEIGHTS).read_bytes()
    ours, theirs = (load_training(newest_checkpoint(out)) for out in (resumed, whole))
    for index, state in theirs["optimiser"]["state"].items():
        for name, value in state.items():
            assert torch.equal(ours["optimiser"]["state"][index][name], value), (index, name)


@pytest.mark.parametrize(("before", "after"), [(1, 1), (3, 3), (1, 3), (3, 1)])
def test_any_number_goes_on_with_the_samples_that_were_left(trainings: Trainings, before: int, after: int) -> None:
    name = trainings.folder / f"{before}-to-{after}"
    resumed = name if name.exists() else trainings.goes_on(before, after)
    done = int(newest_checkpoint(trainings.killed(before)).name)
    steps = trainings.notes(trainings.killed(before))[:done] + trainings.notes(resumed)
    assert steps == trainings.notes(trainings.whole(1))
    for first in range(0, STEPS, EPOCH):
        epoch = [attempt for step in steps[first : first + EPOCH] for attempt in step]
        assert set(Counter(epoch).values()) == {1}, "no sample twice in an epoch"
    record = read_record(resumed)
    assert record["step"] == STEPS and record["trained"]["processes"] == after
    if before != after:
        assert record["earlier"] == [{"until_step": done, "processes": before}]

"""Trainings on a Ray cluster of this machine's own."""

import os
import signal
import threading
from contextlib import suppress
from pathlib import Path

import pytest
import ray

from factory.graph.local import ClusterDied
from planners.training.checkpoint import load_planner, read_record
from planners.training.on_ray import train_on_ray
from planners.training.processes import TrainingProcess
from planners.training.train import main
from tests.planners.training.test_train import command, table

__all__ = ["table"]
pytestmark = [pytest.mark.ray, pytest.mark.slow]


def test_two_processes_of_ray_train_as_torchruns_would(table: str, tmp_path: Path) -> None:
    assert main([*command(table, tmp_path / "ray"), "executor=ray", "ray.processes=2"]) == 0
    record = read_record(tmp_path / "ray")
    assert record["step"] == 18 and record["trained"]["processes"] == 2
    assert load_planner(tmp_path / "ray").name == "tests.planners.toy:Toy"
    assert not ray.is_initialized()


def kill_the_trainer(process: TrainingProcess) -> None:
    """Of this cluster: it has the raylet of this process."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # gone meanwhile
            is_ours = int(stat.read_text().rpartition(")")[2].split()[1]) == os.getppid()
            if is_ours and stat.with_name("cmdline").read_bytes().startswith(b"ray::TrainController"):
                os.kill(int(stat.parent.name), signal.SIGKILL)
    threading.Event().wait()


def test_a_trainer_that_dies_is_a_cluster_that_died(tmp_path: Path) -> None:
    with pytest.raises(ClusterDied, match="trainer died"):
        train_on_ray(kill_the_trainer, str(tmp_path), 1, 0, 1)
    assert not ray.is_initialized()

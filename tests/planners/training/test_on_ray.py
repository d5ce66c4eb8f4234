"""Trainings on a Ray cluster of this machine's own."""

from pathlib import Path

import pytest
import ray

from planners.training.checkpoint import load_planner, read_record
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

"""Trainings on a Ray cluster of this machine's own."""

import threading
from pathlib import Path

import pytest
import ray

from planners.training.checkpoint import load_planner, read_record
from planners.training.on_ray import each_on_ray
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
    assert main([*command(table, tmp_path / "ray"), "executor=ray", "ray.processes=1"]) == 2, "another number of them"


def test_every_item_of_a_sweep_is_a_task(tmp_path: Path) -> None:
    def note(item: str, out: Path) -> int:
        (out / item).touch()
        return len(item)

    found = dict(each_on_ray(note, ["a", "bb", "ccc"], tmp_path, 1.0, 0.0, threading.Event()))
    assert found == {"a": 1, "bb": 2, "ccc": 3}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "bb", "ccc"]

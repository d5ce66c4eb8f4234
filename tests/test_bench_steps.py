"""The benchmarks behind docs/reproduce.md: counts from shapes are those of a computed step."""

import math
from pathlib import Path

import pytest
import torch

from tests.bench import bench_decoding, bench_planner_steps
from tests.bench.bench_planner_steps import counted_alone, measured

SMALL = "gtrs_dense_small"
FIT_S_OWN = ("picture_of(", "backend import compose_scene")  # what the fit draws with, no sample


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_planner_steps, "VOCABULARY_SIZE", 256)


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_counts_from_shapes_are_those_of_a_computed_step() -> None:
    torch.manual_seed(0)
    computed, counted = measured(SMALL, torch.device("cpu"), batch=2, repeats=1), counted_alone(SMALL, batch=2)
    assert counted.step_flop == computed.step_flop > 2.0 * counted.forward_flop
    assert counted.forward_flop == computed.forward_flop > 0.0
    assert counted.held_gb == pytest.approx(computed.held_gb, rel=1e-2)
    assert counted.held_gb["recomputed"] < counted.held_gb["fp32"]
    assert counted.state_gb == pytest.approx(computed.state_gb, rel=1e-6)
    assert computed.state_gb >= 4 * 4 * computed.parameters / 1e9, "weights, gradients and two moments in float32"
    assert computed.step_s[0] > 0.0 and math.isnan(counted.step_s[0])


def test_benches_draw_as_samples_are_drawn() -> None:
    files = sorted(Path(bench_decoding.__file__).parent.glob("*.py"))
    found = [f"{file.name}: {name}" for file in files for name in FIT_S_OWN if name in file.read_text()]
    assert len(files) > 20 and not found, "draw the finished scene: tasks.render.fit.reconstruct.draw_photo"

"""The bench of the GPUs' schedule runs, and processes that hold a GPU live on while others work."""

import re

import pytest

from tests.bench import bench_gpus


@pytest.mark.slow
def test_a_few_blocks_are_fitted_and_drawn_by_processes_that_stay(capsys: pytest.CaptureFixture[str]) -> None:
    """A process that claimed a GPU is none for other tasks: Ray ends those beyond a node's cores unless it is told."""
    waits = {"prepare_s": 0.3, "fit_s": 0.2, "finish_s": 0.1, "draw_s": 0.05, "drive_s": 0.5}
    bench_gpus.main(bench_gpus.Request(cpus=4, gpus=2, blocks=8, **waits))
    told = capsys.readouterr().out
    (processes,) = re.findall(r"fitted and drawn by (\d+) processes", told)
    assert 2 <= int(processes) <= 5
    assert len(re.findall(r"idle +\d+\.\d %", told)) == 2

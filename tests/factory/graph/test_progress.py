"""Progress: lines where there is no terminal."""

import io
from collections.abc import Sequence
from pathlib import Path

import pytest

from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.graph.progress import ProgressLine, RunCounts, RunForecast, Workload
from factory.store.samples import Store
from tests.factory.toy import ToyWork, executed, refs


def test_without_a_terminal_there_is_one_plain_line_at_the_end() -> None:
    stream = io.StringIO()
    with ProgressLine(4, lambda elapsed_s: 0.0, stream) as progress:
        for clips in range(5):
            progress.show(RunCounts(clips, accepted=3 * clips, rejected=clips, failed=1))
        progress.show(RunCounts(4, 12, 4, 1), last=True)
    (line,) = stream.getvalue().splitlines()
    assert line.startswith("clips 4/4 ") and "12 accepted, 4 rejected, 1 failed" in line and line.endswith("ETA 0 s")


def test_rate_and_time_left_are_told() -> None:
    progress = ProgressLine(10, lambda elapsed_s: 16.2, io.StringIO())
    assert progress.text(RunCounts(), elapsed_s=0.5).endswith("ETA ?")
    progress.show(RunCounts(clips=2))
    assert progress.text(RunCounts(clips=2), elapsed_s=4.0).startswith("30.00 clips/min")
    assert progress.text(RunCounts(clips=2), elapsed_s=4.0).endswith("ETA 16 s")


# The time left of a run follows from what its blocks and its samples have cost.

EXPERTS = ["recovery", "human"]


def test_what_is_left_costs_what_the_same_has_cost() -> None:
    # two workers for 100 s: 3 of 4 blocks at 60 s, 10 of 30 samples at 2 s; left are 60 and 40 s of one worker
    forecast = RunForecast(Workload(1, 3, 180.0), Workload(20, 10, 20.0))
    assert forecast.left_s(100.0) == pytest.approx(50.0)
    forecast.blocks.finish(1)
    assert forecast.left_s(100.0) == pytest.approx(20.0)


def test_a_kind_of_work_that_nothing_is_known_of_leaves_the_time_open() -> None:
    assert RunForecast(Workload(), Workload(5)).left_s(10.0) is None
    assert RunForecast(Workload(2, 3, 60.0), Workload(5)).left_s(10.0) is None
    assert RunForecast(Workload(2), Workload(5, 5, 60.0)).left_s(10.0) is None
    assert RunForecast(Workload(0, 3), Workload(5, 5)).left_s(10.0) is None, "what is done was found in a cache"
    assert RunForecast(Workload(0, 3, 60.0), Workload(0, 5, 5.0)).left_s(10.0) == 0.0
    assert RunForecast(Workload(), Workload()).left_s(10.0) == 0.0


def last_line(out: Path, work: ToyWork, rounds: int, capsys: pytest.CaptureFixture[str], code: int = COMPLETE) -> str:
    experts: Sequence[str] = EXPERTS
    capsys.readouterr()
    assert executed(work, refs(4), experts, rounds, Store(out)).exit_code == code
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("clips ")][-1]


def test_nothing_is_left_of_a_run_that_is_through(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"{ref.log_id}:{ref.start_ms}" for ref in refs(4)]
    ends = {names[0]: "standing", names[1]: "no_candidates", f"{names[2]}:human:-1": "bad"}
    work = ToyWork(blocks=True, trouble=ends)
    for rounds in (2, 3, 9):  # the last is more than any list has
        assert "  ETA 0 s" in last_line(tmp_path, work, rounds, capsys, COMPLETE_WITH_FAILURES)

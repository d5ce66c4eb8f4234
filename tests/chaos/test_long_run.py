"""A short run of tests.chaos.long_run, and how it tells memory that grows."""

from pathlib import Path

import pytest

from tests.chaos.long_run import Size, trial
from tests.chaos.memory import YOUNG_S, Held, flatness, read


def leaking(pid: int, first_s: float, start_mb: float, mb_h: float) -> list[Held]:
    """An hour of a worker that first loads what it works with."""
    times = [first_s + 5.0 * i for i in range(720)]
    loaded = [start_mb * min(1.0, (t - first_s) / YOUNG_S) for t in times]
    return [Held(t, "worker", pid, mb + mb_h * t / 3600.0) for t, mb in zip(times, loaded)]


def test_a_leak_shows_across_processes_that_are_killed() -> None:
    rows = leaking(7, 0.0, 400.0, 12.0) + leaking(8, 3600.0, 300.0, 12.0)
    flat = flatness(rows, "worker", 7200.0)
    assert flat is not None and flat.processes == 2
    assert flat.slope_mb_h == pytest.approx(12.0)
    assert (flat.second_mb, flat.last_mb) == pytest.approx((400.0 + 12.0 * 0.75, 300.0 + 12.0 * 1.75), abs=0.1)
    assert flatness(rows, "driver", 7200.0) is None


@pytest.mark.slow
def test_a_run_under_kills_ends_in_the_rows_of_one_without(tmp_path: Path) -> None:
    met, told = trial(tmp_path, hours=0.004, every_s=10.0, executor="local", seed=535, size=Size(experts=1, clips=1))
    assert met.kills and met.exits[0] == 1 and not met.stalled
    assert told.missing == told.twice == 0
    assert {row.what for row in read(tmp_path / "memory.csv")} == {"driver", "worker"}

"""A short run of tests.chaos.kills: the driver and workers killed at moments drawn by chance."""

import random
from pathlib import Path

import pytest

from tests.chaos.killed_run import CLIPS, drive
from tests.chaos.kills import Told, Trial, attempts, drivers, workers

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def golden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("kills") / "golden"
    drive(str(out), "local", "", 0.0)
    return out


def test_a_driver_killed_at_any_moment_loses_and_doubles_nothing(golden: Path) -> None:
    told = drivers("local", 4, golden.parent, golden, random.Random(1))
    assert told.runs and told.kills >= 2
    assert told.missing == told.twice == 0 and told.made_twice <= told.uncommitted


@pytest.mark.ray
def test_killed_workers_lose_and_double_nothing(golden: Path) -> None:
    told = workers(4, golden.parent, golden, random.Random(1), clips=CLIPS)
    assert told.kills == 4 and told.missing == told.twice == 0


def test_the_harness_tells_of_what_was_committed_and_made_again(tmp_path: Path) -> None:
    """Of a store that is whole: an attempt in both journals was made again."""
    trial = Trial(tmp_path / "run", Told("none"))
    with trial.command() as before:
        drive(str(trial.out), "local", str(before), 0.0)
    said = "1 attempts were made twice, 0 were not committed"
    with pytest.raises(AssertionError, match=said), trial.command() as after:
        after.write_text("attempt " + attempts(before)[0])

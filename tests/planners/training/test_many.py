"""Many trainings: what is done stays done, what fails is named."""

from pathlib import Path

import pytest

from factory.exits import INTERRUPTED, Failed, Stopped
from planners.training.checkpoint import read_record
from planners.training.many import LOG, SweepResources, Training, folder_of, is_done, train_all, train_one
from tests.planners.training.test_train import command, table

__all__ = ["table"]


def small(table: str, label: str, *more: str) -> Training:
    overrides = [o for o in command(table, Path("unused"), "steps=4", *more) if not o.startswith("out=")]
    return Training(label, tuple(overrides))


@pytest.mark.slow
def test_a_sweep_trains_what_is_not_done_and_names_what_fails(table: str, tmp_path: Path) -> None:
    good, bad = small(table, "good"), small(table, "bad", "device=cuda")
    with pytest.raises(Failed, match=r"bad \(exit 2\): error: device=cuda"):
        train_all([good, bad], tmp_path, SweepResources(jobs=2))
    assert is_done(tmp_path, good) and not is_done(tmp_path, bad)
    assert read_record(folder_of(tmp_path, good))["step"] == 4
    written = (folder_of(tmp_path, good) / LOG).stat().st_mtime_ns
    train_all([good], tmp_path, SweepResources())
    assert (folder_of(tmp_path, good) / LOG).stat().st_mtime_ns == written, "it was not to be trained again"
    assert not is_done(tmp_path, small(table, "good", "seed=1")), "other overrides are another training"


@pytest.mark.slow
def test_what_runs_when_time_is_up_is_saved_and_nothing_new_begins(table: str, tmp_path: Path) -> None:
    long = small(table, "long", "steps=200000", "checkpoint_every=100000")
    losses = folder_of(tmp_path, long) / "losses.csv"
    assert train_one(long, tmp_path, lambda: losses.exists() and losses.stat().st_size > 100) == INTERRUPTED
    assert 0 < read_record(folder_of(tmp_path, long))["step"] < 200000
    assert not is_done(tmp_path, long)
    with pytest.raises(Stopped, match="0 of 1 are trained"):
        train_all([small(table, "next")], tmp_path, SweepResources(minutes=0.0))
    assert not folder_of(tmp_path, small(table, "next")).exists()


def test_two_trainings_of_one_label_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="twice"):
        train_all([Training("twice", ()), Training("twice", ("seed=1",))], tmp_path, SweepResources())

"""Runs that begin at once: exactly one goes on, the last in one table's log; a dead one is in nobody's way."""

import multiprocessing
import os
import signal
from collections.abc import Callable
from multiprocessing.synchronize import Barrier
from pathlib import Path

import pytest

from factory.exits import COMPLETE
from factory.store.location import write_shard
from factory.store.samples import OUTCOMES, Store, outcomes_table
from factory.store.table import AnotherWriter
from tests.factory.graph.runs import run
from tests.factory.graph.test_two_drivers import an_outcome
from tests.factory.tables import assert_same_tables

WRITERS, TRIALS = 3, 40


def begin_and_write(barrier: Barrier, folder: str, name: str, told: Path) -> None:
    """Trial after trial: begin at the moment when the others do, then commit; a line on what became of each."""
    for trial in range(TRIALS):
        store, fate = Store(f"{folder}/{trial}"), "goes on"
        barrier.wait(60.0)
        try:
            store.begin_run([])
        except AnotherWriter:
            fate = "ended at once"
        barrier.wait(60.0)
        if fate == "goes on":
            rows = outcomes_table([an_outcome(f"{name}{i}") for i in range(2)])
            try:
                for row in (rows[:1], rows[1:]):
                    store.outcomes.commit([write_shard(store.outcomes.location, OUTCOMES, row)])
            except AnotherWriter:
                fate = "ended at its commit"
        with told.open("a") as file:
            file.write(f"{fate}\n")


@pytest.mark.slow
def test_of_three_that_begin_at_once_exactly_one_goes_on_in_each_of_40_trials(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(WRITERS)
    names = [f"writer{i}" for i in range(WRITERS)]
    writers = [
        context.Process(target=begin_and_write, args=(barrier, str(tmp_path), name, tmp_path / name)) for name in names
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join(300.0)
        assert writer.exitcode == 0
    fates = [(tmp_path / name).read_text().splitlines() for name in names]
    for trial in range(TRIALS):
        (winner,) = (name for name, fate in zip(names, fates) if fate[trial] == "goes on")
        store = Store(tmp_path / str(trial))
        assert sorted(store.outcomes) == [f"{winner}0", f"{winner}1"]
        assert store.candidates.epoch == store.samples.epoch == store.outcomes.epoch


def test_epochs_grow_and_an_earlier_one_claims_nothing_more(tmp_path: Path) -> None:
    older, newer = Store(tmp_path), Store(tmp_path)
    first = older.candidates.claim()
    second = newer.candidates.claim()
    assert second > first
    newer.samples.claim(second)
    with pytest.raises(AnotherWriter, match="another run has taken over"):
        older.samples.claim(first)
    newer.samples.set_property("x", "y")  # its claim stands


def test_a_claim_above_all_tables_takes_those_that_are_ahead(tmp_path: Path) -> None:
    for _ in range(3):
        Store(tmp_path).outcomes.claim()
    store = Store(tmp_path)
    store.begin_run([])
    assert {store.candidates.epoch, store.samples.epoch, store.outcomes.epoch} == {4}


def killed_while_it_claims(folder: str, tables: int) -> None:
    store = Store(folder)
    epoch = None
    for table in (store.candidates, store.samples, store.outcomes)[:tables]:
        epoch = table.claim(epoch)
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.parametrize("tables", [1, 2, 3])
def test_a_run_that_died_while_it_claimed_is_in_nobodys_way(
    tmp_path: Path, plain: Callable[..., Path], tables: int
) -> None:
    died = multiprocessing.get_context("spawn").Process(target=killed_while_it_claims, args=(str(tmp_path), tables))
    died.start()
    died.join(60.0)
    assert died.exitcode == -signal.SIGKILL
    assert run(tmp_path).exit_code == COMPLETE
    assert_same_tables(tmp_path, plain())

"""Runs that begin at once: exactly one goes on, the last in one table's log; a dead one is in nobody's way."""

import multiprocessing
import os
import signal
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import pytest

from factory.exits import COMPLETE
from factory.store.location import Location, write_shard
from factory.store.samples import OUTCOMES, Kind, Outcome, Store, outcomes_table
from factory.store.table import AnotherWriter, KeyedTable
from tests.factory.graph.runs import run
from tests.factory.tables import assert_same_tables
from tests.factory.toy import ToyWork

# Two runs on one store: the one that begins later wins, whenever the older commits.


def an_outcome(key: str) -> Outcome:
    return Outcome(key, "clip", "toy", "log0", "recovery", "recovery-1", 0, Kind.REJECTED, "settings", "{}")


def test_a_claim_stands_though_the_older_run_commits_at_the_same_moment(tmp_path: Path) -> None:
    where = Location.parse(tmp_path / "outcomes")
    older = KeyedTable(where, OUTCOMES)
    older.claim()

    class Overtaken(KeyedTable):
        """The older run commits between what this one has seen of the log and its claim."""

        def _transact(self, *args: Any) -> None:
            if "b" not in older:
                commit(older, "b")
            super()._transact(*args)

    def commit(table: KeyedTable, key: str) -> None:
        table.commit([write_shard(where, OUTCOMES, outcomes_table([an_outcome(key)]))])

    newer = Overtaken(where, OUTCOMES)
    commit(older, "a")
    newer.claim()
    assert "a" in newer and "b" in newer
    with pytest.raises(AnotherWriter):
        commit(older, "c")
    commit(newer, "c")


@dataclass(frozen=True)
class LateWork(ToyWork):
    """Getting ready takes it a whole run of another."""

    out: str = ""

    def warm(self, draws: bool = True) -> None:
        assert run(Path(self.out)).exit_code == COMPLETE


def test_what_the_older_run_commits_while_the_newer_gets_ready_is_not_made_again(
    tmp_path: Path, plain: Callable[..., Path]
) -> None:
    newer = run(tmp_path / "out", LateWork(out=str(tmp_path / "out")))
    assert newer.exit_code == COMPLETE and newer.executed.attempts == 0
    assert_same_tables(tmp_path / "out", plain())


WRITERS, TRIALS = 3, 12


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
def test_of_three_that_begin_at_once_exactly_one_goes_on_in_every_trial(tmp_path: Path) -> None:
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

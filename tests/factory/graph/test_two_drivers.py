"""Two runs on one store: the one that begins later wins, whenever the older commits."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from factory.exits import COMPLETE
from factory.store.location import Location, write_shard
from factory.store.samples import OUTCOMES, Kind, Outcome, outcomes_table
from factory.store.table import AnotherWriter, KeyedTable
from tests.factory.graph.runs import run
from tests.factory.tables import assert_same_tables
from tests.factory.toy import ToyWork


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

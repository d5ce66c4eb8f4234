"""Trials of which many are made: each in a process that is left for good, and what came of all of them."""

import os
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from factory.store.samples import Store
from factory.store.verify import verify
from tests.factory.tables import assert_same_rows, tables_of


def leave_by(trial: Callable[[], int], words: Path) -> NoReturn:
    """End this process, of its parent's making, with what the trial returns; with 1 and a traceback where it raises.

    words: the file that all it says goes into, behind what is there.
    """
    code = 1
    for number in (1, 2):
        os.dup2(os.open(words, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
    try:
        code = trial()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


@dataclass
class Findings:
    """How trials ended; what is none of the `fine` ways is told on stderr at once."""

    fine: Sequence[str]
    told: Counter[str] = field(default_factory=Counter)

    def note(self, trial: object, found: str) -> None:
        """One trial, in words, and how it ended."""
        if found not in self.fine:
            print(f"{trial}: {found}", file=sys.stderr, flush=True)
        self.told[found if found in self.fine else "else"] += 1

    @property
    def n_others(self) -> int:
        return self.told["else"]

    @property
    def cells(self) -> str:
        """Of a table's row: a count for each fine way, and of all others."""
        return " | ".join(str(self.told[kind]) for kind in (*self.fine, "else"))


def untold(row: Any) -> dict[str, Any]:
    """A row less the number of runs that tried it: a run that was killed at it counts."""
    return {name: value for name, value in row.items() if name != "tries"}


def assert_same_stores(out: Path, golden: Path) -> None:
    """All tables, and verify."""
    made, undisturbed = tables_of(out), tables_of(golden)
    assert_same_rows(made[0], undisturbed[0])
    for rows, others in zip(made[1:], undisturbed[1:]):
        assert [untold(row) for row in rows] == [untold(row) for row in others]
    found = verify(Store(out)).damage
    assert found == (), found

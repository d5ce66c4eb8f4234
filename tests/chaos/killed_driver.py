"""A driver that kills itself at a named moment: `python -m tests.chaos.killed_driver OUT EXECUTOR MOMENT JOURNAL`."""

import os
import signal
import sys
from collections.abc import Callable
from typing import Any

from factory.graph import driver
from factory.graph.execute import Execution, execute
from factory.store.samples import Store
from factory.store.table import KeyedTable
from tests.factory.toy import ToyWork, refs

EXPERTS = ["recovery", "pdm_closed", "human"]


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def after(owner: type, name: str, when: Callable[..., bool], before: bool = False) -> None:
    """Die after (or before) the first call of a method for which `when(self, *args)` holds."""
    real = getattr(owner, name)

    def call(self: Any, *args: Any, **options: Any) -> Any:
        if before and when(self, *args):
            die()
        result = real(self, *args, **options)
        if not before and when(self, *args):
            die()
        return result

    setattr(owner, name, call)


def nth(n: int, condition: Callable[..., bool] = lambda *args: True) -> Callable[..., bool]:
    seen = [0]

    def when(*args: Any) -> bool:
        seen[0] += condition(*args)
        return seen[0] == n

    return when


MOMENTS: dict[str, Callable[[], None]] = {
    "a clip was just prepared": lambda: after(driver.RunDriver, "_take_prepared", nth(2)),
    "attempts are in flight": lambda: after(driver.RunDriver, "_take_attempt", nth(9)),
    "shards are written, nothing is committed": lambda: after(driver.CommitQueue, "_commit", nth(1), before=True),
    "samples are committed, outcomes are not": lambda: after(
        KeyedTable, "commit", nth(2, lambda self, add, *rest: self.spec.name == "samples" and bool(add))
    ),
    "everything is committed, the driver has not said so": lambda: after(driver.RunDriver, "loop", nth(1)),
}


def main(out: str, executor: str, moment: str, journal: str) -> int:
    MOMENTS[moment]()
    work = ToyWork(journal=journal)
    summary = execute(work, refs(5), EXPERTS, 2, Store(out), Execution(executor, 2, shard_seconds=0.05))  # type: ignore[arg-type]
    return summary.exit_code


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

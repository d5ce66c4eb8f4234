"""A toy's run in this process, and what the tests of runs take it to be."""

import math
from collections.abc import Sequence
from pathlib import Path

from factory.graph.execute import Execution, RunSummary
from factory.store.samples import Store
from tests.factory.toy import ToyWork, executed, refs

EXPERTS = ["recovery", "pdm_closed", "human"]


def run(
    out: Path,
    work: ToyWork | None = None,
    rounds: int = 2,
    n: int = 4,
    experts: Sequence[str] = EXPERTS,
    **options: object,
) -> RunSummary:
    """options: of Execution."""
    how = Execution("local", **({"shard_seconds": math.inf} | options))  # type: ignore[arg-type]
    return executed(work or ToyWork(), refs(n), experts, rounds, Store(out), how)

"""A run whose bucket misbehaves, and the same command again."""

import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from factory.store.location import Location
from factory.store.samples import Store
from factory.store.verify import verify
from tests.chaos.buckets.bad_store import BadStore, Fault, What, credentials, environment_of
from tests.factory.tables import assert_same_tables

ROOT = Path(__file__).parents[3]
WORDS = (
    *("executor=local", "render=none", "reward.labels=none", "vocabulary.k=64"),
    *("experts=[recovery,human]", "limit=2", "rounds=1", "shard_seconds=0.1"),
)
TIMEOUT_S = 900.0


@dataclass(frozen=True)
class Ended:
    """A run."""

    code: int
    said: str  # on stderr, without what shows progress

    @property
    def last(self) -> str:
        return (self.said.splitlines() or [""])[-1]


def command(out: str, words: Sequence[str] = WORDS) -> list[str]:
    return [sys.executable, "-m", "factory.run", f"out={out}", *words]


def run(store: BadStore, out: str, fault: Fault | None) -> Ended:
    """One run, with what it meets."""
    store.fault = fault
    process = subprocess.Popen(
        command(out), cwd=ROOT, env=environment_of(store), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    store.victim = process.pid
    try:
        _, said = process.communicate(timeout=TIMEOUT_S)
    finally:
        process.kill()
        store.fault = None
    lines = [line for line in said.splitlines() if line.strip() and not line.startswith("clips ")]
    return Ended(process.returncode, "\n".join(lines))


def check(store: BadStore, golden: Path, out: str, fault: Fault) -> tuple[Ended, Ended]:
    """The run that meets the fault, and the next one. Raises AssertionError where they do not keep what is promised."""
    first = run(store, out, fault)
    assert fault.met, "the run met no fault"
    assert first.code in ((0, 4) if fault.what is not What.KILL else (-9,)), first
    assert "Traceback" not in first.said and len(first.said.splitlines()) <= 1, first.said
    again = run(store, out, None)
    assert again.code == 0 and not again.said, again
    there = Location.parse(out, credentials(store.straight))
    assert_same_tables(there, golden)
    assert verify(Store(there)).damage == ()
    return first, again


@contextmanager
def undisturbed() -> Iterator[Path]:
    """A folder with the rows as they are to be."""
    with tempfile.TemporaryDirectory() as folder:
        golden = Path(folder) / "golden"
        subprocess.run(command(str(golden)), cwd=ROOT, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        yield golden

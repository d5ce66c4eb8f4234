"""A bucket that misbehaves ends a run with one line at most; the same command then makes the same rows."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.chaos.buckets.bad_store import BUCKET, BadStore, Fault, What, bad_store, environment_of
from tests.chaos.buckets.object_stores import ROOT, check, undisturbed

pytestmark = pytest.mark.slow
LOG = "_delta_log/0.*json"
COMMIT = """
import sys
import pyarrow as pa
from factory.store.location import Location
from factory.store.location import write_shard
from factory.store.schema import TableSpec
from factory.store.table import KeyedTable
spec = TableSpec("t", pa.schema([("k", pa.string())]), "k")
table = KeyedTable(Location.parse(sys.argv[1]), spec)
assert table.lost_commit() is None
table.claim()
table.set_property("a.b", sys.argv[2])
table.commit([write_shard(table.location, spec, pa.table({"k": [sys.argv[2]]}))])
print(*sorted(table))
"""


def rare(value: int):  # type: ignore[no-untyped-def]  # pytest does not name what it returns
    """Of make chaos alone."""
    return pytest.param(value, marks=pytest.mark.chaos)


@pytest.fixture(scope="module")
def store() -> Iterator[BadStore]:
    pytest.importorskip("boto3")
    with bad_store() as made:
        yield made


@pytest.fixture(scope="module")
def golden() -> Iterator[Path]:
    with undisturbed() as made:
        yield made


@pytest.mark.chaos
@pytest.mark.parametrize(
    "fault",
    [Fault(What.SLOW_DOWN, first=120), Fault(What.KILL, "PUT", "samples/_delta_log/0.*json", first=3)],
    ids=["503 from then on", "SIGKILL in a commit"],
)
def test_the_same_command_makes_the_same_rows(store: BadStore, golden: Path, fault: Fault) -> None:
    check(store, golden, f"s3://{BUCKET}/run-{fault.first}", fault)


def committed(store: BadStore, name: str, key: str, fault: Fault | None) -> str:
    """Keys of a table in another process, which commits one."""
    store.fault = fault
    words = [sys.executable, "-c", COMMIT, f"s3://{BUCKET}/{name}", key]
    done = subprocess.run(words, cwd=ROOT, env=environment_of(store), capture_output=True, text=True, timeout=300)
    store.fault = None
    return done.stdout.strip() or done.stderr


@pytest.mark.parametrize("number", [1, rare(2), rare(3), rare(4)])  # the table's own, its claim, its metadata, its rows
def test_a_commit_whose_answer_is_lost_is_known_as_ones_own(store: BadStore, number: int) -> None:
    unanswered = Fault(What.UNANSWERED, "PUT", LOG, first=number, times=1)
    assert committed(store, f"lost-{number}", "a", unanswered) == "a" and unanswered.met == 1
    assert committed(store, f"lost-{number}", "b", None) == "a b"


@pytest.mark.parametrize("first", [1, rare(7), rare(13)])
def test_listings_that_break_off_are_asked_for_again(store: BadStore, first: int) -> None:
    """Those of the table's opening, of its making, of its claim, and of commits, before they are made and after it."""
    torn = Fault(What.TORN, "GET", "list-type=2&prefix|start-after", first=first, times=3)
    assert committed(store, f"torn-{first}", "a", torn) == "a" and torn.met == 3
    assert committed(store, f"torn-{first}", "b", None) == "a b"


@pytest.mark.chaos
def test_half_a_word_that_there_is_no_checkpoint_is_asked_for_again(store: BadStore) -> None:
    torn = Fault(What.TORN, "GET", "_last_checkpoint", first=3, times=3)
    assert committed(store, "unsaid", "a", torn) == "a" and torn.met == 3


@pytest.mark.chaos
def test_listings_that_are_behind_are_waited_for(store: BadStore) -> None:
    for keys in ("a", "a b"):
        assert committed(store, "behind", keys[-1], Fault(What.UNLISTED, seconds=2.0)) == keys

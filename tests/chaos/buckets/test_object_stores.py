"""A bucket that misbehaves while a table is committed to; whole runs: experiments/chaos/object_stores.py."""

import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.chaos.buckets.bad_store import BUCKET, BadStore, Fault, What, bad_store, environment_of
from tests.pages import REPOSITORY

pytestmark = pytest.mark.long
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


@pytest.fixture(scope="module")
def store() -> Iterator[BadStore]:
    pytest.importorskip("boto3")
    with bad_store() as made:
        yield made


def committed(store: BadStore, name: str, key: str, fault: Fault | None) -> str:
    """Keys of a table in another process, which commits one."""
    store.fault = fault
    words = [sys.executable, "-c", COMMIT, f"s3://{BUCKET}/{name}", key]
    done = subprocess.run(words, cwd=REPOSITORY, env=environment_of(store), capture_output=True, text=True, timeout=300)
    store.fault = None
    return done.stdout.strip() or done.stderr


def test_a_commit_whose_answer_is_lost_is_known_as_ones_own(store: BadStore) -> None:
    unanswered = Fault(What.UNANSWERED, "PUT", LOG, first=1, times=1)
    assert committed(store, "lost", "a", unanswered) == "a" and unanswered.met == 1
    assert committed(store, "lost", "b", None) == "a b"


def test_listings_that_break_off_are_asked_for_again(store: BadStore) -> None:
    torn = Fault(What.TORN, "GET", "list-type=2&prefix|start-after", times=3)
    assert committed(store, "torn", "a", torn) == "a" and torn.met == 3
    assert committed(store, "torn", "b", None) == "a b"

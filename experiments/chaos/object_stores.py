"""A run whose bucket misbehaves, and the same command again: `python -m experiments.chaos.object_stores [NAME ...]`.

Prints a line for each trouble: what the run ended with and said, what the next one, without the trouble, ended with,
and how its rows compare with those of a run that nothing disturbed. Before them `many`: the driver alone, with trivial
work in very many commits, while one request in twenty fails in some way and all listings are behind; killed once, then
the same command until it is complete.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from factory.store.location import Location
from factory.store.samples import Store
from factory.store.verify import verify
from tests.chaos.buckets.bad_store import BUCKET, BadStore, Fault, What, bad_store, credentials, environment_of
from tests.factory.tables import assert_same_tables
from tests.pages import REPOSITORY

COMMIT, SHARD, COPY = "samples/_delta_log/0.*json", "samples/round.*parquet", "samples/_commits/"

TROUBLES: Mapping[str, Callable[[], Fault]] = {
    "503 for five requests": lambda: Fault(What.SLOW_DOWN, first=40, times=5),
    "503 from then on": lambda: Fault(What.SLOW_DOWN, first=120),
    "late answers, 2 s, to 20 requests": lambda: Fault(What.LATE, first=40, times=20, seconds=2.0),
    "a commit's answer, 40 s late": lambda: Fault(What.LATE, "PUT", COMMIT, first=3, times=1, seconds=40.0),
    "half an answer, five times": lambda: Fault(What.TORN, "GET", first=20, times=5),
    "half listings, five times": lambda: Fault(What.TORN, "GET", "list-type=2&prefix|start-after", first=30, times=5),
    "half answers from then on": lambda: Fault(What.TORN, "GET", first=70),
    "credentials expire early": lambda: Fault(What.EXPIRED, first=60),
    "credentials expire at a shard": lambda: Fault(What.EXPIRED, first=177),
    "credentials expire late": lambda: Fault(What.EXPIRED, first=243),
    "no right to write any more": lambda: Fault(What.DENIED, "PUT|POST", first=60),
    "a shard's upload cut, once": lambda: Fault(What.CUT, "PUT", SHARD, times=1),
    "uploads of shards cut, each": lambda: Fault(What.CUT, "PUT", SHARD),
    "end of an upload unanswered, once": lambda: Fault(What.UNANSWERED, "POST", SHARD + ".*uploadId", times=1),
    "a commit cut, once": lambda: Fault(What.CUT, "PUT", COMMIT, first=3, times=1),
    "a commit unanswered, once": lambda: Fault(What.UNANSWERED, "PUT", COMMIT, first=3, times=1),
    "a claim unanswered, once": lambda: Fault(What.UNANSWERED, "PUT", COMMIT, first=2, times=1),
    "a table's first commit unanswered": lambda: Fault(What.UNANSWERED, "PUT", COMMIT, first=1, times=1),
    "listings 3 s behind": lambda: Fault(What.UNLISTED, seconds=3.0),
    "listings 10 s behind": lambda: Fault(What.UNLISTED, seconds=10.0),
    "SIGKILL in a shard's upload": lambda: Fault(What.KILL, "PUT", SHARD, first=2),
    "SIGKILL in a commit": lambda: Fault(What.KILL, "PUT", COMMIT, first=3),
    "SIGKILL in a commit's copy": lambda: Fault(What.KILL, "PUT", COPY, first=3),
}


LISTINGS_BEHIND_S = 0.3


def everything() -> Fault:
    """One request in twenty or so, in all ways at once."""
    listed = Fault(What.UNLISTED, seconds=LISTINGS_BEHIND_S)
    lost = Fault(What.UNANSWERED, "PUT|POST", share=0.02, other=listed)
    late = Fault(What.LATE, seconds=0.5, share=0.01, other=lost)
    return Fault(What.SLOW_DOWN, share=0.02, other=Fault(What.TORN, "GET", share=0.01, other=late))


MANY, CLIPS, TIMES = "many", 8, 10
TRIVIAL = """
import sys
from factory.graph.execute import Execution
from factory.store.samples import Store
from tests.factory.toy import ToyWork, executed, refs
how = Execution("local", shard_seconds=0.0)
work, store, clips = ToyWork(n_candidates=12), Store(sys.argv[1]), refs(int(sys.argv[2]))
ended = executed(work, clips, ["pdm_closed", "recovery"], 4, store, how)
print(ended.message, file=sys.stderr)
sys.exit(ended.exit_code)
"""


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


def run(store: BadStore, out: str, fault: Fault | None, words: Sequence[str] = ()) -> Ended:
    """One run, with what it meets."""
    store.fault = fault
    process = subprocess.Popen(
        words or command(out),
        cwd=REPOSITORY,
        env=environment_of(store),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
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


def check_many(store: BadStore, out: str) -> str:
    """What many commits met. Raises AssertionError where they do not keep what is promised."""
    words = [sys.executable, "-c", TRIVIAL]
    kill = Fault(What.KILL, "PUT", COMMIT, first=30)
    kill.other = everything()
    assert run(store, out, kill, [*words, out, str(CLIPS)]).code == -9
    faults, codes = kill.other.all, list[int]()
    while 0 not in codes:
        codes.append((ended := run(store, out, (again := everything()), [*words, out, str(CLIPS)])).code)
        faults += again.all
        assert ended.code in (0, 4) and "Traceback" not in ended.said and len(codes) < TIMES, ended.said
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([*words, f"{folder}/golden", str(CLIPS)], cwd=REPOSITORY, check=True, capture_output=True)
        there = Location.parse(out, credentials(store.straight))
        assert_same_tables(there, Path(folder) / "golden")
        assert verify(Store(there)).damage == ()
    met = ", ".join(
        f"{sum(f.met for f in faults if f.what is what)} {what.name}" for what in dict.fromkeys(f.what for f in faults)
    )
    return f"{len(store.log)} requests: {met}; codes {codes}"


@contextmanager
def undisturbed() -> Iterator[Path]:
    """A folder with the rows as they are to be."""
    with tempfile.TemporaryDirectory() as folder:
        golden = Path(folder) / "golden"
        subprocess.run(
            command(str(golden)), cwd=REPOSITORY, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        yield golden


def main(names: Sequence[str]) -> int:
    failed = 0
    if not names or MANY in names:
        with bad_store() as store:
            print(check_many(store, f"s3://{BUCKET}/many"), flush=True)
    if list(names) == [MANY]:
        return 0
    print("| the bucket | times | exit code | it said | again |\n|---|---|---|---|---|", flush=True)
    with undisturbed() as golden, bad_store() as store:
        for number, name in enumerate(TROUBLES):
            if names and name not in names:
                continue
            fault = TROUBLES[name]()
            try:
                first, again = check(store, golden, f"s3://{BUCKET}/run-{number}", fault)
            except AssertionError as error:
                failed += 1
                print(f"| {name} | {fault.met} | FAILED | {error} | |", flush=True)
                continue
            print(f"| {name} | {fault.met} | {first.code} | {first.last} | {again.code} |", flush=True)
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

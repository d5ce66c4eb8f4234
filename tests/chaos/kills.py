"""SIGKILL at moments drawn by chance: `python -m tests.chaos.kills [seed=0] [minutes=60] [local=50] [workers=100]...`

A run of toy samples is killed and the same command given again, until it says that it is complete; then samples,
outcomes, candidates and MCAP shards must be those of an undisturbed run, nothing missing and nothing twice, and no
attempt that was committed may have been made again. What is killed, and how often:

    local     the driver of executor=local          raylet   Ray's process of a node, of a cluster of one
    ray       the driver of executor=ray            gcs      Ray's process of a cluster
    workers   a worker of executor=ray, every so often while runs go on
    node      a whole node of two

A row a kind, of as many as there was time for. `made twice` counts attempts that ran before and after the kill, `not
committed` those that had run and were not settled then: the first cannot exceed the second. `first` is the worst time
from the second command, a new interpreter, to its first new attempt.
"""

import math
import multiprocessing
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from factory.exits import COMPLETE
from factory.store.location import Location
from factory.store.mcap_shards.mirror import McapTable
from factory.store.samples import Store
from factory.store.verify import verify
from tests.chaos.killed_run import drive, leave
from tests.chaos.processes import below, command, kill
from tests.factory.tables import assert_same_rows, tables_of
from tests.pages import REPOSITORY

AGAIN = 5  # commands until one says that it is complete
OVER_S = 90.0  # after which a run whose cluster was killed is ended
PROGRAMS = {"raylet": "/raylet/raylet ", "gcs": "/gcs_server"}
KINDS = {"local": 50, "ray": 5, "workers": 100, "raylet": 2, "gcs": 2, "node": 2}  # how often, unless said otherwise


def _started(*given: object) -> multiprocessing.process.BaseProcess:
    """The command in a new process that has its modules already: of a driver that is to be killed soon."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.chaos.killed_run"])
    process = context.Process(target=leave, args=given)
    process.start()
    return process


@dataclass
class Told:
    """What came of the kills of a kind."""

    kind: str
    kills: int = 0
    runs: int = 0
    missing: int = 0
    twice: int = 0  # samples
    uncommitted: int = 0  # attempts that had run and were not settled
    made_twice: int = 0
    first_s: list[float] = field(default_factory=list)
    ended: int = 0  # runs that went on for OVER_S without what was killed

    def row(self) -> str:
        first = f"{max(self.first_s):.1f} s" if self.first_s else "-"
        numbers = (self.kills, self.runs, self.missing, self.twice, self.uncommitted, self.made_twice)
        return f"| {self.kind} | {' | '.join(map(str, numbers))} | {first} |"


def attempts(journal: Path) -> list[str]:
    """Names of the attempts that ran."""
    lines = journal.read_text().splitlines() if journal.exists() else []
    return [line.split()[1] for line in lines if line.startswith("attempt ")]


def settled(out: Path) -> int:
    """Attempts that the tables have done."""
    store = Store(out)
    kinds = store.outcomes.read(["kind"])["kind"].to_pylist() if len(store.outcomes) else []
    return len(store.samples) + kinds.count("rejected")


def again(out: Path, before: Path, told: Told, fresh: bool) -> None:
    """Give the command until it is complete; count what it made anew. fresh: by a new interpreter, and timed."""
    done, ran, after = settled(out), attempts(before), before.with_suffix(".after")
    began = time.monotonic()
    for _ in range(AGAIN):
        if fresh:
            given = [sys.executable, "-m", "tests.chaos.killed_run", str(out), "local", str(after)]
            process = subprocess.Popen(given, cwd=REPOSITORY, env=os.environ | {"PYTHONPATH": str(REPOSITORY)})
            while process.poll() is None and not attempts(after):
                time.sleep(0.02)
            if attempts(after):
                told.first_s.append(time.monotonic() - began)
            exit_code = process.wait()
            fresh = False
        else:
            exit_code = drive(str(out), "local", str(after))
        if exit_code == COMPLETE:
            break
    assert exit_code == COMPLETE, exit_code
    lost = len(ran) - done
    made_twice = len(set(ran) & set(attempts(after)))
    assert made_twice <= lost, f"{made_twice} attempts were made twice, {lost} were not committed"
    told.uncommitted += lost
    told.made_twice += made_twice


def untold(row: Any) -> dict[str, Any]:
    """A row less the number of runs that tried it: a run that was killed at it counts."""
    return {name: value for name, value in row.items() if name != "tries"}


def compare(out: Path, golden: Path, told: Told) -> None:
    """All tables, their MCAP shards and verify. Raises AssertionError."""
    wanted = Store(golden).samples.read(["attempt_id"])["attempt_id"].to_pylist()
    keys = Store(out).samples.read(["attempt_id"])["attempt_id"].to_pylist()
    told.missing += len(set(wanted) - set(keys))
    told.twice += len(keys) - len(set(keys))
    made, undisturbed = tables_of(out), tables_of(golden)
    assert_same_rows(made[0], undisturbed[0])
    for rows, others in zip(made[1:], undisturbed[1:]):
        assert [untold(row) for row in rows] == [untold(row) for row in others]
    mcap = McapTable(Location.parse(out))
    assert_same_rows(mcap.read().sort_by("attempt_id"), Store(golden).samples.read().sort_by("attempt_id"))
    assert not mcap.behind(Store(out).samples) and not mcap.outdated(Store(out).samples)
    found = verify(Store(out)).damage
    assert found == (), found


def drivers(kind: str, n: int, folder: Path, golden: Path, rng: random.Random, end: float = math.inf) -> Told:
    """Kill the driver at any moment of its run."""
    told, whole_s = Told(f"driver, executor={kind}"), 0.0
    for trial in range(-2, n):  # the first runs are for their time alone
        if time.monotonic() > end:
            break
        out, journal = folder / f"{kind}{trial}", folder / f"{kind}{trial}.journal"
        process = _started(str(out), kind, str(journal))
        while process.is_alive() and not journal.exists():
            time.sleep(0.01)
        began = time.monotonic()
        process.join(None if trial < 0 else rng.uniform(0.0, whole_s))
        if trial < 0:
            whole_s = time.monotonic() - began
            continue
        assert process.pid is not None
        others = below(process.pid)
        told.kills += kill(process.pid)
        process.join()
        _put_away(others)
        told.runs += 1
        again(out, journal, told, fresh=not told.first_s or trial % 5 == 0)
        compare(out, golden, told)
    return told


def workers(n: int, folder: Path, golden: Path, rng: random.Random, end: float = math.inf) -> Told:
    """Kill a worker, wait a little, kill another, in run after run."""
    told = Told("worker, executor=ray")
    while told.kills < n and time.monotonic() < end:
        out, journal = folder / f"workers{told.runs}", folder / f"workers{told.runs}.journal"
        process = _started(str(out), "ray", str(journal), 0.1)
        assert process.pid is not None
        while process.is_alive() and told.kills < n:
            time.sleep(rng.uniform(0.05, 0.4))
            at_work = [pid for pid, line in below(process.pid).items() if line.startswith("ray::")]
            if at_work and attempts(journal):
                told.kills += kill(rng.choice(sorted(at_work)))
        process.join()
        told.runs += 1
        again(out, journal, told, fresh=False)
        compare(out, golden, told)
    return told


def parts(kind: str, n: int, folder: Path, golden: Path, rng: random.Random, end: float = math.inf) -> Told:
    """Kill a process of Ray's, or one node with all that is on it, while attempts are at work."""
    names = {"raylet": "raylet", "gcs": "GCS, executor=ray", "node": "one node of two"}
    told = Told(names[kind])
    for trial in range(n):
        if time.monotonic() > end:
            break
        out, journal, notes = (folder / f"{kind}{trial}{end}" for end in ("", ".journal", ".pid"))
        process = _started(str(out), "node" if kind == "node" else "ray", str(journal), 0.1, str(notes))
        assert process.pid is not None
        while process.is_alive() and not attempts(journal):
            time.sleep(0.1)
        time.sleep(rng.uniform(0.0, 2.0))
        others = below(process.pid)
        if kind == "node":
            raylet = int(notes.read_text())
            chosen = [raylet, *below(raylet)]
        else:
            chosen = [pid for pid, line in others.items() if PROGRAMS[kind] in line][:1]
        told.kills += sum(map(kill, chosen)) > 0
        process.join(OVER_S)
        if process.is_alive():
            told.ended += 1
            kill(process.pid)
            process.join()
        _put_away(others)
        told.runs += 1
        again(out, journal, told, fresh=False)
        compare(out, golden, told)
    if told.ended:
        told.kind += f" ({told.ended} runs were ended after {OVER_S:.0f} s)"
    return told


def _put_away(processes: dict[int, str]) -> None:
    """What a killed driver had started, where it did not go with it."""
    end = time.monotonic() + 5.0
    while time.monotonic() < end and any(command(pid) == line for pid, line in processes.items()):
        time.sleep(0.1)
    for pid, line in processes.items():
        if line and command(pid) == line:
            kill(pid)


def main(**asked: int) -> None:
    """Prints one table; with any kind named, those alone."""
    rng, end = random.Random(asked.pop("seed", 0)), time.monotonic() + 60.0 * asked.pop("minutes", 60)
    assert set(asked) <= set(KINDS), f"there are {list(KINDS)}"
    with tempfile.TemporaryDirectory() as name:
        folder, golden = Path(name), Path(name) / "golden"
        drive(str(golden), "local", "", 0.0)
        told: dict[str, Callable[[int], Told]] = {
            "local": lambda n: drivers("local", n, folder, golden, rng, end),
            "ray": lambda n: drivers("ray", n, folder, golden, rng, end),
            "workers": lambda n: workers(n, folder, golden, rng, end),
            "raylet": lambda n: parts("raylet", n, folder, golden, rng, end),
            "gcs": lambda n: parts("gcs", n, folder, golden, rng, end),
            "node": lambda n: parts("node", n, folder, golden, rng, end),
        }
        print("| killed | kills | runs | missing | twice | not committed | made twice | first |")
        print("|---|---|---|---|---|---|---|---|", flush=True)
        for kind, n in (asked or KINDS).items():
            print(told[kind](n).row(), flush=True)


if __name__ == "__main__":
    main(**{key: int(value) for key, _, value in (word.partition("=") for word in sys.argv[1:])})

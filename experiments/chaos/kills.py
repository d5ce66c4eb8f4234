"""SIGKILL at moments drawn by chance: `python -m experiments.chaos.kills [seed=0] [local=50] [workers=100]...`

A run of toy samples is killed, the same command given and killed again, and at last given until it says that it is
complete; then samples, outcomes and candidates must be those of an undisturbed run, nothing missing and
nothing twice, and no attempt that was committed may have been made again. What is killed, and how often:

    local     the driver of executor=local          raylet   Ray's process of a node, of a cluster of one
    ray       the same on a cluster of its own      gcs      Ray's process of a cluster
    cluster   the same on one that goes on          agent    Ray's agent of a node
    workers   a worker, while runs go on            node     a whole node of two

A row a kind, of as many as there was time for. `made twice` counts attempts that ran before and after the kill, `not
committed` those that had run and were not settled then, of killed workers the one in hand: the first cannot exceed the
second. `first` is the worst time from a last command, a new interpreter, to its first new attempt.
"""

import math
import multiprocessing
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from experiments.chaos.killed_run import CLIPS, drive, leave
from experiments.chaos.processes import PROGRAMS, below, kill, put_away, workers_below
from factory.exits import COMPLETE
from factory.store.samples import Store
from tests.chaos.trials import assert_same_stores
from tests.pages import REPOSITORY

AGAIN = 5  # commands until one says that it is complete
OVER_S = 90.0  # after which a run whose cluster was killed is ended
KILLS_A_RUN = 5  # of drivers, until the command is left alone
TIMED = 5  # runs from one timed to the next
MANY = 24  # clips of a run whose workers are killed
KINDS = {"local": 50, "ray": 10, "cluster": 40, "workers": 100, "raylet": 3, "gcs": 3, "agent": 2, "node": 3}


def _started(*given: object) -> multiprocessing.process.BaseProcess:
    """The command in a new process that has its modules already: of a driver that is to be killed soon."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["experiments.chaos.killed_run"])
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
    exits: Counter[int] = field(default_factory=Counter)  # of the runs that lost a part

    def row(self) -> str:
        first = f"{max(self.first_s):.1f} s" if self.first_s else "-"
        numbers = (self.kills, self.runs, self.missing, self.twice, self.uncommitted, self.made_twice)
        return f"| {self.kind} | {' | '.join(map(str, numbers))} | {first} |"


def attempts(*journals: Path) -> list[str]:
    """Names of the attempts that ran."""
    lines = [line for journal in journals if journal.exists() for line in journal.read_text().splitlines()]
    return [line.split()[1] for line in lines if line.startswith("attempt ")]


def settled(out: Path) -> int:
    """Attempts that the tables have done."""
    store = Store(out)
    kinds = store.outcomes.read(["kind"])["kind"].to_pylist() if len(store.outcomes) else []
    return len(store.samples) + kinds.count("rejected")


@dataclass
class Trial:
    """One `out`, and the journals of the commands that it was given."""

    out: Path
    told: Told
    journals: list[Path] = field(default_factory=list)

    @contextmanager
    def command(self) -> Iterator[Path]:
        """A command's journal; then counts what it made anew. Raises AssertionError where that was committed."""
        ran, done = set(attempts(*self.journals)), settled(self.out) if self.journals else 0
        journal = self.out.with_name(f"{self.out.name}.journal{len(self.journals)}")
        self.journals.append(journal)
        yield journal
        lost, made_twice = len(ran) - done, len(ran & set(attempts(journal)))
        assert made_twice <= lost, f"{made_twice} attempts were made twice, {lost} were not committed"
        self.told.uncommitted += lost
        self.told.made_twice += made_twice

    def again(self, fresh: str = "", clips: int = CLIPS) -> None:
        """Give the command until it is complete. fresh: by a new interpreter, with this executor, and timed."""
        for _ in range(AGAIN):
            with self.command() as journal:
                exit_code = (
                    self._timed(fresh, journal) if fresh else drive(str(self.out), "local", str(journal), clips=clips)
                )
            fresh = ""
            if exit_code == COMPLETE:
                return
        raise AssertionError(f"exit code {exit_code} after {AGAIN} commands")

    def _timed(self, executor: str, journal: Path) -> int:
        began = time.monotonic()
        given = [sys.executable, "-m", "experiments.chaos.killed_run", str(self.out), executor, str(journal)]
        process = subprocess.Popen(given, cwd=REPOSITORY, env=os.environ | {"PYTHONPATH": str(REPOSITORY)})
        while process.poll() is None and not attempts(journal):
            time.sleep(0.02)
        if attempts(journal):
            self.told.first_s.append(time.monotonic() - began)
        return process.wait()


def compare(out: Path, golden: Path, told: Told) -> None:
    """All tables, and verify. Raises AssertionError."""
    wanted = Store(golden).samples.read(["attempt_id"])["attempt_id"].to_pylist()
    keys = Store(out).samples.read(["attempt_id"])["attempt_id"].to_pylist()
    told.missing += len(set(wanted) - set(keys))
    told.twice += len(keys) - len(set(keys))
    assert_same_stores(out, golden)


def drivers(kind: str, n: int, folder: Path, golden: Path, rng: random.Random, end: float = math.inf) -> Told:
    """Kill the driver at any moment of its run, and the next that goes on from there."""
    names = {"local": "driver, executor=local", "ray": "driver, its own Ray", "cluster": "driver, a standing cluster"}
    told, whole_s = Told(names[kind]), 0.0
    with standing() if kind == "cluster" else nullcontext(kind) as executor:
        for number in range(-2, n):  # the first runs are for their time alone
            trial = Trial(folder / f"{kind}{number}", told)
            if told.kills >= n or time.monotonic() > end:
                break
            for _ in range(KILLS_A_RUN if number >= 0 else 1):
                if told.kills >= n:
                    break
                with trial.command() as journal:
                    process = _started(str(trial.out), executor, str(journal))
                    while process.is_alive() and not journal.exists():
                        time.sleep(0.01)
                    began = time.monotonic()
                    process.join(None if number < 0 else rng.uniform(0.0, 2.0 * whole_s / KILLS_A_RUN))
                    whole_s = time.monotonic() - began if number < 0 else whole_s
                    assert process.pid is not None
                    others = below(process.pid)
                    told.kills += process.is_alive() and kill(process.pid)
                    process.join()
                    put_away(others)
                if process.exitcode == COMPLETE:
                    break
            if number >= 0:
                told.runs += 1
                trial.again("" if number % TIMED else executor)
                compare(trial.out, golden, told)
    return told


@contextmanager
def standing() -> Iterator[str]:
    """The address of a cluster of one node that outlives its drivers."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "num_gpus": 0, "include_dashboard": False})
    try:
        yield cluster.address
    finally:
        cluster.shutdown()


def workers(n: int, folder: Path, golden: Path, rng: random.Random, end: float = math.inf, clips: int = MANY) -> Told:
    """Kill a worker, wait until there are two again and a little, kill another, in run after run."""
    told = Told("worker, executor=ray")
    while told.kills < n and time.monotonic() < end:
        trial, before = Trial(folder / f"workers{told.runs}", told), told.kills
        with trial.command() as journal:
            process = _started(str(trial.out), "ray", str(journal), 0.1, "", clips)
            assert process.pid is not None
            while process.is_alive() and told.kills < n:
                time.sleep(rng.uniform(0.05, 0.4))
                at_work = workers_below(process.pid)
                if len(at_work) > 1 and attempts(journal):
                    told.kills += kill(rng.choice(at_work))
            process.join()
        in_hand, names = told.kills - before, attempts(journal)
        made_twice = len(names) - len(set(names))
        assert made_twice <= in_hand, f"{made_twice} attempts were made twice, {in_hand} workers killed"
        told.uncommitted += in_hand
        told.made_twice += made_twice
        told.runs += 1
        trial.again(clips=clips)
        compare(trial.out, golden, told)
    return told


def parts(kind: str, n: int, folder: Path, golden: Path, rng: random.Random, end: float = math.inf) -> Told:
    """Kill a process of Ray's, or one node with all that is on it, while attempts are at work."""
    names = {"raylet": "raylet", "gcs": "GCS", "agent": "an agent of Ray's", "node": "one node of two"}
    told = Told(names[kind])
    while told.runs < n and time.monotonic() < end:
        trial, notes = Trial(folder / f"{kind}{told.runs}", told), folder / f"{kind}{told.runs}.pid"
        with trial.command() as journal:
            process = _started(str(trial.out), "node" if kind == "node" else "ray", str(journal), 0.1, str(notes))
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
            put_away(others)
        told.exits[process.exitcode or 0] += 1
        told.runs += 1
        trial.again()
        compare(trial.out, golden, told)
    exits = ", ".join(f"{code}: {count}" for code, count in sorted(told.exits.items()))
    told.kind += f" (exit codes {exits}; {told.ended} ended after {OVER_S:.0f} s)"
    return told


def main(**asked: int) -> None:
    """Prints one table; with any kind named, those alone."""
    rng = random.Random(asked.pop("seed", 0))
    end = time.monotonic() + 60.0 * asked.pop("minutes", 60)
    assert set(asked) <= set(KINDS), f"there are {list(KINDS)}"
    with tempfile.TemporaryDirectory() as name:
        folder, golden, many = Path(name), Path(name) / "golden", Path(name) / "many"
        drive(str(golden), "local", "", 0.0)
        if "workers" in (asked or KINDS):
            drive(str(many), "local", "", 0.0, clips=MANY)

        def told(kind: str, n: int) -> Told:
            if kind == "workers":
                return workers(n, folder, many, rng, end)
            return (drivers if kind in ("local", "ray", "cluster") else parts)(kind, n, folder, golden, rng, end)

        print("| killed | kills | runs | missing | twice | not committed | made twice | first |")
        print("|---|---|---|---|---|---|---|---|", flush=True)
        for kind, n in (asked or KINDS).items():
            print(told(kind, n).row(), flush=True)


if __name__ == "__main__":
    main(**{key: int(value) for key, _, value in (word.partition("=") for word in sys.argv[1:])})

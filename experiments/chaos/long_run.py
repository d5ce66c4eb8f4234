"""Hours of a run under kills: `python -m experiments.chaos.long_run [hours=2] [every_s=180] [executor=ray] ...`

The real command on clips of the synthetic town, without pictures. Some `every_s` after the run goes on, drawn by
chance, a worker, the driver or one of Ray's two processes is killed; where the run ends before it is complete, the same
command is given again. In the end its rows must be those of a run that nothing disturbed, and `verify` finds nothing.
Experts wait before they plan, so that `hours` cost little of a core; the undisturbed run, of the same rows, does not.

    experts=6 clips=8  how much there is to do      out=build/long_run  gets memory.csv, memory.png, log.txt, both runs

Memory: resident, of the driver and of workers, every 5 s. Its slope is that within processes, less their first two
minutes, since a kill begins a new one.
"""

import os
import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from experiments.chaos.memory import Flatness, Held, draw, flatness, read, rss_mb, write
from experiments.chaos.trouble import below, command_line, kill, peers
from factory.exits import COMPLETE
from factory.store.samples import Store
from tests.chaos.trials import assert_same_stores
from tests.pages import REPOSITORY

WORDS = (
    *("clips=synthetic", "render=none", "reward.labels=none"),
    *("vocabulary.k=2048", "perturb=dense", "perturb.at_most=400", "rounds=1000"),  # until candidates run out
)
VICTIMS = {"ray": {"worker": 4, "driver": 1, "raylet": 1, "gcs": 1}, "local": {"worker": 1, "driver": 1}}  # chances
WORKERS = {"ray": 2, "local": 1}
SAMPLE_S, STALLED_S = 5.0, 600.0
FRUITLESS = 3  # commands in a row that nothing was killed of and that got no further


@dataclass(frozen=True)
class Size:
    """How much there is to do: of each clip and expert, some 60 attempts."""

    experts: int
    clips: int


@dataclass
class Endured:
    """What a run met, and how its commands ended."""

    seconds: float = 0.0
    kills: list[tuple[float, str]] = field(default_factory=list)
    exits: Counter[int] = field(default_factory=Counter)
    stalled: int = 0  # commands that were ended since nothing went on


def command(out: Path, executor: str, size: Size, wait_s: float, journal: Path) -> list[str]:
    names = [f"slow_{number}" for number in range(size.experts)]
    words = [f"out={out}", f"executor={executor}", f"workers={WORKERS[executor]}", f"limit={size.clips}"]
    words.append(f"experts=[{','.join(names)}]")
    for number, name in enumerate(names):
        given = {"_target_": "experiments.chaos.slow_expert.SlowKeepLane", "settle_m": 5.0 + 5.0 * number}
        given |= {"name": name, "wait_s": wait_s, "journal": journal}
        words += [f"+expert.{name}.{key}={value}" for key, value in given.items()]
    return [sys.executable, "-m", "factory.run", *words, *WORDS]


def start(words: list[str], log: IO[bytes]) -> subprocess.Popen[bytes]:
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    return subprocess.Popen(words, cwd=REPOSITORY, env=environment, stdout=log, stderr=subprocess.STDOUT)


def workers_of(driver: int, executor: str) -> list[int]:
    if executor == "ray":
        return peers(driver, "worker")
    return sorted(pid for pid, line in below(driver).items() if "multiprocessing.spawn" in line)


def make_driver(command: int, executor: str) -> int:
    """The process that drives: on Ray, once it is there, the first that the command starts."""
    found = [pid for pid, line in below(command).items() if "spawn_main" in line] if executor == "ray" else []
    return min(found, default=command)


def strike(what: str, driver: int, executor: str, rng: random.Random) -> bool:
    """False where there is none of them."""
    if what == "driver":
        return kill(driver)
    if what == "worker":
        found = workers_of(driver, executor)
    else:
        found = peers(driver, what)
    return bool(found) and kill(rng.choice(found))


def planned(journal: Path) -> int:
    """Plans that experts were asked for."""
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def endure(words: list[str], executor: str, every_s: float, rng: random.Random, journal: Path, folder: Path) -> Endured:
    """The command under kills, again and again until it is complete. Raises AssertionError where it gets no further."""
    met, began, told, fruitless = Endured(), time.monotonic(), 0.0, 0
    due, at_last, chances = float("inf"), 0, VICTIMS[executor]
    with (folder / "log.txt").open("ab") as log:
        while met.exits[COMPLETE] == 0:
            process = start(words, log)
            others: dict[int, str] = {}
            before, n_kills, n_plans, moved = planned(journal), len(met.kills), -1, time.monotonic()
            try:
                while process.poll() is None:
                    time.sleep(min(1.0, every_s / 10.0))
                    now = time.monotonic()
                    if now - told >= SAMPLE_S:
                        told, others = now, below(process.pid)
                        seen = [("driver", make_driver(process.pid, executor))] + [
                            ("worker", pid) for pid in workers_of(process.pid, executor)
                        ]
                        held = [
                            Held(now - began, what, pid, mb) for what, pid in seen if (mb := rss_mb(pid)) is not None
                        ]
                        write(folder / "memory.csv", held)
                        if planned(journal) > n_plans:
                            n_plans, moved = planned(journal), now
                    if due == float("inf") and planned(journal) > at_last:
                        due = now + rng.uniform(0.2, 1.8) * every_s
                        victim = rng.choices(list(chances), [*chances.values()])[0]
                    if now >= due and strike(victim, process.pid, executor, rng):
                        met.kills.append((now - began, victim))
                        due, at_last = float("inf"), planned(journal)
                        print(f"{now - began:7.0f} s  {victim} killed, {at_last} plans", flush=True)
                    if now - moved > STALLED_S:
                        met.stalled += 1
                        kill(process.pid)
            finally:  # where we are to end, it does too
                process.kill()
            met.exits[process.wait()] += 1
            print(f"{time.monotonic() - began:7.0f} s  exit code {process.returncode}", flush=True)
            put_away(others)
            got_on = len(met.kills) > n_kills or planned(journal) > before or met.exits[COMPLETE]
            fruitless = 0 if got_on else fruitless + 1
            assert fruitless < FRUITLESS, f"exit code {process.returncode}, and no further: {folder / 'log.txt'}"
    met.seconds = time.monotonic() - began
    return met


def put_away(processes: dict[int, str]) -> None:
    """What a killed driver had started, where it did not go with it."""
    end = time.monotonic() + 5.0
    while time.monotonic() < end and any(command_line(pid) == line for pid, line in processes.items()):
        time.sleep(0.1)
    for pid, line in processes.items():
        if line and command_line(pid) == line:
            kill(pid)


def compare(out: Path, golden: Path) -> tuple[int, int]:
    """Samples that are missing, and that are there twice; all tables, and verify. Raises AssertionError."""
    wanted, keys = (Store(folder).samples.read(["attempt_id"])["attempt_id"].to_pylist() for folder in (golden, out))
    assert_same_stores(out, golden)
    return len(set(wanted) - set(keys)), len(keys) - len(set(keys))


def row_of(what: str, flat: Flatness | None) -> str:
    if flat is None:
        return f"| {what} | 0 | - | - | - |"
    return f"| {what} | {flat.processes} | {flat.second_mb:.0f} | {flat.last_mb:.0f} | {flat.slope_mb_h:+.1f} |"


def trial(folder: Path, hours: float, every_s: float, executor: str, seed: int, size: Size) -> tuple[Endured, str]:
    """The run under kills, and its numbers against the undisturbed one. Raises AssertionError where they differ."""
    golden, out, first, second = (folder / name for name in ("golden", "out", "golden.journal", "out.journal"))
    with (folder / "golden.txt").open("wb") as log:
        code = start(command(golden, "local", size, 0.0, first), log).wait()
    assert code == COMPLETE, (folder / "golden.txt").read_text()
    wait_s = 3600.0 * hours * WORKERS[executor] / planned(first)
    print(f"{planned(first)} plans without kills; each waits {wait_s:.2f} s from now on", flush=True)
    rng = random.Random(seed)
    met = endure(command(out, executor, size, wait_s, second), executor, every_s, rng, second, folder)
    missing, twice = compare(out, golden)
    return met, f"{missing} | {twice} | {planned(second) - planned(first)}"


def main(
    hours: float = 2.0,
    every_s: float = 180.0,
    executor: str = "ray",
    seed: int = 0,
    experts: int = 6,
    clips: int = 8,
    out: Path = REPOSITORY / "build" / "long_run",
) -> None:
    """Prints two tables."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    met, told = trial(out, hours, every_s, executor, seed, Size(experts, clips))
    kinds = Counter(what for _, what in met.kills)
    killed = ", ".join(f"{what} {kinds[what]}" for what in VICTIMS[executor])
    exits = ", ".join(f"{code}: {n}" for code, n in sorted(met.exits.items()))
    print("| hours | killed | exit codes | stalled | missing | twice | planned again |\n|---|---|---|---|---|---|---|")
    print(f"| {met.seconds / 3600.0:.2f} | {killed} | {exits} | {met.stalled} | {told} |")
    print("| memory of | processes | second quarter, MB | last quarter, MB | slope, MB/h |\n|---|---|---|---|---|")
    rows = read(out / "memory.csv")
    for what in ("driver", "worker"):
        print(row_of(what, flatness(rows, what, met.seconds)))
    draw(rows, met.kills, out / "memory.png")


def _typed(words: list[str]) -> dict[str, object]:
    kinds = {"hours": float, "every_s": float, "executor": str, "seed": int, "experts": int, "clips": int, "out": Path}
    return {key: kinds[key](value) for key, _, value in (word.partition("=") for word in words)}


if __name__ == "__main__":
    main(**_typed(sys.argv[1:]))  # type: ignore[arg-type]

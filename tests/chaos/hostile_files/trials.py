"""Cases tried and judged: the exit code, what is said, the innocent's rows, CPU time and memory."""

import atexit
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from factory.exits import EXIT_CODE_TEXT
from tests.chaos.hostile_files.doors import LOGS, PLAIN, SINGLES, Single, put_single
from tests.chaos.hostile_files.grammars import ESCAPE, Rng

REPOSITORY = Path(__file__).resolve().parents[3]
BATCH = 25  # logs beside an innocent one
CPU_S, GB = 8.0, 1.0  # beyond what it takes without the file
LIMIT_S, LIMIT_CPU_S, LIMIT_BYTES = 600.0, 100, 6 << 30  # of what would take all of the machine
MOST_SAID = 20_000  # characters that a file makes a command say
EVERY = 50  # single files, of which one is read by the command as it is typed


@dataclass(frozen=True)
class Verdict:
    """Of one case; of logs `cpu_s` and `gb` are those of the run that it was in."""

    door: str
    number: int
    attack: str
    how: str  # read, refused
    finding: str  # what is wrong; empty: nothing
    cpu_s: float  # beyond the baseline
    gb: float

    @property
    def text(self) -> str:
        return f"{self.door} {self.number} ({self.attack}): {self.finding}"


@dataclass(frozen=True)
class Told:
    """How a process ended."""

    code: int  # below 0: by a signal
    said: str  # on both outputs
    cpu_s: float  # of it and all below it
    gb: float  # of the largest of them


def rng_of(door: str, number: int) -> Rng:
    return np.random.default_rng([number, *door.encode()])


def in_fork(work: Callable[[], int], said: Path) -> Told:
    """Of a fork of this process: what is imported here costs it nothing. Its memory counts from here on."""
    here = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss if sys.platform == "darwin" else _resident_kb()
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            os.setsid()
            to = os.open(said, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
            os.dup2(to, 1)
            os.dup2(to, 2)
            _limit()
            code = work()
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
        except BaseException:
            traceback.print_exc()
        finally:
            try:
                sys.stdout.flush()
                sys.stderr.flush()
                atexit._run_exitfuncs()
            finally:
                os._exit(code & 0xFF)
    return _waited(pid, said, here)


def as_typed(argv: Sequence[str], folder: Path, said: Path) -> Told:
    """Of the command itself."""
    with said.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", *argv],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            preexec_fn=_limit,
            start_new_session=True,
        )
    told = _waited(process.pid, said, 0)
    process.returncode = told.code
    return told


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_DATA, (LIMIT_BYTES, LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_CPU_S, LIMIT_CPU_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _resident_kb() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024


def _waited(pid: int, said: Path, less_kb: int) -> Told:
    """SIGKILL after LIMIT_S."""
    end = time.monotonic() + LIMIT_S
    while True:
        done, status, used = os.wait4(pid, os.WNOHANG)
        if done:
            break
        if time.monotonic() > end:
            os.killpg(pid, signal.SIGKILL)
        time.sleep(0.005)
    text = said.read_bytes().decode(errors="replace")
    return Told(
        os.waitstatus_to_exitcode(status), text, used.ru_utime + used.ru_stime, max(0, used.ru_maxrss - less_kb) / 2**20
    )


def what_is_wrong(told: Told, codes: Sequence[int]) -> str:
    """With a process that a hostile file was given to."""
    if told.code not in codes:
        return f"ended with {told.code}: {told.said[-600:]}"
    if "Traceback (most recent call last)" in told.said or "panicked at" in told.said:
        return f"a traceback: {told.said[-600:]}"
    if ESCAPE in told.said or re.search(r"(?m)^FORGED", told.said):
        at = told.said.index(ESCAPE if ESCAPE in told.said else "\nFORGED")
        return f"wrote to the terminal as the file asked: {told.said[max(0, at - 200) : at + 100]!r}"
    if len(told.said) > MOST_SAID:
        return f"said {len(told.said):,} characters: {told.said[:300]!r}"
    return ""


def over(told: Told, before: Told) -> str:
    """What of time and memory is too much."""
    if (more := told.cpu_s - before.cpu_s) > CPU_S:
        return f"{more:.1f} s of CPU time more"
    return f"{more:.2f} GB more" if (more := told.gb - before.gb) > GB else ""


# Logs


def rows_of(out: Path, table: str = "samples") -> dict[str, list[str]]:
    """Of each log the rows that a run has just written, all columns as text. Delta's reader would not fork."""
    found: dict[str, list[str]] = {}
    for path in sorted((out / table).glob("**/*.parquet")):
        for row in pq.ParquetFile(path).read(use_threads=False).sort_by("attempt_id").to_pylist():
            found.setdefault(row["log_id"], []).append(repr(row))
    return {log_id: sorted(rows) for log_id, rows in found.items()}


@cache
def innocent_alone(innocents: Path, door: str) -> tuple[Told, list[str]]:
    """How a run without a hostile log ends, and its rows."""
    folder = innocents.parent / f"alone {door}"
    shutil.rmtree(folder, ignore_errors=True)
    told, name = _run(innocents, folder, door, {})
    if told.code or not (rows := rows_of(folder / "out").get(name)):
        raise RuntimeError(f"{door}: the innocent log alone ended with {told.code}: {told.said[-2000:]}")
    return told, rows


def _run(innocents: Path, folder: Path, door: str, hostile: dict[str, bytes]) -> tuple[Told, str]:
    logs = LOGS[door]
    (data := folder / "data").mkdir(parents=True)
    name = logs.innocent(innocents, data)
    for log_id, content in hostile.items():
        logs.put(innocents, data, log_id, content)
    words = ["factory", "run", *PLAIN, *logs.words(innocents, data), f"out={folder / 'out'}"]
    return as_typed(words, folder, folder / "said"), name


def judge_logs(innocents: Path, folder: Path, door: str, numbers: Sequence[int]) -> list[Verdict]:
    """All beside one innocent log; where that is not well, in halves."""
    files = {n: crafted(door, innocents, n) for n in numbers}
    return _judged(innocents, folder, door, files)


def _judged(innocents: Path, folder: Path, door: str, files: dict[int, tuple[str, bytes]]) -> list[Verdict]:
    before, rows = innocent_alone(innocents, door)
    here = folder / "-".join(map(str, (min(files), max(files), len(files))))
    told, name = _run(innocents, here, door, {f"h{n:06}": content for n, (_, content) in files.items()})
    wrong = what_is_wrong(told, (0, 3)) or over(told, before)
    how: dict[int, str] = {}
    if not wrong:
        found, failed = rows_of(here / "out"), rows_of(here / "out", "outcomes")
        if found.get(name) != rows:
            wrong = f"the innocent log has {len(found.get(name, []))} rows of {len(rows)}, or others"
        for n in files:
            log_id = next(
                (
                    i
                    for i in (f"h{n:06}", f"sd_h{n:06}")
                    if re.search(rf"\b{i}\b", told.said) or i in found or i in failed
                ),
                "",
            )
            how[n] = "read" if log_id in found else "refused"
            wrong = wrong or ("" if log_id else f"log h{n:06} is not named")
    shutil.rmtree(here)
    if wrong and len(files) > 1:
        items, half = list(files.items()), len(files) // 2
        return [v for part in (items[:half], items[half:]) for v in _judged(innocents, folder, door, dict(part))]
    more_s, more_gb = told.cpu_s - before.cpu_s, told.gb - before.gb
    return [Verdict(door, n, attack, how.get(n, ""), wrong, more_s, more_gb) for n, (attack, _) in files.items()]


def crafted(door: str, innocents: Path, number: int) -> tuple[str, bytes]:
    """Attack and file of a case."""
    return (LOGS.get(door) or SINGLES[door]).craft(innocents, rng_of(door, number))


# Single files


def _answer(single: Single, folder: Path, path: Path) -> int:
    """Of a command, or of the function that reads the file: 0, or 2 with the line of its refusal."""
    os.chdir(folder)
    if argv := single.command.split():
        from factory.__main__ import main as factory
        from planners.__main__ import main as planners

        return {"factory": factory, "planners": planners}[argv[0]](argv[1:])
    try:
        single.read(path)  # type: ignore[misc]
    except single.refusals as error:
        print(f"{type(error).__name__} {error}", file=sys.stderr)
        return 2
    return 0


def judge_single(innocents: Path, folder: Path, door: str, number: int) -> Verdict:
    """One case in a folder of its own, which is removed."""
    single = SINGLES[door]
    attack, content = crafted(door, innocents, number)
    path = put_single(single, innocents, folder, content)
    argv = tuple(single.command.split())
    if argv and number % EVERY == 0:
        before = Told(0, "", _typed(argv[:2], innocents).cpu_s, _typed(argv[:2], innocents).gb)
        told = as_typed(argv, folder, folder / "said")
    else:
        before, told = Told(0, "", 0.0, 0.0), in_fork(lambda: _answer(single, folder, path), folder / "said")
    wrong = what_is_wrong(told, [code for code in EXIT_CODE_TEXT if code != 4]) or over(told, before)
    if not wrong and told.code and (single.named or path.name) not in told.said:
        wrong = f"refused without its name: {told.said[-400:]}"
    shutil.rmtree(folder)
    how = "refused" if told.code else "read"
    return Verdict(door, number, attack, how, wrong, told.cpu_s - before.cpu_s, told.gb - before.gb)


@cache
def _typed(argv: tuple[str, ...], innocents: Path) -> Told:
    """What it takes to start the command, by its help."""
    return as_typed([*argv, "--help"], innocents, innocents.parent / "help")


def load_what_is_read_with(doors: Collection[str]) -> None:
    """Once, before the first fork; nothing of it may start threads, as importing deltalake does."""
    import factory.commands.exchange
    import factory.run  # noqa: F401
    import tasks.experts.pdm_closed
    import tasks.render.fit.reconstruct  # noqa: F401

    if any("checkpoint" in door for door in doors):
        import planners.published.import_planner
    if any("batch" in door for door in doors):
        import planners.data.images  # noqa: F401

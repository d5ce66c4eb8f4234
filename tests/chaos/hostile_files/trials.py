"""Cases tried and judged: the exit code, what is said, the innocent's rows, CPU time and memory."""

import atexit
import importlib
import os
import re
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import NoReturn

import pyarrow.parquet as pq

from factory.exits import EXIT_CODE_TEXT, INTERRUPTED
from tests.chaos.damaged_files.mutants_of_files import rng_of
from tests.chaos.hostile_files.doors import LOGS, PLAIN, SINGLES, Single, put_single
from tests.chaos.hostile_files.grammars import ESCAPE, Crafted
from tests.chaos.trials import leave_by

REPOSITORY = Path(__file__).resolve().parents[3]
CPU_S, GB = 8.0, 1.0  # beyond what it takes without the file
LIMIT_S, LIMIT_CPU_S, LIMIT_BYTES = 600, 20, 6 << 30  # of one process that would take all of the machine
MOST_SAID = 20_000  # characters that a file makes a command say
EVERY = 50  # single files, of which one is read by the command as it is typed


@dataclass(frozen=True)
class Told:
    """How a process ended."""

    code: int  # below 0: by a signal
    said: str  # on both outputs
    cpu_s: float  # of it and all below it
    gb: float  # of the largest of them


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


def crafted(door: str, innocents: Path, number: int) -> Crafted:
    """Attack and file of a case."""
    return (LOGS.get(door) or SINGLES[door]).craft(innocents, rng_of(door, number))


def in_fork(work: Callable[[], int], said: Path, cpu_s: int = LIMIT_CPU_S) -> Told:
    """Of a fork of this process: what is imported here costs it nothing. Its memory counts from here on."""
    here_kb = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024
    if not (pid := os.fork()):
        leave_by(partial(_limited, work, cpu_s), said)
    end = time.monotonic() + LIMIT_S
    while not (ended := os.wait4(pid, os.WNOHANG))[0]:
        if time.monotonic() > end:
            os.killpg(pid, signal.SIGKILL)
        time.sleep(0.005)
    _, status, used = ended
    text, gb = said.read_bytes().decode(errors="replace"), max(0, used.ru_maxrss - here_kb) / 2**20
    return Told(os.waitstatus_to_exitcode(status), text, used.ru_utime + used.ru_stime, gb)


def _limited(work: Callable[[], int], cpu_s: int) -> int:
    os.setsid()
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for kind, most in ((resource.RLIMIT_DATA, LIMIT_BYTES), (resource.RLIMIT_CPU, cpu_s), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(kind, (most, most))
    try:
        return work()
    finally:
        atexit._run_exitfuncs()


def as_typed(argv: Sequence[str], folder: Path, said: Path, cpu_s: int = LIMIT_CPU_S) -> Told:
    """Of the command itself."""

    def command() -> NoReturn:
        os.chdir(folder)
        os.execve(sys.executable, [sys.executable, "-m", *argv], os.environ | {"PYTHONPATH": str(REPOSITORY)})

    return in_fork(command, said, cpu_s)


def what_is_wrong(told: Told, before: Told, codes: Collection[int]) -> str:
    """With a process that a hostile file was given to, beside one that had none."""
    cpu_s, gb = told.cpu_s - before.cpu_s, told.gb - before.gb
    if told.code not in codes:
        return f"ended with {told.code}: {told.said[-600:]}"
    if "Traceback (most recent call last)" in told.said or "panicked at" in told.said:
        return f"a traceback: {told.said[-600:]}"
    if forged := re.search(rf"(?m)^FORGED|{re.escape(ESCAPE)}", told.said):
        at = forged.start()
        return f"wrote to the terminal as the file asked: {told.said[max(0, at - 200) : at + 100]!r}"
    if len(told.said) > MOST_SAID:
        return f"said {len(told.said):,} characters: {told.said[:300]!r}"
    return f"{cpu_s:.1f} s of CPU time more" if cpu_s > CPU_S else f"{gb:.2f} GB more" if gb > GB else ""


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


def _run(innocents: Path, folder: Path, door: str, hostile: Mapping[str, bytes]) -> tuple[Told, str]:
    (data := folder / "data").mkdir(parents=True)
    name, *_ = [LOGS[door].put(innocents, data, *log) for log in (("innocent", None), *hostile.items())]
    words = [word.format(innocents=innocents, data=data) for word in LOGS[door].words.split()]
    command = ["factory", "run", *PLAIN, *words, f"out={folder / 'out'}"]
    cpu_s = LIMIT_CPU_S if hostile else LIMIT_S  # the innocent alone may compile kernels
    return as_typed(command, folder, folder / "said", cpu_s), name


def judge_logs(innocents: Path, folder: Path, door: str, files: Mapping[int, Crafted]) -> list[Verdict]:
    """All beside one innocent log; where that is not well, in halves."""
    before, rows = innocent_alone(innocents, door)
    here = folder / "-".join(map(str, (min(files), max(files), len(files))))
    told, name = _run(innocents, here, door, {f"h{n:06}": content for n, (_, content) in files.items()})
    wrong, how = what_is_wrong(told, before, (0, 3)), dict[int, str]()
    if not wrong:
        found, failed = rows_of(here / "out"), rows_of(here / "out", "outcomes")
        if found.get(name) != rows:
            wrong = f"the innocent log has {len(found.get(name, []))} rows of {len(rows)}, or others"
        for n in files:
            ids = {f"h{n:06}", f"sd_h{n:06}"}
            how[n] = "read" if ids & found.keys() else "refused"
            if not (wrong or ids & (found.keys() | failed.keys()) or re.search(rf"\b(sd_)?h{n:06}\b", told.said)):
                wrong = f"log h{n:06} is not named"
    shutil.rmtree(here)
    if wrong and len(files) > 1:
        numbers, half = list(files), len(files) // 2
        parts = ({n: files[n] for n in part} for part in (numbers[:half], numbers[half:]))
        return [verdict for part in parts for verdict in judge_logs(innocents, folder, door, part)]
    more = told.cpu_s - before.cpu_s, told.gb - before.gb
    return [Verdict(door, n, attack, how.get(n, ""), wrong, *more) for n, (attack, _) in files.items()]


def _answer(single: Single, folder: Path, path: Path) -> int:
    """Of a command, or of the function that reads the file: 0, or 2 with the line of its refusal."""
    os.chdir(folder)
    if isinstance(single.reads, str):
        from factory.__main__ import main as factory
        from planners.__main__ import main as planners

        program, *argv = single.reads.split()
        return {"factory": factory, "planners": planners}[program](argv)
    try:
        single.reads(path)
    except single.refusals as error:
        print(f"{type(error).__name__} {error}", file=sys.stderr)
        return 2
    return 0


def judge_single(innocents: Path, folder: Path, door: str, number: int) -> Verdict:
    """One case in a folder of its own, which is removed."""
    single, (attack, content) = SINGLES[door], crafted(door, innocents, number)
    path = put_single(single, innocents, folder, content)
    if isinstance(single.reads, str) and number % EVERY == 0:
        told = as_typed(single.reads.split(), folder, folder / "said")
    else:
        told = in_fork(partial(_answer, single, folder, path), folder / "said")
    wrong = what_is_wrong(told, Told(0, "", 0.0, 0.0), EXIT_CODE_TEXT.keys() - {INTERRUPTED})
    if not wrong and told.code and (path.name if single.named == "" else single.named or "") not in told.said:
        wrong = f"refused without its name: {told.said[-400:]}"
    shutil.rmtree(folder)
    how = "refused" if told.code else "read"
    return Verdict(door, number, attack, how, wrong, told.cpu_s, told.gb)


LOADED = ("factory.commands.exchange", "factory.graph.execute", "factory.pipeline", "factory.setup.settings")
LOADED += ("factory.views.board.gallery", "tasks.experts.pdm_closed", "tasks.render.fit.reconstruct")


def load_what_is_read_with(doors: Collection[str]) -> None:
    """Once, before the first fork. Who has opened a table is not to be forked: Delta's threads stay behind."""
    planner = {"checkpoint": "planners.published.import_planner", "batch": "planners.data.images"}
    for name in (*LOADED, *(planner[word] for word in planner if any(word in door for door in doors))):
        importlib.import_module(name)

"""Faults at any one of the calls by which a process changes files below a folder: kill, refuse or tear it there.

Python, Arrow and delta-rs, which is compiled Rust, call libc alike, so a library that is loaded before it
(file_steps.c) sees them all. Only on Linux with a C compiler, and with nothing else in LD_PRELOAD.
"""

import ctypes
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path

from tests.chaos.trials import leave_by
from tests.pages import REPOSITORY

FAULTS = {"killed before it": 1, "refused with EIO": 2, "half written, then killed": 3}
NO_FAULT = 0
SOURCE = Path(__file__).with_name("file_steps.c")


@dataclass(frozen=True)
class Step:
    """One call."""

    number: int  # from 1
    call: str
    n_bytes: int  # of a write
    path: str  # relative to the folder


def compiler() -> str | None:
    """None where steps cannot be counted."""
    return shutil.which("cc") if sys.platform == "linux" and "LD_PRELOAD" not in os.environ else None


def steps_of(log: Path) -> list[Step]:
    lines = (line.split(" ", 3) for line in log.read_text().splitlines())
    return [Step(int(number), call, int(n_bytes), path) for number, call, n_bytes, path in lines]


@dataclass(frozen=True)
class Trial:
    """A call of `function(out)` in a process of its own, with a fault at one of its steps below `out`."""

    function: str  # module:name; returns an exit code
    out: str
    log: str  # its steps
    words: str  # what it writes to standard output and error
    number: int = 0
    fault: int = NO_FAULT


class Stepped:
    """A process with the library from which trials are forked, so that none pays for its imports."""

    def __init__(self, folder: Path, imports: Sequence[str]) -> None:
        library, cc = folder / "file_steps.so", compiler()
        assert cc is not None, "there is no C compiler"
        subprocess.run([cc, "-O1", "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-ldl"], check=True)
        environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "LD_PRELOAD": str(library)}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.chaos.file_steps", *imports],
            cwd=REPOSITORY,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def exit_code(self, trial: Trial) -> int:
        """Negative of a signal."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(vars(trial)) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def close(self) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


@contextmanager
def stepping(folder: Path, *imports: str) -> Iterator[Stepped]:
    stepped = Stepped(folder, imports)
    try:
        yield stepped
    finally:
        stepped.close()


def _serve(imports: Sequence[str]) -> None:
    for name in imports:
        import_module(name)
    with suppress(ImportError):
        import_module("pandas")  # which Arrow imports where there is one
    for line in sys.stdin:
        trial = Trial(**json.loads(line))
        child = os.fork()
        if child == 0:
            leave_by(partial(_run, trial), Path(trial.words))
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _run(trial: Trial) -> int:
    log = os.open(trial.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    module, _, name = trial.function.partition(":")
    function: Callable[[str], int] = getattr(import_module(module), name)
    ctypes.CDLL(None).file_steps_arm(os.fsencode(trial.out), ctypes.c_long(trial.number), trial.fault, log)
    return function(trial.out)


if __name__ == "__main__":
    _serve(sys.argv[1:])

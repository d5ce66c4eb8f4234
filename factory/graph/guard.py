"""A small process beside one that works: it ends what is over its limits, and names what was in hand at a crash.

It needs nothing of the process it watches, neither its threads nor its interpreter's lock, so that a loop inside a
compiled function is ended as any other. The process tells it by a pipe what it begins and ends; signals that
reach the process stand in the same pipe as bytes. Run as a script it imports the standard library alone.

In `folder` lie `<key>.work` for what has been at work for SHOWN_S, `<key>.over` for what was ended over its limits, and
`crashed` for what was in hand when a process that nobody supervises died.
"""

import faulthandler
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

TICK_S = 0.25
SHOWN_S = 10.0  # at work for so long, a task is told of, and again every so often
STACK_S = 0.5  # for the watched process to write where it stands
STOPS = frozenset({signal.SIGINT, signal.SIGTERM, signal.SIGHUP})  # as in factory.exits
SIGNALS = bytes({*range(32)} - {ord("\n")})  # bytes that are no text of a task
ASKED_S, KILLED_S = 15.0, 25.0  # after the first of them: a second one, the end
MEMORY_SHARE = 0.9  # of the machine's that one process may hold, where there is no other limit
STACK_LINES = 30
WORK, OVER, CRASHED = ".work", ".over", "crashed"


class WatchedProcess:
    """The watched side: one a process, begun with its first task."""

    def __init__(self, folder: Path, alone: bool) -> None:
        """alone: nobody supervises this process, so a crash is written down, and signals are seen through."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._stack: IO[str] = tempfile.NamedTemporaryFile("w", prefix="factory-stack-", delete=False)  # noqa: SIM115
        faulthandler.register(signal.SIGUSR1, self._stack, all_threads=False)
        script = [sys.executable, "-I", "-S", __file__]
        given = [str(os.getpid()), str(folder), self._stack.name, str(int(alone))]
        read, self._pipe = os.pipe()
        self._guard = subprocess.Popen([*script, *given], stdin=read, start_new_session=True)  # noqa: S603
        self._wakes = alone and threading.current_thread() is threading.main_thread()
        self._ends = [self._pipe]
        if self._wakes:
            os.set_blocking(self._pipe, False)
            signal.set_wakeup_fd(self._pipe, warn_on_full_buffer=False)
            self._ends.append(read)  # held: a signal's byte then has where to go without the guard, too
        else:
            os.close(read)

    @contextmanager
    def watching(self, task: dict[str, Any]) -> Iterator[None]:
        """A task at work: `key`, `what` in words, and where they are limited `seconds` and `gb`; with what is to be
        known of it after a crash."""
        self._tell(task)
        try:
            yield
        finally:
            self._tell({})

    def _tell(self, message: dict[str, Any]) -> None:
        with suppress(BlockingIOError, BrokenPipeError):  # a guard that somebody ended: the work goes on without
            os.write(self._pipe, json.dumps(message).encode() + b"\n")

    def close(self) -> None:
        """Watch no more."""
        if self._wakes:
            signal.set_wakeup_fd(-1)
        faulthandler.unregister(signal.SIGUSR1)
        for end in self._ends:
            os.close(end)
        self._guard.wait()
        self._stack.close()
        Path(self._stack.name).unlink(missing_ok=True)
        with suppress(OSError):  # notes of others are in it, or another run removed it
            self._folder.rmdir()


def read_note(path: Path) -> dict[str, Any] | None:
    """What a guard wrote; None where there is nothing, or half of it."""
    try:
        found: dict[str, Any] = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return found


def main(pid: int, folder: Path, stack: Path, alone: bool) -> None:
    """Watch a process until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    task: dict[str, Any] = {}
    told, began, shown, looked, asked, again = b"", 0.0, 0.0, 0.0, 0.0, False
    while True:
        ready, _, _ = select.select([0], [], [], TICK_S if task or asked else None)
        now = time.monotonic()
        if ready:
            data = os.read(0, 65536)
            if not data:
                break
            if asked == 0.0 and not STOPS.isdisjoint(data):
                asked = now
            *lines, told = (told + data.translate(None, SIGNALS)).split(b"\n")
            for line in lines:
                if shown > began:
                    (folder / f"{task['key']}{WORK}").unlink(missing_ok=True)
                task = json.loads(line) if line else task
                began, shown = now, now
        why = ""
        if task and now - looked >= TICK_S:  # not at every short task that begins or ends
            looked, why = now, _limit_exceeded(task, now - began, resident_gb(pid))
        if why:
            os.kill(pid, signal.SIGUSR1)  # it writes the calls that it is in
            time.sleep(STACK_S)
            calls = "\n".join(stack.read_text(errors="replace").strip().splitlines()[:STACK_LINES])
            _write_note(folder / f"{task['key']}{OVER}", {**task, "why": why, "stack": calls})
            (folder / f"{task['key']}{WORK}").unlink(missing_ok=True)  # before anybody can see that it has ended
            os.kill(pid, signal.SIGKILL)
            task = {}
            break
        if task and now - shown >= SHOWN_S:
            shown = now
            at = {"pid": pid, "host": socket.gethostname(), "held_gb": round(resident_gb(pid), 2)}
            _write_note(folder / f"{task['key']}{WORK}", {**task, **at, "since": time.time() - (now - began)})
        if alone and asked and now - asked >= ASKED_S and not again:
            again = True
            os.kill(pid, signal.SIGINT)
        if alone and asked and now - asked >= KILLED_S:
            os.kill(pid, signal.SIGKILL)
            asked, task = 0.0, {}
            break
    if task:
        (folder / f"{task['key']}{WORK}").unlink(missing_ok=True)
        if alone:
            _write_note(folder / CRASHED, task)
    stack.unlink(missing_ok=True)


def resident_gb(pid: int) -> float:
    """Resident memory of a process."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e9
    except OSError:  # not Linux, or it has just ended
        found = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True)  # noqa: S603, S607
        return int(found.stdout.strip() or 0) * 1024 / 1e9


def _limit_exceeded(task: dict[str, Any], seconds: float, gb: float) -> str:
    most_gb = task.get("gb") or MEMORY_SHARE * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    if task.get("limited", True) and gb > most_gb:
        return f"held {gb:.1f} GB of memory, more than {most_gb:.1f} GB"
    if task.get("seconds") and seconds > task["seconds"]:
        return f"was at work for more than {task['seconds']:.0f} s"
    return ""


def _write_note(path: Path, document: dict[str, Any]) -> None:
    draft = path.with_name(f"{path.name}.tmp")
    with suppress(OSError):  # a full disk, which the run itself tells of
        path.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(json.dumps(document))
        draft.replace(path)


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4] == "1")

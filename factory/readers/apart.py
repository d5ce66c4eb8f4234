"""Files of others, looked at in another process: what brings that down, or never ends, costs one file and no run.

One process for all that are looked at in a thread, started with the first and again after a file that it did not
survive. It ends with this process, whose end of the pipe closes.
"""

import atexit
import os
import pickle
import resource
import signal
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Generic, TypeVar

from factory.exits import ignore_terminal_signals
from factory.readers.base import BadClip, failures_as_bad_clip

LIMIT_S = 300.0  # for one file; the longest logs take seconds
MEMORY_BYTES = 16 * 2**30  # beyond what a file of 1 GB may ask for
FUNCTION, ARGUMENT = b"f", b"a"
A = TypeVar("A")
R = TypeVar("R")


class ReaderProcess:
    """A process that answers one question after the other."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        command = [sys.executable, "-m", "factory.readers.apart", str(theirs.fileno())]
        self._process = subprocess.Popen(  # noqa: S603 (ours)
            command, env=environment, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
        )
        theirs.close()
        self._pipe: Connection[Any, Any] = Connection(ours.detach())

        self._told = b""

    def ask(self, function: bytes, argument: bytes, limit_s: float) -> Any:
        """The answer. Raises TimeoutError, and EOFError or OSError where the process died."""
        if function is not self._told:
            self._pipe.send_bytes(FUNCTION + function)
            self._told = function
        self._pipe.send_bytes(ARGUMENT + argument)
        if not self._pipe.poll(limit_s):
            raise TimeoutError
        return self._pipe.recv()  # ours, where files are data as they are here: nothing of them was run

    def kill(self) -> None:
        """Whoever asks it meets its end."""
        self._process.kill()

    def end(self) -> int:
        """Kill it, if it lives; how it ended."""
        self._pipe.close()
        self._process.kill()
        return self._process.wait()


_idle: list[ReaderProcess] = []  # who asks takes one out, or starts another
_busy: set[ReaderProcess] = set()


class ProcessFunction(Generic[A, R]):
    """A function, answered in the other process; it is sent there once for all arguments that follow each other."""

    def __init__(self, function: Callable[[A], R]) -> None:
        self._function = pickle.dumps(function)

    def __call__(self, argument: A, file: str, limit_s: float = LIMIT_S) -> R:
        """What the function returns; what it raises is raised.

        Raises BadClip with the file's name where it takes longer than `limit_s`, more memory than there is for it, or
        brings the process down.
        """
        is_well, answer = self._asked(pickle.dumps(argument), file, limit_s)
        if is_well:
            found: R = answer
            return found
        if isinstance(answer, MemoryError):
            raise BadClip(file, "file", "reading it takes more memory than there is for it") from answer
        raise answer

    def _asked(self, argument: bytes, file: str, limit_s: float) -> Any:
        process = _idle.pop() if _idle else ReaderProcess()
        _busy.add(process)
        try:
            answer = process.ask(self._function, argument, limit_s)
        except TimeoutError:
            process.end()
            raise BadClip(file, "file", f"reading it was given up after {limit_s:g} s") from None
        except (EOFError, OSError) as error:
            raise BadClip(file, "file", f"its reader {_how(process.end())} over it") from error
        except BaseException:  # a signal while it waits: the answer would be taken for the next question's
            process.end()
            raise
        finally:
            _busy.discard(process)
        _idle.append(process)
        return answer


LOGS_PER_PROCESS = 16  # at least, before another one is started: that takes a second
MOST_PROCESSES = 32  # of some 300 MB each


def read_each(
    read: Callable[[Path], R], paths: Collection[Path], apart: bool, limit_s: float = LIMIT_S
) -> Iterator[R | BadClip]:
    """What is read of each file or folder, in order; the BadClip of one that cannot be read.

    apart: in other processes, one a core where there are many files. Else one after the other in this one.
    """
    elsewhere = ProcessFunction(read) if apart else None

    def one(path: Path) -> R | BadClip:
        try:
            with failures_as_bad_clip(str(path)):
                return read(path) if elsewhere is None else elsewhere(path, str(path), limit_s)
        except BadClip as error:
            return error

    at_once = min(os.cpu_count() or 1, len(paths) // LOGS_PER_PROCESS, MOST_PROCESSES)
    if not apart or at_once < 2:
        yield from map(one, paths)
        return
    pool, ahead = ThreadPoolExecutor(at_once), deque[Future[R | BadClip]]()
    try:
        for path in paths:
            ahead.append(pool.submit(one, path))
            if len(ahead) > 2 * at_once:
                yield ahead.popleft().result()
        yield from (answer.result() for answer in ahead)
    except BaseException:  # a signal: their files may take minutes
        for process in list(_busy):
            process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        while len(_idle) > 1:  # one is kept for what follows
            _idle.pop().end()


def _end() -> None:
    while _idle:
        _idle.pop().end()


def _how(code: int) -> str:
    return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


atexit.register(_end)


def _answer_all(pipe: "Connection[Any, Any]") -> None:
    """The other process: until its pipe closes."""
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    allowed = MEMORY_BYTES if most == resource.RLIM_INFINITY else min(most, MEMORY_BYTES)
    resource.setrlimit(resource.RLIMIT_DATA, (allowed, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    told, function = b"", None
    while True:
        try:
            question = pipe.recv_bytes()
        except EOFError:
            return
        if question[:1] == FUNCTION:
            told, function = question[1:], None
            continue
        signal.alarm(int(LIMIT_S) + 60)  # who asked may be gone
        try:
            function = function or pickle.loads(told)  # noqa: S301 (our own parent's)
            answer = True, function(pickle.loads(question[1:]))  # noqa: S301
        except Exception as error:
            answer = False, error
        signal.alarm(0)
        pipe.send(answer)


if __name__ == "__main__":
    ignore_terminal_signals()
    _answer_all(Connection(int(sys.argv[1])))

"""What a program ends with, how signals end it, and what becomes of its output: the one place for these."""

import atexit
import errno
import io
import os
import signal
import stat
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

COMPLETE, DAMAGED, BAD_CONFIG, COMPLETE_WITH_FAILURES, INTERRUPTED = range(5)
EXIT_CODE_TEXT = {
    COMPLETE: "complete",
    DAMAGED: "checked, and something is wrong with it",
    BAD_CONFIG: "refused: what was asked for does not exist or does not fit; nothing is written",
    COMPLETE_WITH_FAILURES: "complete with failed attempts",
    INTERRUPTED: "interrupted, the same command goes on",
}
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
TERMINAL_SIGNALS = (signal.SIGINT, signal.SIGHUP)  # Ctrl-C and a closed terminal reach every process that runs in it


class Failed(Exception):
    """A part ended with an error; what else was to be done is done."""


class Stopped(Exception):
    """Interrupted or out of minutes; what is done is kept, and the same command goes on."""


def exit_on_early_interrupt() -> None:
    """Until `run_program`, while modules are imported and nothing is begun: SIGINT is one line and INTERRUPTED."""

    def end(number: int, frame: FrameType | None) -> None:
        os.write(2, b"interrupted\n")
        os._exit(INTERRUPTED)

    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
        signal.signal(signal.SIGINT, end)


def run_program(main: Callable[[Sequence[str]], int]) -> None:
    """Run the command line of this process and end with its exit code."""
    # Of all that is done at exit the last: what then comes is Python's own teardown, which makes SIGINT deadly again.
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    sys.exit(run_for_exit_code(lambda: main(sys.argv[1:])))


def run_for_exit_code(work: Callable[[], int]) -> int:
    """What the work of this process returns; INTERRUPTED, after a line, at a KeyboardInterrupt.

    A first SIGINT that comes once the exit code is known changes nothing; a second one ends the process by that code.
    What it prints decides nothing: see `ignore_broken_output`. TERMINAL_SIGNALS are heeded from here on, where the
    process was begun in `terminal_signals_blocked`.
    """
    ignore_broken_output()
    noted, known = list[int](), list[int]()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if known and noted:  # what is waited for at exit, threads and processes, can hang: on a share, say
            os._exit(known[0])
        noted.append(number)
        if not known:
            raise _Interrupt

    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, interrupt)
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, TERMINAL_SIGNALS)
        known.append(work())
    except (KeyboardInterrupt, Exception) as error:
        if not (noted or isinstance(error, KeyboardInterrupt)):
            raise  # after a signal it is what an import of compiled modules has made of it
        known.append(INTERRUPTED)
        print("interrupted", file=sys.stderr)
    return known[0]


class _Interrupt(KeyboardInterrupt):
    """By its exact type: where KeyboardInterrupt itself leaves an exec(), as of a dataclass, Python notes that and ends
    the process by SIGINT, though the exception was caught."""


def ignore_terminal_signals() -> None:
    """In a process begun in `terminal_signals_blocked`: only the program that started it ends it."""
    for number in TERMINAL_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, TERMINAL_SIGNALS)
    ignore_broken_output()


@contextmanager
def terminal_signals_blocked(*signals: signal.Signals) -> Iterator[None]:
    """Processes begun inside do not receive these signals before `ignore_terminal_signals`; all of TERMINAL_SIGNALS.

    This process heeds them at the end of it, when who began others knows them and can end them.
    """
    numbers, held, handlers = signals or TERMINAL_SIGNALS, list[int](), dict[int, Any]()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    if threading.current_thread() is threading.main_thread():  # it handles what another thread receives, too
        stop_signals = [number for number in numbers if callable(signal.getsignal(number))]
        handlers = {number: signal.signal(number, lambda number, _: held.append(number)) for number in stop_signals}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number in held:
            signal.raise_signal(number)


def end_with_parent(code: int, last: Callable[[], object] = lambda: None) -> None:
    """From now on this process, one of multiprocessing's, ends by an exit code once the one that began it has ended.

    last: what it does then.
    """
    import multiprocessing  # here alone: most programs begin no process

    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        last()
        os._exit(code)

    threading.Thread(target=watch, daemon=True).start()


def ignore_broken_output() -> None:
    """From now on standard output and error are dropped once nobody reads them: `... | head`, a closed terminal.

    Characters that their encoding lacks are replaced: by question marks, which keep tables in line, on standard error
    by escapes.
    """
    sys.stdout, sys.stderr = _never_failing(sys.stdout, "replace"), _never_failing(sys.stderr, "backslashreplace")


def _never_failing(stream: TextIO, errors: str) -> TextIO:
    if not isinstance(stream, io.TextIOWrapper):  # closed from the start, or a test's own
        return stream
    stream.flush()
    file = _Output(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        file if stream.write_through else io.BufferedWriter(file),  # PYTHONUNBUFFERED
        encoding=stream.encoding,
        errors=errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


class _Output(io.FileIO):
    """Standard output or error; for this process and those it starts the null device once its reader has gone."""

    def write(self, data: "ReadableBuffer") -> int:
        try:
            return super().write(data)
        except OSError as error:
            closed_terminal = error.errno == errno.EIO and stat.S_ISCHR(os.fstat(self.fileno()).st_mode)
            if not closed_terminal and not isinstance(error, ConnectionError):
                error.filename = "the output"  # of a full disk, say: what ends the command has no other name
                raise
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self.fileno())
            return super().write(data)


@contextmanager
def handling_stop_signals(handle: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """STOP_SIGNALS are handled so, but for a SIGHUP that is ignored, as by nohup.

    Changes nothing off the main thread: the signals of a Ray worker are Ray's.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heeded = [n for n in STOP_SIGNALS if n != signal.SIGHUP or signal.getsignal(n) != signal.SIG_IGN]
    before = {number: signal.signal(number, handle) for number in heeded}
    try:
        yield
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) == handle:
                signal.signal(number, handler)


@contextmanager
def calling_on_stop_signal(stop: Callable[[], object]) -> Iterator[None]:
    """The first SIGINT, SIGTERM or SIGHUP calls `stop`, a second one raises KeyboardInterrupt.

    A SIGHUP is never a second one, and is ignored after the first: a terminal that closes sends it, and its shell once
    more. Where it is ignored from the start, as by nohup, it stays so. Nothing is called off the main thread.
    """
    asked = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP:
            signal.signal(number, signal.SIG_IGN)
        if not asked.is_set():
            asked.set()
            stop()
        elif number != signal.SIGHUP:
            raise _Interrupt

    with handling_stop_signals(handle):
        yield

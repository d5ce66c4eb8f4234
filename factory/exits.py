"""What a program ends with, and how signals end it: the one place for both."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

COMPLETE, DAMAGED, BAD_CONFIG, COMPLETE_WITH_FAILURES, INTERRUPTED = range(5)
MEANING = {
    COMPLETE: "complete",
    DAMAGED: "checked, and something is wrong with it",
    BAD_CONFIG: "refused: what was asked for does not exist or does not fit; nothing is written",
    COMPLETE_WITH_FAILURES: "complete with failed attempts",
    INTERRUPTED: "interrupted, the same command goes on",
}


def as_program(main: Callable[[Sequence[str]], int]) -> None:
    """Run the command line of this process and end with its exit code."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `... | head` ends quietly
    sys.exit(main(sys.argv[1:]))


@contextmanager
def asked_to_stop(stop: Callable[[], object]) -> Iterator[None]:
    """The first SIGINT or SIGTERM calls `stop`, a second one raises KeyboardInterrupt.

    Changes nothing off the main thread: the signals of a Ray worker are Ray's.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()
        stop()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

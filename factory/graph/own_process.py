"""A run on Ray in a process beside the command's, which outlives what Ray does to it.

Ray's core worker ends its process by exit code 1, and Python is not asked, where it finds the raylet or the object
store of its node gone. The command's own process then says so in a line, and goes on on a new cluster.
"""

import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType
from typing import TypeVar

from factory.exits import (
    INTERRUPTED,
    end_with_parent,
    handling_stop_signals,
    run_for_exit_code,
    terminal_signals_blocked,
)
from factory.wording import one_line

AGAIN = "run the same command again to go on"
ANSWER_S = 10.0  # for a cluster's port to be reached, and to say what it speaks
GRPC_HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0"  # ends with a frame of kind 4, as answers begin
LOOK_S = 2.0  # between two looks whether a head node answers
LOST_S = 75.0  # without an answer, a head node is lost: Ray itself gives one up after 60 s, where it notices
NEW_CLUSTERS = 3  # in one run, for those of its own that die
BY_RAY = 1  # its exit code of a process whose raylet is gone

T = TypeVar("T")
Run = Callable[[int, Callable[[str], None]], int]  # clusters begun anew before, says that another is; its exit code


def run_in_own_process(run: Run, is_ours: bool, say: Callable[[str], None]) -> int:
    """run(clusters begun anew before, how it says of another one) in a process of its own; the exit code.

    is_ours: the run begins its cluster itself, so another can replace it. Signals that ask it to stop are passed on;
    where a signal ends that process, it ends this one. What it leaves behind where Ray ends it is ended.
    """
    context, begun = multiprocessing.get_context("spawn"), 0
    while True:
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_child_main, args=(theirs, run, begun))
        with handling_stop_signals(partial(_pass_on, process)):
            with terminal_signals_blocked():
                process.start()
            theirs.close()
            lost = not is_ours and _ended_without_answer(process, os.environ.get("RAY_ADDRESS", ""))
            process.join()
        assert process.pid is not None
        _end_session(process.pid)
        lines, code = _read_messages(ours)
        if code is not None:
            return code
        ended = process.exitcode or 0
        if ended < 0 and not lost:
            with suppress(OSError):  # SIGKILL
                signal.signal(-ended, signal.SIG_DFL)
            os.kill(os.getpid(), -ended)
        if ended != BY_RAY and not lost:
            return ended
        begun += len(lines)
        if not is_ours:
            why = f"the head node has not answered for {LOST_S:.0f} s" if lost else "its raylet or head node has died"
            print(f"the run's Ray cluster is lost: {why}; {AGAIN} once Ray is up", file=sys.stderr)
            return INTERRUPTED
        if begun == NEW_CLUSTERS:
            print(f"Ray's raylet died; {AGAIN}", file=sys.stderr)
            return INTERRUPTED
        begun += 1
        say(new_cluster_text("Ray's raylet died", begun))


def run_command_in_own_process(command: Callable[[T], int], given: T) -> int:
    """command(given), its exit code: as `run_in_own_process`, unless this process is on a cluster already.

    command: a function of a module, which goes on where it was stopped. Raises ConnectionError where no cluster answers
    at RAY_ADDRESS.
    """
    if "ray" in sys.modules and sys.modules["ray"].is_initialized():
        return command(given)
    address = os.environ.get("RAY_ADDRESS", "")
    check_address_answers(address)
    return run_in_own_process(partial(_call, command, given), not address, partial(print, flush=True))


def _call(command: Callable[[T], int], given: T, begun: int, tell: Callable[[str], None]) -> int:
    from factory.graph.local import ClusterDied

    try:
        return command(given)
    except ClusterDied:
        os._exit(BY_RAY)  # as Ray does it, where it is quicker to notice


def _ended_without_answer(process: BaseProcess, address: str) -> bool:
    """Waits for a process that works on a cluster; True once the head node there has been silent for LOST_S: ended."""
    answered = time.monotonic()
    while process.is_alive():
        process.join(LOOK_S)
        try:
            check_address_answers(address)
            answered = time.monotonic()
        except ConnectionError:
            if process.is_alive() and time.monotonic() - answered > LOST_S:
                process.kill()
                return True
    return False


def no_cluster_text(address: str, error: Exception) -> str:
    """The line about an address whose cluster could not be joined, by what an attempt raised: the cause comes first."""
    alone = "unset it to run on this machine alone"
    if "authentication token" in f"{error} {error.__cause__}".lower():  # as Ray has it, of various kinds
        return (
            f"this command lacks the token of the Ray cluster at RAY_ADDRESS={address}: export RAY_AUTH_MODE=token and "
            f"have the token in ~/.ray/auth_token, or {alone}"
        )
    return f"no Ray cluster answers at RAY_ADDRESS={address} ({one_line(error)}); {alone}"


def check_address_answers(address: str) -> None:
    """Raises ConnectionError where no head node listens: at a dashboard's port, say, Ray itself tries for minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if address in ("", "auto", "local"):
        return  # Ray knows where
    try:
        if not (colon and port.isdecimal()):
            raise OSError("it is neither auto nor a host:port")
        with socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER_S) as to:
            to.sendall(GRPC_HELLO)
            if os.environ.get("RAY_USE_TLS", "0") == "0" and to.recv(4)[3:] != GRPC_HELLO[-6:-5]:
                raise OSError("what listens there is no head node, whose port `ray start --head` prints")
    except OSError as error:
        raise ConnectionError(no_cluster_text(address, error)) from error


def new_cluster_text(said: str, number: int) -> str:
    """The line about one of NEW_CLUSTERS."""
    return f"{said}; a new cluster is started, {number} of {NEW_CLUSTERS}"


def _child_main(pipe: Connection, run: Run, begun: int) -> None:
    """The other process: a session of its own, so that a terminal's signals come by way of the command's alone."""
    os.setsid()
    end_with_parent(BY_RAY, partial(_end_session, os.getpid()))  # Ray's agents would look for their GCS for a minute
    code = 1
    try:
        code = run_for_exit_code(lambda: run(begun, pipe.send))
    except SystemExit:  # Ray's own answer to SIGTERM, from when it begins to where the run heeds signals itself
        print(f"interrupted; {AGAIN}", file=sys.stderr)
        code = INTERRUPTED
    finally:
        pipe.send(code)
    sys.exit(code)


def _read_messages(pipe: Connection) -> tuple[list[str], int | None]:
    """Of a process that has ended: its lines, and its exit code where it came to say it."""
    lines: list[str] = []
    with suppress(EOFError):
        while isinstance(message := pipe.recv(), str):
            lines.append(message)
        return lines, message
    return lines, None


def _pass_on(process: BaseProcess, number: int, frame: FrameType | None) -> None:
    """A signal to a process that has begun."""
    if process.pid is not None:
        with suppress(ProcessLookupError):
            os.kill(process.pid, number)


def _end_session(session: int) -> None:
    """End what a process that is gone, or this one, had begun: Ray's processes of a cluster of its own."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            pid = int(stat.parent.name)
            if int(stat.read_text().rpartition(")")[2].split()[3]) == session and pid != os.getpid():
                os.kill(pid, signal.SIGKILL)

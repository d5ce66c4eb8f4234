"""The graph in one process beside this one: what a plug-in does to its process, it does not do to the run.

The other process is supervised as a worker of Ray's is: its task is tried again when it dies, ended over its limits,
and its results come back as bytes that are not opened here. Those used last it keeps, and asks for others again.
"""

import multiprocessing
import os
import pickle
import signal
import time
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from factory.exits import as_worker, without_terminal
from factory.graph.frozen import frozen
from factory.graph.limits import NO_LIMITS, Costs, Limits, cleared, described, notes_folder, put_away, watched
from factory.graph.local import MAX_RETRIES, STEPS, Fuse, Ticket, attempt_tasks, name_of, unready
from factory.graph.metrics import NoRecorder, Recorder
from factory.graph.steps import Failure, warm
from factory.graph.work import NotReady, Stopped, Work, never
from factory.store.attempts import ErrorKind
from factory.store.location import Location

KEPT = 16  # results that the process keeps opened
END_S = 5.0  # for it to end by itself


@dataclass(eq=False)
class KeptResult:
    """Stands for the result of a task; its bytes stay with the run, and go with the last who may ask for them."""

    number: int
    data: bytes = b""

    def __reduce__(self) -> tuple[type["KeptResult"], tuple[int]]:
        return KeptResult, (self.number,)


class IsolatedGraph:
    """Graph in a process of its own, one task after the other."""

    parallelism = 1

    def __init__(
        self,
        work: Work,
        out: Location,
        stopped: Stopped = never,
        fuse: Fuse = "auto",
        limits: Limits = NO_LIMITS,
    ) -> None:
        """Raises NotReady where the process cannot be given the work, or is not ready for it."""
        self.attempt_tasks: Sequence[Sequence[str]] = attempt_tasks(fuse, apart=False)
        self.cores = os.cpu_count() or 1
        self.recorder: Recorder = NoRecorder()
        self._work, self._out, self._stopped = work, out, stopped
        self._context = multiprocessing.get_context("spawn")
        with without_terminal():  # what keeps its semaphores is a process, too
            self._stop = self._context.Event()
        self._costs, self._notes = Costs(limits), notes_folder(out)
        self._waiting: deque[tuple[Ticket, str, tuple[Any, ...]]] = deque()
        self._numbers, self._run = count(), cleared(self._notes)
        self._in_hand: tuple[Ticket, str, tuple[Any, ...]] | None = None
        self._deaths = 0  # at what is in hand
        self._begin()

    def submit(self, step: str, *args: Any) -> Ticket:
        ticket = Ticket(name_of(step, args), None)
        ticket.result = KeptResult(next(self._numbers))
        self._waiting.append((ticket, step, args))
        return ticket

    def ahead(self) -> int:
        return 1

    def wait(self, timeout_s: float) -> tuple[Ticket, Any] | None:
        if self._stopped():
            self._stop.set()
        if self._in_hand is None:
            if not self._waiting:
                return None
            self._in_hand, self._deaths = self._waiting.popleft(), 0
            self._send()
        ticket, _, args = self._in_hand
        until = time.monotonic() + timeout_s
        while self._pipe.poll(max(0.0, until - time.monotonic())):
            try:
                answer = self._pipe.recv()
            except (EOFError, ConnectionResetError):
                report: Any = self._after_death(ticket)
                if report is None:
                    continue
            else:
                if isinstance(answer, KeptResult):
                    asked = (arg for arg in args if isinstance(arg, KeptResult) and arg.number == answer.number)
                    self._pipe.send(next(asked).data)
                    continue
                report, ticket.result.data, worked_s = answer
                if not isinstance(report, Failure):
                    self._costs.took(ticket.step, worked_s)
                ticket.queued_s = max(0.0, time.monotonic() - ticket.submitted - worked_s)
            self._in_hand = None
            return ticket, report
        return None

    def close(self) -> None:
        """End the process, whatever it is at."""
        if self._in_hand is None and self._process.is_alive():
            self._pipe.send(None)
            self._process.join(END_S)
        self._process.kill()
        self._process.join()
        self._waiting.clear()
        put_away(self._notes)

    def _send(self) -> None:
        assert self._in_hand is not None
        ticket, step, args = self._in_hand
        task = described(step, ticket.step, args) | self._costs.limits(ticket.step) | {"run": self._run}
        self._pipe.send((ticket.result.number, step, task, args))

    def _after_death(self, ticket: Ticket) -> Failure | None:
        """Begin anew and hand the task over once more; its Failure where that was done often enough."""
        self._process.join()
        self._deaths += 1
        code = self._process.exitcode or 0
        how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
        self._begin()
        if self._deaths > MAX_RETRIES:
            return Failure(ErrorKind.SYSTEM, f"the process ended {how} at {ticket.step}, {self._deaths} times")
        self._send()
        return None

    def _begin(self) -> None:
        self._pipe, theirs = self._context.Pipe()
        given = (theirs, self._work, self._out, self._stop, self._notes)
        self._process = self._context.Process(target=_serve, args=given, daemon=False)
        try:
            with without_terminal():
                self._process.start()
            theirs.close()
            said = self._pipe.recv()
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise NotReady(f"no process of its own can be given this work ({error}): graph.isolated=never") from error
        except EOFError:
            self._process.join()
            raise NotReady(f"the process for plug-ins ended with exit code {self._process.exitcode}") from None
        except KeyboardInterrupt:  # which the process does not hear
            if self._process.pid is not None:
                self._process.kill()
            raise
        if isinstance(said, Failure):
            raise unready(said)


def _serve(pipe: Connection, work: Work, out: Location, stop: Any, notes: Path) -> None:
    """The other process: a task at a time, until there is none or the run is gone."""
    as_worker()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the run decides
    supplied = {"work": work, "out": out, "stopped": stop.is_set}
    kept: OrderedDict[int, Any] = OrderedDict()

    def value_of(arg: Any) -> Any:
        if not isinstance(arg, KeptResult):
            return arg
        if arg.number not in kept:
            pipe.send(arg)
            kept[arg.number] = frozen(pickle.loads(pipe.recv()))  # noqa: S301 -- this process made it, or its like
        kept.move_to_end(arg.number)
        return kept[arg.number]

    try:
        said, _ = warm(work, draws=True)
        pipe.send(said)
        if isinstance(said, Failure):
            return
        while (message := pipe.recv()) is not None:
            number, step, task, args = message
            given = [value_of(arg) for arg in args]
            began = time.perf_counter()
            function, wants = STEPS[step]
            report, result = watched(notes, task, function, *(supplied[name] for name in wants), *given)
            kept[number] = frozen(result)
            while len(kept) > KEPT:
                kept.popitem(last=False)
            pipe.send((report, pickle.dumps(result, 5), time.perf_counter() - began))
    except (EOFError, BrokenPipeError):  # the run was killed
        return

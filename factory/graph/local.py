"""The graph in this process: one task after the other, in the order of submission. For tests, breakpoints, explain."""

import hashlib
import multiprocessing
import os
import pickle
import secrets
import signal
import tempfile
import time
from abc import ABC, abstractmethod
from collections import OrderedDict, defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from factory.exits import ignore_terminal_signals, terminal_signals_blocked
from factory.files import DiskFull
from factory.graph import steps
from factory.graph.guard import OVER, WORK, WatchedProcess, read_note
from factory.graph.progress import Record
from factory.graph.steps import Failure, NotReady, StopCheck, Work, warm
from factory.readers.base import ClipRef
from factory.store.location import Location
from factory.store.samples import ErrorKind
from factory.store.schema import Stamp
from tasks.stages import ATTEMPT, TASKS

# What a task may take, and a task under watch: beyond its seconds or its memory it is ended (factory.graph.guard).

SEEN = 20  # tasks of a name that must have ended before their cost says what another may take
TIMES = 30.0  # the longest so far, a task may take
LEAST_S = 300.0  # and never less than this


@dataclass(frozen=True)
class Limits:
    """Most that a task may take, by its name, where it is not what tasks.stages says."""

    seconds: Mapping[str, float] = field(default_factory=dict)
    gb: Mapping[str, float] = field(default_factory=dict)

    def for_task(self, name: str) -> tuple[float | None, float | None]:
        """(seconds, GB) of a task; of stages fused into one the sum of their seconds, the most of their memory."""
        parts = [task for task in TASKS if task.name in name.split("+")]
        seconds = [self.seconds.get(task.name, task.limit_s) for task in parts]
        memory = [self.gb.get(task.name, task.limit_gb) for task in parts]
        known = [gb for gb in memory if gb is not None]
        return sum(seconds) or None, max(known) if known and len(known) == len(memory) else None


class TaskDurations:
    """How long tasks have taken in this run, and so what the next may take."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._seen: dict[str, list[float]] = defaultdict(lambda: [0, 0.0, 0.0])  # how many, the longest, all together

    def add(self, name: str, seconds: float) -> None:
        """A task that ended well."""
        n, longest, together = self._seen[name]
        self._seen[name] = [n + 1, max(longest, seconds), together + seconds]

    def tasks_in(self, name: str, seconds: float) -> int:
        """How many of this name usually end in so many seconds; 1 until that is known."""
        n, _, together = self._seen[name]
        return max(1, int(seconds * n / together)) if n >= SEEN and together > 0.0 else 1

    def limits_for(self, name: str) -> dict[str, float | None]:
        """Of the next task of this name; what the settings give is not tightened."""
        seconds, gb = self._limits.for_task(name)
        n, longest, _ = self._seen[name]
        given = set(name.split("+")) & set(self._limits.seconds)
        if seconds is not None and n >= SEEN and not given:
            seconds = min(seconds, max(LEAST_S, TIMES * longest))
        return {"seconds": seconds, "gb": gb}


def notes_folder(out: Location) -> Path:
    """Where guards write: in a local store, which all nodes see; of a remote one on each machine."""
    if out.is_local:
        return Path(out.uri) / "in_work"
    name = hashlib.sha256(out.uri.encode()).hexdigest()[:16]
    return Path(tempfile.gettempdir()) / f"driving-data-factory-{os.getuid()}" / name


def start_run_notes(folder: Path) -> str:
    """A new run's name in the notes of its guards; those of earlier runs go, but for what was in hand at a crash."""
    for path in (*folder.glob(f"*{OVER}"), *folder.glob(f"*{WORK}")):
        path.unlink(missing_ok=True)
    return secrets.token_hex(8)


def remove_if_empty(folder: Path) -> None:
    """The folder of notes, where a run leaves none."""
    with suppress(OSError):  # there is none, or something in it
        folder.rmdir()


def task_note(step: str, name: str, args: tuple[Any, ...]) -> dict[str, Any]:
    """Key and words of a task, and which clip, expert and candidate it is of."""
    stamp = next((arg for arg in args if isinstance(arg, Stamp)), None)
    ref = next((arg for arg in args if isinstance(arg, ClipRef)), None)
    if stamp is not None:
        of = {"attempt_id": stamp.attempt_id, "expert": stamp.expert, "candidate": stamp.candidate_index}
        what = f"{name} of expert {stamp.expert}, candidate {stamp.candidate_index}, attempt {stamp.attempt_id}"
        return {"key": f"{name}-{stamp.attempt_id}", "what": what, **of}
    if ref is not None:
        return {"key": f"{name}-{ref.clip_id}", "what": f"{name} of clip {ref.clip_id}", "clip_id": ref.clip_id}
    return {"key": f"{name}-{os.getpid()}", "what": name}


_GUARDS: dict[Path, WatchedProcess] = {}  # of this process


def call_watched(
    folder: Path, task: dict[str, Any], call: Callable[..., tuple[Any, Any]], *given: Any
) -> tuple[Any, Any]:
    """(report, result) of a task of a supervised process; a Failure where an earlier try was ended over its limits."""
    over = folder / f"{task['key']}{OVER}"
    if (found := read_note(over)) is not None and found["run"] == task["run"]:
        over.unlink(missing_ok=True)
        where = found["stack"] or "where it stood is not known"
        return Failure(ErrorKind.LIMIT, f"{where}\n{found['what']} {found['why']}"), None
    if folder not in _GUARDS:
        _GUARDS[folder] = WatchedProcess(folder, alone=False)
    with _GUARDS[folder].watching(task):
        return call(*given)


# What several attempts are given is read only, as a shared object store hands it out: none changes another's bytes.

T = TypeVar("T")


def read_only(value: T) -> T:
    """The same value; every numpy array in its dataclasses, mappings and sequences is read only from here on."""
    seen: set[int] = set()
    waiting: list[object] = [value]
    while waiting:
        one = waiting.pop()
        kind: Any = type(one)
        if kind in _LEAVES or id(one) in seen:
            continue
        seen.add(id(one))
        if isinstance(one, list | tuple | frozenset):
            waiting += one
        elif isinstance(one, np.ndarray):
            one.flags.writeable = False
        elif names := _members(kind):
            waiting += [getattr(one, name) for name in names]
        elif isinstance(one, Mapping):
            waiting += one.values()
    return value


_LEAVES = frozenset({str, bytes, int, float, bool, type(None)})


@cache
def _members(kind: Any) -> tuple[str, ...]:
    """Of a dataclass; none of another type."""
    return tuple(member.name for member in fields(kind)) if is_dataclass(kind) else ()


MAX_RETRIES = 2  # of a task whose worker died


@dataclass(frozen=True)
class Claims:
    """What tasks claim of a Ray node, beside cores."""

    gpu_share: float = 0.0  # of a GPU, every task that draws; 0: drawn without
    memory_gb: Mapping[str, float] = field(default_factory=dict)  # by task, where it is not what tasks.stages says

    def memory_bytes(self, name: str) -> int:
        """Of a task by its name; of stages fused into one, the most that any of them wants."""
        parts = set(name.split("+"))
        wanted = (self.memory_gb.get(task.name, task.memory_gb) for task in TASKS if task.name in parts)
        return int(1e9 * max(wanted, default=0.0))


class ClusterLacks(ValueError):
    """The cluster has no node that the run could use."""


class MachineFailure(RuntimeError):
    """The machine fails what it is given, or task after task."""


class ClusterDied(RuntimeError):
    """What Ray runs on this machine died in the middle of a run."""

    def __init__(self, said: str, is_ours: bool) -> None:
        """is_ours: the run began the cluster, for itself."""
        super().__init__(said)
        self.is_ours = is_ours


@dataclass(eq=False)
class Ticket:
    """A submitted task. `result` stands for its large result and may be an argument of later tasks."""

    step: str
    result: Any
    submitted: float = field(default_factory=time.monotonic)
    queued_s: float = 0.0  # once it is finished: from submission to report, less the time at work


STEPS: Mapping[str, tuple[Any, tuple[str, ...]]] = {  # its function, and what it is supplied with
    "reconstruct": (steps.reconstruct, ("work", "stopped")),
    "perturb": (steps.prepare, ("work", "out")),
    "attempt": (steps.attempt, ("work",)),
    "attempts": (steps.attempt, ("work",)),  # one after the other
    "write": (steps.write, ("out",)),
    "episodes": (steps.episodes, ("work", "out")),
    "warm": (steps.warm, ("work",)),
}


def task_name(step: str, args: tuple[Any, ...]) -> str:
    """What metrics and Ray call a task: an attempt's by the stages in it."""
    return "+".join(args[0]) if step in ("attempt", "attempts") else step


@dataclass
class _Result:
    value: Any = None


def not_ready_error(failure: Failure) -> Exception:
    """What is to be raised where a machine could not get its kernels."""
    if failure.disk_full:
        return DiskFull(failure.disk_full)
    if failure.kind is ErrorKind.MACHINE:
        return MachineFailure(failure.error.splitlines()[-1])
    return NotReady(failure.error) if failure.kind is ErrorKind.INPUT else RuntimeError(failure.error)


class Graph(ABC):
    """What both executors offer: submit a function of factory.graph.steps, wait for reports."""

    parallelism = 1  # tasks at once
    cores = os.cpu_count() or 1  # that one task can have
    attempt_tasks: Sequence[Sequence[str]] = (ATTEMPT,)  # the stages of an attempt, by task
    record_metric: Record = staticmethod(lambda metric, value, labels: None)  # nobody watches a run in one process

    @abstractmethod
    def submit(self, step: str, *args: Any) -> Ticket:
        """Run `step`; arguments may be results of earlier tickets. What STEPS says is supplied to it."""

    def attempts_per_task(self) -> int:
        """Of a walk: more than 1 where `attempts` make them, whose tasks have a list of rows."""
        return 1

    @abstractmethod
    def wait(self, timeout_s: float) -> tuple[Ticket, Any] | None:
        """A finished task and its report (a steps.Failure where it died); None when the time is up."""

    @abstractmethod
    def close(self) -> None:
        """Begin and await nothing more."""


class LocalGraph(Graph):
    """Graph in this process. Nothing ends a task here; a guard sees signals through, and says what was in hand."""

    def __init__(self, work: Work, out: Location, stopped: StopCheck) -> None:
        """stopped: asked now and then by tasks that take long, as nobody else can while they are at work."""
        self._supplied = {"work": work, "out": out, "stopped": stopped}
        self._waiting: deque[tuple[Ticket, str, tuple[Any, ...]]] = deque()
        self._notes = notes_folder(out)
        self._guard: WatchedProcess | None = None
        work.warm()

    def submit(self, step: str, *args: Any) -> Ticket:
        ticket = Ticket(task_name(step, args), _Result())
        self._waiting.append((ticket, step, args))
        return ticket

    def wait(self, timeout_s: float) -> tuple[Ticket, Any] | None:
        if not self._waiting:
            return None
        ticket, step, args = self._waiting.popleft()
        function, wants = STEPS[step]
        plain = [arg.value if isinstance(arg, _Result) else arg for arg in args]
        ticket.queued_s = time.monotonic() - ticket.submitted
        self._guard = self._guard or WatchedProcess(self._notes, alone=True)
        with self._guard.watching({**task_note(step, ticket.step, args), "limited": False}):
            report, result = function(*(self._supplied[name] for name in wants), *plain)
        ticket.result.value = read_only(result)
        return ticket, report

    def close(self) -> None:
        self._waiting.clear()
        if self._guard is not None:
            self._guard.close()


# The graph in one process beside this one: what a plug-in does to its process, it does not do to the run.
#
# The other process is supervised as a worker of Ray's is: its task is tried again when it dies, ended over its
# limits, and its results come back as bytes that are not opened here. Those used last it keeps, and asks for others
# again.

KEPT_BYTES = 1 << 28  # of results that the process keeps opened: rows until their shard is written, and their clips
END_S = 5.0  # for it to end by itself


@dataclass(eq=False)
class KeptResult:
    """Stands for the result of a task; its bytes stay with the run, and go with the last who may ask for them."""

    number: int
    data: bytes = b""

    def __reduce__(self) -> tuple[type["KeptResult"], tuple[int]]:
        return KeptResult, (self.number,)


class IsolatedGraph(Graph):
    """Graph in a process of its own, one task after the other."""

    def __init__(self, work: Work, out: Location, stopped: StopCheck, limits: Limits) -> None:
        """Raises NotReady where the process cannot be given the work, or is not ready for it."""
        self._work, self._out, self._stopped = work, out, stopped
        self._context = multiprocessing.get_context("spawn")
        with terminal_signals_blocked():  # what keeps its semaphores is a process, too
            self._stop = self._context.Event()
        self._costs, self._notes = TaskDurations(limits), notes_folder(out)
        self._waiting: deque[tuple[Ticket, str, tuple[Any, ...]]] = deque()
        self._numbers, self._run = count(), start_run_notes(self._notes)
        self._in_hand: tuple[Ticket, str, tuple[Any, ...]] | None = None
        self._deaths = 0  # at what is in hand
        self._begin()

    def submit(self, step: str, *args: Any) -> Ticket:
        ticket = Ticket(task_name(step, args), None)
        ticket.result = KeptResult(next(self._numbers))
        self._waiting.append((ticket, step, args))
        return ticket

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
                    self._costs.add(ticket.step, worked_s)
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
        remove_if_empty(self._notes)

    def _send(self) -> None:
        assert self._in_hand is not None
        ticket, step, args = self._in_hand
        task = task_note(step, ticket.step, args) | self._costs.limits_for(ticket.step) | {"run": self._run}
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
        """Another process, with its work. One that dies before it is ready is begun anew, MAX_RETRIES times."""
        for deaths in count(1):
            self._pipe, theirs = self._context.Pipe()
            given = (theirs, self._out, self._stop, self._notes)
            self._process = self._context.Process(target=_serve_tasks, args=given, daemon=False)
            try:
                with terminal_signals_blocked():
                    self._process.start()
                theirs.close()
                self._pipe.send(self._work)  # no argument: Python would wait for ever until a dead process reads it
                said = self._pipe.recv()
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                self._process.kill()
                advice = f"no process of its own can be given this work ({error}): graph.isolated=never"
                raise NotReady(advice) from error
            except (EOFError, BrokenPipeError, ConnectionResetError):
                self._process.join()
                if deaths > MAX_RETRIES:
                    said = f"the process for plug-ins ended with exit code {self._process.exitcode}"
                    raise NotReady(said) from None
                continue
            except KeyboardInterrupt:  # which the process does not hear
                if self._process.pid is not None:
                    self._process.kill()
                raise
            if isinstance(said, Failure):
                raise not_ready_error(said)
            return


def _serve_tasks(pipe: Connection, out: Location, stop: Any, notes: Path) -> None:
    """The other process: a task at a time, until there is none or the run is gone."""
    ignore_terminal_signals()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the run decides
    supplied = {"out": out, "stopped": stop.is_set}
    kept: OrderedDict[int, tuple[Any, int]] = OrderedDict()  # with its size in bytes
    left = KEPT_BYTES

    def value_of(arg: Any) -> Any:
        if not isinstance(arg, KeptResult):
            return arg
        if arg.number not in kept:
            pipe.send(arg)
            data = pipe.recv()
            keep(arg.number, pickle.loads(data), len(data))  # noqa: S301 -- this process made it, or its like
        kept.move_to_end(arg.number)
        return kept[arg.number][0]

    def keep(number: int, value: Any, n_bytes: int) -> None:
        nonlocal left
        kept[number], left = (read_only(value), n_bytes), left - n_bytes
        while left < 0 and len(kept) > 1:
            left += kept.popitem(last=False)[1][1]

    try:
        supplied["work"] = work = pipe.recv()
        said, _ = warm(work, draws=True)
        pipe.send(said)
        if isinstance(said, Failure):
            return
        while (message := pipe.recv()) is not None:
            number, step, task, args = message
            given = [value_of(arg) for arg in args]
            began = time.perf_counter()
            function, wants = STEPS[step]
            report, result = call_watched(notes, task, function, *(supplied[name] for name in wants), *given)
            data = pickle.dumps(result, 5)
            if result is not None:
                keep(number, result, len(data))
            pipe.send((report, data, time.perf_counter() - began))
    except (EOFError, BrokenPipeError):  # the run was killed
        return

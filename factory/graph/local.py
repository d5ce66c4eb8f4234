"""The graph in this process: one task after the other, in the order of submission. For tests, breakpoints, explain."""

import os
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from factory.graph import steps
from factory.graph.frozen import frozen
from factory.graph.guard import Guard
from factory.graph.limits import described, notes_folder
from factory.graph.metrics import NoRecorder, Recorder
from factory.graph.steps import Failure
from factory.graph.work import NotReady, Stopped, Work, never
from factory.store.attempts import ErrorKind
from factory.store.disk import DiskFull
from factory.store.location import Location
from tasks.stages import ATTEMPT, TASKS

Fuse = Literal["auto", "all", "none"]
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


class MachineIll(RuntimeError):
    """The machine fails what it is given, or task after task."""


class ClusterDied(RuntimeError):
    """What Ray runs on this machine died in the middle of a run."""

    def __init__(self, said: str, is_ours: bool) -> None:
        """is_ours: the run began the cluster, for itself."""
        super().__init__(said)
        self.is_ours = is_ours


NO_CLAIMS = Claims()


@dataclass(eq=False)
class Ticket:
    """A submitted task. `result` stands for its large result and may be an argument of later tasks."""

    step: str
    result: Any
    submitted: float = field(default_factory=time.monotonic)
    queued_s: float = 0.0  # once it is finished: from submission to report, less the time at work


class Graph(Protocol):
    """What both executors offer: submit a function of factory.graph.steps, wait for reports."""

    parallelism: int  # tasks at once
    cores: int  # that one task can have
    attempt_tasks: Sequence[Sequence[str]]  # the stages of an attempt, by the tasks that they are fused into
    recorder: Recorder  # of metrics

    def submit(self, step: str, *args: Any) -> Ticket:
        """Run `step`; arguments may be results of earlier tickets. What STEPS says is supplied to it."""
        ...

    def ahead(self) -> int:
        """Attempts of a walk that one task is to make: 1, or more of a `stretch`, whose tasks have a list of rows."""
        ...

    def wait(self, timeout_s: float) -> tuple[Ticket, Any] | None:
        """A finished task and its report (a steps.Failure where it died); None when the time is up."""
        ...

    def close(self) -> None: ...


STEPS: Mapping[str, tuple[Any, tuple[str, ...]]] = {  # its function, and what it is supplied with
    "reconstruct": (steps.reconstruct, ("work", "stopped")),
    "perturb": (steps.prepare, ("work", "out")),
    "attempt": (steps.attempt, ("work",)),
    "stretch": (steps.attempt, ("work",)),  # one after the other
    "write": (steps.write, ("out",)),
    "episodes": (steps.episodes, ("work", "out")),
    "mcap_shard": (steps.mcap_shard, ("out",)),
    "warm": (steps.warm, ("work",)),
}


def attempt_tasks(fuse: Fuse, apart: bool) -> tuple[tuple[str, ...], ...]:
    """The stages of an attempt by task; apart: whether `auto` makes a task of each, as where `render` claims a GPU."""
    return tuple((stage,) for stage in ATTEMPT) if fuse == "none" or (fuse == "auto" and apart) else (ATTEMPT,)


def name_of(step: str, args: tuple[Any, ...]) -> str:
    """What metrics and Ray call a task: an attempt's by the stages in it."""
    return "+".join(args[0]) if step in ("attempt", "stretch") else step


def cores_of(step: str, args: tuple[Any, ...]) -> int:
    """That a task uses: a reconstruction is told how many threads it has."""
    return int(args[1]) if step == "reconstruct" else 1


@dataclass
class _Box:
    value: Any = None


def unready(failure: Failure) -> Exception:
    """What is to be raised where a machine could not get its kernels."""
    if failure.disk_full:
        return DiskFull(failure.disk_full)
    if failure.kind is ErrorKind.MACHINE:
        return MachineIll(failure.error.splitlines()[-1])
    return NotReady(failure.error) if failure.kind is ErrorKind.INPUT else RuntimeError(failure.error)


class LocalGraph:
    """Graph in this process. Nothing ends a task here; a guard sees signals through, and says what was in hand."""

    parallelism = 1

    def __init__(self, work: Work, out: Location, stopped: Stopped = never, fuse: Fuse = "auto") -> None:
        """stopped: asked now and then by tasks that take long, as nobody else can while they are at work."""
        self.attempt_tasks: Sequence[Sequence[str]] = attempt_tasks(fuse, apart=False)
        self.cores = os.cpu_count() or 1
        self.recorder: Recorder = NoRecorder()
        self._supplied = {"work": work, "out": out, "stopped": stopped}
        self._waiting: deque[tuple[Ticket, str, tuple[Any, ...]]] = deque()
        self._notes = notes_folder(out)
        self._guard: Guard | None = None
        work.warm()

    def submit(self, step: str, *args: Any) -> Ticket:
        ticket = Ticket(name_of(step, args), _Box())
        self._waiting.append((ticket, step, args))
        return ticket

    def ahead(self) -> int:
        return 1

    def wait(self, timeout_s: float) -> tuple[Ticket, Any] | None:
        if not self._waiting:
            return None
        ticket, step, args = self._waiting.popleft()
        function, wants = STEPS[step]
        plain = [arg.value if isinstance(arg, _Box) else arg for arg in args]
        ticket.queued_s = time.monotonic() - ticket.submitted
        self._guard = self._guard or Guard(self._notes, alone=True)
        with self._guard.watching({**described(step, ticket.step, args), "limited": False}):
            report, result = function(*(self._supplied[name] for name in wants), *plain)
        ticket.result.value = frozen(result)
        return ticket, report

    def close(self) -> None:
        self._waiting.clear()
        if self._guard is not None:
            self._guard.close()

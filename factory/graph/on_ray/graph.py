"""The graph's tasks in a cluster's workers.

Large results stay in the object store and travel by reference. A worker that dies is retried by Ray; what then still
fails becomes a steps.Failure.
"""

import logging
import os
import secrets
import shutil
import signal
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import ray
from ray import exceptions
from ray.autoscaler.sdk import request_resources
from ray.exceptions import RayError, RayTaskError
from ray.util.metrics import Counter, Gauge, Histogram
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from factory.exits import terminal_signals_blocked
from factory.files import DiskFull, machine_fault_of, nearest_existing
from factory.graph.local import (
    MAX_RETRIES,
    STEPS,
    Claims,
    ClusterDied,
    ClusterLacks,
    Graph,
    Limits,
    MachineFailure,
    TaskDurations,
    Ticket,
    call_watched,
    not_ready_error,
    notes_folder,
    remove_if_empty,
    start_run_notes,
    task_name,
    task_note,
)
from factory.graph.own_process import AGAIN, check_address_answers, no_cluster_text
from factory.graph.plan import AttemptBatch
from factory.graph.progress import METRICS, Metric, Type
from factory.graph.steps import (
    AttemptReport,
    AttemptUnfinished,
    BatchReport,
    Failure,
    NotReady,
    PartialAttempt,
    PartialBatch,
    PreparedClip,
    Work,
    attempt,
    draw_together,
    never_stop,
)
from factory.store.location import BadLocation, Location
from factory.store.samples import ErrorKind
from factory.store.schema import Stamp
from factory.wording import one_line, time_text
from tasks.stages import ATTEMPT, TASKS

# A Ray cluster joined, or begun on this machine: whether it answers and lives, its nodes, and what they all see.
#
# Nothing but loopback is opened for a cluster of our own, and `ray stop` is never called.

VITAL = ("raylet", "gcs_server")
PROBE_SECONDS = 120.0
OWN_BYTES = 2**20  # of files of a cluster of our own, before it does anything: less, and another will not begin either
GPU_WAIT_S = 900.0  # for the first node with one to come
log = logging.getLogger(__name__)
RAYLET_DIED = "Ray's raylet on this machine died; run the same command again once Ray is up"
WORKER_ENV = {
    **dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
    "RAY_EXPERIMENTAL_NOSET_CUDA_VISIBLE_DEVICES": "1",  # tasks.render.splatting.gsplat_backend.own_place
}
FORWARDED_ENV = ("NUMBA_CACHE_DIR",)


@ray.remote(num_cpus=0)
def _can_read(out: Location, name: str, token: bytes) -> bool:
    return out.read(name) == token


def join_or_start_cluster(workers: int | None) -> bool:
    """Join the cluster of RAY_ADDRESS, else start one in this machine (then True).

    Raises ConnectionError where nothing answers there; where nothing listens at once: Ray itself tries for minutes.
    Raises ClusterDied where one of our own does not come up, DiskFull where there is no space for its files: another
    would wait half a minute in vain, as this one did.
    """
    named = os.environ.get("RAY_ADDRESS", "")
    environment = WORKER_ENV | {name: os.environ[name] for name in FORWARDED_ENV if name in os.environ}
    where = "auto" if named else "local"
    own = {"num_cpus": workers, "include_dashboard": False}
    given: dict[str, Any] = {"runtime_env": {"env_vars": environment}} if named else own
    if where == "local":  # Ray warns that a cluster of our own asks for a token, as it should
        logging.getLogger("ray._private.authentication.authentication_token_setup").setLevel(logging.ERROR)
    check_address_answers(named)
    try:
        # Ray keeps SIGINT from its processes itself.
        with terminal_signals_blocked(signal.SIGHUP), _with_environment({} if named else environment):
            ray.init(address=where, log_to_driver=False, logging_level=logging.WARNING, **given)
    except Exception as error:  # Ray has none of its own for what keeps it from beginning
        if where == "local":
            ray.shutdown()
            folder = os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or tempfile.gettempdir()
            free = shutil.disk_usage(nearest_existing(Path(folder))).free
            said = f"Ray did not begin on this machine ({one_line(error)}); its files lie in {folder}"
            if free < OWN_BYTES:
                raise DiskFull(f"{said}: the disk is full, {free:,} bytes are free") from error
            raise ClusterDied(f"{said}, where {free:,} bytes are free", True) from error
        if not isinstance(error, ConnectionError | ray.exceptions.AuthenticationError):
            raise
        raise ConnectionError(no_cluster_text(named, error)) from error
    return where == "local"


@contextmanager
def _with_environment(values: Mapping[str, str]) -> Iterator[None]:
    """This process's, while a cluster begins that hands it on: of a runtime_env, the workers that Ray begins ahead of
    any task are of no use to tasks."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def joined_cluster() -> Iterator[None]:
    """The cluster of RAY_ADDRESS, left again by who was not in it. Raises ConnectionError where nothing answers."""
    joins = not ray.is_initialized()
    if joins:
        join_or_start_cluster(None)
    try:
        yield
    finally:
        if joins:
            ray.shutdown()


def tasks_at_once(workers: int | None, is_ours: bool) -> int:
    """Tasks: of a cluster of our own no more than it has cores, of another what was asked for, as it may grow."""
    available = int(ray.cluster_resources().get("CPU", 1))
    return max(1, min(workers or available, available) if is_ours else workers or available)


def dead_ray_process() -> str:
    """A process of a cluster that this one began, where it has died.

    Looked at before anything is asked of Ray, which ends this process when it finds the object store gone.
    """
    node = ray._private.worker._global_node
    return next((name for name, _ in node.dead_processes() if name in VITAL), "") if node is not None else ""


def nodes_of_cluster(having: str = "") -> list[str]:
    return [n["NodeID"] for n in ray.nodes() if n["Alive"] and (not having or n["Resources"].get(having))]


def per_node(resource: str) -> list[int]:
    """Of each node that works: a head without cores does not."""
    working = [node["Resources"] for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]
    return [int(resources[resource]) for resources in working if resources.get(resource)]


def has_gpu(wait: bool) -> bool:
    """Some node has a GPU; where none has, one is asked for and waited for."""
    if nodes_of_cluster("GPU") or not wait:
        return bool(nodes_of_cluster("GPU"))
    request_resources(bundles=[{"GPU": 1}])
    began = time.monotonic()
    while not nodes_of_cluster("GPU"):
        if time.monotonic() - began > GPU_WAIT_S:
            raise ClusterLacks(
                f"no node of the cluster has a GPU, and none came in {GPU_WAIT_S:.0f} s: start one, or draw with "
                "render.backend=cpu"
            )
        time.sleep(min(2.0, GPU_WAIT_S))
    request_resources(bundles=[])  # the attempts themselves hold it from now on
    return True


def on_node(node: str) -> NodeAffinitySchedulingStrategy:
    return NodeAffinitySchedulingStrategy(node, soft=False)


def check_shared(out: Location, setting: str, wanted: str) -> None:
    """Every node reads what the driver wrote under `out`; one that dies meanwhile need not.

    Raises BadLocation with what is `wanted` of the setting, ConnectionError where a node does not answer.
    """
    nodes = nodes_of_cluster()
    if len(nodes) < 2:
        return
    name, token = f"probe-{secrets.token_hex(8)}", secrets.token_bytes(16)
    out.write(name, token)
    try:
        asked = [_can_read.options(scheduling_strategy=on_node(node)).remote(out, name, token) for node in nodes]
        ray.wait(asked, num_returns=len(asked), timeout=PROBE_SECONDS)
        blind = [node for node, answer in zip(nodes, asked) if not _answer_of(node, answer)]
    finally:
        out.remove(name)
    if blind:
        raise BadLocation(f"{setting}={out.uri} is not the same folder on nodes {blind}: name {wanted}")


def _answer_of(node: str, answer: Any) -> bool:
    try:
        return bool(ray.get(answer, timeout=0.0))
    except RayTaskError:
        raise
    except RayError as error:
        if node in nodes_of_cluster():
            raise ConnectionError(f"node {node} does not answer ({one_line(error)}); {AGAIN}") from error
        return True


ILL = (  # what Ray says when it is the machine that failed
    *(exceptions.NodeDiedError, exceptions.LocalRayletDiedError, exceptions.RaySystemError),
    *(exceptions.RuntimeEnvSetupError, exceptions.OutOfMemoryError, exceptions.ObjectLostError),
    *(exceptions.ObjectStoreFullError, exceptions.OutOfDiskError),
)
FIT_SHARE = 0.01  # of a GPU: what brings a fit to a node with one, where fits take turns (gsplat_backend.fit_turn)
TASKS_A_SECOND = 300.0  # that one driver hands out and takes back
AHEAD_S, MOST_AHEAD_S = 1.0, 8.0  # of attempts that one task makes; as much as so many workers need, less than DRAIN_S
WARM_S = 90.0  # what kernels usually take on two cores
SAY_EVERY_S = 10.0  # between two lines about them
LOOK_S = 1.0  # between two looks at whether a cluster lives
WARMING = {"key": "warm", "what": "compiling kernels", "run": "", "limited": False}

_HELD: dict[str, Any] = {}  # per worker process: the run's Work, fetched once


def _recording(metric: Metric) -> Callable[[float, dict[str, str]], None]:
    labels = ("run", *metric.labels)
    match metric.type:
        case Type.COUNTER:
            return Counter(metric.name, metric.about, labels).inc
        case Type.GAUGE:
            return Gauge(metric.name, metric.about, labels).set
        case Type.HISTOGRAM:
            return Histogram(metric.name, metric.about, list(metric.buckets), labels).observe


def seconds_ahead(workers: int) -> float:
    """How long a task of several attempts is to take, so that the driver bears what so many workers hand in."""
    return max(AHEAD_S, min(workers / TASKS_A_SECOND, MOST_AHEAD_S))


class RayGraph(Graph):
    """Graph of Ray tasks. Connects to the cluster of RAY_ADDRESS, else starts one in this machine."""

    def __init__(self, work: Work, out: Location, workers: int | None, claims: Claims, limits: Limits) -> None:
        """workers: CPUs of a cluster started here, tasks at once on one that is there already; None: all its CPUs.

        More workers than a cluster has CPUs now are what makes one grow that can. A cluster without a GPU is asked for
        one where tasks claim it, and waited for; memory is claimed up to what the largest node has.
        Raises BadLocation when some node does not see `out`, ClusterLacks when no GPU comes, NotReady or MachineFailure
        when a node cannot do its part, ClusterDied when a cluster of our own does not come up or dies meanwhile, and
        DiskFull when there is no space for it.
        """
        self._connected = not ray.is_initialized()
        if self._connected and not os.environ.get("RAY_ADDRESS"):
            print("starting Ray on this machine: some 10 s", file=sys.stderr, flush=True)
        self._is_ours = self._connected and join_or_start_cluster(workers)
        self.parallelism = tasks_at_once(workers, self._is_ours)
        self.cores = min(self.parallelism, *(per_node("CPU") or [1]))  # none yet where a cluster grows from nothing
        recording = {metric.name: _recording(metric) for metric in METRICS}  # each node's agent serves Prometheus
        self.record_metric = lambda metric, value, labels: recording[metric.name](value, dict(labels))
        self._supplied: dict[str, Any] = {
            "work": [ray.put(work)],
            "out": out,
            "stopped": never_stop,
        }  # list: a reference
        self._costs, self._notes = TaskDurations(limits), notes_folder(out)
        self._run = start_run_notes(self._notes)
        self._tickets: dict[Any, Ticket] = {}
        self._ready: deque[Any] = deque()
        self._held_back: dict[bool, deque[tuple[Ticket, str, tuple[Any, ...]]]] = {False: deque(), True: deque()}
        self._flying = {False: 0, True: 0}  # both by whether a task claims a GPU
        try:
            self._gpu_share = claims.gpu_share if claims.gpu_share and has_gpu(wait=not self._is_ours) else 0.0
            self._claims, self._most_memory = claims, max(per_node("memory"), default=None)
            self.attempt_tasks = [(stage,) for stage in ATTEMPT] if self._gpu_share else (ATTEMPT,)
            self._after_drawing = _after_drawing(self.attempt_tasks) if self._gpu_share else frozenset()
            check_shared(out, "out", "shared storage or a URL")
            self._warm_every_node(with_gpu_only=self._gpu_share > 0.0)
        except BaseException as error:
            dead = dead_ray_process() if self._is_ours else ""
            self.close()
            if dead and isinstance(error, Exception):
                raise ClusterDied(f"Ray's {dead} died", is_ours=True) from error
            raise

    def _warm_every_node(self, with_gpu_only: bool) -> None:
        """Kernels on every node; what attempts draw with where they are made: on all nodes, or on those with a GPU."""
        nodes, work, watch = nodes_of_cluster(), self._supplied["work"], (self._notes, WARMING)
        draws = nodes_of_cluster("GPU") if with_gpu_only else nodes
        reports = [
            _run.options(name="warm", scheduling_strategy=on_node(n)).remote("warm", watch, 1, work, n in draws)[0]
            for n in nodes
        ]
        waiting, began, said_s = reports, time.monotonic(), 0.0
        while waiting:
            self._check_alive()
            _, waiting = ray.wait(waiting, num_returns=len(waiting), timeout=LOOK_S)
            spent_s = time.monotonic() - began
            if waiting and spent_s - said_s >= SAY_EVERY_S:
                said_s, left = spent_s, time_text(WARM_S - spent_s) if spent_s < WARM_S else "?"
                told = f"kernels, compiled once for this version: {len(waiting)} of {len(nodes)} nodes wait  ETA {left}"
                print(told, file=sys.stderr, flush=True)
        for node, report in zip(nodes, reports):
            try:
                answer, _ = ray.get(report)
            except RayError as error:
                if node not in nodes_of_cluster():
                    continue  # it has left the cluster: no task goes there
                said = f"node {node} could not get its kernels ready: {one_line(error)}"
                is_of_code = isinstance(error, RayTaskError) and _error_kind(error) is not ErrorKind.MACHINE
                raise (NotReady if is_of_code else MachineFailure)(said) from error
            if isinstance(answer, Failure):
                raise not_ready_error(answer)

    def _check_alive(self) -> None:
        """Raises ClusterDied where a cluster of our own has lost one of its processes."""
        if self._is_ours and (dead := dead_ray_process()):
            raise ClusterDied(f"Ray's {dead} died", is_ours=True)

    def submit(self, step: str, *args: Any) -> Ticket:
        ticket = Ticket(task_name(step, args), None)
        self._held_back[self._claims_gpu(ticket)].append((ticket, step, args))
        self._dispatch()
        return ticket

    def attempts_per_task(self) -> int:
        """As many as usually end in AHEAD_S, more on more workers; of drives, where drawing is another task."""
        return self._costs.tasks_in("+".join(self.attempt_tasks[0]), seconds_ahead(self.parallelism))

    def _claims_gpu(self, ticket: Ticket) -> bool:
        return self._gpu_share > 0.0 and any(task.may_draw for task in TASKS if task.name in ticket.step.split("+"))

    def _dispatch(self) -> None:
        """A cluster of our own queues what its CPUs do not take; on a shared one the rest is held back here.

        What draws has a queue of its own, so that neither the GPUs nor the CPUs wait for the other's tasks.
        """
        for draws, waiting in self._held_back.items():
            while waiting and (self._is_ours or self._flying[draws] < self.parallelism):
                ticket, step, args = waiting.popleft()
                supplied = [self._supplied[name] for name in STEPS[step][1]]
                if ticket.step in self._after_drawing:
                    args = tuple(ResultToFetch(arg) if isinstance(arg, ray.ObjectRef) else arg for arg in args)
                most = FIT_SHARE if step == "reconstruct" else 1.0
                gpu = min(self._gpu_share, most) if draws else None
                memory = self._claims.memory_bytes(ticket.step)
                memory = memory if self._most_memory is None else min(memory, self._most_memory)
                cores = int(args[1]) if step == "reconstruct" else 1  # it is told how many threads it has
                n_rows = args[-1].samples if step == "attempts" else 1
                task = _remote_task(ticket.step, cores, gpu, memory or None, 1 + n_rows)
                told = task_note(step, ticket.step, args) | self._costs.limits_for(ticket.step) | {"run": self._run}
                report, *results = task.remote(step, (self._notes, told), len(supplied), *supplied, *args)
                ticket.result = results if step == "attempts" else results[0]
                self._tickets[report] = ticket
                self._flying[draws] += 1

    def wait(self, timeout_s: float) -> tuple[Ticket, Any] | None:
        """Raises ClusterDied."""
        self._check_alive()
        if not self._ready and self._tickets:
            pending = list(self._tickets)
            some, _ = ray.wait(pending, num_returns=len(pending), timeout=0, fetch_local=True)
            if not some:
                some, _ = ray.wait(pending, num_returns=1, timeout=timeout_s, fetch_local=True)
            self._ready.extend(some)
        if not self._ready:
            return None
        reference = self._ready.popleft()
        ticket = self._tickets.pop(reference)
        self._flying[self._claims_gpu(ticket)] -= 1
        self._dispatch()
        try:
            report, worked_s = ray.get(reference)
        except exceptions.LocalRayletDiedError as error:
            raise ClusterDied(RAYLET_DIED, self._is_ours) from error
        except RayError as error:
            report, worked_s = Failure(_error_kind(error), f"{type(error).__name__}: {error}"[:2000]), 0.0
        if isinstance(report, AttemptUnfinished) and isinstance(ticket.result, list):
            ticket.result = ticket.result[0]
        if isinstance(report, BatchReport | AttemptUnfinished) and report.seconds:
            for seconds in report.seconds:
                self._costs.add(ticket.step, seconds)
        elif not isinstance(report, Failure):
            self._costs.add(ticket.step, worked_s)
        ticket.queued_s = max(0.0, time.monotonic() - ticket.submitted - worked_s)
        return ticket, report

    def close(self) -> None:
        self._tickets.clear()
        if self._connected:
            ray.shutdown()
        remove_if_empty(self._notes)


@cache
def _remote_task(name: str, cores: int, gpu: float | None, memory: int | None, returns: int) -> Any:
    """The remote function with what it claims; built once, as Ray takes its time over it."""
    return _run.options(name=name, num_cpus=cores, num_gpus=gpu, memory=memory, num_returns=returns)


def _error_kind(error: RayError) -> ErrorKind:
    """A worker that died may have died of its clip; a node, its memory or its object store are the machine's."""
    ill = isinstance(error, ILL) or machine_fault_of(error.cause if isinstance(error, RayTaskError) else error)
    return ErrorKind.MACHINE if ill else ErrorKind.SYSTEM


@dataclass(frozen=True)
class ResultToFetch:
    """A result that a task fetches itself: Ray sends a task to the node where most of what it is given lies.

    What follows a picture would go to the node that drew it, and take the cores that the next pictures wait for.
    """

    reference: Any


def _after_drawing(tasks: Sequence[Sequence[str]]) -> frozenset[str]:
    """Names of an attempt's tasks behind the one that may draw."""
    draws = [any(task.may_draw for task in TASKS if task.name in stages) for stages in tasks]
    return frozenset("+".join(stages) for stages in tasks[draws.index(True) + 1 :])


@ray.remote(num_cpus=1, num_returns=2, max_retries=MAX_RETRIES)
def _run(step: str, watch: tuple[Path, dict[str, Any]], n_supplied: int, *args: Any) -> tuple[Any, ...]:
    """A function of factory.graph.steps in a worker, under watch: its report with the seconds it took, its result; of
    a batch each sample's."""
    began = time.perf_counter()
    supplied = [_cached_work(arg) if isinstance(arg, list) else arg for arg in args[:n_supplied]]
    given = [ray.get(arg.reference) if isinstance(arg, ResultToFetch) else arg for arg in args[n_supplied:]]
    if step == "attempts":
        report, *results = _attempt_batch(watch, *supplied, *given)
    else:
        report, *results = call_watched(*watch, STEPS[step][0], *supplied, *given)
    return (report, time.perf_counter() - began), *results


def _attempt_batch(
    watch: tuple[Path, dict[str, Any]],
    work: Work,
    stages: Sequence[str],
    so_far: PreparedClip | PartialBatch,
    stamp: Stamp,
    batch: AttemptBatch,
) -> list[Any]:
    """Some stages of a batch of a walk from `stamp` on: a report, then a row or None for each sample, or before the
    last stages what these start from.

    Each attempt is under watch. As many drives are made as samples are wanted, and their pictures drawn together: a
    walk that went one by one would make all of them, too. What it makes does not depend on how long it takes, so that
    Ray can make lost rows again.
    """
    notes, told = watch
    name = "+".join(stages)
    reached: list[PartialAttempt | AttemptReport | Failure] = []
    seconds: list[float] = []
    rows: list[Any] = []
    parts = so_far.attempts if isinstance(so_far, PartialBatch) else (so_far,) * batch.n
    began = time.perf_counter()
    drawn = _drawn_together(watch, work, parts, stamp) if name == "render" else {}
    each_s = (time.perf_counter() - began) / len(drawn) if drawn else 0.0
    n_going = 0
    for i, part in enumerate(parts):
        if isinstance(part, AttemptReport | Failure):
            reached.append(part)
            continue
        began = time.perf_counter()
        given = stages, part, stamp.of_attempt(so_far.clip_id, stamp.candidate_index + i, stamp.round + len(rows))
        if i in drawn:
            report, result = drawn[i]
        else:
            report, result = call_watched(notes, told | task_note("attempt", name, given), attempt, work, *given)
        seconds.append(each_s if i in drawn else time.perf_counter() - began)
        reached.append(result if isinstance(report, AttemptUnfinished) else report)
        rows += [result] if isinstance(report, AttemptReport) and result is not None else []
        n_going += result is not None
        if isinstance(report, Failure) or n_going == batch.samples:
            break
    nothing = [None] * batch.samples
    reports = [one for one in reached if not isinstance(one, PartialAttempt)]
    if len(reports) < len(reached):
        unfinished = PartialBatch(so_far.clip_id, tuple(reached))
        return [AttemptUnfinished(tuple(seconds)), unfinished, *nothing[1:]]
    return [BatchReport(tuple(reports), tuple(seconds)), *rows, *nothing[len(rows) :]]


def _drawn_together(
    watch: tuple[Path, dict[str, Any]], work: Work, parts: Sequence[object], stamp: Stamp
) -> dict[int, tuple[Any, Any]]:
    """By place, report and result of the parts that are driven; none where they failed together, so that each is drawn
    alone and a failure is its own."""
    driven = {i: part for i, part in enumerate(parts) if isinstance(part, PartialAttempt)}
    if len(driven) < 2:
        return {}
    notes, told = watch
    limit = {"seconds": told["seconds"] and told["seconds"] * len(driven)}
    note = told | task_note("attempts", "render", (stamp,)) | limit
    failure, found = call_watched(notes, note, draw_together, work, [*driven.values()])
    if found is None:
        why = failure.error.splitlines()[-1]
        log.warning("%d samples could not be drawn together, each is drawn alone: %s", len(driven), why)
        return {}
    return dict(zip(driven, found, strict=True))


def _cached_work(reference: list[Any]) -> Any:
    key = reference[0].hex()
    if key not in _HELD:
        _HELD.clear()
        _HELD[key] = ray.get(reference[0])
    return _HELD[key]


# Any function's tasks in a cluster's workers, as futures.

R = TypeVar("R")
P = ParamSpec("P")


class RayPool(Executor):
    """Tasks of a core each as futures, of any function. What a task raises is its future's own exception."""

    def __init__(self, workers: int | None, to: Location | None) -> None:
        """Workers as of RayGraph; to: the folder that tasks write to.

        Raises BadLocation where some node does not see it, ConnectionError where no cluster answers,
        ClusterDied where none begins here.
        """
        self._connected = not ray.is_initialized()
        self._is_ours = self._connected and join_or_start_cluster(workers)
        self.parallelism = tasks_at_once(workers, self._is_ours)
        self._references: dict[Future[Any], Any] = {}
        try:
            if to is not None:
                check_shared(to, "to", "storage that all of them share")
        except BaseException:
            self.shutdown()
            raise

    def submit(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """A future raises BrokenExecutor where its worker died, with all retries, and ClusterDied with the raylet."""
        reference = _call_function.remote(function, args, kwargs)
        future: Future[R] = Future()
        future.set_running_or_notify_cancel()
        self._references[future] = reference  # by which it could be ended
        reference.future().add_done_callback(lambda done: self._copy_result(done, future))
        return future

    def _copy_result(self, done: Future[R], future: Future[R]) -> None:
        self._references.pop(future, None)
        error = done.exception()
        if error is None:
            future.set_result(done.result())
        elif isinstance(error, RayTaskError):  # Ray wraps what a task raised with its traceback
            future.set_exception(error.cause)
        elif isinstance(error, exceptions.LocalRayletDiedError):
            future.set_exception(ClusterDied(RAYLET_DIED, self._is_ours))
        else:
            future.set_exception(BrokenExecutor(f"{type(error).__name__}: {one_line(error)}"))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster; cancel_futures: end what is not done. What is done is in its future already."""
        if cancel_futures:
            for reference in list(self._references.values()):
                ray.cancel(reference)
        self._references.clear()
        if self._connected:
            ray.shutdown()


@ray.remote(num_cpus=1, max_retries=MAX_RETRIES)
def _call_function(function: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    return function(*args, **kwargs)

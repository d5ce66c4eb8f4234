"""The task graph itself, with stages that only wait: what a cluster of several nodes gains, and what the driver bears.

    python -m tests.bench.bench_scale                                the same run on 1, 2 and 4 nodes of this machine
    python -m tests.bench.bench_scale nodes=1 attempts=100000 wait_ms=0      a long run, as fast as it goes
    ... nodes=1 attempts=3000000 accepted=0.03 wait_ms=0 row_kb=0 out=<folder>     its tables stay; killed, it goes on
    ... simulated=true nodes=1,2,8,64 cpus=16 wait_ms=570 row_kb=0      nodes that this machine does not have

Nodes are Ray's own (`ray start` on loopback), with `cpus` each in name; stages sleep, so that the cores of this machine
are no limit before the graph is. A row carries `row_kb` of incompressible bytes for its pictures. `ideal` is the time
that all the sleeping takes on so many CPUs. Memory and CPU time are the driver's; `again` is how long the same command
takes to find that all is done, `found` the attempts of a run before it in the same folder.

Simulated are the workers and the clock: the run's own driver hands out tasks and commits tables; each is answered after
its seconds of virtual time, on which the driver's CPU time counts too, with `task_ms` for what Ray asks of it a task.
Rate and the driver's share are of the middle half of the attempts. Commits come by the real clock.
"""

import heapq
import json
import math
import re
import resource
import sys
import tempfile
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from factory.config.arguments import run_request_command
from factory.exits import COMPLETE
from factory.graph.execute import Execution, execute
from factory.graph.local import STEPS, Limits, LocalGraph, TaskDurations, Ticket, _Result, task_name
from factory.graph.on_ray.graph import ray, seconds_ahead  # with the environment that keeps it on loopback
from factory.graph.steps import AcceptedDrive, BatchReport, PreparedClip, RejectedAttempt, SampleColumns, Spent, attempt
from factory.readers.base import ClipRef
from factory.store.samples import Store
from tasks.stages import Rejected
from tests.factory.toy import ToyWork, any_row

EXPERTS = ("pdm_closed", "recovery")
CANDIDATES = 16  # of a clip; where half of them are accepted, five rounds take ten


@dataclass(frozen=True)
class Request:
    """The command line."""

    nodes: str = "1,2,4"
    cpus: int = 2  # of each node
    attempts: int = 2000  # about
    wait_ms: int = 200  # of a stage
    rounds: int = 5
    row_kb: int = 20
    accepted: float = 0.5  # share of the attempts; the others cost a worker hardly anything
    simulated: bool = False
    task_ms: float = 2.8  # of the driver's CPU, in a simulation: docs/capacity.md
    out: str = ""  # kept, for the same command to go on in; else a temporary folder

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[1-9]\d*(,[1-9]\d*)*", self.nodes):
            raise ValueError(f"nodes={self.nodes}: give numbers with commas between them, as 1,2,4")
        if not 0.0 < self.accepted <= 1.0:
            raise ValueError(f"accepted={self.accepted}: give a share above 0, at most 1")

    @property
    def each(self) -> list[int]:
        """Numbers of nodes."""
        return [int(number) for number in self.nodes.split(",")]


@dataclass(frozen=True)
class WaitingWork(ToyWork):
    """Stages that wait, and rows with some weight."""

    row_kb: int = 20

    def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
        name = f"{prepared.clip_id}:{expert}:{candidate}"
        time.sleep(self.seconds)
        chance = zlib.crc32(name.encode()) / 2**32
        if chance < self.threshold:
            return RejectedAttempt(Rejected("reward", "nc"), {"nc": chance}, {"reward": Spent(0.01)})
        digest = prepared.content_digest
        return AcceptedDrive(
            (name, any_row() | {"clip_id": prepared.clip_id, "content_digest": digest}), {"reward": Spent(0.01)}
        )

    def drawn(self, driven: AcceptedDrive) -> SampleColumns:
        drawn = super().drawn(driven)
        assert isinstance(drawn, SampleColumns)
        name, _ = driven.payload  # type: ignore[misc]
        image: Any = drawn.row["images"]
        noise = np.random.default_rng(zlib.crc32(name.encode())).bytes(self.row_kb * 1024)
        return replace(drawn, row={**drawn.row, "images": [{**image[0], "jpeg": noise}]})


class SimulatedGraph(LocalGraph):
    """So many cores that are not there, on a virtual clock [s] that this process's own CPU time moves on too."""

    def __init__(self, work: Any, out: Any, stopped: Any, cores: int, wait_s: float, task_s: float) -> None:
        super().__init__(work, out, stopped)
        self.parallelism = self.cores = cores
        self._wait_s, self._task_s = wait_s, task_s
        self._free = [0.0] * cores  # when each core is
        self._flying: list[tuple[float, int, Ticket, Any]] = []  # by the time of the report
        self._costs, self._submitted = TaskDurations(Limits()), 0
        self._now = self._busy = 0.0
        self._since = time.process_time()
        self.marks: list[tuple[float, float]] = []  # clock and driver's seconds as each attempt was handed in

    def attempts_per_task(self) -> int:
        return self._costs.tasks_in("+".join(self.attempt_tasks[0]), seconds_ahead(self.parallelism))

    def submit(self, step: str, *args: Any) -> Ticket:
        self._charge(self._task_s)
        ticket = Ticket(task_name(step, args), _Result())
        given = [arg.value if isinstance(arg, _Result) else arg for arg in args]
        began = time.process_time()
        report, took_s = self._worked(step, ticket, given)
        took_s = time.process_time() - began if step == "write" else took_s
        ends = max(self._now, heapq.heappop(self._free)) + took_s
        heapq.heappush(self._free, ends)
        heapq.heappush(self._flying, (ends, self._submitted, ticket, report))
        self._submitted += 1
        self._since = time.process_time()
        return ticket

    def wait(self, timeout_s: float) -> tuple[Ticket, Any] | None:
        self._charge()
        if not self._flying:
            return None
        ends, _, ticket, report = heapq.heappop(self._flying)
        self._now = max(self._now, ends)
        if "+" in ticket.step:
            n = len(report.reports) if isinstance(report, BatchReport) else 1
            self.marks += [(self._now, self._busy)] * n
            for _ in range(n):
                self._costs.add(ticket.step, self._wait_s)
        return ticket, report

    def _charge(self, more_s: float = 0.0) -> None:
        """What the driver has worked since it was last here."""
        used = time.process_time() - self._since + more_s
        self._now, self._busy, self._since = self._now + used, self._busy + used, time.process_time()

    def _worked(self, step: str, ticket: Ticket, given: list[Any]) -> tuple[Any, float]:
        """A task's report and how long it takes; its result is in the ticket."""
        function, wants = STEPS[step]
        if step != "attempts":
            report, ticket.result.value = function(*(self._supplied[name] for name in wants), *given)
            return report, self._wait_s
        stages, prepared, first, batch = given
        reports, rows = [], list[_Result]()
        while len(reports) < batch.n and len(rows) < batch.samples:
            at = first.candidate_index + len(reports), first.round + len(rows)
            stamp = first.of_attempt(prepared.clip_id, *at)
            report, row = attempt(self._supplied["work"], stages, prepared, stamp)  # type: ignore[arg-type]
            reports.append(report)
            rows += [_Result(row)] if row is not None else []
        ticket.result = rows
        return BatchReport(tuple(reports), (self._wait_s,) * len(reports)), self._wait_s * len(reports)


def simulated(request: Request, nodes: int) -> str:
    """A row of a simulation's table."""
    cores, wait_s = nodes * request.cpus, request.wait_ms / 1000
    enough = replace(request, attempts=max(request.attempts, 40 * cores))  # so that its middle half has all at work
    refs, work = _run_of(enough)
    with tempfile.TemporaryDirectory() as folder, patch("factory.graph.execute.LocalGraph") as graph:
        made: list[SimulatedGraph] = []

        def begin(*to: Any) -> SimulatedGraph:
            made.append(SimulatedGraph(*to, cores, wait_s, request.task_ms / 1000))
            return made[-1]

        graph.side_effect = begin
        out = Store(Path(request.out or folder) / f"simulated-{nodes}")
        summary = execute(replace(work, seconds=0.0), refs, EXPERTS, request.rounds, out, Execution("local"),
                          say=lambda line: None)  # fmt: skip
    if summary.exit_code != COMPLETE:
        raise RuntimeError(f"the run ended with {summary.exit_code}: {summary.message} {summary.counts}")
    marks = made[0].marks
    (began, busy), (ended, busier) = marks[len(marks) // 4], marks[3 * len(marks) // 4]
    rate = len(marks) / 2 / (ended - began)
    busy_s = busier - busy
    return (f"{nodes:5d}{cores:8d}{len(marks):10d}{rate:8.1f}{100 * rate * wait_s / cores:11.1f}%"
            f"{100 * busy_s / (ended - began):14.1f}%{2000 * busy_s / len(marks):15.2f}")  # fmt: skip


def main(request: Request) -> None:
    """Print the table, a row for each number of nodes."""
    print(f"{request.cpus} CPUs a node, stages of {request.wait_ms} ms, rows of {request.row_kb} kB")
    if request.simulated:
        print(f"{'nodes':>5}{'cores':>8}{'attempts':>10}{'per s':>8}{'cores busy':>12}{'driver share':>15}"
              f"{'driver CPU ms':>15}")  # fmt: skip
        for nodes in request.each:
            print(simulated(request, nodes), flush=True)
        return
    print(f"{'nodes':>5}{'found':>9}{'attempts':>10}{'samples':>9}{'seconds':>9}{'ideal':>8}{'efficiency':>12}"
           f"{'per s':>8}{'driver CPU ms':>15}{'driver MB':>11}"
           f"{'commits':>9}{'files':>7}{'MB':>8}{'again s':>9}")  # fmt: skip
    for nodes in request.each:
        print(measured(request, nodes), flush=True)


def measured(request: Request, nodes: int) -> str:
    """A row of the table: a run on so many nodes."""
    from ray.cluster_utils import Cluster

    refs, work = _run_of(request)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": request.cpus, "include_dashboard": False})
    try:
        for _ in range(nodes - 1):
            cluster.add_node(num_cpus=request.cpus)
        ray.init(address=cluster.address, log_to_driver=False)
        with tempfile.TemporaryDirectory() as folder:
            return _row(request, nodes, refs, work, Path(request.out or folder) / f"nodes-{nodes}")
    finally:
        ray.shutdown()
        cluster.shutdown()


def _run_of(request: Request) -> tuple[list[ClipRef], WaitingWork]:
    """Clips of about as many attempts as are asked for, and what is to be done with them."""
    per_clip = len(EXPERTS) * min(round(request.rounds / request.accepted), CANDIDATES)
    refs = [ClipRef("waiting", f"log{i // 50}", 1000 * i) for i in range(math.ceil(request.attempts / per_clip))]
    threshold, seconds = 1.0 - request.accepted, request.wait_ms / 1000
    return refs, WaitingWork(n_candidates=CANDIDATES, threshold=threshold, seconds=seconds, row_kb=request.row_kb)


def _row(request: Request, nodes: int, refs: Sequence[ClipRef], work: WaitingWork, out: Path) -> str:
    ray.get([_warm.remote() for _ in range(4 * nodes * request.cpus)])  # worker processes, that take seconds to start
    before, began = _cpu_s(), time.perf_counter()
    summary = execute(work, refs, EXPERTS, request.rounds, Store(out), Execution("ray"), say=lambda line: None)
    took, cpu_s = time.perf_counter() - began, _cpu_s() - before
    if summary.exit_code != COMPLETE:
        raise RuntimeError(f"the run ended with {summary.exit_code}: {summary.message} {summary.counts}")
    began = time.perf_counter()
    again = execute(work, refs, EXPERTS, request.rounds, Store(out), Execution("ray"), say=lambda line: None)
    again_s = time.perf_counter() - began
    attempts, found = summary.executed.attempts, summary.executed.found_done
    if (again.executed.attempts, again.executed.found_done) != (0, attempts + found):
        raise RuntimeError(f"the second run found {again.executed.found_done} of {attempts} + {found} attempts done")
    ideal = work.seconds * (attempts + summary.executed.prepared) / (nodes * request.cpus)
    store = Store(out)
    files = list(out.rglob("*.parquet"))
    size = sum(path.stat().st_size for path in files) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return (f"{nodes:5d}{found:9d}{attempts:10d}{len(store.samples):9d}{took:9.1f}{ideal:8.1f}"
            f"{100 * ideal / took:11.1f}%{attempts / took:8.1f}{1000 * cpu_s / attempts:15.2f}{peak:11.0f}"
            f"{_commits(out):9d}{len(files):7d}{size:8.0f}{again_s:9.1f}")  # fmt: skip


@ray.remote(num_cpus=1)
def _warm() -> None:
    import factory.graph.steps  # noqa: F401

    time.sleep(0.2)


def _cpu_s() -> float:
    used: Any = resource.getrusage(resource.RUSAGE_SELF)
    return float(used.ru_utime + used.ru_stime)


def _commits(out: Path) -> int:
    """Of all tables."""
    logs = list(out.rglob("_delta_log/*.json"))
    return sum(any("commitInfo" in json.loads(line) for line in path.read_text().splitlines()) for path in logs)


if __name__ == "__main__":
    sys.exit(run_request_command(main, sys.argv[1:]))

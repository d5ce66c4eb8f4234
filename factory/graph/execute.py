"""Executes a run: plan against the tables, drive the tasks in one executor or the other, tell how it ended.

The driver can die at any moment: what is committed is done, the rest is tried again by the next run, with the
same result.
"""

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from deltalake.exceptions import DeltaError

from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED, calling_on_stop_signal
from factory.files import DiskFull, machine_fault_of
from factory.graph.driver import (
    SHARD_BYTES,
    SHARD_SECONDS,
    CommitQueue,
    EpisodeScheduler,
    EpisodeSettings,
    RunDriver,
    WriteFailed,
)
from factory.graph.guard import CRASHED, read_note
from factory.graph.local import (
    Claims,
    ClusterDied,
    ClusterLacks,
    Graph,
    Limits,
    LocalGraph,
    MachineFailure,
    notes_folder,
)
from factory.graph.own_process import AGAIN, NEW_CLUSTERS, new_cluster_text
from factory.graph.plan import RunPlan, RunRecords, make_plan, plan_after_crash, retry_policy
from factory.graph.progress import Outlook, RunMetrics, RunTotals
from factory.graph.steps import NotReady, Spent, Work
from factory.readers.base import ClipRef
from factory.store.funnel import Funnel, funnel_of
from factory.store.location import BadLocation
from factory.store.samples import CURRENT_RUN, LAST_RUN, REMADE, ChangedRun, History, Kind, OnChange, Store
from factory.store.table import AnotherWriter
from factory.wording import one_line
from tasks.caches import json_with_checksum

Executor = Literal["local", "ray"]


@dataclass
class RunSummary:
    """How a run ended."""

    exit_code: int
    message: str = ""
    counts: dict[str, int] = field(default_factory=dict)  # accepted, rejected, failed, exhausted, of the planned clips
    executed: RunTotals = field(default_factory=RunTotals)
    seconds: dict[str, tuple[int, Spent]] = field(default_factory=dict)  # stage -> tasks of this run, what they spent
    notes: list[str] = field(default_factory=list)
    funnel: Funnel | None = None
    began_ms: int = 0  # since 1970; 0: nothing was left to do
    lost_cluster: bool = False  # the run's own, which another may replace
    is_broken: bool = False  # by what it writes to or works on, as the message says: then no page is written


@dataclass(frozen=True)
class Execution:
    """How a run is executed, and what it writes beside its rows."""

    executor: Executor = "ray"
    workers: int | None = None  # processes of a Ray cluster of its own; None: one per CPU
    on_change: OnChange = "stop"
    retry: bool = False  # attempts that failed by input or a bug are tried again, too
    claims: Claims = field(default_factory=Claims)  # on Ray
    limits: Limits = field(default_factory=Limits)  # of a task, beyond which it is ended
    isolated: bool = False  # executor=local works in a process of its own, which may die
    shard_bytes: int = SHARD_BYTES
    shard_seconds: float = SHARD_SECONDS
    minutes: float | None = None  # after which nothing new is begun, as after an interruption
    episodes: EpisodeSettings | None = None  # MCAP files to be written beside the samples
    command: Sequence[str] | None = None  # the settings as they were given, kept for `retry`
    remade: Mapping[str, Any] | None = None  # of a remake, which is a redo: what run.json says of it


def execute(
    work: Work,
    refs: Sequence[ClipRef],
    experts: Sequence[str],
    rounds: int,
    store: Store,
    how: Execution = Execution(),
    say: Callable[[str], None] = print,
) -> RunSummary:
    """Make the samples of `rounds` rounds for every clip and expert, as far as the store does not hold them already.

    Invalid arguments come back as exit code 2 with a message and nothing written.
    """
    if not refs or not experts or rounds < 1:
        return RunSummary(BAD_CONFIG, f"nothing to do: {len(refs)} clips, experts {list(experts)}, rounds={rounds}")
    twice = [clip_id for clip_id, n in Counter(ref.clip_id for ref in refs).items() if n > 1]
    if twice or len(set(experts)) < len(experts):
        return RunSummary(BAD_CONFIG, f"named twice: clips {twice[:3]}, experts {list(experts)}")
    run = _Run(work, refs, experts, rounds, store, how)
    refused = run.plan() or run.open()
    if refused is not None:
        return refused
    run.drive()
    summary = run.close()
    for line in (*summary.notes, str(summary.executed)):
        say(line)
    return summary


class _Run:
    """One run in its four parts: planned against the tables, opened, driven, closed."""

    def __init__(
        self, work: Work, refs: Sequence[ClipRef], experts: Sequence[str], rounds: int, store: Store, how: Execution
    ) -> None:
        self._work, self._refs, self._experts, self._rounds = work, refs, experts, rounds
        self._store, self._how = store, how
        self._identity, self._digests = work.identity, {expert: work.expert_digest(expert) for expert in experts}
        self._policy = retry_policy(how.retry, self._identity.versions_json)
        self._graph: Graph | None = None
        self._ended = RunSummary(COMPLETE)

    def plan(self) -> RunSummary | None:
        """What is left to do; how the run ends where the tables are another's, or cannot be read."""
        try:
            names = {ref.dataset for ref in self._refs}
            self._records = self._store.checked_records(self._identity, self._digests, self._how.on_change, names)
            if self._how.remade is not None:
                self._records[-1][REMADE] = dict(self._how.remade)
            kept = self._how.on_change == "stop" and self._records[-1]["on_change"] == "keep"
            self._on_change: OnChange = "keep" if kept else self._how.on_change
            plan = self._planned(not self._store.starts_over(self._records))
            wanted = self._how.episodes
            self._episodes = EpisodeScheduler(self._store, wanted, self._refs) if wanted else None
        except ChangedRun as error:
            return RunSummary(BAD_CONFIG, str(error))
        except (OSError, DeltaError) as error:
            if machine_fault_of(error):
                return RunSummary(INTERRUPTED, f"{one_line(error)}; {AGAIN}")
            damaged = f"python -m factory verify {self._store.location.uri} says what is damaged"
            return RunSummary(BAD_CONFIG, f"{error}; {damaged}")
        self._notes = notes_folder(self._store.location)
        records = RunRecords(self._identity, self._digests)
        crash = read_note(self._notes / CRASHED) or {}  # what was in hand when the last run died, by its guard
        plan, self._died = plan_after_crash(crash, plan, records, self._policy)
        self._use_plan(plan)
        if plan.frozen:
            kept_clips = f"{len(plan.frozen)} clips kept as they are"
            self._driver.notes.append(f"{kept_clips}: their candidates come from other settings")
        return None

    def _planned(self, has_history: bool) -> RunPlan:
        history = self._store.history(self._identity, self._digests) if has_history else History()
        wanted = (self._refs, self._experts, self._rounds)
        return make_plan(*wanted, history, self._identity, self._on_change, self._policy, self._work.once)

    def _use_plan(self, plan: RunPlan) -> None:
        self._plan, work = plan, self._work
        self._driver = RunDriver(
            self._identity, plan, self._digests, self._rounds, self._policy, work.block, work.doing
        )

    def open(self) -> RunSummary | None:
        """The executor, where anything is due; how the run ends where this machine or cluster is not ready for it."""
        if not self._plan.todo and (self._episodes is None or not self._episodes.is_due):
            return None
        how, to = self._how, (self._work, self._store.location)
        try:
            if how.executor == "local" and how.isolated:
                from factory.graph.local import IsolatedGraph

                self._graph = IsolatedGraph(*to, lambda: self._driver.interrupted, how.limits)
            elif how.executor == "local":
                self._graph = LocalGraph(*to, lambda: self._driver.interrupted)
            else:
                from factory.graph.on_ray.graph import RayGraph

                self._graph = RayGraph(*to, how.workers, how.claims, how.limits)
        except (BadLocation, ClusterLacks, NotReady, ConnectionError) as error:
            return RunSummary(BAD_CONFIG, str(error))
        except ClusterDied as error:
            return RunSummary(INTERRUPTED, str(error), lost_cluster=error.is_ours)
        except (MachineFailure, OSError) as error:  # while kernels are compiled
            if isinstance(error, OSError) and not machine_fault_of(error):
                raise
            return RunSummary(INTERRUPTED, _advice_after(error))
        except KeyboardInterrupt:
            return RunSummary(INTERRUPTED, "stopped before anything was begun")
        return None

    def drive(self) -> None:
        """The tasks, until nothing is left or the run is to end; how it ended, and the executor is closed."""
        ended = self._ended
        try:
            self._begin()
            if self._graph is not None:
                self._loop(self._graph)
            ended.exit_code = COMPLETE_WITH_FAILURES if self._driver.has_failures else COMPLETE
            if self._episodes is not None and (errors := self._episodes.errors):
                text = f"{len(errors)} MCAP files were not written ({errors[0]})"
                ended.exit_code = INTERRUPTED
                ended.message = f"{text}; run the same command again to write them"
            if self._driver.interrupted:
                ended.exit_code, ended.message = INTERRUPTED, "interrupted; run the same command again to go on"
        except KeyboardInterrupt:
            ended.exit_code, ended.message = INTERRUPTED, "stopped at once; run the same command again"
        except MachineFailure as error:
            self._end_broken(f"{error}; put it right and run the same command again: no clip is blamed")
        except (AnotherWriter, WriteFailed, ClusterDied) as error:
            self._end_broken(str(error))
            ended.lost_cluster = isinstance(error, ClusterDied) and error.is_ours
        except (OSError, DeltaError) as error:  # what holds the tables fails: a full disk, a share that went away
            self._end_broken(_advice_after(error))
        finally:
            if self._graph is not None:
                self._graph.close()

    def _begin(self) -> None:
        """The run's first words in the tables; planned again where another run committed while this one got ready."""
        store, once = self._store, self._work.once
        if store.begin_run(self._records):
            self._use_plan(self._planned(True))
            self._died = []
        wanted = {expert: 1 if once(expert) else self._rounds for expert in self._experts}
        store.record_plan(wanted, [ref.clip_id for ref in self._refs])
        if self._died:
            store.commit([], [], self._died)
            died_at = self._died[0].error.partition(": ")[2]
            self._driver.notes.append(f"the run before this one died at {died_at}; it comes last")
        (self._notes / CRASHED).unlink(missing_ok=True)

    def _loop(self, graph: Graph) -> None:
        store, how, episodes = self._store, self._how, self._episodes
        self._ended.began_ms = began_ms = int(time.time() * 1000)
        document = {"began_ms": began_ms, "folder": os.getcwd(), "command": how.command and list(how.command)}

        def note(outlook: Outlook) -> None:
            with suppress(OSError):  # for people, and again in some seconds; a commit to the same place says it
                store.location.write(CURRENT_RUN, json_with_checksum(document | asdict(outlook)).encode())

        note(Outlook(began_ms))
        metrics = RunMetrics(graph.record_metric, store.location)
        with calling_on_stop_signal(self._driver.stop_soon), _stop_after(self._driver.stop, how.minutes):
            if episodes is not None:
                episodes.start(graph)
            commits = CommitQueue(graph, store, how.shard_bytes, how.shard_seconds)
            self._driver.loop(graph, commits, metrics, episodes, note)
            if episodes is not None:
                episodes.remove_outdated()

    def _end_broken(self, message: str) -> None:
        self._ended.exit_code, self._ended.message, self._ended.is_broken = INTERRUPTED, message, True

    def close(self) -> RunSummary:
        """How the run ended, as last_run.json keeps it too."""
        ended, driver = self._ended, self._driver
        ended.executed, ended.seconds, ended.notes = driver.executed, driver.seconds, driver.notes
        del driver, self._driver, self._plan  # perhaps millions of walks, before the tables are counted
        try:
            ended.funnel = funnel_of(self._store, [ref.clip_id for ref in self._refs])
            ended.counts = _attempt_counts(ended.funnel, self._experts)
        except (OSError, DeltaError) as error:
            self._end_broken(ended.message or f"{one_line(error)}; {AGAIN}")
        try:
            killed = self._store.newest_run().goes_on  # behind its last commit
            if ended.began_ms or ended.exit_code or killed:
                write_last_run(self._store, ended)
        except OSError as error:  # the same disk or share
            self._end_broken(ended.message or _advice_after(error))
        return ended


def _advice_after(error: Exception) -> str:
    """What to do where this machine, or what holds the tables, fails."""
    if isinstance(error, DiskFull):
        return f"{error}; free disk space and run the same command again: it goes on from what is committed"
    return f"{one_line(error)}; {AGAIN}"


def rerun_on_new_clusters(
    once: Callable[[], RunSummary], say: Callable[[str], None] = print, begun: int = 0
) -> RunSummary:
    """A run, and again on a new cluster where its own died: it goes on from what is committed.

    begun: new clusters that it had before.
    """
    for number in range(begun + 1, NEW_CLUSTERS + 1):
        summary = once()
        if not summary.lost_cluster:
            return summary
        say(new_cluster_text(summary.message, number))
    summary = once()
    if summary.lost_cluster:
        summary.message += f"; {AGAIN}"
    return summary


@contextmanager
def _stop_after(stop: Callable[[], None], minutes: float | None) -> Iterator[None]:
    """Drains the run after so many minutes."""
    timer = threading.Timer(60.0 * (minutes or 0.0), stop)
    timer.daemon = True
    if minutes == 0.0:
        stop()
    elif minutes is not None:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _attempt_counts(funnel: Funnel, experts: Sequence[str]) -> dict[str, int]:
    """Attempts of the planned clips by what became of them; clip-level rows among them."""
    rows = [row for row in funnel.rows if row.expert in experts]
    broken = sum(n for why, n in funnel.clip_outcomes.items() if why.startswith("failed."))
    return {
        Kind.ACCEPTED.value: sum(row.accepted for row in rows),
        Kind.REJECTED.value: sum(row.rejected for row in rows) + sum(funnel.clip_outcomes.values()) - broken,
        Kind.FAILED.value: sum(row.failed for row in rows) + broken,
        Kind.EXHAUSTED.value: sum(funnel.exhausted.get(expert, 0) for expert in experts),
    }


def write_last_run(store: Store, summary: RunSummary) -> None:
    """last_run.json: what the newest run that did anything did, for people and reports."""
    document = {
        "began_ms": summary.began_ms,
        "ended_ms": int(time.time() * 1000),
        "exit_code": summary.exit_code,
        "message": summary.message,
        "counts": summary.counts,
        "executed": asdict(summary.executed),
        "seconds": {
            stage: {"tasks": n, "seconds": spent.wall_s, "cpu_seconds": spent.cpu_s}
            for stage, (n, spent) in summary.seconds.items()
        },
        "notes": summary.notes,
    }
    store.location.write(LAST_RUN, json_with_checksum(document).encode())

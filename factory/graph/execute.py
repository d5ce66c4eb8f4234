"""Executes a run: plan against the tables, drive the tasks in one executor or the other, tell how it ended.

The driver can die at any moment: what is committed is done, the rest is tried again by the next run, with the
same result.
"""

import json
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Literal

from deltalake.exceptions import DeltaError

from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED, asked_to_stop
from factory.graph.apart import AGAIN, NEW_CLUSTERS, begun_anew
from factory.graph.batch import SHARD_BYTES, SHARD_SECONDS, Gatherer, WriteFailed
from factory.graph.crashes import counted, crash_of
from factory.graph.driver import Driver
from factory.graph.episodes import Beside, Episodes, EpisodesWanted, McapShards, Together
from factory.graph.guard import CRASHED
from factory.graph.limits import NO_LIMITS, Limits, notes_folder
from factory.graph.local import NO_CLAIMS, Claims, ClusterDied, ClusterLacks, Fuse, Graph, LocalGraph, MachineIll
from factory.graph.metrics import RunMetrics
from factory.graph.plan import RunPlan, make_plan
from factory.graph.progress import Executed
from factory.graph.records import Records
from factory.graph.walk import Try, retry_policy
from factory.graph.work import NotReady, Work
from factory.readers.base import ClipRef
from factory.store.attempts import NOTHING, Kind
from factory.store.disk import DiskFull, why_ill
from factory.store.funnel import Funnel, funnel_of
from factory.store.location import BadLocation
from factory.store.samples import CURRENT_RUN, ChangedRun, OnChange, Store
from factory.store.table import AnotherWriter
from factory.wording import one_line

Executor = Literal["local", "ray"]


@dataclass
class RunSummary:
    """How a run ended."""

    exit_code: int
    message: str = ""
    counts: dict[str, int] = field(default_factory=dict)  # accepted, rejected, failed, exhausted, of the planned clips
    executed: Executed = field(default_factory=Executed)
    seconds: dict[str, tuple[int, float]] = field(default_factory=dict)  # stage -> (tasks, seconds) of this run
    notes: list[str] = field(default_factory=list)
    funnel: Funnel | None = None
    began_ms: int = 0  # since 1970; 0: nothing was left to do
    lost_cluster: bool = False  # the run's own, which another may replace
    is_broken: bool = False  # by what it writes to or works on, as the message says: then no page is written


def execute(
    work: Work,
    refs: Sequence[ClipRef],
    experts: Sequence[str],
    rounds: int,
    store: Store,
    executor: Executor = "ray",
    workers: int | None = None,
    *,
    on_change: OnChange = "stop",
    retry: bool = False,
    ray_address: str | None = None,
    claims: Claims = NO_CLAIMS,
    fuse: Fuse = "auto",
    limits: Limits = NO_LIMITS,
    isolated: bool = False,
    shard_bytes: int = SHARD_BYTES,
    shard_seconds: float = SHARD_SECONDS,
    minutes: float | None = None,
    episodes: EpisodesWanted | None = None,
    mcap_shards: bool = False,
    command: Sequence[str] | None = None,
    say: Callable[[str], None] = print,
) -> RunSummary:
    """Make the samples of `rounds` rounds for every clip and expert, as far as the store does not hold them already.

    workers: processes of a local Ray cluster, None: one per CPU. retry: try failed(input | bug) attempts again too.
    claims: on Ray. limits: of a task, beyond which it is ended. fuse: whether the stages of an attempt are one task;
    auto: not where drawing claims a GPU. isolated: executor=local works in a process of its own, which may die.
    minutes: after which nothing new is begun, as after an interruption. episodes: MCAP files to be written
    beside the samples; mcap_shards: all samples as MCAP shards too. command: the settings as they were given, kept for
    `retry`.
    Invalid arguments come back as exit code 2 with a message and nothing written.
    """
    if not refs or not experts or rounds < 1:
        return RunSummary(BAD_CONFIG, f"nothing to do: {len(refs)} clips, experts {list(experts)}, rounds={rounds}")
    twice = [clip_id for clip_id, n in Counter(ref.clip_id for ref in refs).items() if n > 1]
    if twice or len(set(experts)) < len(experts):
        return RunSummary(BAD_CONFIG, f"named twice: clips {twice[:3]}, experts {list(experts)}")
    digests = {expert: work.expert_digest(expert) for expert in experts}
    identity = work.identity
    try:
        records = store.agree(identity, digests, on_change)
        history = NOTHING if store.starts_over(records) else store.history(identity, digests)
        if on_change == "stop" and records[-1]["on_change"] == "keep":
            on_change = "keep"
        policy = retry_policy(retry, identity.versions_json)
        plan = make_plan(refs, experts, rounds, history, identity, on_change, policy, work.once)
        parts: list[Beside] = [McapShards(store)] if mcap_shards else []
        parts += [Episodes(store, episodes, refs)] if episodes else []
        pictured = Together(parts) if parts else None
    except ChangedRun as error:
        return RunSummary(BAD_CONFIG, str(error))
    except (OSError, DeltaError) as error:
        if why_ill(error):
            return RunSummary(INTERRUPTED, f"{one_line(error)}; {AGAIN}")
        return RunSummary(BAD_CONFIG, f"{error}; python -m factory verify {store.location.uri} says what is damaged")
    notes = notes_folder(store.location)
    plan, died = counted(crash_of(notes), plan, Records(identity, digests), policy)
    driver = Driver(identity, plan, digests, rounds, policy, work.block, work.doing)
    if plan.frozen:
        driver.notes.append(f"{len(plan.frozen)} clips kept as they are: their candidates come from other settings")
    code, message, began_ms, is_broken, lost_cluster = COMPLETE, "", 0, False, False
    try:
        is_due = plan.todo or (pictured is not None and pictured.is_due)
        graph: Graph | None = None
        if is_due and executor == "local" and isolated:
            from factory.graph.isolated import IsolatedGraph

            graph = IsolatedGraph(work, store.location, lambda: driver.interrupted, fuse, limits)
        elif is_due and executor == "local":
            graph = LocalGraph(work, store.location, lambda: driver.interrupted, fuse)
        elif is_due:
            from factory.graph.on_ray.graph import RayGraph

            graph = RayGraph(work, store.location, workers, ray_address, claims, fuse, limits)
    except (BadLocation, ClusterLacks, NotReady, ConnectionError) as error:
        return RunSummary(BAD_CONFIG, str(error))
    except ClusterDied as error:
        return RunSummary(INTERRUPTED, str(error), lost_cluster=error.is_ours)
    except (MachineIll, OSError) as error:  # while kernels are compiled
        if isinstance(error, OSError) and not why_ill(error):
            raise
        said = out_of_disk(error) if isinstance(error, DiskFull) else f"{one_line(error)}; {AGAIN}"
        return RunSummary(INTERRUPTED, said)
    except KeyboardInterrupt:
        return RunSummary(INTERRUPTED, "stopped before anything was begun")
    try:
        if store.begin(records):  # another run committed while this one was getting ready
            history = store.history(identity, digests)
            plan = make_plan(refs, experts, rounds, history, identity, on_change, policy, work.once)
            driver = Driver(identity, plan, digests, rounds, policy, work.block, work.doing)
            died = []
        store.plan({expert: 1 if work.once(expert) else rounds for expert in experts}, [ref.clip_id for ref in refs])
        if died:
            store.commit([], [], died)
            driver.notes.append(f"the run before this one died at {died[0].error.partition(': ')[2]}; it comes last")
        (notes / CRASHED).unlink(missing_ok=True)
        if graph is not None:
            began_ms = _announce(store, plan, experts, rounds, command)
            metrics = RunMetrics(graph.recorder, store.location)
            with asked_to_stop(driver.hurry), _alarm(driver.stop, minutes):
                if pictured is not None:
                    pictured.begin(graph)
                driver.loop(graph, Gatherer(graph, store, shard_bytes, shard_seconds), metrics, pictured)
                if pictured is not None:
                    pictured.tidy()
        code = COMPLETE_WITH_FAILURES if driver.has_failures else COMPLETE
        if pictured is not None and pictured.errors:
            text = f"{len(pictured.errors)} MCAP files were not written ({pictured.errors[0]})"
            code, message = INTERRUPTED, f"{text}; run the same command again to write them"
        if driver.interrupted:
            code, message = INTERRUPTED, "interrupted; run the same command again to go on"
    except DiskFull as error:
        code, message, is_broken = INTERRUPTED, out_of_disk(error), True
    except MachineIll as error:
        text = f"{error}; put it right and run the same command again: no clip is blamed"
        code, message, is_broken = INTERRUPTED, text, True
    except (AnotherWriter, WriteFailed, ClusterDied) as error:
        code, message, is_broken = INTERRUPTED, str(error), True
        lost_cluster = isinstance(error, ClusterDied) and error.is_ours
    except (OSError, DeltaError) as error:  # what holds the tables fails: a share that went away, a lost network
        code, message, is_broken = INTERRUPTED, f"{one_line(error)}; {AGAIN}", True
    except KeyboardInterrupt:
        code, message = INTERRUPTED, "stopped at once; run the same command again"
    finally:
        if graph is not None:
            graph.close()
    funnel = None
    try:
        funnel = funnel_of(store, [ref.clip_id for ref in refs])
    except (OSError, DeltaError) as error:
        code, message, is_broken = INTERRUPTED, message or f"{one_line(error)}; {AGAIN}", True
    counts = {} if funnel is None else _counts(funnel, experts)
    summary = RunSummary(
        *(code, message, counts, driver.executed, driver.seconds, driver.notes, funnel, began_ms),
        lost_cluster=lost_cluster,
        is_broken=is_broken,
    )
    if began_ms or code:
        try:
            record_summary(store, summary)
        except OSError as error:  # the same disk or share
            summary.exit_code, summary.is_broken = INTERRUPTED, True
            summary.message = summary.message or (
                out_of_disk(error) if isinstance(error, DiskFull) else f"{one_line(error)}; {AGAIN}"
            )
    for line in (*summary.notes, str(summary.executed)):
        say(line)
    return summary


def out_of_disk(error: DiskFull) -> str:
    """What to do where a disk is full."""
    return f"{error}; free disk space and run the same command again: it goes on from what is committed"


def on_new_clusters(once: Callable[[], RunSummary], say: Callable[[str], None] = print, begun: int = 0) -> RunSummary:
    """A run, and again on a new cluster where its own died: it goes on from what is committed.

    begun: new clusters that it had before.
    """
    for number in range(begun + 1, NEW_CLUSTERS + 1):
        summary = once()
        if not summary.lost_cluster:
            return summary
        say(begun_anew(summary.message, number))
    summary = once()
    if summary.lost_cluster:
        summary.message += f"; {AGAIN}"
    return summary


@contextmanager
def _alarm(stop: Callable[[], None], minutes: float | None) -> Iterator[None]:
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


def _counts(funnel: Funnel, experts: Sequence[str]) -> dict[str, int]:
    """Attempts of the planned clips by what became of them; clip-level rows among them."""
    rows = [row for row in funnel.rows if row.expert in experts]
    broken = sum(n for why, n in funnel.clip_outcomes.items() if why.startswith("failed."))
    return {
        Kind.ACCEPTED.value: sum(row.accepted for row in rows),
        Kind.REJECTED.value: sum(row.rejected for row in rows) + sum(funnel.clip_outcomes.values()) - broken,
        Kind.FAILED.value: sum(row.failed for row in rows) + broken,
        Kind.EXHAUSTED.value: sum(funnel.exhausted.get(expert, 0) for expert in experts),
    }


def _announce(store: Store, plan: RunPlan, experts: Sequence[str], rounds: int, command: Sequence[str] | None) -> int:
    """current_run.json: when the run began and how many walks it has before it, for who watches; the beginning."""
    walks = [
        step
        for clip in plan.todo
        for walk in clip.walks
        if (step := clip.steps.get(walk.expert)) is None or isinstance(step, Try) or walk.lacks_exhausted(step)
    ]
    began_ms = int(time.time() * 1000)
    document = {
        "began_ms": began_ms,
        "clips": len(plan.todo) + len(plan.done),
        "clips_left": len(plan.todo),
        "walks_left": len(walks),
        "experts": list(experts),
        "rounds": rounds,
        "folder": os.getcwd(),
        "command": None if command is None else list(command),
    }
    store.location.write(CURRENT_RUN, (json.dumps(document, indent=1) + "\n").encode())
    return began_ms


def record_summary(store: Store, summary: RunSummary) -> None:
    """last_run.json: what the newest run that did anything did, for people and reports."""
    document = {
        "began_ms": summary.began_ms,
        "ended_ms": int(time.time() * 1000),
        "exit_code": summary.exit_code,
        "message": summary.message,
        "counts": summary.counts,
        "executed": asdict(summary.executed),
        "seconds": {stage: {"tasks": n, "seconds": total} for stage, (n, total) in summary.seconds.items()},
        "notes": summary.notes,
    }
    store.location.write("last_run.json", (json.dumps(document, indent=1) + "\n").encode())

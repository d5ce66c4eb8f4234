"""The driver's loop: keeps a bounded number of clips open and walks their candidates, in either executor.

Attempts of one walk are a chain, walks are parallel. Results go to a CommitQueue, which commits them in groups.
Everything the driver knows it can know again from the tables, so it can die at any moment.
"""

import ctypes
import math
import re
import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pyarrow as pa

from factory.files import DiskFull
from factory.graph.local import Graph, MachineFailure, Ticket
from factory.graph.plan import (
    CLIP_CANDIDATE,
    AttemptBatch,
    Blocked,
    ClipPlan,
    Complete,
    Exhausted,
    RunPlan,
    RunRecords,
    Step,
    Try,
    WalkState,
    needs_prepared_clip,
    next_batch,
    past_from_outcome,
    tries_so_far,
)
from factory.graph.progress import Note, ProgressLine, RunCounts, RunForecast, RunMetrics, RunTotals, Workload
from factory.graph.steps import (
    AttemptReport,
    AttemptUnfinished,
    BatchReport,
    BlockReport,
    BlockUnfinished,
    EpisodeBatch,
    EpisodesReport,
    Failure,
    MakeEpisode,
    PrepareReport,
    Spent,
)
from factory.readers.base import ClipRef
from factory.store.episodes import EPISODES_FOLDER, episode_name, wants_episode
from factory.store.location import Shard
from factory.store.samples import ClipCandidates, ErrorKind, Kind, Outcome, PastAttempt, Store
from factory.store.schema import RunIdentity, Stamp, attempt_id
from tasks.stages import Rejected

# Episodes beside the table of samples, made of what is committed: files for people, one for every chosen sample.
#
# The tables say which files there are to be. A file's name holds the sample and what its row was made under, so that
# a name that is there is written, whole and of the present row: what a killed run left out the next one makes up for,
# and what a redo replaced goes. Which samples are chosen follows from their ids, whatever the order they were made
# in.

ROWS = ["attempt_id", "clip_id", "settings_hash", "stage_versions"]
PER_TASK = 4  # episodes, some 0.1 to 1 s each
OURS = re.compile(r"[0-9A-Za-z_-]+-[0-9a-f]{8}\.mcap|\..*\.tmp")  # names that may be tidied away; drafts too


@dataclass(frozen=True)
class EpisodeSettings:
    """Which samples are to have an episode, and what makes it."""

    every: int  # 1 all, n one in n
    make: MakeEpisode  # a function that workers can import


class EpisodeScheduler:
    """Keeps the episodes of a run in step with its table: says what is missing and has tasks write it."""

    def __init__(self, store: Store, wanted: EpisodeSettings, refs: Iterable[ClipRef]) -> None:
        """refs: the run's clips; episodes of others are left as they are."""
        self._store, self._wanted = store, wanted
        self._refs = {ref.clip_id: ref for ref in refs}
        self._folder = store.location.child(EPISODES_FOLDER)
        self._there = set(self._folder.names())
        self._queue: deque[EpisodeBatch] = deque()
        self._writing: set[Ticket] = set()
        self._graph: Graph | None = None
        self.written = 0
        self.errors: list[str] = []
        for path, partition in sorted(store.samples.live_files().items()):
            self._queue_missing(path, partition)

    @property
    def is_due(self) -> bool:
        """Something is missing or in hand."""
        return bool(self._queue or self._writing)

    def start(self, graph: Graph) -> None:
        """Have the missing ones written."""
        self._graph = graph
        self._submit()

    def remove_outdated(self) -> None:
        """Drafts of killed runs, and what is of rows that are no more."""
        live = {episode_name(row) for row in self._store.samples.read(ROWS).to_pylist()}
        for name in sorted(set(self._folder.names()) - live):
            if OURS.fullmatch(name):
                self._folder.remove(name)

    def on_commit(self, paths: Sequence[str]) -> None:
        """The table has these new files."""
        live = self._store.samples.live_files()
        for path in paths:
            if path in live:
                self._queue_missing(path, live[path])
        self._submit()

    def take_report(self, ticket: Ticket, report: Any) -> bool:
        """Of a task; False where the ticket is not one of these."""
        if ticket not in self._writing:
            return False
        self._writing.remove(ticket)
        done = EpisodesReport(0, (report.error,)) if isinstance(report, Failure) else report
        self.written += done.written
        self.errors += [error.splitlines()[-1] for error in done.errors]
        self._submit()
        return True

    def stop(self) -> None:
        """Begin no more; the next run makes up for it."""
        self._queue.clear()

    def _queue_missing(self, path: str, partition: Mapping[str, str]) -> None:
        missing: dict[str, ClipRef] = {}
        for row in self._store.samples.read_file(path, partition, ROWS).to_pylist():
            name = episode_name(row)
            chosen = wants_episode(row["attempt_id"], self._wanted.every)
            if chosen and name not in self._there and row["clip_id"] in self._refs:
                missing[row["attempt_id"]] = self._refs[row["clip_id"]]
                self._there.add(name)  # asked for once
        keys = sorted(missing)
        for i in range(0, len(keys), PER_TASK):
            refs = {key: missing[key] for key in keys[i : i + PER_TASK]}
            self._queue.append(EpisodeBatch(path, partition, refs, self._wanted.make))

    def _submit(self) -> None:
        """A few at once: walks and episodes share the cores."""
        assert self._graph is not None, "start() comes first"
        while self._queue and len(self._writing) < self._graph.parallelism:
            self._writing.add(self._graph.submit("episodes", self._queue.popleft()))


# Which clips may be prepared: each waits for the block that it is rendered from, and that is built once, as a task.
#
# Clips keep their order but for those that wait; as many blocks are built at once as there are workers.

BlockOf = Callable[[ClipRef], str | None]


@dataclass(frozen=True)
class BlockBuild:
    """The next task: the block of this clip."""

    block: str
    ref: ClipRef


class ClipQueue:
    """The clips of a plan, handed out one by one."""

    def __init__(self, clips: Sequence[ClipPlan], block_of: BlockOf, workers: int) -> None:
        self._ahead = deque(clips)
        self._ready: deque[ClipPlan] = deque()  # their block is built
        self._waiting: dict[str, list[ClipPlan]] = {}  # block that is being built -> clips
        self._built: set[str] = set()
        self._block_of = block_of
        needed = {block_of(clip.ref) for clip in clips if needs_prepared_clip(clip)} - {None}
        self.n_blocks = len(needed)
        self.at_once = max(1, min(workers, self.n_blocks))

    def __bool__(self) -> bool:
        """Some clip has not been handed out."""
        return bool(self._ahead or self._ready or self._waiting)

    def next(self, wanted: bool) -> ClipPlan | BlockBuild | None:
        """A clip to begin with, if one is `wanted`, or a block to build; None: nothing for now."""
        if wanted and self._ready:
            return self._ready.popleft()
        while self._ahead:
            clip = self._ahead[0]
            block = self._block_of(clip.ref) if needs_prepared_clip(clip) else None
            if block is None or block in self._built:
                return self._ahead.popleft() if wanted else None
            if block in self._waiting:
                self._waiting[block].append(self._ahead.popleft())
            elif len(self._waiting) < self.at_once:
                self._waiting[block] = [self._ahead.popleft()]
                return BlockBuild(block, clip.ref)
            else:
                return None
        return None

    def mark_built(self, block: str) -> None:
        """Its clips may go on, also where building failed: each of them will say so itself."""
        self._built.add(block)
        self._ready.extend(self._waiting.pop(block))


# Results on their way to the tables: gathered by reference, written as shards by tasks, committed in groups.
#
# A batch closes when the rows of one partition reach 128 MB or after 30 s, a run's first after 2 s; its shards are
# written by tasks; when all of them stand, the driver commits the whole batch. What is not committed when a run dies is
# tried again by the next one.

SHARD_BYTES = 128 * 2**20
SHARD_SECONDS = 30.0
FIRST_SHARE = 1.0 / 15.0  # of a batch's time after which a run's first rows are written: somebody waits for them


class WriteFailed(RuntimeError):
    """A shard could not be written."""


@dataclass(frozen=True)
class PendingRow:
    """An accepted row that lies with a worker."""

    result: Any
    n_bytes: int
    partition: tuple[int, str]  # round, expert
    licence: str


@dataclass
class PendingCommit:
    """What one commit holds."""

    rows: dict[tuple[int, str], list[PendingRow]] = field(default_factory=lambda: defaultdict(list))
    n_bytes: Counter[tuple[int, str]] = field(default_factory=Counter)  # of rows: asked on every turn of the loop
    candidates: list[ClipCandidates] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    replaced: list[str] = field(default_factory=list)  # attempt_ids whose old rows go
    unlisted: list[str] = field(default_factory=list)  # clip_ids whose candidate list goes
    shards: list[Shard] = field(default_factory=list)
    writing: int = 0
    opened: float = 0.0

    @property
    def is_empty(self) -> bool:
        return not (self.rows or self.candidates or self.outcomes or self.replaced or self.unlisted)

    @property
    def largest(self) -> int:
        """Bytes of the largest partition."""
        return max(self.n_bytes.values(), default=0)


_C_LIBRARY = ctypes.CDLL(None)


class CommitQueue:
    """Fills the open batch, sends full ones to be written, commits the written ones."""

    def __init__(self, graph: Graph, store: Store, shard_bytes: int, shard_seconds: float) -> None:
        self._graph, self._store = graph, store
        self.on_commit: Callable[[Sequence[Shard], float], None] = lambda shards, seconds: None
        self._shard_bytes, self._shard_seconds = shard_bytes, shard_seconds
        self._open = PendingCommit()
        self._written_by: dict[Ticket, PendingCommit] = {}
        self._has_sent_rows = False

    @property
    def n_writing(self) -> int:
        return len({id(batch) for batch in self._written_by.values()})

    def add(
        self,
        rows: Sequence[PendingRow] = (),
        candidates: Sequence[ClipCandidates] = (),
        outcomes: Sequence[Outcome] = (),
        replaced: Sequence[str] = (),
        unlisted: Sequence[str] = (),
    ) -> None:
        """Results that must become visible together."""
        if self._open.is_empty:
            self._open.opened = time.monotonic()
        for row in rows:
            self._open.rows[row.partition].append(row)
            self._open.n_bytes[row.partition] += row.n_bytes
        self._open.candidates.extend(candidates)
        self._open.outcomes.extend(outcomes)
        self._open.replaced.extend(replaced)
        self._open.unlisted.extend(unlisted)

    def send_if_due(self) -> None:
        batch = self._open
        age = time.monotonic() - batch.opened
        due_s = self._shard_seconds * (FIRST_SHARE if batch.rows and not self._has_sent_rows else 1.0)
        if not batch.is_empty and (batch.largest >= self._shard_bytes or age >= due_s):
            self.send()

    def send(self) -> None:
        """Close the open batch and have its shards written."""
        batch, self._open = self._open, PendingCommit()
        self._has_sent_rows |= bool(batch.rows)
        for partition in sorted(batch.rows):
            ticket = self._graph.submit("write", *(row.result for row in batch.rows[partition]))
            self._written_by[ticket] = batch
            batch.writing += 1
        if not batch.writing:
            self._commit(batch)

    def take_report(self, ticket: Ticket, report: Any) -> bool:
        """Take the report of a write; False where the ticket is not one. Raises WriteFailed and the store's errors."""
        batch = self._written_by.pop(ticket, None)
        if batch is None:
            return False
        if isinstance(report, Failure):
            said = report.error.splitlines()[-1]
            raise WriteFailed(f"a file of samples could not be written: {said}; run the same command again to go on")
        batch.shards.append(report)
        batch.writing -= 1
        if not batch.writing:
            self._commit(batch)
        return True

    def _commit(self, batch: PendingCommit) -> None:
        licences = {row.licence for rows in batch.rows.values() for row in rows}
        began = time.perf_counter()
        self._store.commit(batch.candidates, batch.shards, batch.outcomes, batch.replaced, batch.unlisted, licences)
        self.on_commit(batch.shards, time.perf_counter() - began)
        batch.rows.clear()
        # A driver of days would else hold what each of its threads once needed, in the C library's many arenas and
        # Arrow's. About a millisecond.
        pa.default_memory_pool().release_unused()
        if hasattr(_C_LIBRARY, "malloc_trim"):  # of glibc
            _C_LIBRARY.malloc_trim(0)


CLIPS_PER_WORKER = 2  # open at once: one works while the next is being prepared
WAIT_S = 0.5
DRAIN_S = 18.0  # of the 30 that are given after a first signal
WRITE_S = 6.0  # to write what is done, after that
MACHINE_FAILURES_IN_A_ROW = 6  # tasks that fail by the machine, or three for every task at once: then the run stops


@dataclass(frozen=True)
class AttemptInFlight:
    """An attempt in flight."""

    clip: ClipPlan
    walk: WalkState
    prepared: Any  # stands for the prepared clip
    stamp: Stamp
    tasks_done: int = 0  # of the graph's `attempt_tasks`
    batch: AttemptBatch | None = None  # of the walk, from this attempt on


class RunDriver:
    """The state of one run, fed by its loop one report at a time."""

    def __init__(
        self,
        identity: RunIdentity,
        plan: RunPlan,
        digests: Mapping[str, str],
        rounds: int,
        policy: Callable[[PastAttempt], bool],
        block_of: BlockOf,
        doing: Callable[[], str],
    ) -> None:
        """block_of: name of the block that is to be built before a clip; doing: how far long tasks are."""
        self._identity, self._rounds, self._policy = identity, rounds, policy
        self._plan, self._block_of, self._doing = plan, block_of, doing
        self._records = RunRecords(identity, digests)
        self.executed = RunTotals(found_done=plan.found_done)
        self.notes: list[str] = []
        self._seconds: dict[str, tuple[int, Spent]] = defaultdict(lambda: (0, Spent()))
        self._fresh: set[str] = set()  # attempt_ids that failed in this run
        self._building: dict[Ticket, BlockBuild] = {}
        self._preparing: dict[Ticket, ClipPlan] = {}
        self._trying: dict[Ticket, AttemptInFlight] = {}
        self._walks_left: dict[str, int] = {}
        self._held: dict[tuple[str, str], tuple[list[PendingRow], list[Outcome]]] = {}  # redo: until the walk ends
        self._stopping = threading.Event()
        self._deadline = math.inf
        self._machine_failures = 0
        self._uncached = ""  # why the first could not be kept
        self._tally = RunCounts()
        walks = [walk for clip in plan.todo for walk in clip.walks]
        for walk in walks:
            walk.wanted = max(0, (1 if walk.once else rounds) - walk.n_found)
        self._forecast = RunForecast(Workload(), Workload(left=sum(walk.wanted for walk in walks)))

    def stop(self) -> None:
        """Begin nothing more; what is in flight is finished and committed."""
        self._stopping.set()

    def stop_soon(self) -> None:
        """As `stop`, for who is soon killed: what is in flight for more than DRAIN_S is left undone."""
        self._deadline = time.monotonic() + DRAIN_S
        self.stop()

    @property
    def seconds(self) -> dict[str, tuple[int, Spent]]:
        """Stage -> tasks of this run, and what they spent."""
        return dict(sorted(self._seconds.items()))

    @property
    def has_failures(self) -> bool:
        """Some planned clip or walk stands at a failed attempt, from this run or an earlier one."""
        clips = (*self._plan.todo, *self._plan.done)
        return any(clip.failed or any(isinstance(step, Blocked) for step in clip.steps.values()) for clip in clips)

    @property
    def interrupted(self) -> bool:
        return self._stopping.is_set()

    def loop(
        self, graph: Graph, commits: CommitQueue, metrics: RunMetrics, episodes: EpisodeScheduler | None, note: Note
    ) -> None:
        """Until nothing is left, or stopped and drained. Raises DiskFull once a disk is full, and MachineFailure."""
        self._graph, self._commits, self._metrics, self._episodes = graph, commits, metrics, episodes
        commits.on_commit = self._on_commit
        with ProgressLine(len(self._plan.todo), self._forecast.left_s, doing=self._doing, note=note) as progress:
            self._work_through(graph, commits, progress)
        if self.executed.uncached:
            what = f"{self.executed.uncached} prepared clips could not be kept ({self._uncached})"
            self.notes.append(f"{what}; a later run that needs them prepares them again")

    def _work_through(self, graph: Graph, commits: CommitQueue, progress: ProgressLine) -> None:
        self._queue = ClipQueue(self._plan.todo, self._block_of, graph.parallelism)
        self._forecast.blocks.left = self._queue.n_blocks
        while True:
            wanted = len(self._walks_left) + len(self._preparing) < CLIPS_PER_WORKER * graph.parallelism
            if commits.n_writing < 2 and not self.interrupted:
                begun = self._queue.next(wanted)
                if begun is not None:
                    self._start(begun)
                    continue
            finished = graph.wait(WAIT_S)
            if finished is not None:
                self._take_report(*finished)
            commits.send_if_due()
            progress.show(self._tally)
            self._show_state()
            idle = not self._preparing and not self._trying and not commits.n_writing
            if time.monotonic() > self._deadline:
                in_hand = len(self._preparing) + len(self._trying) + len(self._building)
                self.notes.append(f"{in_hand} tasks did not end within {DRAIN_S:.0f} s of the signal: left undone")
                self._deadline += WRITE_S
                break
            if idle and (self.interrupted or not self._queue):  # the next run continues a half-built block
                break
        commits.send()
        while time.monotonic() < self._deadline and (
            commits.n_writing or (self._episodes is not None and self._episodes.is_due)
        ):
            if self.interrupted and self._episodes is not None:
                self._episodes.stop()
            finished = graph.wait(WAIT_S)
            if finished is not None:
                self._take_report(*finished)
            progress.show(self._tally)
        progress.show(self._tally, last=True)
        self._show_state(last=True)

    def _on_commit(self, shards: Sequence[Shard], seconds: float) -> None:
        self._metrics.record_commit(shards, seconds)
        if self._episodes is not None:
            self._episodes.on_commit([shard.path for shard in shards])

    def _show_state(self, last: bool = False) -> None:
        clips = len(self._plan.todo)
        self._metrics.record_state(clips, clips - self._tally.clips, self._in_flight, last)

    def _in_flight(self) -> dict[str, int]:
        return {
            "walks": sum(self._walks_left.values()),
            "attempts": len(self._trying),
            "clips": len(self._preparing),
            "blocks": len(self._building),
            "batches": self._commits.n_writing,
        }

    def _start(self, what: ClipPlan | BlockBuild) -> None:
        if isinstance(what, BlockBuild):
            threads = max(1, self._graph.cores // self._queue.at_once)
            self._building[self._graph.submit("reconstruct", what.ref, threads)] = what
        elif needs_prepared_clip(what):
            self._preparing[self._graph.submit("perturb", what.ref, what.content)] = what
        else:
            self._start_walks(what, None)

    def _take_report(self, ticket: Ticket, report: Any) -> None:
        self._metrics.record_task(ticket.step, ticket.queued_s, report)
        last = report.reports[-1] if isinstance(report, BatchReport) else report
        if isinstance(last, Failure) and last.disk_full:
            raise DiskFull(last.disk_full)
        self._machine_failures += 1
        if not (isinstance(last, Failure) and last.kind is ErrorKind.MACHINE):
            self._machine_failures = 0
        elif self._machine_failures >= max(MACHINE_FAILURES_IN_A_ROW, 3 * self._graph.parallelism):
            said = last.error.splitlines()[-1]
            raise MachineFailure(f"the machine failed {self._machine_failures} tasks in a row, the last one by: {said}")
        if self._commits.take_report(ticket, report):
            return
        if self._episodes is not None and self._episodes.take_report(ticket, report):
            self.executed.episodes = self._episodes.written
            return
        if ticket in self._building:
            self._take_block(self._building.pop(ticket), report)
        elif ticket in self._preparing:
            self._take_prepared(self._preparing.pop(ticket), ticket.result, report)
        else:
            self._take_attempt(self._trying.pop(ticket), ticket.result, report)

    def _take_block(self, build: BlockBuild, report: BlockReport | BlockUnfinished | Failure) -> None:
        if isinstance(report, BlockUnfinished):
            self.notes.append(f"block {build.block} is not finished; the next run goes on with it")
            return
        self._forecast.blocks.finish(1)
        if isinstance(report, BlockReport):
            self._add_seconds(report.seconds, self._forecast.blocks)
        else:
            last = report.error.splitlines()[-1]
            self.notes.append(f"block {build.block} failed ({last}); it is tried again for each of its clips")
        self._queue.mark_built(build.block)

    def _take_prepared(self, clip: ClipPlan, result: Any, report: PrepareReport | Rejected | Failure) -> None:
        clip_id = clip.ref.clip_id
        replaced = [*clip.stale, *([clip.past.attempt_id] if clip.past is not None else [])]
        if isinstance(report, Rejected):
            replaced += [key for walk in clip.walks for key in walk.stale]
        if isinstance(report, PrepareReport):
            self._add_seconds(report.seconds, self._forecast.samples)
            if report.note:
                self.notes.append(report.note)
            elif (
                clip.listed is not None
                and clip.listed.prepare_digest == self._identity.prepare_digest
                and not report.from_cache
            ):
                self.notes.append(f"clip {clip_id}: its prepared clip was not in the cache; prepared again")
            self.executed.prepared += not report.from_cache
            self.executed.from_cache += report.from_cache
            self.executed.uncached += bool(report.uncached)
            self._uncached = self._uncached or report.uncached
            clip.n_candidates = len(report.clip.candidates)
            is_listed = clip.listed is not None and clip.listed.content_digest == report.clip.content_digest
            rows = [] if is_listed else [self._records.candidates(clip.ref, report.clip)]
            self._commits.add(candidates=rows, replaced=replaced)
            clip.past = None
            self._start_walks(clip, result)
            return
        key = attempt_id(clip_id, CLIP_CANDIDATE, self._identity.vocabulary_digest, "", "")
        outcome = self._records.outcome(clip.ref, key, "", CLIP_CANDIDATE, report, tries_so_far(clip.past), {}, {})
        clip.past = past_from_outcome(outcome)
        clip.failed = outcome.kind == Kind.FAILED
        unlisted = [clip_id] if isinstance(report, Rejected) else []
        self._commits.add(outcomes=[outcome], replaced=replaced, unlisted=unlisted)
        self._metrics.record_outcome(outcome, None)
        self._tally.rejected += not clip.failed
        self._tally.failed += clip.failed
        self._tally.clips += 1
        for walk in clip.walks:
            self._forecast_settled(walk)

    def _start_walks(self, clip: ClipPlan, prepared: Any) -> None:
        self._walks_left[clip.ref.clip_id] = len(clip.walks)
        for walk in clip.walks:
            self._advance(clip, walk, prepared)

    def _advance(self, clip: ClipPlan, walk: WalkState, prepared: Any) -> None:
        step = walk.step(clip.n_candidates, self._rounds, self._may_retry)
        clip.steps[walk.expert] = step
        if isinstance(step, Try) and not self.interrupted:
            stamp = self._records.stamp(clip.ref, walk.expert, step)
            ahead = 1 if walk.one_by_one else self._graph.attempts_per_task()
            along = next_batch(walk.once, clip.n_candidates, self._rounds, walk.known, step, ahead)
            self._submit_attempt(
                AttemptInFlight(clip, walk, prepared, stamp, batch=along if along.n > 1 else None), prepared
            )
            return
        self._end_walk(clip, walk, step)
        walk.forget()
        self._walks_left[clip.ref.clip_id] -= 1
        if not self._walks_left[clip.ref.clip_id]:
            del self._walks_left[clip.ref.clip_id]
            self._tally.clips += not self.interrupted

    def _submit_attempt(self, trial: AttemptInFlight, so_far: Any) -> None:
        """The next task of an attempt, from the result of the one before."""
        stages = self._graph.attempt_tasks[trial.tasks_done]
        if trial.batch is not None:
            ticket = self._graph.submit("attempts", stages, so_far, trial.stamp, trial.batch)
        else:
            ticket = self._graph.submit("attempt", stages, so_far, trial.stamp)
        self._trying[ticket] = trial

    def _forecast_settled(self, walk: WalkState, n: int | None = None) -> None:
        """`n` of the samples that the walk was to make are behind it, None: all, made or not."""
        n = walk.wanted if n is None else min(n, walk.wanted)
        walk.wanted -= n
        self._forecast.samples.finish(n)

    def _end_walk(self, clip: ClipPlan, walk: WalkState, step: Step) -> None:
        if not isinstance(step, Try):
            self._forecast_settled(walk)
        if walk.needs_exhausted_row(step):
            assert isinstance(step, Exhausted)
            stamp = self._records.stamp(clip.ref, walk.expert, Try(step.n_tried, -1))
            outcome = self._records.outcome(clip.ref, stamp.attempt_id, walk.expert, step.n_tried, step, 0, {}, {})
            walk.known[step.n_tried] = past_from_outcome(outcome)
            self._store_or_hold(clip, walk, outcomes=[outcome])
            self._metrics.record_outcome(outcome, None)
        rows, outcomes = self._held.pop((clip.ref.clip_id, walk.expert), ([], []))
        if isinstance(step, Complete | Exhausted):
            if walk.stale:
                self._commits.add(rows=rows, outcomes=outcomes, replaced=sorted(walk.stale))
        else:  # rows of an unfinished redo are made again, so that readers see the old walk or the new one
            self._commits.add(outcomes=[o for o in outcomes if o.kind == Kind.FAILED])

    def _take_attempt(
        self, trial: AttemptInFlight, result: Any, report: AttemptReport | AttemptUnfinished | BatchReport | Failure
    ) -> None:
        if isinstance(report, AttemptUnfinished):
            self._submit_attempt(replace(trial, tasks_done=trial.tasks_done + 1), result)
            return
        if isinstance(report, BatchReport):
            self._take_batch(trial, result, report)
        elif trial.batch is not None:  # lost with its worker, and at which of them nobody knows
            trial.walk.one_by_one = True
        else:
            self._settle_attempt(trial, trial.stamp, result, report)
        self._advance(trial.clip, trial.walk, trial.prepared)

    def _take_batch(self, trial: AttemptInFlight, rows: Sequence[Any], done: BatchReport) -> None:
        first, accepted = trial.stamp, 0
        for i, report in enumerate(done.reports):
            stamp = first.of_attempt(trial.clip.ref.clip_id, first.candidate_index + i, first.round + accepted)
            is_accepted = isinstance(report, AttemptReport) and report.rejected is None
            self._settle_attempt(trial, stamp, rows[accepted] if is_accepted else None, report)
            accepted += is_accepted

    def _settle_attempt(
        self, trial: AttemptInFlight, stamp: Stamp, result: Any, report: AttemptReport | Failure
    ) -> None:
        """What became of an attempt goes on to the tables; result: stands for the row of an accepted one."""
        clip, walk = trial.clip, trial.walk
        self.executed.attempts += 1
        known = walk.known.get(stamp.candidate_index)
        replaced = [known.attempt_id] if known is not None else []  # under keep perhaps of other expert inputs
        if isinstance(report, AttemptReport):
            self._add_seconds(report.seconds, self._forecast.samples)
        if isinstance(report, AttemptReport) and report.rejected is None:
            walk.known[stamp.candidate_index] = PastAttempt(stamp.attempt_id, Kind.ACCEPTED, True, round=stamp.round)
            row = PendingRow(result, report.n_bytes, (stamp.round, stamp.expert), report.licence)
            self._store_or_hold(clip, walk, rows=[row], replaced=replaced)
            self._tally.accepted += 1
            self._forecast_settled(walk, 1)
            self._metrics.record_accepted(stamp.expert, stamp.round)
        else:
            what = report if isinstance(report, Failure) else report.rejected
            assert what is not None
            measured: tuple[dict[str, float], dict[str, float]] = {}, {}
            if isinstance(report, AttemptReport):
                measured = dict(report.subscores), {stage: spent.wall_s for stage, spent in report.seconds.items()}
            outcome = self._records.outcome(
                clip.ref, stamp.attempt_id, stamp.expert, stamp.candidate_index, what, tries_so_far(known), *measured
            )
            walk.known[stamp.candidate_index] = past_from_outcome(outcome)
            if outcome.kind == Kind.FAILED:
                self._fresh.add(stamp.attempt_id)
            self._store_or_hold(clip, walk, outcomes=[outcome], replaced=replaced)
            self._metrics.record_outcome(outcome, stamp.round)
            self._tally.rejected += outcome.kind == Kind.REJECTED
            self._tally.failed += outcome.kind == Kind.FAILED

    def _store_or_hold(
        self,
        clip: ClipPlan,
        walk: WalkState,
        rows: Sequence[PendingRow] = (),
        outcomes: Sequence[Outcome] = (),
        replaced: Sequence[str] = (),
    ) -> None:
        """On to the commit queue; a walk that replaces rows is held back until it ends."""
        if not walk.stale:
            self._commits.add(rows=rows, outcomes=outcomes, replaced=replaced)
            return
        held_rows, held_outcomes = self._held.setdefault((clip.ref.clip_id, walk.expert), ([], []))
        held_rows.extend(rows)
        held_outcomes.extend(outcomes)

    def _may_retry(self, past: PastAttempt) -> bool:
        return past.attempt_id not in self._fresh and self._policy(past)

    def _add_seconds(self, seconds: Mapping[str, Spent], work: Workload) -> None:
        for stage, spent in seconds.items():
            n, total = self._seconds[stage]
            self._seconds[stage] = n + 1, total + spent
            work.spent_s += spent.wall_s

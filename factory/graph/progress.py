"""What a run says of itself: how far it is and how long it will take, to people; its metrics, to a monitoring system.

Progress is a bar on a terminal, plain lines elsewhere.
"""

import math
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from factory.graph.steps import AttemptReport, BatchReport, BlockReport, Failure, PrepareReport
from factory.store.location import Location, Shard
from factory.store.samples import Kind, Outcome
from factory.wording import rate_text, time_left_text, time_text

LINE_EVERY_S = 15.0
ASK_EVERY_S = 5.0  # when the run will end, and how far long tasks are


@dataclass
class Bar:
    """Shows `done` of `total` things, and a text; `before` were done when it began."""

    what: str
    total: int
    before: int = 0
    stream: TextIO = field(default_factory=lambda: sys.stderr)
    quiet: bool = False
    _began: float = field(default_factory=time.monotonic)
    _said: float = field(default_factory=time.monotonic)
    _bar: Progress | None = None

    def __post_init__(self) -> None:
        if self.stream.isatty() and not self.quiet:
            columns = (
                TextColumn(self.what),
                BarColumn(),
                TextColumn("{task.completed}/{task.total}  {task.fields[text]}"),
            )
            self._bar = Progress(*columns, console=Console(file=self.stream), transient=True)
            self._bar.add_task("", total=self.total, completed=self.before, text="")
            self._bar.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: int, text: Callable[[float], str], last: bool) -> None:
        """Update the bar; without a terminal print a line every 15 s and at the end. text: seconds so far -> words."""
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=done, text=text(now - self._began))
        elif not self.quiet and (last or now - self._said >= LINE_EVERY_S):
            self._said = now
            print(f"{self.what} {done}/{self.total}  {text(now - self._began)}", file=self.stream, flush=True)


@dataclass
class RateBar(Bar):
    """The rate and the time left by it; those done before this run are not in the rate."""

    def show(self, done: int, note: str = "") -> None:
        """So many are done."""
        self.update(done, lambda elapsed_s: self.text(done, elapsed_s, note), done >= self.total)

    def text(self, done: int, elapsed_s: float, note: str) -> str:
        """Rate, time left, note."""
        rate = (done - self.before) / elapsed_s if elapsed_s > 0 else 0.0
        left = time_text((self.total - done) / rate) if rate > 0 else "?"
        return "  ".join(filter(None, [rate_text(rate), f"ETA {left}", note]))


@dataclass
class Workload:
    """One kind of work of a run."""

    left: int = 0
    done: int = 0
    spent_s: float = 0.0  # seconds of all workers together

    def finish(self, n: int) -> None:
        """`n` of what was left are done."""
        self.left -= n
        self.done += n


@dataclass
class RunForecast:
    """All work of a run; the driver keeps it.

    A run builds blocks and settles samples: makes each that a walk was asked for, or finds that it cannot be made.
    Finished clips would be a poor measure: blocks come first and cost as much as all of a clip's samples.
    """

    blocks: Workload
    samples: Workload

    def left_s(self, elapsed_s: float) -> float | None:
        """Seconds left of a run that began `elapsed_s` ago; None as long as some kind of work has no known cost.

        Workers stay as busy as they have been.
        """
        ahead = [work for work in (self.blocks, self.samples) if work.left]
        if not ahead:
            return 0.0
        spent_s = self.blocks.spent_s + self.samples.spent_s
        if spent_s == 0.0 or not all(work.done for work in ahead):
            return None
        return elapsed_s * sum(work.spent_s * work.left / work.done for work in ahead) / spent_s


@dataclass
class RunCounts:
    """Counts of a run; clips that were found done at its start are not among them."""

    clips: int = 0
    accepted: int = 0
    rejected: int = 0
    failed: int = 0


@dataclass
class RunTotals:
    """What this run did itself, and what it found done."""

    prepared: int = 0  # clip and perturb stages computed
    from_cache: int = 0  # prepared clips taken from disk
    attempts: int = 0
    found_done: int = 0  # attempts settled by earlier runs
    episodes: int = 0  # files written
    uncached: int = 0  # prepared clips that could not be kept for later runs

    def __str__(self) -> str:
        episodes = f"; wrote {self.episodes} MCAP files" if self.episodes else ""
        return (
            f"executed {self.prepared} perturb tasks ({self.from_cache} from cache) and {self.attempts} attempts; "
            f"found {self.found_done} attempts done{episodes}"
        )


@dataclass(frozen=True)
class Outlook:
    """What a run says of itself while it goes on; current_run.json holds it, for pages to say the same."""

    said_ms: int = 0  # since 1970
    ends_ms: int | None = None  # likewise; None: not known yet
    doing: str = ""  # how far long tasks are


Note = Callable[[Outlook], None]  # takes it every few seconds


class ProgressLine(Bar):
    """Shows a Tally against `total` clips; `note` takes each outlook."""

    def __init__(
        self,
        total: int,
        left_s: Callable[[float], float | None],  # seconds of the run so far -> seconds left, if that is known
        stream: TextIO | None = None,
        doing: Callable[[], str] = str,  # how far long tasks are
        note: Note = lambda outlook: None,
    ) -> None:
        super().__init__("clips", total, stream=stream or sys.stderr)
        self.left_s, self.doing, self.note = left_s, doing, note
        self._outlook = Outlook()
        self._asked = -math.inf

    def show(self, tally: RunCounts, last: bool = False) -> None:
        """So far is the run."""
        if last or time.monotonic() - self._asked >= ASK_EVERY_S:
            self._asked = time.monotonic()
            now_ms, left_s = int(time.time() * 1000), self.left_s(self._asked - self._began)
            ends_ms = None if left_s is None else now_ms + int(1000 * left_s)
            self._outlook = Outlook(now_ms, ends_ms, self.doing())
            self.note(self._outlook)
        self.update(tally.clips, lambda elapsed_s: self.text(tally, elapsed_s), last)

    def text(self, tally: RunCounts, elapsed_s: float) -> str:
        rate = tally.clips / elapsed_s if elapsed_s > 0 else 0.0
        left = time_left_text(self._outlook.ends_ms, time.time() * 1000)
        counts = f"{tally.accepted} accepted, {tally.rejected} rejected, {tally.failed} failed"
        return "  ".join(filter(None, [rate_text(rate, " clips"), counts, f"ETA {left}", self._outlook.doing]))


# What a run tells a monitoring system: the table of metrics, and the one place that records them.
#
# The driver records what it learns anyway when results come back, so that workers know nothing of metrics and a local
# run records into nothing. Ray exports every name with the prefix `ray_` and counters with the suffix `_total`. The
# table of docs/metrics.md is tested against this one.
#
# Trap: Ray hands on a histogram's buckets, not its values, so the `_sum` it exports is made of the buckets'
# midpoints. What is to be added up has a counter beside the histogram.

GAUGES_EVERY_S = 1.0
DISK_EVERY_S = 10.0
TASK_SECONDS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3600.0)
DECIBELS = (15.0, 18.0, 20.0, 22.0, 24.0, 25.0, 26.0, 27.0, 28.0, 29.0, 30.0, 32.0, 35.0, 40.0)


class Type(StrEnum):
    COUNTER = "counter"
    GAUGE = "gauge"
    HISTOGRAM = "histogram"


@dataclass(frozen=True)
class Metric:
    """One metric; `run` (the URI of `out`) is a label of each besides its own."""

    name: str
    type: Type
    unit: str
    labels: tuple[str, ...]
    about: str
    buckets: tuple[float, ...] = ()  # upper bounds of a histogram's

    @property
    def exported(self) -> str:
        """The name that Prometheus sees; a histogram's is followed by `_bucket` and `_count`."""
        return f"ray_{self.name}" + ("_total" if self.type is Type.COUNTER else "")


OUTCOMES = Metric(
    "factory_outcomes",
    Type.COUNTER,
    "attempts",
    ("kind", "expert", "round", "stage", "reason"),
    "What became of attempts; of a whole clip where `expert` is empty. `reason` of a failure: its kind of error.",
)
TASKS = Metric("factory_tasks", Type.COUNTER, "tasks", ("task", "result"), "Tasks that came back: `ok` or `failed`.")
STAGE_SECONDS = Metric(
    "factory_stage_seconds", Type.HISTOGRAM, "s", ("stage",), "Time in a stage, per task.", TASK_SECONDS
)
STAGE_SPENT = Metric("factory_stage_spent_seconds", Type.COUNTER, "s", ("stage",), "Time in a stage, all workers.")
QUEUE_WAIT = Metric(
    "factory_queue_wait_seconds",
    Type.HISTOGRAM,
    "s",
    ("task",),
    "From submission to report, less the time at work: no worker free, inputs on their way, the driver's delay.",
    TASK_SECONDS,
)
SAMPLES = Metric("factory_samples", Type.COUNTER, "rows", ("expert", "round"), "Samples committed.")
BYTES = Metric("factory_sample_bytes", Type.COUNTER, "B", ("expert", "round"), "Size of the shards committed.")
COMMIT_SECONDS = Metric(
    "factory_commit_seconds", Type.HISTOGRAM, "s", (), "One group commit of all tables.", TASK_SECONDS
)
LOOKUPS = Metric(
    "factory_cache_lookups",
    Type.COUNTER,
    "tasks",
    ("cache", "hit"),
    "Whether a task found what it asked for: `prepared` clips and `block`s on disk, the `scene` to draw in its worker.",
)
PSNR = Metric(
    "factory_psnr_db",
    Type.HISTOGRAM,
    "dB",
    ("of",),
    "Held-out photos of a scene: of every `block` when its task ends, of every accepted `sample`.",
    DECIBELS,
)
CLIPS = Metric("factory_clips", Type.GAUGE, "clips", (), "Clips that this run began with, those found done left out.")
CLIPS_LEFT = Metric("factory_clips_left", Type.GAUGE, "clips", (), "Of them, not done yet. Absent: no driver is alive.")
IN_FLIGHT = Metric(
    "factory_in_flight",
    Type.GAUGE,
    "",
    ("what",),
    "`walks` of open clips, `attempts` (a batch counts once), `clips` being prepared, `blocks` being built, "
    "`batches` being written.",
)
DISK = Metric("factory_disk_bytes", Type.GAUGE, "B", (), "Size of the file system of a local `out`.")
DISK_FREE = Metric("factory_disk_free_bytes", Type.GAUGE, "B", (), "Free space there.")

METRICS = tuple(metric for metric in list(globals().values()) if isinstance(metric, Metric))


# Adds to a counter (more than 0), sets a gauge, or observes in a histogram; with all labels that the metric has.
Record = Callable[[Metric, float, Mapping[str, str]], None]


class RunMetrics:
    """Turns what the driver learns into metrics."""

    def __init__(self, record: Record, out: Location, clock: Callable[[], float] = time.monotonic) -> None:
        self._record, self._out, self._clock = record, out, clock
        self._gauges_at = self._disk_at = -math.inf

    def record_task(self, step: str, queued_s: float, report: object) -> None:
        """A task came back, whatever it was."""
        attempts = report.reports if isinstance(report, BatchReport) else (report,)
        failed = isinstance(attempts[-1], Failure)
        self._add(TASKS, 1, task=step, result="failed" if failed else "ok")
        self._add(QUEUE_WAIT, queued_s, task=step)
        for each in attempts:
            self._record_report(each)

    def _record_report(self, report: object) -> None:
        if isinstance(report, PrepareReport | BlockReport | AttemptReport):
            for stage, spent in report.seconds.items():
                self._add(STAGE_SECONDS, spent.wall_s, stage=stage)
                self._add(STAGE_SPENT, spent.wall_s, stage=stage)
        if isinstance(report, PrepareReport):
            self._record_lookup("prepared", report.from_cache)
        elif isinstance(report, BlockReport):
            self._record_lookup("block", report.from_cache)
            self._record_psnr("block", report.psnr_db)
        elif isinstance(report, AttemptReport):
            self._record_lookup("scene", report.scene_at_hand)
            if report.rejected is None:
                self._record_psnr("sample", report.psnr_db)

    def record_accepted(self, expert: str, round: int) -> None:
        """An attempt became a sample that is on its way to the table."""
        self._add(OUTCOMES, 1, kind=Kind.ACCEPTED.value, expert=expert, round=str(round), stage="", reason="")

    def record_outcome(self, outcome: Outcome, round: int | None) -> None:
        """Anything else; round: the one that was tried for, None for a clip as a whole and for the end of a list."""
        self._add(
            OUTCOMES,
            1,
            kind=outcome.kind,
            expert=outcome.expert,
            round="" if round is None else str(round),
            stage=outcome.stage,
            reason=outcome.error_kind or outcome.reason,
        )

    def record_commit(self, shards: Sequence[Shard], seconds: float) -> None:
        """A batch is in the tables."""
        self._add(COMMIT_SECONDS, seconds)
        for shard in shards:
            where = {"expert": shard.partition["expert"], "round": shard.partition["round"]}
            self._add(SAMPLES, len(shard.keys), **where)
            self._add(BYTES, shard.size, **where)

    def record_state(
        self, clips: int, left: int, in_flight: Callable[[], Mapping[str, int]], last: bool = False
    ) -> None:
        """How things stand; may be called as often as one likes, and at the end."""
        now = self._clock()
        if last or now - self._gauges_at >= GAUGES_EVERY_S:
            self._gauges_at = now
            self._add(CLIPS, clips)
            self._add(CLIPS_LEFT, left)
            for what, n in in_flight().items():
                self._add(IN_FLIGHT, n, what=what)
        if self._out.is_local and now - self._disk_at >= DISK_EVERY_S:
            self._disk_at = now
            disk = shutil.disk_usage(self._out.uri)
            self._add(DISK, disk.total)
            self._add(DISK_FREE, disk.free)

    def _record_lookup(self, cache: str, hit: bool | None) -> None:
        if hit is not None:
            self._add(LOOKUPS, 1, cache=cache, hit=str(hit).lower())

    def _record_psnr(self, of: str, psnr_db: float | None) -> None:
        if psnr_db is not None and math.isfinite(psnr_db):
            self._add(PSNR, psnr_db, of=of)

    def _add(self, metric: Metric, value: float, **labels: str) -> None:
        if value > 0 or metric.type is not Type.COUNTER:
            self._record(metric, value, {"run": self._out.uri, **labels})

"""What a run tells a monitoring system: the table of metrics, and the one place that records them.

The driver records what it learns anyway when results come back, so that workers know nothing of metrics and a local run
records into nothing. Ray exports every name with the prefix `ray_` and counters with the suffix `_total`. The table of
docs/metrics.md is tested against this one.

Trap: Ray hands on a histogram's buckets, not its values, so the `_sum` it exports is made of the buckets' midpoints.
What is to be added up has a counter beside the histogram.
"""

import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from factory.graph.steps import Attempted, Failure, Prepared, Reconstructed, Walked
from factory.store.attempts import Kind, Outcome
from factory.store.location import Location
from factory.store.parquet_file import Shard

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
    "`walks` of open clips, `attempts` (a stretch counts once), `clips` being prepared, `blocks` being built, "
    "`batches` being written.",
)
DISK = Metric("factory_disk_bytes", Type.GAUGE, "B", (), "Size of the file system of a local `out`.")
DISK_FREE = Metric("factory_disk_free_bytes", Type.GAUGE, "B", (), "Free space there.")

METRICS = tuple(metric for metric in list(globals().values()) if isinstance(metric, Metric))


class Recorder(Protocol):
    """Where values go."""

    def record(self, metric: Metric, value: float, labels: Mapping[str, str]) -> None:
        """Add to a counter (more than 0), set a gauge, or observe in a histogram; `labels` has all of the metric's."""
        ...


class NoRecorder:
    """Of runs in one process: nobody watches."""

    def record(self, metric: Metric, value: float, labels: Mapping[str, str]) -> None:
        pass


class RunMetrics:
    """Turns what the driver learns into metrics."""

    def __init__(self, recorder: Recorder, out: Location, clock: Callable[[], float] = time.monotonic) -> None:
        self._recorder, self._out, self._clock = recorder, out, clock
        self._gauges_at = self._disk_at = -math.inf

    def task(self, step: str, queued_s: float, report: object) -> None:
        """A task came back, whatever it was."""
        attempts = report.reports if isinstance(report, Walked) else (report,)
        failed = isinstance(attempts[-1], Failure)
        self._add(TASKS, 1, task=step, result="failed" if failed else "ok")
        self._add(QUEUE_WAIT, queued_s, task=step)
        for each in attempts:
            self._made(each)

    def _made(self, report: object) -> None:
        if isinstance(report, Prepared | Reconstructed | Attempted):
            for stage, spent in report.seconds.items():
                self._add(STAGE_SECONDS, spent, stage=stage)
                self._add(STAGE_SPENT, spent, stage=stage)
        if isinstance(report, Prepared):
            self._looked_up("prepared", report.from_cache)
        elif isinstance(report, Reconstructed):
            self._looked_up("block", report.from_cache)
            self._psnr("block", report.psnr_db)
        elif isinstance(report, Attempted):
            self._looked_up("scene", report.scene_at_hand)
            if report.rejected is None:
                self._psnr("sample", report.psnr_db)

    def accepted(self, expert: str, round: int) -> None:
        """An attempt became a sample that is on its way to the table."""
        self._add(OUTCOMES, 1, kind=Kind.ACCEPTED.value, expert=expert, round=str(round), stage="", reason="")

    def outcome(self, outcome: Outcome, round: int | None) -> None:
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

    def committed(self, shards: Sequence[Shard], seconds: float) -> None:
        """A batch is in the tables."""
        self._add(COMMIT_SECONDS, seconds)
        for shard in shards:
            where = {"expert": shard.partition["expert"], "round": shard.partition["round"]}
            self._add(SAMPLES, len(shard.keys), **where)
            self._add(BYTES, shard.size, **where)

    def state(self, clips: int, left: int, in_flight: Mapping[str, int], last: bool = False) -> None:
        """How things stand; may be called as often as one likes, and at the end."""
        now = self._clock()
        if last or now - self._gauges_at >= GAUGES_EVERY_S:
            self._gauges_at = now
            self._add(CLIPS, clips)
            self._add(CLIPS_LEFT, left)
            for what, n in in_flight.items():
                self._add(IN_FLIGHT, n, what=what)
        if self._out.is_local and now - self._disk_at >= DISK_EVERY_S:
            self._disk_at = now
            disk = shutil.disk_usage(self._out.uri)
            self._add(DISK, disk.total)
            self._add(DISK_FREE, disk.free)

    def _looked_up(self, cache: str, hit: bool | None) -> None:
        if hit is not None:
            self._add(LOOKUPS, 1, cache=cache, hit=str(hit).lower())

    def _psnr(self, of: str, psnr_db: float | None) -> None:
        if psnr_db is not None and math.isfinite(psnr_db):
            self._add(PSNR, psnr_db, of=of)

    def _add(self, metric: Metric, value: float, **labels: str) -> None:
        if value > 0 or metric.type is not Type.COUNTER:
            self._recorder.record(metric, value, {"run": self._out.uri, **labels})

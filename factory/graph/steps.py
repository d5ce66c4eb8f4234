"""The tasks of the graph as plain functions, and the work that they ask for: one small protocol.

Each task returns (report, result): the small report goes to the driver, the large result stays where it was made and is
handed to other tasks by reference. The local executor calls the tasks, the Ray executor ships them to workers. What a
stage raises becomes a Failure here and nowhere else.
"""

import hashlib
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol, TypeVar

import pyarrow as pa

from factory.files import machine_fault_of, raising_place_refused, why_disk_full
from factory.readers.base import BadClip, ClipRef, Unreadable
from factory.store.episodes import EPISODES_FOLDER, episode_name
from factory.store.location import BadCacheFile, ClipCache, Location, SceneFiles, Shard, write_shard
from factory.store.reader import read_samples
from factory.store.samples import CandidateRow, ErrorKind
from factory.store.schema import SAMPLES, RunIdentity, Stamp, sample_rows_to_table
from factory.wording import one_line
from tasks.stages import ATTEMPT, Rejected
from tasks.world.repair.records import Repair, RepairCount

if TYPE_CHECKING:
    from tasks.hard_scenes import BenchmarkClip


# The seam between the science and the machine: what a run executes.
#
# The executors know clips, candidates and attempts only through `Work`. It is picklable and pure given its arguments:
# whatever the worker, the order or the retry, the same arguments give the same result.

HUMAN_CANDIDATE = -1  # the only candidate index of experts that are tried once: the log itself

StopCheck = Callable[[], bool]  # whether the run was asked to stop: a long task looks now and then


def never_stop() -> bool:
    """For who is not asked to stop."""
    return False


class TaskStopped(Exception):
    """A long task left off because the run was asked to stop; what it has done is kept, and the next one goes on."""


class NotReady(ValueError):
    """This machine lacks what the run needs of it; the message says what, and how to give it."""


@dataclass(frozen=True)
class Spent:
    """Time in a stage, of one task or of several."""

    wall_s: float = 0.0
    cpu_s: float = 0.0  # of all threads of the process

    @staticmethod
    def now() -> "Spent":
        """By this process's clocks; a later one less an earlier one is what was spent."""
        return Spent(time.perf_counter(), time.process_time())

    def __add__(self, more: "Spent") -> "Spent":
        return Spent(self.wall_s + more.wall_s, self.cpu_s + more.cpu_s)

    def __sub__(self, before: "Spent") -> "Spent":
        return Spent(self.wall_s - before.wall_s, self.cpu_s - before.cpu_s)

    def __truediv__(self, n: int) -> "Spent":
        return Spent(self.wall_s / n, self.cpu_s / n)


@dataclass(frozen=True)
class PreparedClip:
    """The stages `clip` and `perturb` of one clip: everything its attempts need."""

    clip_id: str
    content_digest: str
    candidates: tuple[CandidateRow, ...]  # empty: no simulated expert has anything to try
    gate_counts: Mapping[str, int]  # gate -> vocabulary entries it dropped, in the gates' order
    payload: object  # tree of frozen dataclasses, dicts, tuples, numpy arrays and scalars (factory.store.location)
    dropped: Rejected | None = None  # why there are no candidates; the human row is scored all the same
    seconds: Mapping[str, Spent] = field(default_factory=dict)  # by stage
    scenes: "BenchmarkClip | None" = None  # to be kept beside the tables before any row of the clip is
    repairs: tuple[RepairCount, ...] = ()  # in what it was read from
    repair_records: tuple[Repair, ...] = ()  # the same one by one, factory.store.samples.MOST_RECORDS at most


@dataclass(frozen=True)
class AcceptedDrive:
    """A drive that the reward accepts, on its way to a sample: all that it takes to draw and to label it."""

    payload: object  # the work's own; it can be pickled
    seconds: Mapping[str, Spent] = field(default_factory=dict)  # by stage


@dataclass(frozen=True)
class SampleColumns:
    """Some columns of a sample, of factory.store.schema less the ones in its BOOKKEEPING."""

    row: Mapping[str, object]
    seconds: Mapping[str, Spent] = field(default_factory=dict)  # by stage
    scene_at_hand: bool | None = None  # the worker had the scene to draw in its memory; None: nothing was drawn


@dataclass(frozen=True)
class RejectedAttempt:
    """An attempt that was turned down."""

    rejected: Rejected
    subscores: Mapping[str, float] = field(default_factory=dict)  # as far as they were computed
    seconds: Mapping[str, Spent] = field(default_factory=dict)
    scene_at_hand: bool | None = None


@dataclass(frozen=True)
class BlockReport:
    """A clip's block is in this machine's cache."""

    seconds: Mapping[str, Spent]  # by stage
    from_cache: bool  # it was there
    psnr_db: float | None = None  # of its held-out photos; None where there are none


class Work(Protocol):
    """What a run does with a clip. Implementations hold reader, settings and tables, and nothing that changes."""

    @property
    def identity(self) -> RunIdentity: ...

    def warm(self, draws: bool = True) -> None:
        """Compile the kernels into their cache. Called once per machine before any worker starts.

        draws: attempts are made on this machine, so that it must have what they draw with.
        Raises NotReady.
        """
        ...

    def once(self, expert: str) -> bool:
        """Whether the expert has one attempt, candidate -1 in round 0, whatever the candidates and rounds."""
        ...

    def expert_digest(self, expert: str) -> str:
        """Of the expert's inputs and settings."""
        ...

    def content_digest(self, ref: ClipRef) -> str | None:
        """Of what the clip would be read from now, without preparing it; None where the reader cannot tell."""
        ...

    def block(self, ref: ClipRef) -> str | None:
        """Name of the block that the clip is rendered from, known without reading it; None: nothing to build ahead."""
        ...

    def reconstruct(self, ref: ClipRef, threads: int, stopped: StopCheck = never_stop) -> BlockReport:
        """Build the clip's block into this machine's cache. Raises BadClip, TaskStopped soon after `stopped`."""
        ...

    def doing(self) -> str:
        """How far long tasks on this machine are, for a progress line; empty where there are none."""
        ...

    def prepare(self, ref: ClipRef) -> PreparedClip | Rejected:
        """Read the clip and list its candidates. Rejected: the clip stage drops it for every expert.

        Raises BadClip for broken input, also for a ref whose log the index called broken.
        """
        ...

    def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
        """Rollout, expert, rollout and reward of one candidate."""
        ...

    def draw(self, driven: Sequence[AcceptedDrive]) -> list[SampleColumns | RejectedAttempt]:
        """Of each of a clip's drives the columns of its pictures and the `tags` they add; RejectedAttempt where the
        pictures are no sample's.
        """
        ...

    def label(self, driven: AcceptedDrive) -> SampleColumns:
        """All other columns."""
        ...


@dataclass(frozen=True)
class PartialAttempt:
    """An attempt that some stages are done of."""

    driven: AcceptedDrive
    drawn: SampleColumns | None = None


def run_stage(
    work: Work, stage: str, so_far: PreparedClip | PartialAttempt, candidate: int, expert: str
) -> PartialAttempt | SampleColumns | RejectedAttempt:
    """The next stage of an attempt (tasks.stages.ATTEMPT) from where it stands.

    SampleColumns: the sample's. Seconds are those of all stages so far.
    """
    if stage == "drive":
        assert isinstance(so_far, PreparedClip)
        driven = work.drive(so_far, candidate, expert)
        return driven if isinstance(driven, RejectedAttempt) else PartialAttempt(driven)
    assert isinstance(so_far, PartialAttempt)
    driven, drawn = so_far.driven, so_far.drawn
    if stage == "render":
        (found,) = work.draw([driven])
        return _drawn(driven, found)
    assert stage == "label" and drawn is not None
    labelled = work.label(driven)
    tags = [*labelled.row["tags"], *drawn.row.get("tags", ())]  # type: ignore[misc]
    seconds = {**driven.seconds, **drawn.seconds, **labelled.seconds}
    return SampleColumns({**labelled.row, **drawn.row, "tags": tags}, seconds, drawn.scene_at_hand)


def _drawn(driven: AcceptedDrive, found: SampleColumns | RejectedAttempt) -> PartialAttempt | RejectedAttempt:
    if isinstance(found, RejectedAttempt):
        return replace(found, seconds={**driven.seconds, **found.seconds})
    return PartialAttempt(driven, found)


def run_attempt(work: Work, prepared: PreparedClip, candidate: int, expert: str) -> SampleColumns | RejectedAttempt:
    """One attempt, whole."""
    so_far: PreparedClip | PartialAttempt = prepared
    for stage in ATTEMPT:
        result = run_stage(work, stage, so_far, candidate, expert)
        if not isinstance(result, PartialAttempt):
            return result
        so_far = result
    raise AssertionError(f"{ATTEMPT[-1]} does not end an attempt")


P = ParamSpec("P")
R = TypeVar("R")
ERROR_LINES = 12  # of a traceback that an outcome keeps


@dataclass(frozen=True)
class Failure:
    """An incident instead of a report."""

    kind: ErrorKind
    error: str
    disk_full: str = ""  # what a full disk said: nothing more can be written, and nothing failed by itself
    task: str = ""  # of an attempt, where it is known (tasks.stages.ATTEMPT)


@dataclass(frozen=True)
class PrepareReport:
    """Report on a prepared clip."""

    clip: PreparedClip  # without what its attempts alone need
    from_cache: bool
    note: str = ""  # why the cache was of no use, where a file was there
    uncached: str = ""  # why it could not be kept for later runs
    seconds: Mapping[str, Spent] = field(default_factory=dict)


@dataclass(frozen=True)
class BlockUnfinished:
    """Report on a block that is not finished because the run stops; the next run goes on with it."""


@dataclass(frozen=True)
class AttemptUnfinished:
    """Report on an attempt whose further stages are another task; the result is what that starts from."""

    seconds: tuple[float, ...] = ()  # of a batch, that each took


@dataclass(frozen=True)
class AttemptReport:
    """Report on an attempt."""

    rejected: Rejected | None  # None: accepted, and the result is the row
    n_bytes: int = 0  # of the row
    licence: str = ""  # of its source
    subscores: Mapping[str, float] = field(default_factory=dict)
    seconds: Mapping[str, Spent] = field(default_factory=dict)
    scene_at_hand: bool | None = None
    psnr_db: float | None = None  # of the block that an accepted one is drawn from


@dataclass(frozen=True)
class BatchReport:
    """Report on a batch of a walk: one attempt after the other, the last one perhaps a failure."""

    reports: tuple[AttemptReport | Failure, ...]
    seconds: tuple[float, ...]  # that each took


@dataclass(frozen=True)
class PartialBatch:
    """A batch of a walk that some stages are done of: its attempts from the first on, as far as they have come."""

    clip_id: str
    attempts: tuple[PartialAttempt | AttemptReport | Failure, ...]  # the last one perhaps a failure


MakeEpisode = Callable[[Mapping[str, Any], PreparedClip], bytes]  # a sample's row and its prepared clip -> a file


@dataclass(frozen=True)
class EpisodeBatch:
    """Samples of one committed file whose episodes are to be written."""

    path: str  # in the table `samples`
    partition: Mapping[str, str]
    refs: Mapping[str, ClipRef]  # attempt_id -> its clip
    make: MakeEpisode


@dataclass(frozen=True)
class EpisodesReport:
    """Report on them: files that stand now, and why others do not."""

    written: int
    errors: tuple[str, ...] = ()


def cache_key(clip_id: str, prepare_digest: str) -> str:
    """File name of a prepared clip."""
    return f"{clip_id}-{hashlib.sha256(prepare_digest.encode()).hexdigest()[:16]}"


def failure_from_error(error: BaseException) -> Failure:
    """Broken input, an ailing machine, what may be either, or a bug; with the last lines of the traceback."""
    if isinstance(error, BadClip) and not isinstance(error, Unreadable):
        return Failure(ErrorKind.INPUT, str(error))
    raised = error.__cause__ if isinstance(error, Unreadable) else error
    kind = ErrorKind.SYSTEM if isinstance(raised, OSError | MemoryError) else ErrorKind.BUG
    kind = ErrorKind.MACHINE if machine_fault_of(error) else kind
    lines = "".join(traceback.format_exception(error)).strip().splitlines()
    return Failure(kind, "\n".join(lines[-ERROR_LINES:]), why_disk_full(error))


def reporting_failures(task: Callable[P, R]) -> Callable[P, R]:
    """The boundary where whatever a stage or a user's code raises, SystemExit too, becomes data: a Failure's report."""

    @wraps(task)
    def reported(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return task(*args, **kwargs)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            trace = error.__traceback__
            return failure_from_error(error.with_traceback(trace and trace.tb_next)), None  # type: ignore[return-value]

    return reported


@reporting_failures
def prepare(
    work: Work, out: Location, ref: ClipRef, wanted_content: str | None = None
) -> tuple[PrepareReport | Rejected | Failure, PreparedClip | None]:
    """The clip from the cache, else prepared and cached; wanted_content: the digest that its stored rows are made of.

    A log that was changed is an input failure where its rows are to be continued, else its cached clip is not used.
    """
    cache, key = ClipCache(out.child("cache/prepared")), cache_key(ref.clip_id, work.identity.prepare_digest)
    note, began = "", Spent.now()
    try:
        stored = cache.load(key)
    except BadCacheFile as error:
        stored, note = None, f"cache file {key}: {error}; prepared again"
    except OSError as error:
        stored, note = None, f"cache file {key}: cannot be read: {one_line(error)}; prepared again"
    if isinstance(stored, PreparedClip) and stored.repairs and work.identity.settings.get("repairs") == "refuse":
        stored = None  # kept by a run that made them; this one reads the clip, and refuses it
    found = work.content_digest(ref) if stored is not None or wanted_content is not None else None
    _refuse_changed(ref, found, wanted_content)
    if isinstance(stored, PreparedClip) and found not in (None, stored.content_digest):
        stored, note = None, f"cache file {key}: log {ref.log_id} was changed since; prepared again"
    if isinstance(stored, PreparedClip):
        _refuse_changed(ref, stored.content_digest, wanted_content)
        _keep_scenes(out, stored)
        seconds = {"cache": Spent.now() - began}
        return PrepareReport(replace(stored, payload=None, scenes=None), True, note, "", seconds), stored
    result = work.prepare(ref)
    if isinstance(result, Rejected):
        _refuse_changed(ref, f"none ({result.reason})", wanted_content)  # the clip had candidates
        return result, None
    if result.clip_id != ref.clip_id:
        raise ValueError(f"prepare({ref.clip_id}) returned clip {result.clip_id}")
    _refuse_changed(ref, result.content_digest, wanted_content)
    uncached = ""
    try:
        cache.store(key, result)
    except OSError as error:  # a result that could not be cached is still a result
        uncached = f"{cache.location.uri}: {one_line(error)}"
    _keep_scenes(out, result)
    return PrepareReport(replace(result, payload=None, scenes=None), False, note, uncached, result.seconds), result


def _keep_scenes(out: Location, clip: PreparedClip) -> None:
    """Before any attempt, so that no row stands without them; written anew each time, they may be of older settings."""
    if clip.scenes is not None:
        scenes = out.child("scenes")
        with raising_place_refused(scenes.uri):
            SceneFiles(scenes).store(clip.scenes)


def _refuse_changed(ref: ClipRef, found: str | None, wanted: str | None) -> None:
    if None not in (found, wanted) and found != wanted:
        problem = f"content digest {found} where the table has {wanted} for clip {ref.clip_id}: the log was changed"
        raise BadClip(f"log {ref.log_id}", "clip", f"{problem}; restore it or choose another out")


def attempt(
    work: Work, stages: Sequence[str], so_far: PreparedClip | PartialAttempt, stamp: Stamp
) -> tuple[AttemptReport | AttemptUnfinished | Failure, pa.Table | PartialAttempt | None]:
    """Some stages of one attempt, from where it stands; an accepted one is checked against the schema here, where its
    traceback still means something."""
    began, stage = Spent.now(), ""
    try:
        for stage in stages:
            result = run_stage(work, stage, so_far, stamp.candidate_index, stamp.expert)
            if not isinstance(result, PartialAttempt):
                break
            so_far = result
        if isinstance(result, PartialAttempt):
            return AttemptUnfinished(), result
        seconds = result.seconds or {"attempt": Spent.now() - began}
        if isinstance(result, RejectedAttempt):
            return _rejection(result, seconds), None
        row = sample_rows_to_table([{**result.row, **vars(stamp)}])
        (psnr_db,) = row["psnr"].to_pylist()
        report = AttemptReport(
            None,
            row.nbytes,
            str(result.row["licence"]),
            seconds=seconds,
            scene_at_hand=result.scene_at_hand,
            psnr_db=psnr_db,
        )
        return report, row
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the same boundary
        return replace(failure_from_error(error), task=stage), None


def _rejection(result: RejectedAttempt, seconds: Mapping[str, Spent]) -> AttemptReport:
    subscores, at_hand = dict(result.subscores), result.scene_at_hand
    return AttemptReport(result.rejected, subscores=subscores, seconds=seconds, scene_at_hand=at_hand)


@reporting_failures
def draw_together(
    work: Work, parts: Sequence[PartialAttempt]
) -> tuple[Failure | None, list[tuple[AttemptReport | AttemptUnfinished, PartialAttempt | None]] | None]:
    """The stage `render` of several attempts on a clip at once: of each what `attempt` says of one."""
    found = [_drawn(part.driven, one) for part, one in zip(parts, work.draw([p.driven for p in parts]), strict=True)]
    return None, [
        (AttemptUnfinished(), one) if isinstance(one, PartialAttempt) else (_rejection(one, one.seconds), None)
        for one in found
    ]


def write(out: Location, *rows: pa.Table) -> tuple[Shard | Failure, None]:
    """Rows of one partition as one shard."""
    try:
        return write_shard(out.child("samples"), SAMPLES, pa.concat_tables(rows)), None
    except OSError as error:
        return failure_from_error(error), None


@reporting_failures
def episodes(work: Work, out: Location, wanted: EpisodeBatch) -> tuple[EpisodesReport | Failure, None]:
    """Committed samples as MCAP files beside their table; the log's drive comes from the prepared clip."""
    written, errors = 0, []
    for row in read_samples(out.child("samples"), wanted.path, wanted.partition, wanted.refs):
        key = row["attempt_id"]
        report, clip = prepare(work, out, wanted.refs[key], row["content_digest"])
        if clip is None:
            errors.append(f"clip {row['clip_id']}: {report.error if isinstance(report, Failure) else report}")
            continue
        try:
            out.child(EPISODES_FOLDER).write(episode_name(row), wanted.make(row, clip))
            written += 1
        except Exception as error:  # one that cannot be made costs no other
            errors.append(f"sample {key}: {failure_from_error(error).error.splitlines()[-1]}")
    return EpisodesReport(written, tuple(errors)), None


@reporting_failures
def reconstruct(
    work: Work, stopped: StopCheck, ref: ClipRef, threads: int
) -> tuple[BlockReport | BlockUnfinished | Failure, None]:
    """The block that the clip is rendered from, into the cache of this machine."""
    if stopped():  # before its sensors are read
        return BlockUnfinished(), None
    try:
        return work.reconstruct(ref, threads, stopped), None
    except TaskStopped:
        return BlockUnfinished(), None


@reporting_failures
def warm(work: Work, draws: bool) -> tuple[str | Failure, None]:
    """Kernels into the cache of this machine."""
    try:
        work.warm(draws)
    except NotReady as error:
        return Failure(ErrorKind.INPUT, str(error)), None
    return "", None

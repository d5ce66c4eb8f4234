"""The tasks of the graph as plain functions; the local executor calls them, the Ray executor ships them to workers.

Each returns (report, result): the small report goes to the driver, the large result stays where it was made and is
handed to other tasks by reference. What a stage raises becomes a Failure here and nowhere else.
"""

import hashlib
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pyarrow as pa

from factory.graph.work import (
    NotReady,
    PartialAttempt,
    PreparedClip,
    RejectedAttempt,
    StopCheck,
    TaskStopped,
    Work,
    go_on,
)
from factory.readers.base import BadClip, ClipRef, Unreadable
from factory.store.attempts import ErrorKind
from factory.store.cache import BadCacheFile, ClipCache, SceneFiles
from factory.store.disk import machine_fault_of, refused_as_the_runs_own, why_disk_full
from factory.store.location import Location
from factory.store.mcap_files import FOLDER, episode_name, write_mcap_shard
from factory.store.parquet_file import Shard, write_shard
from factory.store.reader import samples_of
from factory.store.schema import SAMPLES, Stamp, sample_row_to_table
from factory.wording import one_line
from tasks.stages import Rejected

ERROR_LINES = 12  # of a traceback that an outcome keeps


@dataclass(frozen=True)
class Failure:
    """An incident instead of a report."""

    kind: ErrorKind
    error: str
    disk_full: str = ""  # what a full disk said: nothing more can be written, and nothing failed by itself
    task: str = ""  # of an attempt, where it is known (tasks.stages.ATTEMPT)


@dataclass(frozen=True)
class Prepared:
    """Report on a prepared clip."""

    clip: PreparedClip  # without what its attempts alone need
    from_cache: bool
    note: str = ""  # why the cache was of no use, where a file was there
    uncached: str = ""  # why it could not be kept for later runs
    seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Reconstructed:
    """Report on a block that is in the cache now."""

    seconds: Mapping[str, float]
    from_cache: bool
    psnr_db: float | None


@dataclass(frozen=True)
class HalfBuilt:
    """Report on a block that is not finished because the run stops; the next run goes on with it."""


@dataclass(frozen=True)
class HandedOn:
    """Report on an attempt whose further stages are another task; the result is what that starts from."""


@dataclass(frozen=True)
class Attempted:
    """Report on an attempt."""

    rejected: Rejected | None  # None: accepted, and the result is the row
    n_bytes: int = 0  # of the row
    licence: str = ""  # of its source
    subscores: Mapping[str, float] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    scene_at_hand: bool | None = None
    psnr_db: float | None = None  # of the block that an accepted one is drawn from


@dataclass(frozen=True)
class Walked:
    """Report on a stretch of a walk: one attempt after the other, the last one perhaps a failure."""

    reports: tuple[Attempted | Failure, ...]
    seconds: tuple[float, ...]  # that each took


MakeEpisode = Callable[[Mapping[str, Any], PreparedClip], bytes]  # a sample's row and its prepared clip -> a file


@dataclass(frozen=True)
class EpisodesOf:
    """Samples of one committed file whose episodes are to be written."""

    path: str  # in the table `samples`
    partition: Mapping[str, str]
    refs: Mapping[str, ClipRef]  # attempt_id -> its clip
    make: MakeEpisode


@dataclass(frozen=True)
class EpisodesWritten:
    """Report on them: files that stand now, and why others do not."""

    written: int
    errors: tuple[str, ...] = ()


def cache_key(clip_id: str, prepare_digest: str) -> str:
    """File name of a prepared clip."""
    return f"{clip_id}-{hashlib.sha256(prepare_digest.encode()).hexdigest()[:16]}"


def prepare(
    work: Work, out: Location, ref: ClipRef, wanted_content: str | None = None
) -> tuple[Prepared | Rejected | Failure, PreparedClip | None]:
    """The clip from the cache, else prepared and cached; wanted_content: the digest that its stored rows are made of.

    A log that was changed is an input failure where its rows are to be continued, else its cached clip is not used.
    """
    cache, key = ClipCache(out.child("cache/prepared")), cache_key(ref.clip_id, work.identity.prepare_digest)
    note, began = "", time.perf_counter()
    try:
        try:
            stored = cache.load(key)
        except BadCacheFile as error:
            stored, note = None, f"cache file {key}: {error}; prepared again"
        except OSError as error:
            stored, note = None, f"cache file {key}: cannot be read: {one_line(error)}; prepared again"
        found = work.content_digest(ref) if stored is not None or wanted_content is not None else None
        _refuse_changed(ref, found, wanted_content)
        if isinstance(stored, PreparedClip) and found not in (None, stored.content_digest):
            stored, note = None, f"cache file {key}: log {ref.log_id} was changed since; prepared again"
        if isinstance(stored, PreparedClip):
            _refuse_changed(ref, stored.content_digest, wanted_content)
            _keep_scenes(out, stored)
            seconds = {"cache": time.perf_counter() - began}
            return Prepared(replace(stored, payload=None, scenes=None), True, note, "", seconds), stored
        result = work.prepare(ref)
        if isinstance(result, Rejected):
            _refuse_changed(ref, f"none ({result.reason})", wanted_content)  # the clip had candidates
            return result, None
        if result.clip_id != ref.clip_id:
            raise ValueError(f"prepare({ref.clip_id}) returned clip {result.clip_id}")
        _refuse_changed(ref, result.content_digest, wanted_content)
        uncached = _why_uncached(cache, key, result)
        _keep_scenes(out, result)
        return Prepared(replace(result, payload=None, scenes=None), False, note, uncached, result.seconds), result
    except KeyboardInterrupt:
        raise
    except (
        BaseException
    ) as error:  # the boundary where whatever a stage or a user's code raises, SystemExit too, becomes data
        return failure_of(error), None


def _why_uncached(cache: ClipCache, key: str, clip: PreparedClip) -> str:
    """Keep a prepared clip; what stopped that, if anything did: a result that could not be cached is still a result."""
    try:
        cache.store(key, clip)
    except OSError as error:
        return f"{cache.location.uri}: {one_line(error)}"
    return ""


def _keep_scenes(out: Location, clip: PreparedClip) -> None:
    """Before any attempt, so that no row stands without them; written anew each time, they may be of older settings."""
    if clip.scenes is not None:
        scenes = out.child("scenes")
        with refused_as_the_runs_own(scenes.uri):
            SceneFiles(scenes).store(clip.scenes)


def _refuse_changed(ref: ClipRef, found: str | None, wanted: str | None) -> None:
    if None not in (found, wanted) and found != wanted:
        problem = f"content digest {found} where the table has {wanted} for clip {ref.clip_id}: the log was changed"
        raise BadClip(f"log {ref.log_id}", "clip", f"{problem}; restore it or choose another out")


def attempt(
    work: Work, stages: Sequence[str], so_far: PreparedClip | PartialAttempt, stamp: Stamp
) -> tuple[Attempted | HandedOn | Failure, pa.Table | PartialAttempt | None]:
    """Some stages of one attempt, from where it stands; an accepted one is checked against the schema here, where its
    traceback still means something."""
    began, stage = time.perf_counter(), ""
    try:
        for stage in stages:
            result = go_on(work, stage, so_far, stamp.candidate_index, stamp.expert)
            if not isinstance(result, PartialAttempt):
                break
            so_far = result
        if isinstance(result, PartialAttempt):
            return HandedOn(), result
        seconds = result.seconds or {"attempt": time.perf_counter() - began}
        if isinstance(result, RejectedAttempt):
            subscores, at_hand = dict(result.subscores), result.scene_at_hand
            return Attempted(result.rejected, subscores=subscores, seconds=seconds, scene_at_hand=at_hand), None
        row = sample_row_to_table([{**result.row, **vars(stamp)}])
        (psnr_db,) = row["psnr"].to_pylist()
        report = Attempted(
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
        return replace(failure_of(error), task=stage), None


def write(out: Location, *rows: pa.Table) -> tuple[Shard | Failure, None]:
    """Rows of one partition as one shard."""
    try:
        return write_shard(out.child("samples"), SAMPLES, pa.concat_tables(rows)), None
    except OSError as error:
        return failure_of(error), None


def episodes(work: Work, out: Location, wanted: EpisodesOf) -> tuple[EpisodesWritten | Failure, None]:
    """Committed samples as MCAP files beside their table; the log's drive comes from the prepared clip."""
    written, errors = 0, []
    try:
        for row in samples_of(out.child("samples"), wanted.path, wanted.partition, wanted.refs):
            key = row["attempt_id"]
            report, clip = prepare(work, out, wanted.refs[key], row["content_digest"])
            if clip is None:
                errors.append(f"clip {row['clip_id']}: {report.error if isinstance(report, Failure) else report}")
                continue
            try:
                out.child(FOLDER).write(episode_name(row), wanted.make(row, clip))
                written += 1
            except Exception as error:  # one that cannot be made costs no other
                errors.append(f"sample {key}: {failure_of(error).error.splitlines()[-1]}")
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the same boundary
        return failure_of(error), None
    return EpisodesWritten(written, tuple(errors)), None


def mcap_shard(out: Location, path: str, partition: Mapping[str, str]) -> tuple[Shard | Failure, None]:
    """A committed shard of samples as an MCAP shard, to be committed."""
    try:
        return write_mcap_shard(out, path, partition), None
    except OSError as error:
        return failure_of(error), None


def reconstruct(
    work: Work, stopped: StopCheck, ref: ClipRef, threads: int
) -> tuple[Reconstructed | HalfBuilt | Failure, None]:
    """The block that the clip is rendered from, into the cache of this machine."""
    if stopped():  # before its sensors are read
        return HalfBuilt(), None
    try:
        built = work.reconstruct(ref, threads, stopped)
        return Reconstructed(built.seconds, built.from_cache, built.psnr_db), None
    except TaskStopped:
        return HalfBuilt(), None
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the same boundary
        return failure_of(error), None


def warm(work: Work, draws: bool) -> tuple[str | Failure, None]:
    """Kernels into the cache of this machine."""
    try:
        work.warm(draws)
    except NotReady as error:
        return Failure(ErrorKind.INPUT, str(error)), None
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the same boundary
        return failure_of(error), None
    return "", None


def failure_of(error: BaseException) -> Failure:
    """Broken input, an ailing machine, what may be either, or a bug; with the last lines of the traceback."""
    if isinstance(error, BadClip) and not isinstance(error, Unreadable):
        return Failure(ErrorKind.INPUT, str(error))
    raised = error.__cause__ if isinstance(error, Unreadable) else error
    kind = ErrorKind.SYSTEM if isinstance(raised, OSError | MemoryError) else ErrorKind.BUG
    kind = ErrorKind.MACHINE if machine_fault_of(error) else kind
    lines = "".join(traceback.format_exception(error)).strip().splitlines()
    return Failure(kind, "\n".join(lines[-ERROR_LINES:]), why_disk_full(error))

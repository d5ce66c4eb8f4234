"""The seam between the science and the machine: what a run executes, said as one small protocol.

The executors know clips, candidates and attempts only through `Work`. It is picklable and pure given its arguments:
whatever the worker, the order or the retry, the same arguments give the same result.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

from factory.readers.base import ClipRef
from factory.store.attempts import CandidateRow
from factory.store.schema import RunIdentity
from tasks.stages import ATTEMPT, Rejected

if TYPE_CHECKING:
    from tasks.hard_scenes import BenchmarkClip

HUMAN_CANDIDATE = -1  # the only candidate index of experts that are tried once: the log itself

StopCheck = Callable[[], bool]  # whether the run was asked to stop: a long task looks now and then


def never() -> bool:
    """For who is not asked to stop."""
    return False


class TaskStopped(Exception):
    """A long task left off because the run was asked to stop; what it has done is kept, and the next one goes on."""


class NotReady(ValueError):
    """This machine lacks what the run needs of it; the message says what, and how to give it."""


@dataclass(frozen=True)
class PreparedClip:
    """The stages `clip` and `perturb` of one clip: everything its attempts need."""

    clip_id: str
    content_digest: str
    candidates: tuple[CandidateRow, ...]  # empty: no simulated expert has anything to try
    gate_counts: Mapping[str, int]  # gate -> vocabulary entries it dropped, in the gates' order
    payload: object  # tree of frozen dataclasses, dicts, tuples, numpy arrays and scalars (factory.store.cache)
    dropped: Rejected | None = None  # why there are no candidates; the human row is scored all the same
    seconds: Mapping[str, float] = field(default_factory=dict)  # stage -> seconds
    scenes: "BenchmarkClip | None" = None  # to be kept beside the tables before any row of the clip is


@dataclass(frozen=True)
class AcceptedDrive:
    """A drive that the reward accepts, on its way to a sample: all that it takes to draw and to label it."""

    payload: object  # the work's own; it can be pickled
    seconds: Mapping[str, float] = field(default_factory=dict)  # stage -> seconds


@dataclass(frozen=True)
class Columns:
    """Some columns of a sample, of factory.store.schema less the ones in its BOOKKEEPING."""

    row: Mapping[str, object]
    seconds: Mapping[str, float] = field(default_factory=dict)  # stage -> seconds
    scene_at_hand: bool | None = None  # the worker had the scene to draw in its memory; None: nothing was drawn


@dataclass(frozen=True)
class RejectedAttempt:
    """An attempt that was turned down."""

    rejected: Rejected
    subscores: Mapping[str, float] = field(default_factory=dict)  # as far as they were computed
    seconds: Mapping[str, float] = field(default_factory=dict)
    scene_at_hand: bool | None = None


@dataclass(frozen=True)
class Built:
    """A clip's block is in this machine's cache."""

    seconds: Mapping[str, float]  # by stage
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

    def reconstruct(self, ref: ClipRef, threads: int, stopped: StopCheck = never) -> Built:
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

    def draw(self, driven: AcceptedDrive) -> Columns | RejectedAttempt:
        """The columns of its pictures and the `tags` they add; RejectedAttempt where the pictures are no sample's."""
        ...

    def label(self, driven: AcceptedDrive) -> Columns:
        """All other columns."""
        ...


@dataclass(frozen=True)
class PartialAttempt:
    """An attempt that some stages are done of."""

    driven: AcceptedDrive
    drawn: Columns | None = None


def go_on(
    work: Work, stage: str, so_far: PreparedClip | PartialAttempt, candidate: int, expert: str
) -> PartialAttempt | Columns | RejectedAttempt:
    """The next stage of an attempt (tasks.stages.ATTEMPT) from where it stands.

    Columns: the sample's. Seconds are those of all stages so far.
    """
    if stage == "drive":
        assert isinstance(so_far, PreparedClip)
        driven = work.drive(so_far, candidate, expert)
        return driven if isinstance(driven, RejectedAttempt) else PartialAttempt(driven)
    assert isinstance(so_far, PartialAttempt)
    driven, drawn = so_far.driven, so_far.drawn
    if stage == "render":
        found = work.draw(driven)
        if isinstance(found, RejectedAttempt):
            return replace(found, seconds={**driven.seconds, **found.seconds})
        return PartialAttempt(driven, found)
    assert stage == "label" and drawn is not None
    labelled = work.label(driven)
    tags = [*labelled.row["tags"], *drawn.row.get("tags", ())]  # type: ignore[misc]
    seconds = {**driven.seconds, **drawn.seconds, **labelled.seconds}
    return Columns({**labelled.row, **drawn.row, "tags": tags}, seconds, drawn.scene_at_hand)


def attempted(work: Work, prepared: PreparedClip, candidate: int, expert: str) -> Columns | RejectedAttempt:
    """One attempt, whole."""
    so_far: PreparedClip | PartialAttempt = prepared
    for stage in ATTEMPT:
        result = go_on(work, stage, so_far, candidate, expert)
        if not isinstance(result, PartialAttempt):
            return result
        so_far = result
    raise AssertionError(f"{ATTEMPT[-1]} does not end an attempt")

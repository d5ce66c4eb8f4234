"""A clip's life, top to bottom: read, perturbed, driven, judged, drawn, labelled. Its row is written by factory/graph.

The stages behind the machine: what `factory.graph.steps.Work` asks for, with real clips and the science of tasks/.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from factory.graph.local import read_only
from factory.graph.steps import (
    AcceptedDrive,
    BlockReport,
    PreparedClip,
    RejectedAttempt,
    SampleColumns,
    Spent,
    StopCheck,
    never_stop,
)
from factory.readers.base import BadClip, ClipReader, ClipRef, Unreadable, painter_of, read_clip
from factory.stages.rows import NO_IMAGES, label_columns, sample_row
from factory.store.location import ClipCache
from factory.store.remake import EarlierRows
from factory.store.samples import CAMERA_LEFT_OUT, MOST_RECORDS, CandidateRow
from factory.store.schema import UNLISTED, RunIdentity, attempt_id
from tasks.attempt import (
    ExpertGate,
    Judged,
    ReadyScene,
    Timed,
    attempt,
    drive_under_log_replay,
    has_route,
    perturbed_scene,
    vocabulary_labels,
)
from tasks.experts.protocol import Expert, Human, drives_once_per_clip
from tasks.hard_scenes import BEFORE_STEPS, BenchmarkClip, drive_follow_up, frame_digest, seen_half_a_second_earlier
from tasks.perturb import NO_STARTS, Candidate, Perturbation, PerturbSettings, end_speed_mps, perturb
from tasks.render.settings import RenderMode, RenderSettings
from tasks.rollout.simulate import TrafficSettings, check_same_policy
from tasks.stages import FOLLOW_UP_BEFORE, HUMAN_BEFORE, Rejected
from tasks.subscores import OF_ONE_PLAN
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, Clip, random_stream, scene_of_clip
from tasks.world.frames import HEADING
from tasks.world.repair.records import first_repairs, repair_counts
from tasks.world.vocabulary import Vocabulary

if TYPE_CHECKING:  # else loaded by a run that draws: a third of a second
    from factory.stages.imaging import Imaging


@dataclass(frozen=True, eq=False)
class PerturbedClip:
    """The payload of a prepared clip. It is cached without its sensor files: where data lies may change."""

    ref: ClipRef
    clip: Clip
    candidates: tuple[Candidate, ...]


def logged_poses(prepared: PreparedClip) -> Array | None:
    """(81, 3) the log from T to T+2H, world frame, of a prepared clip; None of another work's."""
    payload = prepared.payload
    return _logged_poses(payload.clip.ego_states) if isinstance(payload, PerturbedClip) else None


CACHED_CLIP = ("payload", "clip")  # where in a prepared clip's file the clip is


def cached_poses(cache: ClipCache, key: str) -> Array | None:
    """The same of a prepared clip in the cache, or none. Raises BadCacheFile."""
    states = cache.load(key, within=(*CACHED_CLIP, "ego_states"))
    return _logged_poses(states) if isinstance(states, np.ndarray) else None


def _logged_poses(ego_states: Array) -> Array:
    return ego_states[NOW:, : HEADING + 1]


@dataclass(frozen=True)
class WholeClip:
    """A clip that attempts can start from, whole, and what became of its candidates."""

    clip: Clip
    found: Perturbation | Rejected  # Rejected by render or perturb: no simulated expert has anything to try
    seconds: Mapping[str, Spent]  # by stage
    cameras_left_out: tuple[str, ...] = field(default=(), kw_only=True)  # too poor in its block to be drawn

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Those that attempts start from."""
        return () if isinstance(self.found, Rejected) else self.found.candidates


TAKEN_OVER = "taken over"  # among the seconds of a remake: to look for what holds of earlier rows


class BrokenLog(BadClip):
    """A log that the index could not read; its message is the index's, which names file and field itself."""

    def __init__(self, log_id: str, said: str) -> None:
        super().__init__(log_id, "log", said)

    def __str__(self) -> str:
        return self.problem

    def __reduce__(self) -> tuple[type["BrokenLog"], tuple[str, str]]:  # type: ignore[override]
        return BrokenLog, (self.file, self.problem)


@dataclass(frozen=True)
class Drive:
    """One attempt up to the reward's verdict with everything it went through: to be drawn, labelled or explained."""

    ref: ClipRef  # the window that its sensor files are of
    candidate: Candidate | None  # None: the log's own drive
    judged: Judged | None  # None where the expert had no plan
    rejected: Rejected | None  # None: the reward accepts it
    shared: tuple[int, ...] = ()  # steps at which samples of this drive have their now, where there are several
    row_overrides: Mapping[str, object] = field(default_factory=dict)  # columns that the row has in place of its own
    sampled_instead: Judged | None = None  # as the sample tells it, where that is not `judged`
    pictures: Mapping[str, object] | None = None  # of an earlier sample of this drive, which hold; None: to be drawn
    labels: Mapping[str, object] | None = None  # likewise

    @property
    def sampled(self) -> Judged:
        """What the sample is made of."""
        assert self.judged is not None, "a drive that was accepted"
        return self.sampled_instead or self.judged


class Stopwatch:
    """What was spent, by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, Spent] = {}

    @contextmanager
    def timing(self, stage: str) -> Iterator[None]:
        """Adds the time spent inside to the stage."""
        began = Spent.now()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, Spent()) + (Spent.now() - began)


@dataclass(frozen=True)
class FactoryWork:
    """Reader, settings and tables of one run; pure given its arguments."""

    reader: ClipReader
    broken: Mapping[ClipRef, str]
    vocabulary: Vocabulary
    experts: Mapping[str, Expert]
    perturb: PerturbSettings
    traffic: TrafficSettings
    gate: ExpertGate
    labels_of: Vocabulary | None  # whose trajectories samples are labelled with; None: they have no vocabulary labels
    render: RenderSettings
    seed: int
    identity: RunIdentity
    cache_dir: str  # of reconstructed blocks
    photos_alone: bool  # clips may have photos and no lidar
    starts: Mapping[str, Array] = field(default_factory=dict, kw_only=True)  # clip_id -> (S, 40, 3) of its own
    earlier: EarlierRows | None = field(default=None, kw_only=True)  # of which a remake takes over what still holds

    # A clip is read, and perturbed into candidates.

    def prepare(self, ref: ClipRef) -> PreparedClip | Rejected:
        """Read the clip, check that its block can be rendered, list its candidates.

        In a run of experts that are tried once, on the log itself, the clip is read and nothing more: their drives need
        no block and no candidates.
        """
        made = self.read_and_perturb(ref) if self._simulates else self._log_only_clip(ref)
        return made if isinstance(made, Rejected | PreparedClip) else self.prepared_clip(ref, made)

    def _log_only_clip(self, ref: ClipRef) -> PreparedClip | Rejected:
        watch = Stopwatch()
        clip = self._read(ref, watch)
        if isinstance(clip, Rejected):
            return clip
        return PreparedClip(
            clip_id=clip.clip_id,
            content_digest=clip.content_digest,
            candidates=(),
            gate_counts={},
            payload=PerturbedClip(ref, without_sensors(clip), ()),
            seconds=watch.seconds,
            repairs=repair_counts(clip.repairs),
            repair_records=first_repairs(clip.repairs, MOST_RECORDS),
        )

    def read_and_perturb(self, ref: ClipRef) -> WholeClip | Rejected:
        """All that `prepare` decides, and every gated trajectory's fate. Rejected: for every expert. Raises BadClip."""
        watch = Stopwatch()
        clip = self._read(ref, watch)
        return clip if isinstance(clip, Rejected) else self._perturbed(clip, watch)

    def _read(self, ref: ClipRef, watch: Stopwatch) -> Clip | Rejected:
        if ref in self.broken:
            raise BrokenLog(ref.log_id, self.broken[ref])
        with watch.timing("clip"):
            clip = read_clip(self.reader, ref)
        if not has_route(clip.centerline):
            return Rejected("clip", "route_ended", "the log ends at the end of its route")
        return clip

    def _perturbed(self, clip: Clip, watch: Stopwatch) -> WholeClip:
        with watch.timing("render"):  # before perturb work is spent; without a gate only a block that will be needed
            asked = self.render.mode is RenderMode.AUTO and (self.render.refuses_blocks or self._simulates)
            block = self.imaging.block_verdict(clip) if asked else None
        self._refuse_another_policy()
        with watch.timing("perturb"):
            rng, starts = random_stream(self.seed, clip.clip_id, "perturb"), self.starts.get(clip.clip_id, NO_STARTS)
            found: Perturbation | Rejected
            if block is not None and block.fault is not None:
                found = Rejected("render", "psnr", block.fault)
            else:
                found = perturb(clip, self.vocabulary, self.perturb, self.traffic, rng, starts)
        left_out = tuple(block.left_out) if block is not None else ()
        return WholeClip(clip, found, watch.seconds, cameras_left_out=left_out)

    def prepared_clip(self, ref: ClipRef, made: WholeClip) -> PreparedClip:
        """What attempts start from."""
        clip, found = without_sensors(made.clip), made.found
        gates = found.counts if isinstance(found, Rejected) else found.gate_counts
        return PreparedClip(
            clip_id=clip.clip_id,
            content_digest=clip.content_digest,
            candidates=tuple(_candidate_row(index, candidate) for index, candidate in enumerate(made.candidates)),
            gate_counts={**gates, **{f"{CAMERA_LEFT_OUT}{name}": 1 for name in made.cameras_left_out}},
            payload=PerturbedClip(ref, clip, made.candidates),
            dropped=found if isinstance(found, Rejected) else None,
            seconds=made.seconds,
            repairs=repair_counts(clip.repairs),
            repair_records=first_repairs(clip.repairs, MOST_RECORDS),
        )

    # A candidate is driven, an expert drives on from there, and the reward judges it.

    def drive(self, prepared: PreparedClip, candidate: int, expert: str) -> AcceptedDrive | RejectedAttempt:
        """Rollout, expert, rollout and reward; candidate -1 with experts that are tried once."""
        watch, key, earlier, known = Stopwatch(), "", self.earlier, None
        if earlier is not None and not earlier.is_of(prepared.clip_id, prepared.content_digest):
            earlier = None
        if earlier is not None:
            vocabulary, digest = self.identity.vocabulary_digest, self.expert_digest(expert)
            key = attempt_id(prepared.clip_id, candidate, vocabulary, expert, digest)
            with watch.timing(TAKEN_OVER):
                known = earlier.rejection(key)
            if known is not None and earlier.is_settled(known[0], driven=False):
                return RejectedAttempt(*known, watch.seconds)
        drive = self.trace(prepared, candidate, expert, watch.timing)
        if drive.rejected is not None:
            return RejectedAttempt(drive.rejected, _subscores(drive), watch.seconds)
        if earlier is not None:
            has_one_plan = not hasattr(self.experts.get(expert), "plans")  # so this is the drive that was rejected
            if known is not None and has_one_plan and earlier.is_settled(known[0], driven=True):
                return RejectedAttempt(*known, watch.seconds)
            with watch.timing(TAKEN_OVER):
                pictures, labels = earlier.kept_columns(key, _driven_row(drive))
            drive = replace(drive, pictures=pictures, labels=labels)
        return AcceptedDrive(drive, watch.seconds)

    def trace(self, prepared: PreparedClip, candidate: int, expert: str, timed: Timed = nullcontext) -> Drive:
        """The same with nothing left out."""
        payload, driver = perturbed_clip_of(prepared), self.experts[expert]
        rng = random_stream(self.seed, prepared.clip_id, f"expert.{expert}", candidate)
        if drives_once_per_clip(driver):
            judged = drive_under_log_replay(scene_of_clip(payload.clip), driver, rng, timed)
            return Drive(payload.ref, None, judged, None)
        chosen = payload.candidates[candidate]
        self._refuse_another_policy()
        with timed("rollout"):
            ready = _ready_scene(payload, candidate, self.traffic)
        result = attempt(ready, driver, self.gate, rng, timed)
        return Drive(payload.ref, chosen, *((None, result) if isinstance(result, Rejected) else result))

    # What the reward accepts is drawn.

    def draw(self, driven: Sequence[AcceptedDrive]) -> list[SampleColumns | RejectedAttempt]:
        """Of each of a clip's drives the pictures; RejectedAttempt where they are no sample's. Raises BadClip."""
        drives, watch, before = [drive_of(one) for one in driven], Stopwatch(), self._scenes_in_memory()
        wanted = [drive for drive in drives if drive.pictures is None]
        with watch.timing("render"):
            made = iter(self._pictures(wanted) if wanted else ())
        seconds = {stage: spent / len(wanted) for stage, spent in watch.seconds.items() if wanted}
        (hits, misses), found = self._scenes_in_memory(), list[SampleColumns | RejectedAttempt]()
        at_hand = None if (hits, misses) == before else misses == before[1]  # every scene wanted; None: none was
        for drive in drives:
            pictures = next(made) if drive.pictures is None else drive.pictures
            if isinstance(pictures, Rejected):
                found.append(RejectedAttempt(pictures, _subscores(drive), seconds, at_hand))
            elif drive.pictures is None:
                found.append(SampleColumns(pictures, seconds, at_hand))
            else:
                found.append(SampleColumns(pictures))
        return found

    def _scenes_in_memory(self) -> tuple[int, int]:
        """How many scenes were in this process's memory when they were wanted, and how many were not."""
        if self.render.mode is not RenderMode.AUTO:
            return 0, 0
        from factory.stages.imaging import scene_cache_counts

        return scene_cache_counts()

    def _pictures(self, drives: Sequence[Drive]) -> list[Mapping[str, object] | Rejected]:
        """Of each of a clip's drives: those that are fit are drawn together."""
        if self.render.mode is RenderMode.NONE:
            return [NO_IMAGES for _ in drives]
        clips = [drive.sampled.scene.clip for drive in drives]
        if self.render.mode is RenderMode.AUTO:
            now = read_clip(self.reader, drives[0].ref)
            clips = [replace(clip, images=now.images, sweeps=now.sweeps, block=now.block) for clip in clips]
        found: list[Mapping[str, object] | Rejected | None] = [self.unfit(*of) for of in zip(clips, drives)]
        fit = [i for i, why in enumerate(found) if why is None]
        asked = [(clips[i], drives[i].candidate, drives[i].sampled) for i in fit]
        for i, pictures in zip(fit, self.imaging.pictures(asked), strict=True):
            found[i] = pictures
        return [one for one in found if one is not None]

    def unfit(self, clip: Clip, drive: Drive) -> Rejected | None:
        """Why the pictures of an accepted drive are no sample's; `clip` with its sensor files. Raises BadClip.

        The log's own drive is never filtered.
        """
        if drive.candidate is None or drive.judged is None:
            return None
        return self.imaging.unfit(clip, drive.candidate, drive.judged, drive.shared)

    # All else of the row; the graph writes it.

    def label(self, driven: AcceptedDrive) -> SampleColumns:
        """All but the pictures, the vocabulary labels among it."""
        watch, drive = Stopwatch(), drive_of(driven)
        judged = drive.sampled
        labels = dict(drive.labels or {})
        if self.labels_of is not None and drive.labels is None:
            with watch.timing("labels"):
                labelled = vocabulary_labels(self.labels_of, judged.scene, judged.prepared, judged.reference)
                labels = label_columns(labelled)
        return SampleColumns({**_driven_row(drive), **labels}, watch.seconds)

    # The block that a clip's pictures are drawn from is built before.

    def block(self, ref: ClipRef) -> str | None:
        """The reader's name of the clip's block; None where it has none, or this run asks nothing of blocks."""
        named = getattr(self.reader, "block", None)
        asked = self._simulates or self.render.rig.may_correct(self.photos_alone)
        if named is None or ref in self.broken or not asked or self.render.mode is not RenderMode.AUTO:
            return None
        name = named(ref)
        return None if name is None else str(name)

    def reconstruct(self, ref: ClipRef, threads: int, stopped: StopCheck = never_stop) -> BlockReport:
        """The clip's block into this machine's cache, of a run of the log's own drives what their photos need of it.

        Raises BadClip, and TaskStopped where a fit is `stopped`.
        """
        watch = Stopwatch()
        with watch.timing("reconstruct"):
            clip = read_clip(self.reader, ref)
            if not self._simulates:
                return BlockReport(watch.seconds, self.imaging.build_rig(clip))
            found, psnr_db = self.imaging.build(clip, threads, stopped)
        return BlockReport(watch.seconds, found, psnr_db)

    def doing(self) -> str:
        """The fits that are going on here."""
        if self.render.mode is not RenderMode.AUTO:
            return ""
        from factory.stages.assets import running_fits

        return "; ".join(running_fits(Path(self.cache_dir)))

    # What the machine asks beside.

    def warm(self, draws: bool = True) -> None:
        """This run's kernels, and no others, into the on-disk cache. Raises NotReady."""
        from factory.stages.warm import compile_kernels, kernel_parts

        parts = kernel_parts(self._simulates, self.traffic.mode, self.render, self.photos_alone)
        compile_kernels([part for part in parts if draws or part != "gpu"])

    @property
    def names(self) -> tuple[str, ...]:
        """Whose samples this run makes."""
        return tuple(self.experts)

    def once(self, expert: str) -> bool:
        """Whether the expert says so itself."""
        return drives_once_per_clip(self.experts[expert])

    def expert_digest(self, expert: str) -> str:
        """Of the expert's inputs and settings."""
        return self.experts[expert].digest()

    def content_digest(self, ref: ClipRef) -> str | None:
        """Of what the clip would be read from now; None where the reader cannot tell."""
        digest = getattr(self.reader, "digest", None)
        return None if digest is None else str(digest(ref))

    def _refuse_another_policy(self) -> None:
        """Raises OSError where the policy that drives is another one than the rows say."""
        check_same_policy(self.traffic, self.identity.settings.get("traffic.policy"))

    @property
    def _simulates(self) -> bool:
        return self.identity.prepare_digest != UNLISTED

    @property
    def draws_on_gpu(self) -> bool:
        """Attempts of this run draw pictures with CUDA."""
        return self.render.mode is RenderMode.AUTO and self.render.backend.on_gpu and self._simulates

    @property
    def imaging(self) -> "Imaging":
        """The render stage with this run's settings."""
        from factory.stages.imaging import Imaging

        return Imaging(self.render, self.cache_dir, painter_of(self.reader))


def without_sensors(clip: Clip) -> Clip:
    """Without its sensor files: where data lies may change."""
    return replace(clip, images=(), sweeps=(), block=None)


def perturbed_clip_of(prepared: PreparedClip) -> PerturbedClip:
    """What FactoryWork prepared."""
    assert isinstance(prepared.payload, PerturbedClip)
    return prepared.payload


def drive_of(driven: AcceptedDrive) -> Drive:
    """What FactoryWork drove."""
    assert isinstance(driven.payload, Drive)
    return driven.payload


@lru_cache(maxsize=2)  # experts try a candidate one after the other, at most with another clip's between them
def _ready_scene(clip: PerturbedClip, candidate: int, traffic: TrafficSettings) -> ReadyScene:
    scene = perturbed_scene(clip.clip, clip.candidates[candidate].rollout)
    read_only((scene.ego_history, scene.agents))  # what one expert did to it, the next would drive in
    return ReadyScene(scene, traffic)


def _candidate_row(index: int, candidate: Candidate) -> CandidateRow:
    x, y, heading = (float(value) for value in candidate.end_pose)
    return CandidateRow(
        index=index,
        vocabulary_index=candidate.vocabulary_index,
        end_x=x,
        end_y=y,
        end_heading=heading,
        end_speed=end_speed_mps(candidate),
        cell=candidate.cell,
        score=candidate.score,
        reactive_score=candidate.reactive_score,
    )


def _driven_row(drive: Drive) -> dict[str, object]:
    """All but pictures and labels."""
    judged = drive.sampled
    return {**sample_row(judged.scene.clip, drive.candidate, judged), **drive.row_overrides}


def _subscores(drive: Drive) -> dict[str, float]:
    if drive.judged is None:
        return {}
    scores = drive.judged.scores
    named = {name: float(getattr(scores, name)[1]) for name in OF_ONE_PLAN}
    return named | {"score": float(scores.pdm_score[1])} if np.isfinite(scores.pdm_score[1]) else named


# The work of a benchmark: the frames that planners are shown and scored on (tasks.hard_scenes), beside samples.
#
# A frame is made as a sample is, under its own name in place of an expert's. Each clip needs the same log's window
# 0.5 s earlier, and its scenes are kept beside the tables.


@dataclass(frozen=True)
class WholeClipPair(WholeClip):
    """With the window 0.5 s earlier."""

    before: Clip


@dataclass(frozen=True)
class BenchmarkWork(FactoryWork):
    """A run in which `frames` stand among the experts."""

    frames: tuple[str, ...]  # of tasks.stages.FRAMES

    @property
    def names(self) -> tuple[str, ...]:
        """Experts and frames."""
        return (*self.experts, *self.frames)

    def once(self, expert: str) -> bool:
        """Whether it is the log's own."""
        return expert == HUMAN_BEFORE if expert in self.frames else super().once(expert)

    def expert_digest(self, expert: str) -> str:
        """Of the expert's or frame's inputs and settings."""
        return frame_digest(expert) if expert in self.frames else super().expert_digest(expert)

    def read_and_perturb(self, ref: ClipRef) -> WholeClipPair | Rejected:
        """With the earlier window; Rejected also where there is none."""
        watch = Stopwatch()
        clip = self._read(ref, watch)
        if isinstance(clip, Rejected):
            return clip
        before = self._earlier(ref, watch)
        if isinstance(before, Rejected):
            return before
        made = self._perturbed(clip, watch)
        return WholeClipPair(made.clip, made.found, made.seconds, before, cameras_left_out=made.cameras_left_out)

    def _earlier(self, ref: ClipRef, watch: Stopwatch) -> Clip | Rejected:
        earlier = _earlier_ref(ref)
        if earlier.start_ms < 0:
            return Rejected("clip", "no_earlier_frame", f"the log begins {ref.start_ms} ms before the clip")
        try:
            with watch.timing("clip"):
                return read_clip(self.reader, earlier)
        except Unreadable:
            raise
        except BadClip as error:  # the clip itself was read: what lies before it is no drive
            return Rejected("clip", "no_earlier_frame", str(error))

    def prepared_clip(self, ref: ClipRef, made: WholeClip) -> PreparedClip:
        """With the clip's scenes."""
        assert isinstance(made, WholeClipPair)
        prepared = super().prepared_clip(ref, made)
        rollouts = tuple((i, candidate.rollout) for i, candidate in enumerate(made.candidates))
        return replace(
            prepared, scenes=BenchmarkClip(perturbed_clip_of(prepared).clip, without_sensors(made.before), rollouts)
        )

    def trace(self, prepared: PreparedClip, candidate: int, expert: str, timed: Timed = nullcontext) -> Drive:
        """A frame's drive is never filtered by the reward. The two of a pair fall together at the pictures."""
        if expert not in self.frames:
            return super().trace(prepared, candidate, expert, timed)
        payload = perturbed_clip_of(prepared)
        if expert == HUMAN_BEFORE:
            assert prepared.scenes is not None, "prepared by a run without frames"
            rng = random_stream(self.seed, prepared.clip_id, f"expert.{expert}", candidate)
            judged = drive_under_log_replay(scene_of_clip(prepared.scenes.before), Human(), rng, timed)
            overrides = {  # what its row says about the clip, instead of the earlier window that it was read from
                "clip_id": payload.clip.clip_id,
                "clip_start_s": payload.clip.start_s,
                "now_s": (NOW - BEFORE_STEPS) * STEP_S,
                "parent_states": payload.clip.ego_states[[NOW, NOW + HORIZON_STEPS]],
            }
            return Drive(_earlier_ref(payload.ref), None, judged, None, row_overrides=overrides)
        chosen = payload.candidates[candidate]
        led_to = drive_follow_up(payload.clip, chosen.rollout, self.traffic, timed)
        if isinstance(led_to, Rejected):
            return Drive(payload.ref, chosen, None, led_to)
        shown = seen_half_a_second_earlier(led_to, chosen.rollout) if expert == FOLLOW_UP_BEFORE else None
        now = led_to.scene.step
        return Drive(payload.ref, chosen, led_to, None, shared=(now - BEFORE_STEPS, now), sampled_instead=shown)


def _earlier_ref(ref: ClipRef) -> ClipRef:
    return replace(ref, start_ms=ref.start_ms - round(1000 * BEFORE_STEPS * STEP_S))

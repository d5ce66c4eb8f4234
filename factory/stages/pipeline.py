"""The stages behind the machine: what `factory.graph.work.Work` asks for, with real clips and the science of tasks/."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factory.graph.work import (
    BENCHMARK,
    HUMAN,
    HUMAN_BEFORE,
    LOGGED,
    Accepted,
    AttemptResult,
    Built,
    Dropped,
    NotReady,
    PreparedClip,
    Stopped,
    never,
)
from factory.readers.base import BadClip, ClipReader, ClipRef
from factory.readers.validate import read_clip
from factory.stages.fitting import fits_going_on
from factory.stages.imaging import Imaging, scene_lookups
from factory.stages.rows import earlier_lineage, label_columns, sample_row
from factory.store.candidates import CandidateRow
from factory.store.identity import RunIdentity
from tasks.attempt import (
    ExpertGate,
    Judged,
    Timed,
    attempt,
    follow_up,
    half_a_second_before,
    has_route,
    human_sample,
    perturbed_scene,
)
from tasks.experts.follow_up import BEFORE_STEPS, FollowUp
from tasks.experts.pdm_closed.planner import PdmSettings
from tasks.experts.protocol import Expert
from tasks.hard_scenes import BenchmarkClip
from tasks.perturb import Candidate, Perturbation, PerturbSettings, end_speed_mps, perturb
from tasks.render.scene.engine import Backend, check
from tasks.render.settings import RenderMode, RenderSettings
from tasks.render.splatting.gsplat_backend import BackendMissing
from tasks.reward.epdms import Scores
from tasks.reward.labels import Labelling, vocabulary_labels
from tasks.rollout.simulate import TrafficSettings
from tasks.stages import Rejected
from tasks.subscores import OF_ONE_PLAN
from tasks.world.arrays import Array
from tasks.world.chance import stream
from tasks.world.clip import NOW, STEP_S, Clip, scene_of_clip
from tasks.world.vehicle import HEADING
from tasks.world.vocabulary import Vocabulary


@dataclass(frozen=True)
class PerturbedClip:
    """The payload of a prepared clip. It is cached without its sensor files: where data lies may change."""

    ref: ClipRef
    clip: Clip
    candidates: tuple[Candidate, ...]
    before: Clip | None = None  # of a benchmark: the same log's window 0.5 s earlier


def logged_poses(prepared: object) -> Array | None:
    """(81, 3) the log from T to T+2H, world frame, of a prepared clip; None of what is none, or is another work's."""
    if not isinstance(prepared, PreparedClip) or not isinstance(prepared.payload, PerturbedClip):
        return None
    return prepared.payload.clip.ego_states[NOW:, : HEADING + 1]


@dataclass(frozen=True)
class Considered:
    """A clip that attempts can start from, whole, and what became of its candidates."""

    clip: Clip
    found: Perturbation | Rejected  # Rejected by render or perturb: no simulated expert has anything to try
    seconds: Mapping[str, float]  # by stage
    before: Clip | None = None  # of a benchmark: the same log's window 0.5 s earlier

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Those that attempts start from."""
        return () if isinstance(self.found, Rejected) else self.found.candidates


class BrokenLog(BadClip):
    """A log that the index could not read; its message is the index's, which names file and field itself."""

    def __init__(self, log_id: str, said: str) -> None:
        super().__init__(log_id, "log", said)

    def __str__(self) -> str:
        return self.problem

    def __reduce__(self) -> tuple[type["BrokenLog"], tuple[str, str]]:  # type: ignore[override]
        return BrokenLog, (self.file, self.problem)


@dataclass(frozen=True)
class Trace:
    """One attempt with everything it went through, for pictures and explanations."""

    candidate: Candidate | None
    judged: Judged | None  # None where the expert had no plan
    rejected: Rejected | None  # None: the reward accepts it


class Stopwatch:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Adds the time spent inside to the stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


@dataclass(frozen=True)
class FactoryWork:
    """Reader, settings and tables of one run; pure given its arguments."""

    reader: ClipReader
    broken: Mapping[ClipRef, str]
    vocabulary: Vocabulary
    experts: Mapping[str, Expert]
    perturb: PerturbSettings
    traffic: TrafficSettings
    pdm: PdmSettings
    gate: ExpertGate
    labelling: Labelling | None  # None: samples have no vocabulary labels
    render: RenderSettings
    seed: int
    identity: RunIdentity
    cache_dir: str  # of reconstructed blocks

    def warm(self, draws: bool = True) -> None:
        """This run's kernels, and no others, into the on-disk cache. Raises NotReady."""
        from factory.stages.warm import compile_kernels, parts_of

        if draws and self.render.mode is RenderMode.AUTO:
            try:
                check(self.render.backend)
            except BackendMissing as error:
                raise NotReady(str(error)) from error
        label_traffic = None if self.labelling is None else self.labelling.traffic.mode
        compile_kernels(parts_of(self._simulates, self.traffic.mode, label_traffic, self.render))

    def expert_digest(self, expert: str) -> str:
        """Of the expert's inputs and settings."""
        return self.experts[expert].digest()

    def prepare(self, ref: ClipRef) -> PreparedClip | Rejected:
        """Read the clip, check that its block can be rendered, list its candidates.

        In a run of `human` alone the clip is read and nothing more: its drive needs no block and no candidates.
        """
        if not self._simulates:
            return self._unlisted(ref)
        made = self.considered(ref)
        if isinstance(made, Rejected):
            return made
        clip, found = _bare(made.clip), made.found
        before = None if made.before is None else _bare(made.before)
        rollouts = tuple((i, candidate.rollout) for i, candidate in enumerate(made.candidates))
        return PreparedClip(
            clip_id=clip.clip_id,
            content_digest=clip.content_digest,
            candidates=tuple(_candidate_row(index, candidate) for index, candidate in enumerate(made.candidates)),
            gate_counts=found.counts if isinstance(found, Rejected) else found.gate_counts,
            payload=PerturbedClip(ref, clip, made.candidates, before),
            dropped=found if isinstance(found, Rejected) else None,
            seconds=made.seconds,
            scenes=None if before is None else BenchmarkClip(clip, before, rollouts),
        )

    def considered(self, ref: ClipRef) -> Considered | Rejected:
        """All that `prepare` decides, and every gated trajectory's fate. Rejected: for every expert. Raises BadClip."""
        watch = Stopwatch()
        clip = self._read(ref, watch)
        if isinstance(clip, Rejected):
            return clip
        before = self._earlier(ref, watch)
        if isinstance(before, Rejected):
            return before
        with watch.of("render"):
            blocked = self._block_verdict(clip)
        with watch.of("perturb"):
            found = blocked or perturb(
                clip, self.vocabulary, self.perturb, self.traffic, self.pdm, stream(self.seed, clip.clip_id, "perturb")
            )
        return Considered(clip, found, watch.seconds, before)

    def _read(self, ref: ClipRef, watch: Stopwatch) -> Clip | Rejected:
        if ref in self.broken:
            raise BrokenLog(ref.log_id, self.broken[ref])
        with watch.of("clip"):
            clip = read_clip(self.reader, ref)
        if not has_route(clip.centerline):
            return Rejected("clip", "route_ended", "the log ends at the end of its route")
        return clip

    def _earlier(self, ref: ClipRef, watch: Stopwatch) -> Clip | Rejected | None:
        """The window 0.5 s before a clip that was read; None where nobody asks for it."""
        if not set(self.experts) & BENCHMARK:
            return None
        earlier = _earlier_ref(ref)
        if earlier.start_ms < 0:
            return Rejected("clip", "no_earlier_frame", f"the log begins {ref.start_ms} ms before the clip")
        try:
            with watch.of("clip"):
                return read_clip(self.reader, earlier)
        except BadClip as error:  # the clip itself was read: what lies before it is no drive
            return Rejected("clip", "no_earlier_frame", str(error))

    def _unlisted(self, ref: ClipRef) -> PreparedClip | Rejected:
        watch = Stopwatch()
        clip = self._read(ref, watch)
        if isinstance(clip, Rejected):
            return clip
        payload = PerturbedClip(ref, _bare(clip), ())
        return PreparedClip(clip.clip_id, clip.content_digest, (), {}, payload, seconds=watch.seconds)

    def content_digest(self, ref: ClipRef) -> str | None:
        """Of what the clip would be read from now; None where the reader cannot tell."""
        digest = getattr(self.reader, "digest", None)
        return None if digest is None else str(digest(ref))

    def block(self, ref: ClipRef) -> str | None:
        """The reader's name of the clip's block; None where it has none, or this run does not render from blocks."""
        named = getattr(self.reader, "block", None)
        if named is None or ref in self.broken or not self._simulates or self.render.mode is not RenderMode.AUTO:
            return None
        name = named(ref)
        return None if name is None else str(name)

    def reconstruct(self, ref: ClipRef, threads: int, stopped: Stopped = never) -> Built:
        """The clip's block into this machine's cache. Raises BadClip, and Halted where a fit is `stopped`."""
        watch = Stopwatch()
        with watch.of("reconstruct"):
            found, psnr_db = self.imaging.build(read_clip(self.reader, ref), threads, stopped)
        return Built(watch.seconds, found, psnr_db)

    def doing(self) -> str:
        """The fits that are going on here."""
        return "; ".join(fits_going_on(Path(self.cache_dir)))

    def attempt(self, prepared: PreparedClip, candidate: int, expert: str) -> AttemptResult:
        """Rollout, expert, rollout, reward, render and labels of one candidate; candidate -1 is the human drive."""
        watch = Stopwatch()
        payload = prepared.payload
        assert isinstance(payload, PerturbedClip)
        trace = self.trace(payload, candidate, expert, watch.of)
        if trace.judged is None or trace.rejected is not None:
            assert trace.rejected is not None
            return Dropped(trace.rejected, _subscores(trace.judged.scores) if trace.judged else {}, watch.seconds)
        before = scene_lookups()
        with watch.of("render"):
            sensed = self._with_sensors(payload, expert)
            unfit = self.unfit(sensed, trace, expert)
            if unfit is not None:
                return Dropped(unfit, _subscores(trace.judged.scores), watch.seconds, _at_hand(before))
        judged = self._sampled(trace, expert)
        with watch.of("render"):
            pictures = self.imaging.pictures(sensed, trace.candidate, judged)
        labels = self._labels(judged, watch)
        row = sample_row(judged.scene.clip, trace.candidate, judged)
        if expert == HUMAN_BEFORE:
            row |= earlier_lineage(payload.clip)
        tags = [*row["tags"], *pictures.get("tags", ())]  # type: ignore[misc]
        return Accepted(row | labels | pictures | {"tags": tags}, watch.seconds, _at_hand(before))

    def trace(
        self,
        payload: PerturbedClip,
        candidate: int,
        expert: str,
        timed: Timed = nullcontext,
    ) -> Trace:
        """The same attempt up to the reward's verdict, nothing left out."""
        clip, driver = payload.clip, self.experts[expert]
        rng = stream(self.seed, clip.clip_id, f"expert.{expert}", candidate)
        if expert in LOGGED:
            logged = scene_of_clip(_driven(payload, expert))
            return Trace(None, human_sample(logged, driver, self.pdm, rng, timed), None)
        chosen = payload.candidates[candidate]
        if isinstance(driver, FollowUp):
            led_to = follow_up(clip, chosen.rollout, driver, self.traffic, timed)
            return Trace(chosen, None, led_to) if isinstance(led_to, Rejected) else Trace(chosen, led_to, None)
        with timed("rollout"):
            scene = perturbed_scene(clip, chosen.rollout)
        result = attempt(scene, driver, self.gate, self.traffic, self.pdm, rng, timed)
        if isinstance(result, Rejected):
            return Trace(chosen, None, result)
        return Trace(chosen, *result)

    def unfit(self, clip: Clip, trace: Trace, expert: str) -> Rejected | None:
        """Why the pictures of an accepted drive are no sample's; `clip` with its sensor files. Raises BadClip.

        The human drive is never filtered.
        """
        if trace.candidate is None or trace.judged is None:
            return None
        pair = isinstance(self.experts[expert], FollowUp)
        return self.imaging.unfit(clip, trace.candidate, trace.judged, pair)

    def _sampled(self, trace: Trace, expert: str) -> Judged:
        """The drive as the sample tells it; of the earlier frame of a pair, only after all that the pair shares."""
        assert trace.judged is not None
        driver = self.experts[expert]
        if not (isinstance(driver, FollowUp) and driver.before):
            return trace.judged
        assert trace.candidate is not None
        return half_a_second_before(trace.judged, trace.candidate.rollout, driver.settings)

    def _labels(self, judged: Judged, watch: Stopwatch) -> dict[str, object]:
        """Columns of the vocabulary labels; none in a run without them."""
        if self.labelling is None:
            return {}
        with watch.of("labels"):
            return label_columns(vocabulary_labels(self.labelling, judged.scene, judged.prepared, judged.reference))

    def _block_verdict(self, clip: Clip) -> Rejected | None:
        """Asked for before perturb work is spent. Without a gate a block is built here only if it will be needed."""
        return self.imaging.block_verdict(clip) if self.render.refuses_blocks or self._simulates else None

    @property
    def _simulates(self) -> bool:
        return bool(set(self.experts) - {HUMAN})

    def _with_sensors(self, payload: PerturbedClip, expert: str) -> Clip:
        clip = _driven(payload, expert)
        if self.render.mode is not RenderMode.AUTO:
            return clip
        now = read_clip(self.reader, _earlier_ref(payload.ref) if expert == HUMAN_BEFORE else payload.ref)
        return replace(clip, images=now.images, sweeps=now.sweeps, block=now.block)

    @property
    def draws_on_gpu(self) -> bool:
        """Attempts of this run draw pictures with CUDA."""
        return self.render.mode is RenderMode.AUTO and self.render.backend is Backend.GSPLAT and self._simulates

    @property
    def imaging(self) -> Imaging:
        """The render stage with this run's settings."""
        return Imaging(self.render, self.cache_dir)


def _at_hand(before: tuple[int, int]) -> bool | None:
    """Whether every scene wanted since `before` was in memory; None where none was."""
    hits, misses = scene_lookups()
    return None if (hits, misses) == before else misses == before[1]


def _bare(clip: Clip) -> Clip:
    """Without its sensor files: where data lies may change."""
    return replace(clip, images=(), sweeps=(), block=None)


def _earlier_ref(ref: ClipRef) -> ClipRef:
    return replace(ref, start_ms=ref.start_ms - round(1000 * BEFORE_STEPS * STEP_S))


def _driven(payload: PerturbedClip, expert: str) -> Clip:
    """The window at whose T the expert's sample has its now, or begins its perturbation."""
    if expert != HUMAN_BEFORE:
        return payload.clip
    assert payload.before is not None, "prepared by a run without benchmark experts"
    return payload.before


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


def _subscores(scores: Scores) -> dict[str, float]:
    named = {name: float(getattr(scores, name)[1]) for name in OF_ONE_PLAN}
    return named | {"score": float(scores.pdm_score[1])} if np.isfinite(scores.pdm_score[1]) else named

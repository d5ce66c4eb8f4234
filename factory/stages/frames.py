"""The work of a benchmark: the frames that planners are shown and scored on (tasks.hard_scenes), beside samples.

A frame is made as a sample is, under its own name in place of an expert's. Each clip needs the same log's window 0.5 s
earlier, and its scenes are kept beside the tables.
"""

from contextlib import nullcontext
from dataclasses import dataclass, replace

from factory.graph.work import PreparedClip
from factory.readers.base import BadClip, ClipRef, Unreadable
from factory.readers.validate import read_clip
from factory.stages.pipeline import Drive, FactoryWork, Stopwatch, WholeClip, bare, payload_of
from tasks.attempt import Timed, human_sample
from tasks.experts.human import Human
from tasks.hard_scenes import BEFORE_STEPS, BenchmarkClip, follow_up, frame_digest, half_a_second_before
from tasks.stages import FOLLOW_UP_BEFORE, HUMAN_BEFORE, Rejected
from tasks.world.chance import stream
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, Clip, scene_of_clip


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
        return frame_digest(expert, self.pdm) if expert in self.frames else super().expert_digest(expert)

    def considered(self, ref: ClipRef) -> WholeClipPair | Rejected:
        """With the earlier window; Rejected also where there is none."""
        watch = Stopwatch()
        clip = self._read(ref, watch)
        if isinstance(clip, Rejected):
            return clip
        before = self._earlier(ref, watch)
        if isinstance(before, Rejected):
            return before
        made = self._perturbed(clip, watch)
        return WholeClipPair(made.clip, made.found, made.seconds, before)

    def _earlier(self, ref: ClipRef, watch: Stopwatch) -> Clip | Rejected:
        earlier = _earlier_ref(ref)
        if earlier.start_ms < 0:
            return Rejected("clip", "no_earlier_frame", f"the log begins {ref.start_ms} ms before the clip")
        try:
            with watch.of("clip"):
                return read_clip(self.reader, earlier)
        except Unreadable:
            raise
        except BadClip as error:  # the clip itself was read: what lies before it is no drive
            return Rejected("clip", "no_earlier_frame", str(error))

    def listed(self, ref: ClipRef, made: WholeClip) -> PreparedClip:
        """With the clip's scenes."""
        assert isinstance(made, WholeClipPair)
        prepared = super().listed(ref, made)
        rollouts = tuple((i, candidate.rollout) for i, candidate in enumerate(made.candidates))
        return replace(prepared, scenes=BenchmarkClip(payload_of(prepared).clip, bare(made.before), rollouts))

    def trace(self, prepared: PreparedClip, candidate: int, expert: str, timed: Timed = nullcontext) -> Drive:
        """A frame's drive is never filtered by the reward. The two of a pair fall together at the pictures."""
        if expert not in self.frames:
            return super().trace(prepared, candidate, expert, timed)
        payload = payload_of(prepared)
        if expert == HUMAN_BEFORE:
            assert prepared.scenes is not None, "prepared by a run without frames"
            rng = stream(self.seed, prepared.clip_id, f"expert.{expert}", candidate)
            judged = human_sample(scene_of_clip(prepared.scenes.before), Human(), self.pdm, rng, timed)
            return Drive(_earlier_ref(payload.ref), None, judged, None, told=_lineage(payload.clip))
        chosen = payload.candidates[candidate]
        led_to = follow_up(payload.clip, chosen.rollout, self.traffic, self.pdm, timed)
        if isinstance(led_to, Rejected):
            return Drive(payload.ref, chosen, None, led_to)
        shown = half_a_second_before(led_to, chosen.rollout, self.pdm) if expert == FOLLOW_UP_BEFORE else None
        now = led_to.scene.step
        return Drive(payload.ref, chosen, led_to, None, shared=(now - BEFORE_STEPS, now), shown=shown)


def _lineage(clip: Clip) -> dict[str, object]:
    """What the row of the log 0.5 s before T says about its clip, instead of the earlier window it was read from."""
    return {
        "clip_id": clip.clip_id,
        "clip_start_s": clip.start_s,
        "now_s": (NOW - BEFORE_STEPS) * STEP_S,
        "parent_states": clip.ego_states[[NOW, NOW + HORIZON_STEPS]],
    }


def _earlier_ref(ref: ClipRef) -> ClipRef:
    return replace(ref, start_ms=ref.start_ms - round(1000 * BEFORE_STEPS * STEP_S))

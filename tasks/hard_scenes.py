"""The scenes of a two-stage benchmark: what a planner is driven and scored from, apart from any sample.

Stage one is the log at T, stage two where candidates' rollouts lead at T+H (docs/reward.md 3). Each has a frame
0.5 s earlier, so that extended comfort is defined.
"""

from dataclasses import dataclass

from tasks.attempt import perturbed_scene
from tasks.experts.follow_up import BEFORE_STEPS
from tasks.world.clip import HORIZON_STEPS, Clip, Rollout, Scene, scene_of_clip


@dataclass(frozen=True)
class BenchmarkClip:
    """One clip of a benchmark, without sensor files."""

    clip: Clip
    before: Clip  # the same log's window that begins 0.5 s earlier
    follow_ups: tuple[tuple[int, Rollout], ...]  # candidate index, its reactive rollout from T

    def stage_one(self, before: bool = False) -> Scene:
        """The logged scene at T, or 0.5 s before."""
        return scene_of_clip(self.before if before else self.clip)

    def stage_two(self, candidate: int, before: bool = False) -> Scene:
        """The scene at T+H of a candidate's rollout, or 0.5 s before. Raises KeyError for no candidate of the clip.

        Agents that the rollout moved are marked as such: they go on by their driver model, not by the log.
        """
        return perturbed_scene(self.clip, dict(self.follow_ups)[candidate], HORIZON_STEPS - BEFORE_STEPS * before)

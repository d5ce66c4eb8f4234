"""A two-stage benchmark: the scenes that a planner is driven and scored from, and the frames it is shown of them.

Stage one is the log at T, stage two where candidates' rollouts lead at T+H (docs/reward.md 3). Each has a frame
0.5 s earlier, so that extended comfort is defined.
"""

from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from tasks.attempt import Judged, Timed, drive_and_judge, has_route, judge, perturbed_scene
from tasks.experts.pdm_closed import plan_for
from tasks.experts.protocol import Plan
from tasks.rollout.simulate import TrafficSettings
from tasks.stages import FOLLOW_UP, FOLLOW_UP_BEFORE, HUMAN_BEFORE, Rejected
from tasks.world.clip import HORIZON_STEPS, NOW, Clip, Rollout, Scene, scene_of_clip
from tasks.world.frames import HEADING

BEFORE_STEPS = 5  # the earlier frame of a pair: 0.5 s, over which extended comfort compares two plans


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


@dataclass(frozen=True)
class GivenScenes:
    """One clip of a benchmark that others made: each frame's world as it was given, a clip whose T is the frame."""

    clip: Clip
    before: Clip  # 0.5 s earlier
    follow_ups: tuple[tuple[int, tuple[Clip, Clip]], ...]  # number, the frame now and the one 0.5 s earlier

    def stage_one(self, before: bool = False) -> Scene:
        """As of a BenchmarkClip."""
        return scene_of_clip(self.before if before else self.clip)

    def stage_two(self, candidate: int, before: bool = False) -> Scene:
        """As of a BenchmarkClip. Raises KeyError for no follow-up of the clip."""
        return scene_of_clip(dict(self.follow_ups)[candidate][before])


@dataclass(frozen=True)
class OneStageClip:
    """One clip of a one-stage benchmark: a logged frame, whose earlier one is another clip's or none."""

    clip: Clip

    def stage_one(self) -> Scene:
        """The logged scene at T."""
        return scene_of_clip(self.clip)


def frame_digest(frame: str) -> str:
    """Of what a frame (one of tasks.stages.FRAMES) is made by, as an expert's."""
    if frame == HUMAN_BEFORE:
        return "human"
    return {FOLLOW_UP: "ec60687d0de515e2", FOLLOW_UP_BEFORE: "bc2dc65fb6c61aaa"}[frame]  # attempt ids hold them


def drive_follow_up(
    clip: Clip, stage_one: Rollout, traffic: TrafficSettings, timed: Timed = nullcontext
) -> Judged | Rejected:
    """PDM-Closed from T+H of a candidate's rollout, scored and never filtered.

    A hard scene is allowed to be hard: its drive is a label to look at, not one that must have been good.
    The same for both frames of a pair, also where it is Rejected: a route that has ended at either has no follow-up.
    """
    with timed("rollout"):
        scene = perturbed_scene(clip, stage_one)
        before = perturbed_scene(clip, stage_one, HORIZON_STEPS - BEFORE_STEPS)
    if not (has_route(scene.centerline) and has_route(before.centerline)):
        return Rejected("rollout", "route_ended", "the perturbed ego stands at the end of its route")
    with timed("expert"):
        pdm_plan = plan_for(scene)
    return drive_and_judge(scene, Plan(pdm_plan.poses), traffic, timed, pdm_plan)


def seen_half_a_second_earlier(judged: Judged, stage_one: Rollout) -> Judged:
    """A follow-up's drive seen from its earlier frame: the last 0.5 s of the perturbation, then what came of it."""
    kept = HORIZON_STEPS - BEFORE_STEPS
    scene = perturbed_scene(judged.scene.clip, stage_one, kept)
    states = np.concatenate([stage_one.ego_states[kept:], judged.rollout.ego_states[1 : kept + 1]])
    world = judged.scene.agents.overwritten(judged.scene.step, judged.rollout.agents)
    agents = world.window(NOW + kept, NOW + kept + HORIZON_STEPS + 1)
    rollout = Rollout(scene.step, states, agents, stage_one.simulated | judged.rollout.simulated)
    return judge(scene, Plan(states[1:, : HEADING + 1]), rollout, plan_for(scene))

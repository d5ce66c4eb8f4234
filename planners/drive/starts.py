"""Where drives begin: a clip whose world goes on past its window, and the scenes that are driven on from.

Planners and traffic look 4 s beyond a drive's end: the clip is lengthened. As long as the log is known, which the
clip's block says, the agents' tracks are the log's. After it no newcomer comes; who is driven by IDM goes on, who
replays its log leaves with it (tasks.rollout.simulate), and things and what never left its place stay. A light is
unknown where nobody says better: the synthetic town's phases go on (its painter).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planners.evaluation.frames import NO_CANDIDATE
from tasks.attempt import drive_and_judge, has_route, perturbed_scene
from tasks.experts.pdm_closed import plan_for
from tasks.experts.protocol import Plan
from tasks.perturb import Perturbation
from tasks.rollout.lane_following import stands_always
from tasks.settings import TrafficSettings
from tasks.world.clip import MOVING_KINDS, PER_STEP, STEP_S, AgentTracks, Clip, Scene, scene_of_clip
from tasks.world.road_map import LightState, TrafficLights

LOGGED = -1
ABSENT = {"boxes": np.nan, "velocities": np.nan, "valid": False, "center_z": np.nan}  # of AgentTracks


@dataclass(frozen=True)
class DriveStart:
    """A scene to drive on from."""

    scene: Scene  # of a lengthened clip
    candidate_index: int = NO_CANDIDATE  # that the ego was perturbed by; NO_CANDIDATE: the log at T
    number: int = LOGGED  # among the clip's perturbed starts; LOGGED: the log at T


def extend_clip(clip: Clip, n_steps: int, lights: TrafficLights | None = None) -> Clip:
    """The clip with agents and lights of `n_steps` steps of 0.1 s, at least its own; its ego is known no longer.

    lights: of all these steps, where somebody knows them. Raises ValueError where they are of fewer.
    """
    own = clip.lights
    if lights is None:
        unknown = np.full((max(n_steps - len(own.states), 0), len(own.lane_ids)), LightState.UNKNOWN, np.int8)
        lights = replace(own, states=np.concatenate([own.states, unknown])) if own.lane_ids else own
    elif len(lights.states) < n_steps:
        raise ValueError(f"lights must span {n_steps} steps, got {len(lights.states)}")
    return replace(clip, agents=_continued(_logged(clip), n_steps), lights=lights)


def _logged(clip: Clip) -> AgentTracks:
    """The agents from the clip's first step to the last one that its block knows."""
    if clip.block is None:
        return clip.agents
    first = round((clip.start_s - clip.block.start_s) / STEP_S)
    known = clip.block.agents.window(first, clip.block.agents.n_steps)
    return known if known.n_steps >= clip.agents.n_steps else clip.agents


def _continued(log: AgentTracks, n_steps: int) -> AgentTracks:
    if n_steps <= log.n_steps:
        return log.window(0, n_steps)
    moving = np.array([kind in MOVING_KINDS for kind in log.kinds], dtype=bool)
    stays = log.valid[-1] & (~moving | stands_always(log))
    after: dict[str, Any] = {}
    for name in PER_STEP:
        values = getattr(log, name)
        more = np.full((n_steps - log.n_steps, *values.shape[1:]), ABSENT[name], values.dtype)
        more[:, stays] = values[-1, stays]
        after[name] = np.concatenate([values, more])
    return replace(log, **after)


def logged_start(clip: Clip) -> DriveStart:
    """From the log at T."""
    return DriveStart(scene_of_clip(clip))


def perturbed_starts(
    clip: Clip, perturbation: Perturbation, at_most: int, traffic: TrafficSettings
) -> tuple[DriveStart, ...]:
    """From where the first candidates lead at T+H that PDM-Closed can drive on from.

    Candidates were judged up to there alone, and many a one is about to run into somebody: what nobody can drive is no
    question to a planner. One counts from which PDM-Closed's plan, followed for 4 s, stays without a collision at fault
    and on the road.
    """
    found: list[DriveStart] = []
    for index, candidate in enumerate(perturbation.candidates):
        if len(found) == at_most:
            break
        scene = perturbed_scene(clip, candidate.rollout)
        if not has_route(scene.centerline):
            continue
        plan = plan_for(scene)
        scores = drive_and_judge(scene, Plan(plan.poses), traffic, pdm_plan=plan).scores
        if scores.nc[1] == 1.0 and scores.dac[1] == 1.0:
            found.append(DriveStart(scene, index, len(found)))
    return tuple(found)

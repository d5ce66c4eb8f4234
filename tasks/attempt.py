"""One attempt: from a candidate's perturbed world through an expert's plan to a judged rollout.

`rollout -> expert -> rollout -> reward` of tasks.stages; rendering follows elsewhere, only for what the reward kept.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np

from tasks.experts.pdm_closed import MIN_PROGRESS_M, PdmClosed, PdmPlan, PdmSettings, path_length_m, plan_for
from tasks.experts.protocol import Expert, Plan
from tasks.reward.epdms import PreparedScene, Scores, prepare_scene, score
from tasks.reward.labels import check_end
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficScene, TrafficSettings, next_scene, prepare_traffic, roll_out
from tasks.settings import ExpertGate
from tasks.stages import Rejected
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, Clip, Rollout, Scene, scene_of_clip
from tasks.world.frames import HEADING
from tasks.world.road_map import centerline_from

Timed = Callable[[str], AbstractContextManager[object]]


@dataclass(frozen=True)
class Judged:
    """An expert's plan, driven and scored."""

    scene: Scene  # at T+H (simulated samples) or T (human)
    plan: Plan
    rollout: Rollout
    scores: Scores  # row 1 is this rollout, row 0 PDM-Closed
    prepared: PreparedScene  # the scene among the rollout's agents
    reference: Array  # (41, 11) PDM-Closed as the tracker drives it


def perturbed_scene(clip: Clip, stage_one: Rollout, steps: int = HORIZON_STEPS) -> Scene:
    """The world at T+H that a candidate's rollout leads to; or `steps` of 0.1 s after T, on its way there."""
    pose = stage_one.ego_states[steps, : HEADING + 1]
    return next_scene(scene_of_clip(clip), stage_one, centerline_from(clip.road_map, clip.route, pose), steps)


def has_route(centerline: Array) -> bool:
    """Whether any route is left to drive along: without it nobody can plan and progress has no meaning."""
    return path_length_m(centerline) > MIN_PROGRESS_M


def drive_and_judge(
    scene: Scene,
    plan: Plan,
    traffic: TrafficSettings,
    planner: PdmSettings,
    timed: Timed = nullcontext,
    pdm_plan: PdmPlan | None = None,
) -> Judged:
    """Simulate the plan with the traffic and score it in the two-row batch [PDM-Closed, plan].

    pdm_plan: plan_for(scene, planner), where it is known already.
    """
    with timed("rollout"):
        ready = prepare_traffic(scene, traffic)
    return _driven_among(ready, plan, planner, timed, pdm_plan)


def _driven_among(
    traffic: TrafficScene, plan: Plan, planner: PdmSettings, timed: Timed, pdm_plan: PdmPlan | None
) -> Judged:
    scene = traffic.scene
    with timed("rollout"):
        rollout = roll_out(traffic, track(scene.ego_state, np.asarray(plan.poses)[None])[0])
    with timed("reward"):
        pdm_plan = pdm_plan or plan_for(scene, planner)
        return judge(scene, plan, rollout, pdm_plan, traffic.settings.leaves_out_touching)


def judge(scene: Scene, plan: Plan, rollout: Rollout, pdm_plan: PdmPlan, drop_touching: bool = True) -> Judged:
    """Score a rollout from the scene in the two-row batch [PDM-Closed, rollout].

    drop_touching: who touches the ego at the start is left out, see `TrafficSettings.leaves_out_touching`.
    """
    prepared = prepare_scene(scene, rollout.agents, drop_touching)
    scores = score(prepared, np.array([pdm_plan.driven, rollout.ego_states]), normalise="pairs")
    return Judged(scene, plan, rollout, scores, prepared, pdm_plan.driven)


def verdict(scores: Scores, gate: ExpertGate) -> Rejected | None:
    """None when row 1 (see Judged) passes the gate, else the first sub-score that fails, with all in the detail."""
    failed = [f"{name}={getattr(scores, name)[1]:g}" for name in gate.full if getattr(scores, name)[1] != 1.0]
    if not scores.ep[1] > gate.progress_above:
        failed.append(f"ep={scores.ep[1]:.3f}")
    return Rejected("reward", failed[0].split("=")[0], " ".join(failed)) if failed else None


def end_verdict(judged: Judged, traffic: TrafficScene, gate: ExpertGate) -> Rejected | None:
    """None where a drive's end leads on as the gate asks (docs/reward.md 2m); traffic: as the drive met it."""
    return check_end(traffic, judged.prepared, judged.rollout.ego_states, gate)


def attempt(
    scene: Scene,
    expert: Expert,
    gate: ExpertGate,
    traffic: TrafficSettings,
    planner: PdmSettings,
    rng: np.random.Generator,
    timed: Timed = nullcontext,
) -> tuple[Judged, Rejected | None] | Rejected:
    """Let `expert` plan from the perturbed scene, drive its plan and judge it.

    Returns the judged drive and the verdict (None: accepted); Rejected where the route ends or the expert has no plan.
    `timed(stage)` is entered around the work of each stage, for whoever wants to know where the time goes.
    """
    if not has_route(scene.centerline):
        return Rejected("rollout", "route_ended", "the perturbed ego stands at the end of its route")
    with timed("expert"):  # which may be the very planner that progress is held against: it plans once
        pdm_plan = plan_for(scene, planner) if expert == PdmClosed(planner) else None
        plan = expert.plan(scene, rng) if pdm_plan is None else Plan(pdm_plan.poses)
    if isinstance(plan, Rejected):
        return plan
    with timed("rollout"):
        ready = prepare_traffic(scene, traffic)
    judged = _driven_among(ready, plan, planner, timed, pdm_plan)
    with timed("reward"):
        return judged, verdict(judged.scores, gate) or end_verdict(judged, ready, gate)


def drive_under_log_replay(
    scene: Scene, expert: Expert, planner: PdmSettings, rng: np.random.Generator, timed: Timed = nullcontext
) -> Judged:
    """The drive from the log at T, scored under log replay and never filtered."""
    plan = expert.plan(scene, rng)
    assert isinstance(plan, Plan), "an expert that drives once a clip always has a plan"
    return drive_and_judge(scene, plan, TrafficSettings(mode="replay"), planner, timed)

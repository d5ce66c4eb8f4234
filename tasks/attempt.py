"""One attempt: from a candidate's perturbed world through an expert's plan to a judged rollout.

`rollout -> expert -> rollout -> reward` of tasks.stages; rendering follows elsewhere, only for what the reward kept.
At the end what the reward asks of traffic that answers anew: what a drive's end leads to, and a vocabulary's labels.
"""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tasks.experts.pdm_closed import MIN_PROGRESS_M, PdmClosed, PdmPlan, path_length_m, plan_for
from tasks.experts.protocol import Expert, Plan, plans_of
from tasks.kernels.compiled import kernel
from tasks.reward.areas import N_CORNERS, empty_places, set_area_flags
from tasks.reward.centerline import empty_body, place_body
from tasks.reward.collisions import STOPPED_SPEED_MPS, empty_looks, first_contacts, obstacles_of, set_looks
from tasks.reward.epdms import (
    PreparedScene,
    RuleContext,
    Scores,
    collision_scores,
    prepare_scene,
    rule_context,
    score,
)
from tasks.reward.label_bytes import ARRAYS, VocabularyLabels
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficScene, TrafficSettings, next_scene, prepare_traffic, roll_out, roll_out_longer
from tasks.settings import ExpertGate
from tasks.stages import NEAR_LOG, NOT_RECOVERED, Rejected
from tasks.world.arrays import Array, Bools
from tasks.world.clip import HORIZON_STEPS, STEP_S, Clip, Rollout, Scene, scene_of_clip
from tasks.world.frames import (
    AX,
    HALF_LENGTH,
    HALF_WIDTH,
    HEADING,
    PACIFICA,
    REAR_AXLE_TO_CENTER,
    STEERING,
    VX,
    YAW_RATE,
    X,
    Y,
    ego_boxes,
    touching,
    wrap_angle,
)
from tasks.world.road_map import RoadMap, Route, centerline_finder
from tasks.world.vocabulary import Vocabulary

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
    line = centerline_finder(clip.road_map, clip.route).centerline_from(pose)
    return next_scene(scene_of_clip(clip), stage_one, line, steps)


def has_route(centerline: Array) -> bool:
    """Whether any route is left to drive along: without it nobody can plan and progress has no meaning."""
    return path_length_m(centerline) > MIN_PROGRESS_M


def drive_and_judge(
    scene: Scene,
    plan: Plan,
    traffic: TrafficSettings,
    timed: Timed = nullcontext,
    pdm_plan: PdmPlan | None = None,
) -> Judged:
    """Simulate the plan with the traffic and score it in the two-row batch [PDM-Closed, plan].

    pdm_plan: plan_for(scene), where it is known already.
    """
    with timed("rollout"):
        ready = prepare_traffic(scene, traffic)
    return _driven_among(ready, plan, timed, pdm_plan)


def _driven_among(traffic: TrafficScene, plan: Plan, timed: Timed, pdm_plan: PdmPlan | None) -> Judged:
    scene = traffic.scene
    with timed("rollout"):
        rollout = roll_out(traffic, track(scene.ego_state, np.asarray(plan.poses)[None])[0])
    with timed("reward"):
        pdm_plan = pdm_plan or plan_for(scene)
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
    clip, prepared, states = judged.scene.clip, judged.prepared, judged.rollout.ego_states
    if gate.off_route:
        metres = route_ahead_m(clip.road_map, clip.route, states[-1, : HEADING + 1])
        if metres is None:
            return Rejected("reward", "off_route", "ends on no lane of the route")
        if metres < math.inf:
            return Rejected("reward", "off_route", f"ends on a lane that leaves the route within {metres:.1f} m")
    if gate.after:
        going_on = hit_after_s(traffic, prepared, states)
        if going_on < math.inf:
            braking = hit_after_s(traffic, prepared, states, BRAKING_MPS2)
            if braking < math.inf:
                when = f"after {going_on:.1f} s, after {braking:.1f} s when it brakes"
                return Rejected("reward", "after", f"hits somebody {when}")
    return None


class ReadyScene:
    """A scene with what every drive from it meets and is held against, made when first asked for.

    Experts that try the same candidate share it: to prepare traffic and PDM-Closed's plan costs more than a drive.
    """

    def __init__(self, scene: Scene, traffic: TrafficSettings) -> None:
        self.scene, self._settings = scene, traffic

    @cached_property
    def traffic(self) -> TrafficScene:
        return prepare_traffic(self.scene, self._settings)

    @cached_property
    def pdm_plan(self) -> PdmPlan:
        return plan_for(self.scene)


def attempt(
    ready: ReadyScene, expert: Expert, gate: ExpertGate, rng: np.random.Generator, timed: Timed = nullcontext
) -> tuple[Judged, Rejected | None] | Rejected:
    """Let `expert` plan from a perturbed scene, drive its plan and judge it; of several plans up to one that passes.

    Returns the judged drive and the verdict (None: accepted), where none passes that of the first; Rejected where the
    route ends or the expert has no plan.
    `timed(stage)` is entered around the work of each stage, for whoever wants to know where the time goes.
    """
    scene = ready.scene
    if not has_route(scene.centerline):
        return Rejected("rollout", "route_ended", "the perturbed ego stands at the end of its route")
    with timed("expert"):  # which may be the very planner that progress is held against: it plans once
        is_planner = expert == PdmClosed()
        plans = iter([Plan(ready.pdm_plan.poses)]) if is_planner else plans_of(expert, scene, rng)
    refused: tuple[Judged, Rejected] | Rejected | None = None
    while True:
        with timed("expert"):
            plan = next(plans, None)
        if plan is None or isinstance(plan, Rejected):
            refused = refused or plan
            break
        with timed("rollout"):
            traffic = ready.traffic
        with timed("reward"):
            pdm_plan = ready.pdm_plan
        judged = _driven_among(traffic, plan, timed, pdm_plan)
        with timed("reward"):
            found = verdict(judged.scores, gate) or end_verdict(judged, traffic, gate)
            found = found or _near_log_verdict(judged, gate) or _goal_verdict(judged)
        if found is None:
            return judged, None
        refused = refused or (judged, found)
    assert refused is not None, f"{expert.name} gave no plan and no reason"
    return refused


# Within these over its whole length a drive is the log's own: where, how turned and how fast the log is each instant.
NEAR_LOG_M, NEAR_LOG_RAD, NEAR_LOG_MPS = 1.0, math.radians(5.0), 1.0


def off_log(judged: Judged) -> Array:
    """(40, 3) how far [m], turned [rad] and how much faster or slower [m/s] a drive is than the log at 0.1 .. 4.0 s."""
    off = judged.rollout.ego_states[1:] - judged.scene.log_ahead[1:]
    return np.column_stack([np.hypot(off[:, X], off[:, Y]), np.abs(wrap_angle(off[:, HEADING])), np.abs(off[:, VX])])


def _near_log_verdict(judged: Judged, gate: ExpertGate) -> Rejected | None:
    if not gate.near_log:
        return None
    metres, turn, mps = off_log(judged).max(axis=0)
    if metres > NEAR_LOG_M or turn > NEAR_LOG_RAD or mps > NEAR_LOG_MPS:
        return None
    detail = f"at most {metres:.2f} m, {math.degrees(turn):.1f} degrees and {mps:.1f} m/s off the log"
    return Rejected("reward", NEAR_LOG, detail)


def _goal_verdict(judged: Judged) -> Rejected | None:
    end, goal = judged.rollout.ego_states[-1], judged.plan.goal
    missed = goal and goal.missed(end[: HEADING + 1], float(end[VX]))
    return Rejected("reward", NOT_RECOVERED, missed) if missed else None


def drive_under_log_replay(
    scene: Scene, expert: Expert, rng: np.random.Generator, timed: Timed = nullcontext
) -> Judged:
    """The drive from the log at T, scored under log replay and never filtered."""
    plan = expert.plan(scene, rng)
    assert isinstance(plan, Plan), "an expert that drives once a clip always has a plan"
    return drive_and_judge(scene, plan, TrafficSettings(mode="replay"), timed)


# Whether the route goes on where a drive ends (docs/reward.md 2m).

NEAR_M, NEAR_RAD = 0.5, math.radians(30.0)  # of a lane of the route
ONWARD_M = 20.0  # as far as the driving command looks


def route_ahead_m(road_map: RoadMap, route: Route, pose: Array) -> float | None:
    """Metres of the route's lanes ahead of a rear-axle pose (3,), along the longest way; inf: as far as is asked.

    Asked is for ONWARD_M, or to the route's end. None where the pose is on no lane of the route: farther than NEAR_M
    from its polygon, or turned against its centreline by more than NEAR_RAD. Raises NoRoute where the map has none of
    the route's lanes.
    """
    metres = centerline_finder(road_map, route).metres_ahead(pose, NEAR_M, NEAR_RAD, ONWARD_M)
    return metres if metres is None or metres < ONWARD_M else math.inf


# Whom a drive hits in the second after its end (docs/reward.md 2m).
#
# A drive is judged up to its last instant, time to collision up to 0.9 s before it. So it may end a moment before a
# collision that nobody can prevent any more. Here traffic and ego go on for a second: the ego at its speed and steering
# angle, or braking on the same arc.

AFTER_STEPS = 10  # 1 s
BRAKING_MPS2 = 3.0  # comfortable: what PDM-Closed brakes with (docs/reward.md 4)


def hit_after_s(traffic: TrafficScene, prepared: PreparedScene, states: Array, braking_mps2: float = 0.0) -> float:
    """Seconds from a drive's end to the first collision at fault in the second after it; inf: there is none.

    traffic: as the drive with states (41, 11) met it; prepared: the scene that it was judged in. The ego goes on as
    `extrapolate` has it, the traffic answers to that. At fault is what NC takes for it (docs/reward.md 2b); who touches
    the ego at the drive's end is left out, as who touches it at a scene's start is.
    """
    going_on = extrapolate(states, braking_mps2)
    tracks = roll_out_longer(traffic, going_on).window(HORIZON_STEPS, len(going_on))
    after = going_on[HORIZON_STEPS:].copy()
    left = tracks.valid.any(axis=0) & ~touching(ego_boxes(after[0], PACIFICA), tracks.boxes[0])
    boxes = np.where(tracks.valid[:, left, None], tracks.boxes[:, left], np.nan)
    score = collision_scores(tracks.kinds)[left]
    velocity = tracks.velocities[tracks.valid.argmax(axis=0), np.arange(len(tracks))]  # where it is first seen
    is_stopped = (score > 0.0) | (np.hypot(*velocity.T) <= STOPPED_SPEED_MPS)[left]
    return STEP_S * float(_first_hit(rule_context(prepared, with_history=False), boxes, is_stopped, score, after))


def extrapolate(states: Array, braking_mps2: float = 0.0) -> Array:
    """States (51, 11): those of a drive (41, 11), and a second more at its last steering angle.

    At its last speed, or slowing down by `braking_mps2` until it stands. On an arc, since the kinematic bicycle's
    curvature is tan(steering) / wheel base (docs/reward.md 1b).
    """
    end = states[-1]
    seconds = STEP_S * np.arange(1, AFTER_STEPS + 1)
    if braking_mps2 > 0.0:
        seconds = np.minimum(seconds, abs(end[VX]) / braking_mps2)
    slowing = math.copysign(braking_mps2, end[VX])
    way, curvature = end[VX] * seconds - 0.5 * slowing * seconds**2, math.tan(end[STEERING]) / PACIFICA.wheel_base
    turn = curvature * way
    chord = way * np.sinc(turn / (2.0 * np.pi))  # numpy's sinc has pi in it
    after = np.zeros((AFTER_STEPS, len(end)))
    after[:, X] = end[X] + chord * np.cos(end[HEADING] + turn / 2.0)
    after[:, Y] = end[Y] + chord * np.sin(end[HEADING] + turn / 2.0)
    after[:, HEADING] = end[HEADING] + turn
    after[:, VX] = end[VX] - slowing * seconds
    after[:, AX] = -slowing
    after[:, STEERING], after[:, YAW_RATE] = end[STEERING], curvature * after[:, VX]
    return np.concatenate([states, after])


@kernel
def _first_hit(context: RuleContext, boxes: Array, is_stopped: Bools, collision_score: Array, states: Array) -> float:
    """Index of the first collision at fault of states (T, 11) with boxes (T, N, 5), inf: none."""
    n_times, n_objects = states.shape[0], len(is_stopped)
    body, places = empty_body(n_times), empty_places(context.map_index, N_CORNERS * n_times)
    place_body(states, REAR_AXLE_TO_CENTER, body)
    set_area_flags(context.map_index, body, HALF_LENGTH, HALF_WIDTH, places)
    obstacles, looks = obstacles_of(boxes, is_stopped, collision_score), empty_looks(n_times, n_times, n_objects)
    set_looks(body, looks)
    return first_contacts(obstacles, states, body, looks, 0, context.map_index, places)[1]


# A vocabulary's labels.

TRAJECTORIES_AT_ONCE = 512  # 2 MB of states, which stay in the caches


def vocabulary_labels(
    vocabulary: Vocabulary, scene: Scene, prepared: PreparedScene, reference: Array
) -> VocabularyLabels:
    """The scores of the whole vocabulary, driven by the tracker from the scene's ego state at the sample's now.

    prepared: the scene with the objects that the sample was judged among; reference: (41, 11) PDM-Closed as the tracker
    drives it, to which every trajectory's progress is related.
    """
    rows, trajectories = vocabulary.along_strips
    found = {name: np.empty(len(trajectories)) for name in ARRAYS}
    reference_m = 0.0
    states = np.empty((1 + min(len(trajectories), TRAJECTORIES_AT_ONCE), *reference.shape))
    states[0] = reference
    for start in range(0, len(trajectories), TRAJECTORIES_AT_ONCE):
        block = trajectories[start : start + TRAJECTORIES_AT_ONCE]
        track(scene.ego_state, block, local=True, out=states[1 : 1 + len(block)])
        scores = score(prepared, states[: 1 + len(block)], normalise="pairs")
        reference_m = float(scores.ep_raw_m[0] * scores.multiplier[0])
        for name, values in found.items():
            values[start : start + len(block)] = getattr(scores, name)[1:]
    kept = {name: np.empty_like(values) for name, values in found.items()}
    for name, values in kept.items():
        values[rows] = found[name]
    return VocabularyLabels(vocabulary.digest, reference_m, **kept)

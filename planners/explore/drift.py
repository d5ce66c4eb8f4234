"""Where a planner drives itself within H of the log, and how it does from there.

A way begins with the log, from T for `after_s`; there the planner takes over. In the open loop its plan at T is
followed for all of H; in the closed loop it plans every 0.5 s. Where it is at T+H is its drift. From there it
drives on in the closed loop for another H, and that drive is judged as an expert's is: by the reward's rules, against
PDM-Closed, among the traffic that it met. Nothing ends a drive on the way: what it hit or left is what it is judged by.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from planners.drive.drivers import DriveEnd, Driver
from planners.drive.eyes import Eyes, Sight
from planners.drive.loop import PLAN_STEPS
from tasks.attempt import ExpertGate, has_route, judge, verdict
from tasks.experts.pdm_closed.planner import PdmSettings, plan_for
from tasks.experts.protocol import Plan
from tasks.perturb import PerturbSettings, gate_failures
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficSettings, next_scene, prepare_traffic, roll_out
from tasks.subscores import OF_ONE_PLAN
from tasks.world.arrays import Array
from tasks.world.clip import HISTORY_STEPS, HORIZON_STEPS, NOW, STEP_S, Clip, Rollout, Scene, scene_of_clip
from tasks.world.frames import to_local
from tasks.world.route import RouteFinder
from tasks.world.vehicle import HEADING

CLIP_STEPS = NOW + 2 * HORIZON_STEPS + PLAN_STEPS + HORIZON_STEPS + 1  # that a clip must have to be driven in
NO_PLAN, NO_ROUTE, NO_SCORE = "no_plan", "route_ended", "no_score"


@dataclass(frozen=True)
class Handover:
    """How a planner is let drive from T to T+H."""

    after_s: float  # of the log
    closed: bool

    def __str__(self) -> str:
        return f"{'closed' if self.closed else 'open'} loop from {self.after_s:.1f} s"

    @property
    def start_step(self) -> int:
        """Of the clip, where the planner takes over."""
        return NOW + round(self.after_s / STEP_S)


@dataclass(frozen=True)
class Judging:
    """What a planner's drive is judged by, and among whom it drives."""

    perturb: PerturbSettings
    traffic: TrafficSettings
    pdm: PdmSettings
    gate: ExpertGate


@dataclass(frozen=True)
class Judgement:
    """How a drive of H was."""

    score: float  # EPDMS (/14)
    fails: str  # the first sub-score for which the reward would reject it; "": none
    subscores: Mapping[str, float]


@dataclass(frozen=True)
class Drifted:
    """A state that a planner drove itself into."""

    way: Handover
    ego_states: Array  # (41, 11) T .. T+H
    end_pose: Array  # (3,) in the frame of the logged pose at T+H
    there: Judgement  # of its drive from T+H on


def ways_of(open_loop: bool, handover_s: Sequence[float]) -> tuple[Handover, ...]:
    """The closed loop from each of these times, then the open loop from T."""
    closed = tuple(Handover(after_s, True) for after_s in handover_s)
    return (*closed, Handover(0.0, False)) if open_loop else closed


def from_the_log(clip: Clip, driver: Driver, eyes: Eyes, judging: Judging) -> Judgement | str:
    """The planner's closed loop from T to T+H; NO_PLAN, NO_ROUTE or NO_SCORE where there is no such thing."""
    came = drive_on(handed_over(clip, NOW), driver, eyes, judging.traffic, HORIZON_STEPS, PLAN_STEPS)
    return NO_PLAN if came is None else _verdict(scene_of_clip(clip), *came, judging)


def drift(clip: Clip, way: Handover, driver: Driver, eyes: Eyes, judging: Judging) -> Drifted | str:
    """Where a way leads; why it leads nowhere: the gate of the perturbation that its end fails, or as `from_the_log`.

    clip: of CLIP_STEPS (planners.drive.starts.lengthened). Raises ValueError where the driver's answer is no plan.
    """
    start = way.start_step
    follow = PLAN_STEPS if way.closed else HORIZON_STEPS
    came = drive_on(handed_over(clip, start), driver, eyes, judging.traffic, NOW + HORIZON_STEPS - start, follow)
    if came is None:
        return NO_PLAN
    states, there = np.concatenate([clip.ego_states[NOW:start], came[0]]), came[1]
    end_pose = to_local(clip.ego_states[NOW + HORIZON_STEPS, : HEADING + 1], states[-1, : HEADING + 1])
    for gate, fails in gate_failures(end_pose, judging.perturb).items():
        if fails:
            return gate
    on = drive_on(there, driver, eyes, judging.traffic, HORIZON_STEPS, PLAN_STEPS)
    found = NO_PLAN if on is None else _verdict(there, *on, judging)
    return found if isinstance(found, str) else Drifted(way, states, end_pose, found)


def handed_over(clip: Clip, step: int) -> Scene:
    """The logged scene at a step of the clip, from T on."""
    if step == NOW:
        return scene_of_clip(clip)
    ahead = RouteFinder(clip.road_map, clip.route).centerline_from(clip.ego_states[step, : HEADING + 1])
    return Scene(clip, step, clip.ego_states[step - HISTORY_STEPS : step + 1], clip.agents, ahead)


def drive_on(
    scene: Scene, driver: Driver, eyes: Eyes, traffic: TrafficSettings, n_steps: int, follow_steps: int
) -> tuple[Array, Scene] | None:
    """The ego's states (n_steps + 1, 11) and the scene at their end, of a driver that follows each plan for so long.

    follow_steps: divides n_steps. None where the driver has no plan. Traffic is prepared anew at every plan.
    """
    finder, sight, states = RouteFinder(scene.clip.road_map, scene.clip.route), Sight(eyes), [scene.ego_state[None]]
    for _ in range(n_steps // follow_steps):
        plan = driver.plan(scene, sight.look(scene).sample)
        if isinstance(plan, DriveEnd):
            return None
        tracked = track(scene.ego_state, plan[None])[0]
        rollout = roll_out(prepare_traffic(scene, traffic), tracked, follow_steps)
        states.append(tracked[1 : follow_steps + 1])
        scene = next_scene(scene, rollout, finder.centerline_from(tracked[follow_steps, : HEADING + 1]), follow_steps)
    return np.concatenate(states), scene


def _verdict(start: Scene, states: Array, end: Scene, judging: Judging) -> Judgement | str:
    """Of a drive of H from a scene, among the traffic that the scene at its end remembers."""
    if not has_route(start.centerline):
        return NO_ROUTE
    agents = end.agents.window(start.step, start.step + HORIZON_STEPS + 1)
    moved = end.ever_simulated if end.ever_simulated is not None else np.zeros(len(agents), dtype=bool)
    rollout = Rollout(start.step, states, agents, moved)
    plan, touching = Plan(states[1:, : HEADING + 1]), judging.traffic.leaves_out_touching
    scores = judge(start, plan, rollout, plan_for(start, judging.pdm), touching).scores
    named = {name: float(getattr(scores, name)[1]) for name in OF_ONE_PLAN}
    if not np.isfinite([*named.values(), scores.pdm_score[1]]).all():
        return NO_SCORE
    rejected = verdict(scores, judging.gate)
    return Judgement(float(scores.pdm_score[1]), "" if rejected is None else rejected.reason, named)

"""The closed loop of AlpaSim's nuPlan track: look, plan, follow the plan for 0.5 s among the others, and again.

From the log its first 0.5 s are driven whatever is planned, then AlpaSim's MPC follows the plans (planners.drive.mpc);
from a perturbed start it does at once. A drive lasts as long as its recording, whatever happens: what counts of it,
planners.drive.alpasim_score says. The others are prepared anew from where all have come to at every plan.
"""

from dataclasses import dataclass, field

import numpy as np

from planners.drive.cameras import DriveCameras, Images, NoCameras, Observer
from planners.drive.drivers import Driver
from planners.drive.mpc import ControllerName, car_at, car_that_moves, controller_of, follow
from planners.drive.starts import LOGGED, DriveStart
from tasks.rollout.simulate import TrafficSettings, next_scene, prepare_traffic, roll_out
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, STEP_S, AgentTracks, Scene
from tasks.world.frames import HEADING, to_local, to_world
from tasks.world.road_map import centerline_finder

DRIVE_VERSION = 4  # raised by hand whenever the same start is driven otherwise
PLAN_STEPS = 5  # of 0.1 s between two plans: 2 Hz
FIRST_QUESTION_S = 0.017  # after the first pose of a recording: a picture's exposure


@dataclass(frozen=True)
class LoopSettings:
    """What every drive depends on."""

    seconds: float = 5.5  # of the recording; a drive is as long as whole plans fit into it, and into the log
    controller: ControllerName = "linear"
    traffic: TrafficSettings = field(default_factory=TrafficSettings)

    def __post_init__(self) -> None:
        if not FIRST_QUESTION_S + PLAN_STEPS * STEP_S <= self.seconds <= 600.0:
            raise ValueError(f"seconds={self.seconds}: a drive is made of 0.517 to 600 s of a recording")

    @property
    def n_steps(self) -> int:
        """Of 0.1 s, of the longest drive."""
        return PLAN_STEPS * int((self.seconds - FIRST_QUESTION_S) / (PLAN_STEPS * STEP_S) + 1e-9)

    def clip_steps(self, start_step: int) -> int:
        """That a clip must have for drives from this step of it: a horizon is looked at beyond the last."""
        return start_step + self.n_steps + PLAN_STEPS + HORIZON_STEPS + 1


@dataclass(frozen=True)
class ClosedLoopDrive:
    """A drive. S + 1 instants 0.1 s apart, the first of them the start's; P plans, the first made at the start."""

    start: DriveStart
    ego_states: Array  # (S + 1, 11)
    agents: AgentTracks  # S + 1 steps
    plans: Array  # (P, 40, 3) world
    images: tuple[Images, ...]  # (P,) what the cameras saw

    @property
    def n_steps(self) -> int:
        """S."""
        return len(self.ego_states) - 1


def drive(
    start: DriveStart, driver: Driver, settings: LoopSettings | None = None, cameras: DriveCameras | None = None
) -> ClosedLoopDrive:
    """Drive on from the start until the recording ends, or the driver has no plan any more.

    cameras: of a driver that looks; None: there are none. Raises ValueError where the clip has too few steps
    (`extend_clip`), its log ends within 0.5 s, its map has none of the route's lanes, or an answer is no plan.
    """
    settings, seen, scene = settings or LoopSettings(), cameras or NoCameras(), start.scene
    if scene.clip.agents.n_steps < settings.clip_steps(scene.step):
        raise ValueError(f"the clip must have {settings.clip_steps(scene.step)} steps, not {scene.clip.agents.n_steps}")
    log_steps = len(scene.clip.ego_states) - 1 - scene.step
    n_plans = min(settings.n_steps, log_steps) // PLAN_STEPS
    if n_plans < 1:
        raise ValueError(f"the log goes on for {log_steps * STEP_S:.1f} s: 0.5 s of it or more are driven")
    finder = centerline_finder(scene.clip.road_map, scene.clip.route)
    tracker, observer = _MpcTracker(start, settings.controller), Observer(seen)
    states, plans, images = [scene.ego_state], list[Array](), list[Images]()
    for _ in range(n_plans):
        seen_now, sample = observer.observe(scene)
        plan = driver.plan(scene, sample)
        if plan is None:
            break
        plans.append(plan)
        images.append(seen_now)
        tracked = tracker(scene, plan)
        rollout = roll_out(prepare_traffic(scene, settings.traffic), tracked, PLAN_STEPS)
        states += list(rollout.ego_states[1 : PLAN_STEPS + 1])
        scene = next_scene(scene, rollout, finder.centerline_from(tracked[PLAN_STEPS, : HEADING + 1]), PLAN_STEPS)
    first = start.scene.step
    return ClosedLoopDrive(
        start=start,
        ego_states=np.stack(states),
        agents=scene.agents.window(first, first + len(states)),
        plans=np.stack(plans) if plans else np.empty((0, HORIZON_STEPS, 3)),
        images=tuple(images),
    )


class _MpcTracker:
    """Follows plans by AlpaSim's MPC, from the log up to the second one by the log."""

    def __init__(self, start: DriveStart, controller: ControllerName) -> None:
        self._controller = controller_of(controller)
        self._car = None if start.number == LOGGED else car_at(start.scene.ego_state)

    def __call__(self, scene: Scene, plan: Array) -> Array:
        """(41, 11) of which PLAN_STEPS are driven; the last of those holds after them, and nobody looks at it."""
        if self._car is None:
            log = scene.clip.ego_states[scene.step : scene.step + HORIZON_STEPS + 1]
            poses = log[:, : HEADING + 1]
            self._car, _ = follow(
                car_that_moves(poses[0], poses[PLAN_STEPS], PLAN_STEPS * STEP_S),
                poses[1:],
                PLAN_STEPS,
                self._controller,
            )
            driven = log[1 : PLAN_STEPS + 1]
        else:
            car = np.concatenate([scene.ego_state[: HEADING + 1], self._car[HEADING + 1 :]])
            self._car, driven = follow(car, plan, PLAN_STEPS, self._controller)
        held = np.repeat(driven[-1:], HORIZON_STEPS - PLAN_STEPS, axis=0)
        return np.concatenate([scene.ego_state[None], driven, held])


def first_pose(states: Array) -> Array:
    """(3,) where the ego was when a recording began whose first question comes at the second of two states (2, >= 3)
    0.1 s apart."""
    before, now = states[-2:, : HEADING + 1]
    there: Array = to_world(now, FIRST_QUESTION_S / STEP_S * to_local(now, before))
    return there

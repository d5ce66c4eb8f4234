"""The closed loop: look, plan, follow the plan for 0.5 s among traffic that answers, and again.

The plan is tracked at 10 Hz by the LQR on the kinematic bicycle that follows every plan here (docs/reward.md 1a); the
traffic is prepared anew from where all have come to, as between the two stages of a sample. What ends a drive is looked
at at every 0.1 s (DriveEnd). A collision is at the ego's fault by the rule of no at-fault collision; off the road is a
body with a corner in no drivable area (docs/reward.md 2a, 2b).

By rule="alpasim" it is AlpaSim's nuPlan track: the first 0.5 s are the log's, then its MPC follows the plans, and a
drive lasts as long as its recording whatever happens; planners.drive.contract asks and planners.drive.alpasim_score
judges.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from planners.drive.cameras import DriveCameras, Images, NoCameras, Observer
from planners.drive.drivers import DriveEnd, Driver
from planners.drive.mpc import car_that_moves, follow
from planners.drive.starts import DriveStart
from tasks.reward.comfort import comfortable
from tasks.reward.epdms import Scores, prepare_scene, score
from tasks.rollout.lqr import track
from tasks.rollout.simulate import TrafficSettings, next_scene, prepare_traffic, roll_out
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import HORIZON_STEPS, STEP_S, AgentTracks, Rollout, Scene
from tasks.world.frames import HEADING, PACIFICA, VX, VY, X, Y, ego_boxes, to_local, to_world, touching
from tasks.world.road_map import CenterlineFinder, arc_lengths

# The road ahead of a drive: how far along it a place lies, and where it ends.

SPACING_M = 0.5  # the road is looked at this densely, however few points its lanes came with
BACK_M, AHEAD_M = 10.0, 30.0  # of the place before, that the next one is looked for in: a road may cross itself


@dataclass(frozen=True)
class RouteAhead:
    """A route's centreline from a drive's start on."""

    xy: Array  # (P, 2) world [m]
    along_m: Array  # (P,) arc length [m]
    start_m: float  # of the ego's rear axle
    end_m: float  # of the rear axle where the front bumper is at the road's end
    known_m: float  # as far as the world is known, at most `end_m`

    @property
    def length_m(self) -> float:
        """Of the route: from the start to where the road, or what is known of it, ends; 0 or more."""
        return max(0.0, self.known_m - self.start_m)

    def place_m(self, xy: Array, before_m: float) -> float:
        """Arc length of the point nearest to a place (2,), the place before having been at `before_m`."""
        near = np.flatnonzero((self.along_m >= before_m - BACK_M) & (self.along_m <= before_m + AHEAD_M))
        first = max(int(near[0]) - 1, 0) if len(near) else max(len(self.xy) - 2, 0)
        last = min(int(near[-1]) + 1, len(self.xy) - 1) if len(near) else len(self.xy) - 1
        a, b = self.xy[first:last], self.xy[first + 1 : last + 1]
        edge = b - a
        square = np.maximum((edge**2).sum(axis=1), 1e-12)
        share = np.clip(((xy - a) * edge).sum(axis=1) / square, 0.0, 1.0)
        i = int(np.argmin(((a + share[:, None] * edge - xy) ** 2).sum(axis=1)))
        return float(self.along_m[first + i] + share[i] * np.sqrt(square[i]))


def route_ahead(centerline: Array, pose: Array, known: Array, bound_m: float) -> RouteAhead:
    """The road along a centreline (P, >= 2) from a rear-axle pose (3,).

    It is known as far as all of it lies within `bound_m` of the places `known` (K, 2).
    """
    line = centerline[:, :2]
    raw = arc_lengths(line)
    along = np.append(np.arange(0.0, raw[-1], SPACING_M), raw[-1])
    xy = np.stack([np.interp(along, raw, line[:, c]) for c in (0, 1)], axis=-1)
    distances = np.hypot(*(xy - pose[:2]).T)
    start_m = RouteAhead(xy, along, 0.0, 0.0, 0.0).place_m(pose[:2], float(along[int(np.argmin(distances))]))
    end_m = float(raw[-1]) - PACIFICA.front_length
    beyond = (along >= start_m) & (distance_m(xy, known) > bound_m)
    known_m = min(end_m, float(along[max(int(np.argmax(beyond)) - 1, 0)])) if beyond.any() else end_m
    return RouteAhead(xy, along, start_m, end_m, known_m)


def distance_m(places: Array, known: Array) -> Array:
    """(N,) of places (N, 2) to the nearest of the known ones (K, 2) [m]."""
    nearest: Array = np.hypot(*np.moveaxis(places[:, None] - known, -1, 0)).min(axis=1)
    return nearest


LoopRule = Literal["own", "alpasim"]
DRIVE_VERSION = 1  # raised by hand whenever the same start is driven otherwise
PLAN_STEPS = 5  # of 0.1 s between two plans: 2 Hz
FIRST_QUESTION_S = 0.017  # after the first pose of AlpaSim's recording: a picture's exposure
NON_DRIVABLE = 1  # column of Scores.ego_areas


@dataclass(frozen=True)
class LoopSettings:
    """What every drive depends on."""

    seconds: float = 20.0  # after which a drive ends
    bound_m: float = 30.0  # from the nearest place that the log's sensors were at
    traffic: TrafficSettings = field(default_factory=TrafficSettings)
    rule: LoopRule = "own"

    def __post_init__(self) -> None:
        if not 0.5 <= self.seconds <= 600.0:
            raise ValueError(f"seconds={self.seconds}: a drive lasts from 0.5 to 600 s")
        if self.n_steps < 1:
            raise ValueError(f"seconds={self.seconds}: by AlpaSim's rule 0.517 s or more")
        if not 0.0 < self.bound_m < np.inf:
            raise ValueError(f"bound_m={self.bound_m}: must be positive and finite [m]")

    @property
    def n_steps(self) -> int:
        """Of 0.1 s, of the longest drive; by AlpaSim, those of whole plans that fit into a recording so long."""
        if self.rule == "own":
            return round(self.seconds / STEP_S)
        return PLAN_STEPS * int((self.seconds - FIRST_QUESTION_S) / (PLAN_STEPS * STEP_S) + 1e-9)

    def clip_steps(self, start_step: int) -> int:
        """That a clip must have for drives from this step of it: a horizon is looked at beyond the last."""
        return start_step + self.n_steps + PLAN_STEPS + HORIZON_STEPS + 1


@dataclass(frozen=True)
class Hit:
    """What the ego's body touched."""

    track_id: str
    kind: str
    at_fault: bool
    speed_mps: float  # of the ego


@dataclass(frozen=True)
class ClosedLoopDrive:
    """A drive. S + 1 instants 0.1 s apart, the first of them the start's; P plans, the first made at the start."""

    start: DriveStart
    road: RouteAhead
    ego_states: Array  # (S + 1, 11)
    agents: AgentTracks  # S + 1 steps
    off_road: Bools  # (S + 1,)
    along_m: Array  # (S + 1,) arc length of the rear axle along the road
    plans: Array  # (P, 40, 3) world
    images: tuple[Images, ...]  # (P,) what the cameras saw
    ended: DriveEnd
    hit: Hit | None

    @property
    def n_steps(self) -> int:
        """S."""
        return len(self.ego_states) - 1


def drive(
    start: DriveStart, driver: Driver, settings: LoopSettings | None = None, cameras: DriveCameras | None = None
) -> ClosedLoopDrive:
    """Drive on from the start until something ends it.

    cameras: of a driver that looks; None: there are none. Raises ValueError where the clip has too few steps
    (`extend_clip`), its map has none of the route's lanes, or the driver's answer is no plan.
    """
    settings, seen, scene = settings or LoopSettings(), cameras or NoCameras(), start.scene
    if scene.clip.agents.n_steps < settings.clip_steps(scene.step):
        raise ValueError(f"the clip must have {settings.clip_steps(scene.step)} steps, not {scene.clip.agents.n_steps}")
    finder = CenterlineFinder(scene.clip.road_map, scene.clip.route)
    tracker = _AlpasimTracker() if settings.rule == "alpasim" else _tracked
    course, observer = _DriveSoFar(start, settings), Observer(seen)
    plans: list[Array] = []
    images: list[Images] = []
    while course.ended is None:
        seen_now, sample = observer.observe(scene)
        plan = driver.plan(scene, sample)
        if isinstance(plan, DriveEnd):
            course.ended = plan
            break
        plans.append(plan)
        images.append(seen_now)
        tracked = tracker(scene, plan)
        rollout = roll_out(prepare_traffic(scene, settings.traffic), tracked, PLAN_STEPS)
        steps = course.follow(rollout, score(prepare_scene(scene, rollout.agents), tracked[None]))
        ahead = finder.centerline_from(tracked[steps, : HEADING + 1])
        scene = next_scene(scene, rollout, ahead, steps)
    first, n = start.scene.step, len(course.states)
    return ClosedLoopDrive(
        start=start,
        road=course.road,
        ego_states=np.stack(course.states),
        agents=scene.agents.window(first, first + n),
        off_road=np.array(course.off_road[:n] or [False], dtype=bool),
        along_m=np.array(course.along_m),
        plans=np.stack(plans) if plans else np.empty((0, HORIZON_STEPS, 3)),
        images=tuple(images),
        ended=course.ended,
        hit=course.hit,
    )


def _tracked(scene: Scene, plan: Array) -> Array:
    """(41, 11) as every plan is followed here."""
    return track(scene.ego_state, plan[None])[0]


class _AlpasimTracker:
    """As AlpaSim follows plans: by its MPC, and by the log up to the second one."""

    def __init__(self) -> None:
        self._car: Array | None = None

    def __call__(self, scene: Scene, plan: Array) -> Array:
        """(41, 11) of which PLAN_STEPS are driven; the last of those holds after them, and nobody looks at it."""
        if self._car is None:
            log = scene.clip.ego_states[scene.step : scene.step + HORIZON_STEPS + 1]
            poses = log[:, : HEADING + 1]
            self._car, _ = follow(
                car_that_moves(poses[0], poses[PLAN_STEPS], PLAN_STEPS * STEP_S), poses[1:], PLAN_STEPS
            )
            driven = log[1 : PLAN_STEPS + 1]
        else:
            car = np.concatenate([scene.ego_state[: HEADING + 1], self._car[HEADING + 1 :]])
            self._car, driven = follow(car, plan, PLAN_STEPS)
        held = np.repeat(driven[-1:], HORIZON_STEPS - PLAN_STEPS, axis=0)
        return np.concatenate([scene.ego_state[None], driven, held])


def first_pose(scene: Scene) -> Array:
    """(3,) where the ego was when AlpaSim's recording began, whose first question this scene is."""
    before, now = scene.ego_history[-2:, : HEADING + 1]
    there: Array = to_world(now, FIRST_QUESTION_S / STEP_S * to_local(now, before))
    return there


class _DriveSoFar:
    """A drive as far as it has come."""

    def __init__(self, start: DriveStart, settings: LoopSettings) -> None:
        scene = start.scene
        self.start, self.settings = start, settings
        log_steps = len(scene.clip.ego_states) - 1 - scene.step
        self._n_steps = settings.n_steps
        if settings.rule == "alpasim":
            self._n_steps = min(self._n_steps, log_steps // PLAN_STEPS * PLAN_STEPS)
            if self._n_steps < PLAN_STEPS:
                raise ValueError(f"the log goes on for {log_steps * STEP_S:.1f} s: AlpaSim drives 0.5 s of it or more")
        self.road = route_ahead(scene.centerline, scene.ego_state[: HEADING + 1], start.known, settings.bound_m)
        self.states, self.along_m, self.off_road = [scene.ego_state], [self.road.start_m], list[bool]()
        self.ended: DriveEnd | None = None
        self.hit: Hit | None = None
        # Who touches the ego from the start on is no collision, as in the public log replay, until it is apart.
        self._excused = _touching_agents(scene.ego_state, scene.agents, scene.step)

    def follow(self, rollout: Rollout, scores: Scores) -> int:
        """Take the rollout's next PLAN_STEPS, or those up to where the drive ends; how many."""
        flags = scores.ego_areas[0, :, NON_DRIVABLE]
        self.off_road += flags[:1].tolist() if not self.off_road else []
        for step in range(1, PLAN_STEPS + 1):
            state = rollout.ego_states[step]
            self.states.append(state)
            self.along_m.append(self.road.place_m(state[[X, Y]], self.along_m[-1]))
            touched = _touching_agents(state, rollout.agents, step)
            self.hit = self.hit or _collision_at(rollout, scores, step, np.setdiff1d(touched, self._excused))
            self._excused = np.intersect1d(touched, self._excused)
            self.ended = self._end(state)
            self.off_road.append(bool(flags[step]) and self.ended is not DriveEnd.ROAD_END)  # it has arrived
            if self.ended is not None:
                return step
        return PLAN_STEPS

    def _end(self, state: Array) -> DriveEnd | None:
        if self.settings.rule == "alpasim":  # which cuts off afterwards what came after an incident
            return DriveEnd.TIME if len(self.states) > self._n_steps else None
        if self.hit is not None:
            return DriveEnd.COLLISION
        if self.along_m[-1] >= self.road.end_m:
            return DriveEnd.ROAD_END
        if distance_m(state[None, [X, Y]], self.start.known)[0] > self.settings.bound_m:
            return DriveEnd.SCENE_END
        return DriveEnd.TIME if len(self.states) > self._n_steps else None


def _touching_agents(state: Array, agents: AgentTracks, step: int) -> Ints:
    """Rows of the agents whose box touches the ego's body at a step."""
    found: Ints = np.flatnonzero(agents.valid[step] & touching(ego_boxes(state, PACIFICA), agents.boxes[step]))
    return found


def _collision_at(rollout: Rollout, scores: Scores, step: int, touched: Ints) -> Hit | None:
    """The collision at a step, of those touched the first; scores: of the rollout, one row."""
    if len(touched) == 0:
        return None
    row = int(touched[0])
    at_fault = bool(scores.first_failures["nc"][0] == step)
    speed_mps = float(np.hypot(*rollout.ego_states[step, [VX, VY]]))
    return Hit(rollout.agents.track_ids[row], str(rollout.agents.kinds[row]), at_fault, speed_mps)


# What a drive is measured by.


@dataclass(frozen=True)
class DriveMeasures:
    """Numbers of one drive."""

    duration_s: float
    distance_m: float  # that the rear axle moved
    progress_m: float  # gained along the route, 0 or more
    route_m: float  # from the start to where the road, or what is known of it, ends
    route_completed: float  # progress over route, 0 .. 1; 1 where there was no route to complete
    collision: bool  # with anything, whoever is to blame
    at_fault_collision: bool
    off_road_s: float  # some corner of the body in no drivable area
    off_road_m: float  # driven meanwhile
    off_road_events: int  # how often it left the drivable area, counting a start outside of it
    comfortable: float  # share of the drive's instants within the six limits of history comfort, 0 .. 1

    @property
    def failures(self) -> int:
        """Collisions at fault and departures from the road."""
        return self.off_road_events + self.at_fault_collision


def measure_drive(drive: ClosedLoopDrive) -> DriveMeasures:
    """Comfort is judged with the start's own history, since its filters are as long as 1.5 s."""
    states, off = drive.ego_states, drive.off_road
    steps_m = np.hypot(*np.diff(states[:, [X, Y]], axis=0).T)
    progress_m = max(0.0, float(drive.along_m[-1] - drive.along_m[0]))
    route_m = drive.road.length_m
    history = drive.start.scene.ego_history
    within = comfortable(np.concatenate([history, states[1:]]))[len(history) - 1 :]
    return DriveMeasures(
        duration_s=drive.n_steps * STEP_S,
        distance_m=float(steps_m.sum()),
        progress_m=progress_m,
        route_m=route_m,
        route_completed=min(1.0, progress_m / route_m) if route_m > 0.0 else 1.0,
        collision=drive.hit is not None,
        at_fault_collision=drive.hit is not None and drive.hit.at_fault,
        off_road_s=float(off[1:].sum() * STEP_S),
        off_road_m=float(steps_m[off[1:]].sum()),
        off_road_events=int((off & ~np.append(False, off[:-1])).sum()),
        comfortable=float(within.mean()),
    )

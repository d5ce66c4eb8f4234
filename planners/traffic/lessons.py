"""What a traffic policy is to learn of a scene: what it sees, and what leads back to what the log did.

One vehicle a world drives, everybody else is on the log. It drives by the lesson itself with noise, or by the policy
as far as it is fitted, so that lessons are of places where that policy comes to (DAgger, Ross et al. 2011). What the
lesson is, tasks/rollout/learned/lesson.py says.

Logs hold next to no emergencies. In a third of the worlds a car is put onto the way that is slower than the vehicle,
and the lesson is to brake for it at least as IDM would: the one thing that is not taken from logs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from tasks.rollout.idm import IdmDriver
from tasks.rollout.learned.drive import BEFORE
from tasks.rollout.learned.imitation import HARDEST_BRAKE, HARDEST_START, SHARPEST, NetworkWeights, advanced, forward
from tasks.rollout.learned.lesson import braked_for, length_along, lessons, poses_along
from tasks.rollout.learned.look import NOW, look
from tasks.rollout.learned.policy import KIND_NUMBER, SEEN_ROWS, SeenWorlds
from tasks.rollout.simulate import SHORTEST_HEADWAY_S, TrafficScene
from tasks.world.agents import AgentKind, AgentTracks
from tasks.world.arrays import F32, Array, Bools, Ints
from tasks.world.boxes import ego_boxes
from tasks.world.clip import HORIZON_STEPS, STEP_S, Scene
from tasks.world.frames import wrap_angle
from tasks.world.vehicle import PACIFICA

REPLICAS = 3  # worlds of each vehicle: as logged, from a place beside it, and from there behind a slower car
SIDE_M, TURN_RAD, RATE = 0.35, 0.05, 0.1  # standard deviations at the start: beside, turned, faster
SWAY = np.array([1.0, 0.01])  # [m/s2], [1/m] of noise on a lesson that is driven
SWAY_STEPS = 5  # that it lasts
LEAD_GAP_M = (4.0, 45.0)  # to the slower car at the start
LOST_M = 4.0  # of the log, where a lesson has no meaning any more
SMOOTH_STEPS = 2  # each side, of the log's speeds
BODY = (4.6, 1.9)  # of the slower car [m]


@dataclass(frozen=True)
class Lessons:
    """M lessons."""

    own: F32  # (M, OWN)
    near: F32  # (M, NEIGHBOURS, NEAR)
    count: Ints  # (M,) neighbours there are
    wants: F32  # (M, 2) acceleration [m/s2], curvature [1/m]
    known: F32  # (M, 2) whether each is, 0 or 1

    def __len__(self) -> int:
        return len(self.own)


def joined(parts: Sequence[Lessons]) -> Lessons:
    """One after the other."""
    return Lessons(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Lessons)))


@dataclass(frozen=True)
class _LessonWorlds:
    """B worlds of one scene over its past and T rows, each with the vehicle that drives in it."""

    boxes: Array  # (BEFORE + T, B, N + 2, 5): the agents, a slower car, the ego
    velocities: Array  # (BEFORE + T, B, N + 2, 2)
    valid: Bools  # (BEFORE + T, B, N + 2)
    who: Ints  # (B,)


def lessons_of(
    scene: Scene, traffic: TrafficScene, weights: NetworkWeights | None, rng: np.random.Generator
) -> Lessons:
    """All of a logged scene, prepared as traffic=learned is; weights: who drives, None: the lesson with noise."""
    assert traffic.roles is not None and traffic.streets is not None
    roles, ways, start = traffic.roles, traffic.streets.ways, scene.step
    driven = (roles.path >= 0) & ~roles.standing & scene.agents.valid[start] & (roles.join_step <= start)
    course = _course(scene, traffic, np.repeat(np.flatnonzero(driven), REPLICAS), rng)
    xy, speed = _logged(scene.clip.agents)
    kinds = np.array([KIND_NUMBER[kind] for kind in (*scene.agents.kinds, AgentKind.VEHICLE, AgentKind.VEHICLE)])
    way, n_worlds, n = np.append(roles.path, -1), len(course.who), len(scene.agents)
    settings = replace(traffic.settings, headway_s=SHORTEST_HEADWAY_S)
    driver = IdmDriver(*(getattr(settings, name) for name in IdmDriver._fields))
    lost, parts, sway = np.zeros(n_worlds, bool), [], np.zeros((n_worlds, 2))
    for t in range(HORIZON_STEPS):
        lost |= ~scene.agents.valid[start + t, course.who]
        free = np.flatnonzero(~lost & (start + t >= roles.hold_until[course.who]))
        who = np.column_stack([free, course.who[free]])
        asked = np.zeros((n_worlds, n + 1), bool)
        asked[free, course.who[free]] = True
        rows, line_state = slice(t, t + SEEN_ROWS), ways.line_state[t : t + 1]
        seen = SeenWorlds(course.boxes[rows], course.velocities[rows], course.valid[rows], kinds, asked)
        views = look(seen, ways._replace(line_state=line_state), way, who)
        boxes, velocities = seen.boxes[NOW], seen.velocities[NOW]
        wants, known, away = lessons(xy, speed, start + t, boxes, velocities, who)
        braked_for(wants, ways, way, driver, boxes, velocities, who, n)
        wants = np.clip(wants, [-HARDEST_BRAKE, -SHARPEST], [HARDEST_START, SHARPEST])
        lost[free[(away > LOST_M) | (known[:, 0] == 0.0)]] = True
        kept = ~lost[free]
        own, near, count = views
        parts.append(_halved(own[kept], near[kept], count[kept], wants[kept], known[kept]))
        if t % SWAY_STEPS == 0:
            sway = rng.normal(0.0, SWAY, (n_worlds, 2)) * (np.arange(n_worlds) % REPLICAS > 0)[:, None]
        moves = wants + sway[free] if weights is None else forward(weights, *views)
        _move(course, t, who, advanced(seen, who, moves))
    return joined(parts)


def _halved(own: Array, near: Array, count: Ints, wants: Array, known: Array) -> Lessons:
    own32, near32, wants32, known32 = (np.asarray(array, np.float32) for array in (own, near, wants, known))
    return Lessons(own32, near32, count, wants32, known32)


def _move(course: _LessonWorlds, t: int, who: Ints, answer: Array) -> None:
    """Where the answer has those who drive, in row t + 1; everybody else is on the log there."""
    row, (b, i) = BEFORE + t + 1, who.T
    x, y, h, v = answer[b, i].T
    course.boxes[row, b, i, :3] = np.column_stack([x, y, h])
    course.boxes[row, b, i, 3:] = course.boxes[row - 1, b, i, 3:]
    course.velocities[row, b, i] = v[:, None] * np.column_stack([np.cos(h), np.sin(h)])
    course.valid[row, b, i] = True


def _course(scene: Scene, traffic: TrafficScene, who: Ints, rng: np.random.Generator) -> _LessonWorlds:
    start, n = scene.step, len(scene.agents)
    log = scene.agents.window(start - BEFORE, start + HORIZON_STEPS + 1)
    shape = (log.n_steps, len(who), n + 2)
    course = _LessonWorlds(np.full((*shape, 5), np.nan), np.full((*shape, 2), np.nan), np.zeros(shape, bool), who)
    for name in ("boxes", "velocities", "valid"):
        getattr(course, name)[:, :, :n] = getattr(log, name)[:, None]
    ego = ego_boxes(scene.clip.ego_states[start - BEFORE : start + HORIZON_STEPS + 1], PACIFICA)
    course.boxes[:, :, n + 1], course.valid[:, :, n + 1] = ego[:, None], True
    course.velocities[:, :, n + 1] = np.gradient(ego[:, :2], STEP_S, axis=0)[:, None]
    for b in range(len(who)):
        if b % REPLICAS > 0:
            _set_beside(course, b, rng)
        if b % REPLICAS == REPLICAS - 1:
            _set_slower_car(course, b, traffic, rng)
    return course


def _logged(agents: AgentTracks) -> tuple[Array, Array]:
    """Places (S, N, 2) and speeds (S, N) along the headings, of a few steps at once; NaN where unknown."""
    steps, heading = np.arange(agents.n_steps), agents.boxes[..., 2]
    early, late = np.maximum(steps - SMOOTH_STEPS, 0), np.minimum(steps + SMOOTH_STEPS, steps[-1])
    moved = (agents.boxes[late, :, :2] - agents.boxes[early, :, :2]) / (STEP_S * (late - early))[:, None, None]
    speed = np.maximum(moved[..., 0] * np.cos(heading) + moved[..., 1] * np.sin(heading), 0.0)
    return np.ascontiguousarray(agents.boxes[..., :2]), speed


def _set_beside(course: _LessonWorlds, b: int, rng: np.random.Generator) -> None:
    """The vehicle's past, now included: beside the log, turned against it, and faster or slower."""
    i, past = course.who[b], slice(0, SEEN_ROWS)
    x, y, h = course.boxes[BEFORE, b, i, :3].tolist()
    side, turn, rate = rng.normal(0.0, SIDE_M), rng.normal(0.0, TURN_RAD), math.exp(rng.normal(0.0, RATE))
    c, s = rate * math.cos(turn), rate * math.sin(turn)
    turned = np.array([[c, s], [-s, c]])  # of rows
    here = np.array([x - side * math.sin(h), y + side * math.cos(h)])
    course.boxes[past, b, i, :2] = here + (course.boxes[past, b, i, :2] - [x, y]) @ turned
    course.boxes[past, b, i, 2] = wrap_angle(course.boxes[past, b, i, 2] + turn)
    course.velocities[past, b, i] = course.velocities[past, b, i] @ turned


def _set_slower_car(course: _LessonWorlds, b: int, traffic: TrafficScene, rng: np.random.Generator) -> None:
    """On the vehicle's way, ahead of it, at a constant speed; every third one stands."""
    assert traffic.streets is not None
    i, n, ways = int(course.who[b]), course.boxes.shape[2] - 2, traffic.streets.ways
    m = int(traffic.streets.way[i])
    x, y, _, length, _ = course.boxes[BEFORE, b, i].tolist()
    speed = float(np.hypot(*course.velocities[BEFORE, b, i])) * max(rng.uniform(-0.5, 1.0), 0.0)
    at = length_along(ways, m, x, y) + 0.5 * (length + BODY[0]) + rng.uniform(*LEAD_GAP_M)
    poses = poses_along(ways, m, at + speed * STEP_S * (np.arange(len(course.boxes)) - BEFORE))
    course.boxes[:, b, n, :3], course.boxes[:, b, n, 3:] = poses, BODY
    course.velocities[:, b, n] = speed * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    course.valid[:, b, n] = True

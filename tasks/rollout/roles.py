"""The agents' roles and paths, as a scene's log gives them: who stands, who joins the lanes when, who starts when."""

import numpy as np

from tasks.rollout.corridor import PATH_SPACING_M, Paths, stretches_of
from tasks.rollout.idm import CLOSED, CLOSED_IF_STOPPABLE, OPEN
from tasks.rollout.lane_following import LaneIndex, LanePath, lane_costs, on_a_lane
from tasks.world.arrays import Array, Bools, Bytes, Ints
from tasks.world.clip import HORIZON_STEPS, STEP_S, AgentTracks, Scene
from tasks.world.road_map import LightState

NEVER = 1_000_000  # a step no clip has
STANDS_WITHIN_M, STANDS_BELOW_MPS = 1.0, 0.3  # over a whole log: boxes of parked cars jitter by decimetres
STARTED_AFTER_M = 0.5  # a car that stood has started


def stands_always(log: AgentTracks) -> Bools:
    """(N,) tracks that never leave their place."""
    seen = log.valid.sum(axis=0)
    first = np.take_along_axis(log.boxes[..., :2], log.valid.argmax(axis=0)[None, :, None], axis=0)
    away = np.hypot(*np.moveaxis(log.boxes[..., :2] - first, -1, 0))
    way = np.where(log.valid, away, 0.0).max(axis=0)
    stands: Bools = (way < STANDS_WITHIN_M) & (way < STANDS_BELOW_MPS * STEP_S * (seen - 1) + 0.1)
    return stands & (seen >= 2)


def join_steps(index: LaneIndex, scene: Scene) -> Ints:
    """(N,) the scene's step for agents that are on a lane now, NEVER for all others."""
    start = scene.step
    out = np.full(len(scene.agents), NEVER)
    here = np.flatnonzero(scene.agents.valid[start])
    on = on_a_lane(*lane_costs(index, scene.agents.boxes[start, here, :3])).any(axis=1)
    out[here[on]] = start
    return out


def first_later_step_on_lane(index: LaneIndex, scene: Scene, i: int) -> int:
    """First later step at which agent i is on a lane; NEVER if it never is."""
    log, start = scene.clip.agents, scene.step
    steps = start + 1 + np.flatnonzero(log.valid[start + 1 : start + HORIZON_STEPS + 1, i])
    on = on_a_lane(*lane_costs(index, log.boxes[steps, i, :3])).any(axis=1)
    return int(steps[on.argmax()]) if on.any() else NEVER


def start_step(log: AgentTracks, i: int, step: int) -> int:
    """When a vehicle that stands at `step` starts in its log: 0 if it moves at `step`, NEVER if it does not start."""
    if not log.valid[step, i] or np.hypot(*log.velocities[step, i]) >= STANDS_BELOW_MPS:
        return 0
    away = np.hypot(*(log.boxes[step:, i, :2] - log.boxes[step, i, :2]).T)
    started = log.valid[step:, i] & (np.nan_to_num(away) > STARTED_AFTER_M)
    return step + int(np.argmax(started)) if started.any() else NEVER


def clocks(scene: Scene) -> Ints:
    """(N,) the step of its log each agent is at: the scene's, or earlier for one that an earlier rollout made wait."""
    log, start = scene.clip.agents, scene.step
    here = scene.agents.boxes[start, :, :2]
    away = np.where(log.valid[: start + 1], np.hypot(*np.moveaxis(log.boxes[: start + 1, :, :2] - here, -1, 0)), np.inf)
    backwards = np.where(np.isnan(away), np.inf, away)[::-1]  # the latest of equal ones
    clock: Ints = start - np.argmin(backwards, axis=0)
    return clock


def logged_track(scene: Scene, i: int, clock: int) -> Array:
    """(K, 5) x, y, heading, height, speed of agent i: where it is, if it is there, then its log after step `clock`."""
    parts = []
    for agents, steps in (
        (scene.agents, slice(scene.step, scene.step + 1)),
        (scene.clip.agents, slice(clock + 1, None)),
    ):
        seen = agents.valid[steps, i]
        speed = np.hypot(*agents.velocities[steps, i].T)
        parts.append(np.column_stack([agents.boxes[steps, i, :3], agents.center_z[steps, i], speed])[seen])
    return np.concatenate(parts)


# A scene's paths as the traffic's kernels take them: how fast one may drive where, and where one must stop when.

StopLine = tuple[float, Bytes]  # path length [m], states (41,) at every step of the rollout

LATERAL_ACCEL_MAX = 3.0  # m/s2, slows down in curves
STOP_STEPS = 5  # a logged stop lasts at least this long
STOP_BEFORE_ENTRY_M, STOP_BEHIND_ENTRY_M = 12.0, 2.0  # where, around a junction's entry, a stop belongs to it


def numbered(found: list[LanePath | None]) -> Ints:
    """Index of each path among those there are, -1 where there is none."""
    has = np.array([path is not None for path in found], dtype=bool)
    return np.where(has, np.cumsum(has) - 1, -1)


def stack_paths(
    scene: Scene,
    found: list[LanePath | None],
    logged_ways: list[LanePath | None],
    target_speed_mps: float,
    decel_max: float,
    logged_stops: bool = True,
) -> Paths:
    """The agents' paths and logged ways (N,), as `numbered` counts them; a logged way's own speeds tell it to stop.

    logged_stops: whether a stop of a log at a junction makes a stop line.
    """
    chosen = [path for path in found + logged_ways if path is not None]
    n_points = len(chosen[0].xy) if chosen else 2
    xy = np.array([path.xy for path in chosen]).reshape(-1, n_points, 2)
    heading = np.array([path.heading for path in chosen]).reshape(-1, n_points)
    limit = np.array([path.speed_limit_mps for path in chosen]).reshape(-1, n_points)
    lines = _stop_lines(scene, found, logged_stops)
    counts = [len(of_path) for of_path in lines] + [0] * (len(chosen) - len(lines))
    states = [state for of_path in lines for _, state in of_path]
    return Paths(
        xy=xy,
        heading=heading,
        height=np.array([path.height for path in chosen]).reshape(-1, n_points),
        target_speed=_target_speeds(limit, heading, target_speed_mps, decel_max),
        stretches=stretches_of(xy, heading),
        line_start=np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]),
        line_at=np.array([at for of_path in lines for at, _ in of_path], dtype=np.float64),
        line_state=np.array(states, dtype=np.uint8).reshape(-1, HORIZON_STEPS + 1).T.copy(),
    )


def _target_speeds(limit: Array, heading: Array, default: float, decel_max: float) -> Array:
    """(M, P) [m/s] the limit or the default, less in curves, and in time before them at comfortable deceleration."""
    target = np.where(np.isnan(limit), default, limit)
    curvature = np.abs(np.gradient(heading, PATH_SPACING_M, axis=1))
    square = np.minimum(target**2, LATERAL_ACCEL_MAX / np.maximum(curvature, 1e-6))
    # v^2 falls by at most 2 b per metre towards a slower place: a running minimum from the far end.
    fall = 2.0 * decel_max * PATH_SPACING_M * np.arange(limit.shape[1])
    square = np.minimum.accumulate((square + fall)[:, ::-1], axis=1)[:, ::-1] - fall
    speeds: Array = np.sqrt(np.maximum(square, 1.0))
    return speeds


def _stop_lines(scene: Scene, found: list[LanePath | None], logged: bool) -> list[list[StopLine]]:
    """Of each path there is: the lights along it, and where the vehicle's log stops if that is wanted (`logged`)."""
    log = scene.clip.agents
    stopped = log.valid & (np.hypot(*np.moveaxis(log.velocities, -1, 0)) < STANDS_BELOW_MPS)
    return [
        [*_light_lines(scene, path), *(_logged_stops(scene, path, i, stopped[:, i]) if logged else ())]
        for i, path in enumerate(found)
        if path is not None
    ]


def _light_lines(scene: Scene, path: LanePath) -> list[StopLine]:
    lights, lines = scene.clip.lights, []
    for lane_id, at in path.lane_entries:
        if lane_id in lights.lane_ids:
            column = lights.lane_ids.index(lane_id)
            steps = np.minimum(np.arange(scene.step, scene.step + HORIZON_STEPS + 1), len(lights.states) - 1)
            light = lights.states[steps, column]
            state = np.full(len(light), OPEN, dtype=np.uint8)
            state[light == LightState.YELLOW] = CLOSED_IF_STOPPABLE
            state[light == LightState.RED] = CLOSED
            lines.append((at, state))
    return lines


def _logged_stops(scene: Scene, path: LanePath, i: int, stopped: Bools) -> list[StopLine]:
    """Stop lines agent i's own log, `stopped` (S,), implies: at a junction's entry, where it stops, until it leaves."""
    entries = _junction_entries(scene, path)
    if not entries or np.count_nonzero(stopped) < STOP_STEPS:
        return []
    log = scene.clip.agents
    edges = np.flatnonzero(np.diff(np.concatenate([[0], stopped.astype(np.int8), [0]])))
    lines = []
    for first, last in zip(edges[::2], edges[1::2]):
        if last - first < STOP_STEPS or last <= scene.step:
            continue
        distance = np.hypot(*(path.xy - log.boxes[first, i, :2]).T)
        nearest = int(np.argmin(distance))
        if distance[nearest] > 3.0:
            continue
        nose = nearest * PATH_SPACING_M + 0.5 * log.boxes[first, i, 3]
        near = [at for at in entries if nose - STOP_BEHIND_ENTRY_M <= at <= nose + STOP_BEFORE_ENTRY_M]
        if near:
            until = NEVER if last >= log.n_steps or not log.valid[last, i] else last
            steps = np.arange(scene.step, scene.step + HORIZON_STEPS + 1)
            lines.append((max(near[0], nose), np.where(steps < until, CLOSED, OPEN).astype(np.uint8)))
    return lines


def _junction_entries(scene: Scene, path: LanePath) -> list[float]:
    lanes = scene.clip.road_map.lanes
    inside, entries = False, []
    for lane_id, at in path.lane_entries:
        if lanes[lane_id].is_intersection and not inside:
            entries.append(at)
        inside = lanes[lane_id].is_intersection
    return entries

"""Ego and traffic for H seconds: the joint rollout (METRIC.md sections 1 and 5), and the scene it leads to.

The ego is tracked first, since it follows its plan whatever the traffic does; then the traffic answers to it.

* A vehicle on a lane (within `snap_distance_m` of a centreline, heading within 60 degrees) is driven by IDM along its
  way through the lane graph; one beside the lanes replays its log until it is on one. Where a driven vehicle on its
  logged way leaves it no room to go on without braking harder than comfort, it is driven by IDM along that way instead.
* A vehicle that its whole log shows standing stays where it is; one that stands now does not start before its log
  does; one that its log stops at a junction stops there as long. The log is all we have of lights and signs that are
  not in the map.
* A driven vehicle goes on when its log ends; a replayed one leaves with its log.
* A vehicle first seen later enters at the first logged step where its box is free, with the minimum gap at both ends,
  and the ego's centre is `enter_clearance_m` away, and is driven from then on; else never. Parked cars, pedestrians and
  things appear by their log.
* Pedestrians and cyclists walk their log; before a step into a driven vehicle they wait, then go on late along the
  same log. Neither they nor replayed vehicles wait for the ego: its reward must not profit from their care.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tasks.rollout.corridor import PATH_SPACING_M, Paths
from tasks.rollout.idm import CLOSED, CLOSED_IF_STOPPABLE, OPEN, Cast, Driver, World, drive
from tasks.rollout.lane_following import (
    LaneIndex,
    LanePath,
    find_path,
    index_lanes,
    lane_costs,
    logged_path,
    on_a_lane,
    straight_path,
)
from tasks.rollout.lqr import track
from tasks.world.agents import MOVING_KINDS, AgentKind, AgentTracks
from tasks.world.clip import HORIZON_STEPS, STEP_S, Rollout, Scene
from tasks.world.lanes import LightState
from tasks.world.vehicle import HEADING, PACIFICA, VX, VY, Vehicle, X, Y

Array = NDArray[np.float64]

NEVER = 1_000_000  # a step no clip has
STANDS_WITHIN_M, STANDS_BELOW_MPS = 1.0, 0.3  # over a whole log: boxes of parked cars jitter by decimetres
STARTED_AFTER_M = 0.5  # a car that stood has started
STOP_STEPS = 5  # a logged stop lasts at least this long
STOP_BEFORE_ENTRY_M, STOP_BEHIND_ENTRY_M = 12.0, 2.0  # where, around a junction's entry, a stop belongs to it
LOG_STRIDE = 3  # every third logged pose tells a way


@dataclass(frozen=True)
class TrafficSettings:
    """How the others move. IDM's parameters are the public benchmark's (METRIC.md section 5)."""

    mode: Literal["idm", "replay"] = "idm"
    target_speed_mps: float = 10.0  # where the lane has no speed limit
    min_gap_m: float = 1.0
    headway_s: float = 1.5
    accel_max: float = 1.0  # m/s2
    decel_max: float = 2.0  # m/s2, comfortable
    exponent: float = 4.0
    emergency_decel: float = 8.0  # m/s2, what tyres can; the public traffic knows no limit
    lateral_accel_max: float = 3.0  # m/s2, slows down in curves
    snap_distance_m: float = 3.0
    enter_clearance_m: float = 30.0
    lookahead_m: float = 60.0
    corridor_margin_m: float = 0.1  # beside the body, each side
    blend_length_m: float = 20.0  # over which a start beside the path fades onto it

    def __post_init__(self) -> None:
        if self.mode not in ("idm", "replay"):
            raise ValueError(f"traffic mode must be idm or replay, not {self.mode!r}")
        for name in ("target_speed_mps", "headway_s", "accel_max", "decel_max", "lateral_accel_max", "blend_length_m"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"traffic {name} must be positive, not {getattr(self, name)}")


@dataclass(frozen=True)
class TrafficScene:
    """Everything about a scene's traffic that does not depend on what the ego will do."""

    scene: Scene
    settings: TrafficSettings
    cast: Cast | None  # None: replay
    paths: Paths | None
    lane_paths: tuple[LanePath | None, ...] = ()  # (N,)


def prepare_traffic(scene: Scene, settings: TrafficSettings) -> TrafficScene:
    """Roles and paths of all agents; once per scene, however many rollouts follow."""
    if settings.mode == "replay":
        return TrafficScene(scene, settings, None, None)
    now, log = scene.agents, scene.clip.agents
    n, start = len(now), scene.step
    moved = np.zeros(n, dtype=bool) if scene.ever_simulated is None else scene.ever_simulated
    is_vehicle = np.array([kind == AgentKind.VEHICLE for kind in now.kinds], dtype=bool)
    moving_kind = np.array([kind in MOVING_KINDS for kind in now.kinds], dtype=bool)
    standing = is_vehicle & _stands_always(log) & ~(moved & now.valid[start])
    index = index_lanes(scene.clip.road_map)
    ahead_m = _path_length(scene, settings)

    join, hold = np.full(n, NEVER), np.zeros(n, dtype=np.int64)
    clock = _clocks(scene)
    found: list[LanePath | None] = [None] * n
    logged_ways: list[LanePath | None] = [None] * n
    for i in np.flatnonzero(is_vehicle & ~standing).tolist():
        driven_before = bool(moved[i] and now.valid[start, i])
        step = start if driven_before else _join_step(index, scene, i, settings.snap_distance_m)
        if step != start:
            logged_ways[i] = logged_path(_logged_track(scene, i, int(clock[i])), ahead_m)
        if step == NEVER:
            continue
        pose = (now.boxes[start, i, :3] if step == start else log.boxes[step, i, :3]).copy()
        logged = log.boxes[np.flatnonzero(log.valid[:, i])[::LOG_STRIDE], i, :3]
        found[i] = find_path(index, pose, logged, settings.snap_distance_m, ahead_m)
        if found[i] is None:  # a driven car that left the map
            found[i] = logged_path(_logged_track(scene, i, int(clock[i])), ahead_m) or straight_path(pose, ahead_m)
        if driven_before:
            join[i] = 0  # wherever its log is by now
        else:
            join[i], hold[i] = step, _start_step(log, i, step)
    numbers = _numbered(found + logged_ways)
    cast = Cast(
        path=numbers[:n],
        logged_path=numbers[n:],
        join_step=join,
        hold_until=hold,
        clock=clock,
        standing=standing,
        moving_kind=moving_kind,
        enters_clear=is_vehicle & ~standing,
    )
    return TrafficScene(scene, settings, cast, _stacked(scene, settings, found, logged_ways), tuple(found))


def simulate(
    scene: Scene,
    poses: Array,
    settings: TrafficSettings,
    traffic: TrafficScene | None = None,
    vehicle: Vehicle = PACIFICA,
) -> Rollout:
    """Ego that tracks `poses` (40, 3) (world, 0.1 .. 4.0 s) and the traffic's answer to it, from the scene's step.

    `traffic` = prepare_traffic(scene, settings) spares the preparation when one scene is rolled out often.
    """
    ego_states = track(scene.ego_state, np.asarray(poses)[None], vehicle)[0]
    return roll_out(traffic if traffic is not None else prepare_traffic(scene, settings), ego_states, vehicle)


def roll_out(traffic: TrafficScene, ego_states: Array, vehicle: Vehicle = PACIFICA) -> Rollout:
    """The traffic's answer to an ego whose states (41, 11) are known."""
    scene = traffic.scene
    start = scene.step
    window = scene.agents.window(start, start + HORIZON_STEPS + 1)
    if traffic.cast is None or traffic.paths is None or len(window) == 0:
        return Rollout(start, ego_states, window, np.zeros(len(window), dtype=bool))
    heading = ego_states[:, HEADING]
    cos, sin = np.cos(heading), np.sin(heading)
    ego_boxes = np.stack(
        [
            ego_states[:, X] + vehicle.rear_axle_to_center * cos,
            ego_states[:, Y] + vehicle.rear_axle_to_center * sin,
            heading,
            np.full(len(heading), vehicle.length),
            np.full(len(heading), vehicle.width),
        ],
        axis=1,
    )
    vx, vy = ego_states[:, VX], ego_states[:, VY]
    ego_velocities = np.stack([cos * vx - sin * vy, sin * vx + cos * vy], axis=1)
    boxes, velocities, valid, center_z, driven = drive(
        start,
        _world(scene.clip.agents),
        _world(window, row=0),
        Cast(*_writable(traffic.cast)),
        Paths(*_writable(traffic.paths)),
        ego_boxes,
        ego_velocities,
        _driver(traffic.settings),
    )
    agents = replace(window, boxes=boxes, velocities=velocities, valid=valid, center_z=center_z)
    return Rollout(start, ego_states, agents, driven)


def next_scene(scene: Scene, rollout: Rollout, centerline: Array) -> Scene:
    """The scene H seconds on: the rollout's world up to its last row, the log after it.

    centerline (P, 3): the route ahead of the ego's new pose.
    """
    moved = rollout.simulated if scene.ever_simulated is None else rollout.simulated | scene.ever_simulated
    return Scene(
        clip=scene.clip,
        step=rollout.start_step + HORIZON_STEPS,
        ego_history=rollout.ego_states[-len(scene.ego_history) :],
        agents=scene.agents.overwritten(rollout.start_step, rollout.agents),
        centerline=centerline,
        ever_simulated=moved,
    )


def _world(agents: AgentTracks, row: int | None = None) -> World:
    arrays = (agents.boxes, agents.velocities, agents.valid, agents.center_z)
    return World(*_writable(a if row is None else a[row] for a in arrays))


def _writable(arrays: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Arrays as the kernel was compiled for; a shared object store hands out read-only ones."""
    return (np.require(a, requirements=["C", "W"]) for a in arrays)


def _driver(settings: TrafficSettings) -> Driver:
    return Driver(
        min_gap=settings.min_gap_m,
        headway=settings.headway_s,
        accel=settings.accel_max,
        decel=settings.decel_max,
        exponent=settings.exponent,
        emergency_decel=settings.emergency_decel,
        lookahead=settings.lookahead_m,
        corridor_margin=settings.corridor_margin_m,
        blend_length=settings.blend_length_m,
        largest_offset=settings.snap_distance_m + 2.0,
        enter_clearance=settings.enter_clearance_m,
    )


def _stands_always(log: AgentTracks) -> NDArray[np.bool_]:
    """(N,) tracks that never leave their place."""
    out = np.zeros(len(log), dtype=bool)
    for i in range(len(log)):
        centers = log.boxes[log.valid[:, i], i, :2]
        if len(centers) >= 2:
            way = np.hypot(*(centers - centers[0]).T).max()
            out[i] = way < STANDS_WITHIN_M and way < STANDS_BELOW_MPS * STEP_S * (len(centers) - 1) + 0.1
    return out


def _path_length(scene: Scene, settings: TrafficSettings) -> float:
    """Metres of path any vehicle can need: what the fastest covers in H, and its view beyond."""
    speeds = np.hypot(*np.moveaxis(scene.agents.velocities, -1, 0))
    limits = [lane.speed_limit_mps or 0.0 for lane in scene.clip.road_map.lanes.values()]
    fastest = max(settings.target_speed_mps, float(np.nanmax(speeds, initial=0.0)), max(limits, default=0.0))
    return fastest * HORIZON_STEPS * STEP_S + settings.lookahead_m + 10.0


def _join_step(index: LaneIndex, scene: Scene, i: int, snap_distance_m: float) -> int:
    """First step from the scene's on at which the vehicle is on a lane; NEVER if it never is."""
    log, start = scene.clip.agents, scene.step
    stop = min(start + HORIZON_STEPS + 1, log.n_steps)
    steps = [k for k in range(start, stop) if (scene.agents.valid[k, i] if k == start else log.valid[k, i])]
    for chunk in (steps[:1], steps[1:]):  # nearly always the first
        if chunk:
            poses = np.stack([(scene.agents if k == start else log).boxes[k, i, :3] for k in chunk])
            on = on_a_lane(*lane_costs(index, poses), snap_distance_m).any(axis=1)
            if on.any():
                return chunk[int(np.argmax(on))]
    return NEVER


def _start_step(log: AgentTracks, i: int, step: int) -> int:
    """When a vehicle that stands at `step` starts in its log: 0 if it moves at `step`, NEVER if it does not start."""
    if not log.valid[step, i] or np.hypot(*log.velocities[step, i]) >= STANDS_BELOW_MPS:
        return 0
    away = np.hypot(*(log.boxes[step:, i, :2] - log.boxes[step, i, :2]).T)
    started = log.valid[step:, i] & (np.nan_to_num(away) > STARTED_AFTER_M)
    return step + int(np.argmax(started)) if started.any() else NEVER


def _clocks(scene: Scene) -> NDArray[np.int64]:
    """(N,) the step of its log each agent is at: the scene's, or earlier for one that an earlier rollout made wait."""
    log, start = scene.clip.agents, scene.step
    here = scene.agents.boxes[start, :, :2]
    away = np.where(log.valid[: start + 1], np.hypot(*np.moveaxis(log.boxes[: start + 1, :, :2] - here, -1, 0)), np.inf)
    backwards = np.where(np.isnan(away), np.inf, away)[::-1]  # the latest of equal ones
    clock: NDArray[np.int64] = start - np.argmin(backwards, axis=0)
    return clock


def _logged_track(scene: Scene, i: int, clock: int) -> Array:
    """(K, 5) x, y, heading, height, speed of agent i: where it is, if it is there, then its log after step `clock`."""

    def columns(agents: AgentTracks, steps: slice) -> Array:
        seen = agents.valid[steps, i]
        speed = np.hypot(*agents.velocities[steps, i].T)
        return np.column_stack([agents.boxes[steps, i, :3], agents.center_z[steps, i], speed])[seen]

    here = columns(scene.agents, slice(scene.step, scene.step + 1))
    return np.concatenate([here, columns(scene.clip.agents, slice(clock + 1, None))])


def _numbered(found: list[LanePath | None]) -> NDArray[np.int64]:
    has = np.array([path is not None for path in found], dtype=bool)
    return np.where(has, np.cumsum(has) - 1, -1)


def _stacked(
    scene: Scene, settings: TrafficSettings, found: list[LanePath | None], logged_ways: list[LanePath | None]
) -> Paths:
    """As `_numbered` counts them; a logged way needs no stop lines, its own speeds tell."""
    chosen = [path for path in found + logged_ways if path is not None]
    n_points = len(chosen[0].xy) if chosen else 2
    line_at: list[float] = []
    line_state: list[NDArray[np.uint8]] = []
    line_start = [0]
    for i, path in enumerate(found):
        if path is not None:
            for at, state in [*_light_lines(scene, path), *_logged_stops(scene, path, i)]:
                line_at.append(at)
                line_state.append(state)
            line_start.append(len(line_at))
    line_start += [len(line_at)] * (len(chosen) + 1 - len(line_start))
    return Paths(
        xy=np.array([path.xy for path in chosen]).reshape(-1, n_points, 2),
        heading=np.array([path.heading for path in chosen]).reshape(-1, n_points),
        height=np.array([path.height for path in chosen]).reshape(-1, n_points),
        target_speed=np.array([_target_speed(path, settings) for path in chosen]).reshape(-1, n_points),
        line_start=np.array(line_start, dtype=np.int64),
        line_at=np.array(line_at, dtype=np.float64),
        line_state=np.array(line_state, dtype=np.uint8).reshape(-1, HORIZON_STEPS + 1).T.copy(),
    )


def _target_speed(path: LanePath, settings: TrafficSettings) -> Array:
    """(P,) the lane's limit or the default, less in curves, and in time before them at the comfortable deceleration."""
    target = np.where(np.isnan(path.speed_limit_mps), settings.target_speed_mps, path.speed_limit_mps)
    curvature = np.abs(np.gradient(path.heading, PATH_SPACING_M))
    square = np.minimum(target**2, settings.lateral_accel_max / np.maximum(curvature, 1e-6))
    # v^2 falls by at most 2 b per metre towards a slower place: a running minimum from the far end.
    fall = 2.0 * settings.decel_max * PATH_SPACING_M * np.arange(len(square))
    square = np.minimum.accumulate((square + fall)[::-1])[::-1] - fall
    return np.sqrt(np.maximum(square, 1.0))


def _light_lines(scene: Scene, path: LanePath) -> list[tuple[float, NDArray[np.uint8]]]:
    """Stop lines of the lights along a path: (path length, states (41,))."""
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


def _logged_stops(scene: Scene, path: LanePath, i: int) -> list[tuple[float, NDArray[np.uint8]]]:
    """Stop lines a vehicle's own log implies: at a junction's entry, where it stops, until it leaves."""
    log = scene.clip.agents
    speed = np.hypot(*log.velocities[:, i].T)
    stopped = log.valid[:, i] & (speed < STANDS_BELOW_MPS)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], stopped.astype(np.int8), [0]])))
    entries = _junction_entries(scene, path)
    lines = []
    for first, last in zip(edges[::2], edges[1::2]):
        if last - first < STOP_STEPS or last <= scene.step or not entries:
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

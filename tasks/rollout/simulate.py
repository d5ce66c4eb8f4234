"""Ego and traffic for H seconds: the joint rollout (docs/reward.md 1 and 5), and the scene it leads to.

The ego is tracked first, since it follows its plan whatever the traffic does; then the traffic answers to it.

* A vehicle on a lane (within SNAP_M of a centreline, heading within 60 degrees) is driven by IDM along its
  way through the lane graph; one beside the lanes replays its log until it is on one. Where a driven vehicle on its
  logged way makes it brake harder than comfort, it is driven by IDM along that way instead.
* A vehicle that its whole log shows standing stays where it is; one that stands now does not start before its log
  does; one that its log stops at a junction stops there as long. The log is all we have of lights and signs that are
  not in the map.
* The parts of an articulated vehicle (tasks/world/repair/tracks.py) drive as one: the first as any vehicle, the
  others behind it along its way (tasks/rollout/lane_following.py). Where it replays its log they do so too.
* A driven vehicle goes on when its log ends; a replayed one leaves with its log.
* A vehicle first seen later enters at the first logged step where its box is free, with the minimum gap at both ends,
  and the ego's centre is ENTER_CLEARANCE_M away, and is driven from then on; else never. Parked cars, pedestrians and
  things appear by their log.
* Pedestrians and cyclists walk their log; before a step into a driven vehicle they wait, then go on late along the
  same log. Neither they nor replayed vehicles wait for the ego: its reward must not profit from their care.

* With `yields` a driver keeps the speeds and stops of its log instead of a target speed, and gives way to others, not
  to the ego, where ways cross or merge (tasks/rollout/yielding.py).

That is `mode=idm`. In `navsim` the traffic is the public evaluation's, to the letter (tasks/rollout/navsim.py), which
knows no articulated vehicles: each part is an agent of its own there. In `custom` those whom IDM would drive are driven
by a policy of a user's own (tasks/rollout/simulate.py).
"""

import errno
import importlib
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tasks.kernels.compiled import hidden_kernel, kernel
from tasks.rollout.corridor import Paths, pose_on_path, project_on_path
from tasks.rollout.idm import (
    ABSENT,
    DRIVEN,
    EGO,
    NO_ROWS,
    REPLAYED,
    STANDING,
    TOWED,
    AgentStates,
    IdmDriver,
    Motion,
    Roles,
    RolloutRows,
    Yielding,
    acceleration_for_others,
    advance,
    begin_with,
    empty_motion,
    empty_rows,
    far_from_ego,
    forward_speed,
    is_clear,
    must_brake,
    nearest_point_index,
    path_to_join,
    project_onto_path,
    road_acceleration,
    touches_driven,
    way_along,
)
from tasks.rollout.lane_following import (
    KNOWN_PATHS,
    NEVER,
    LanePath,
    faster_than_first,
    find_path,
    first_later_step_on_lane,
    hitch,
    index_lanes,
    lane_distances_and_turns,
    log_steps,
    logged_path,
    logged_track,
    on_a_lane,
    stack_paths,
    stands_always,
    start_step,
    straight_path,
    towed_pose,
    trails_behind,
)
from tasks.rollout.lqr import track
from tasks.rollout.navsim import NavsimAgents, navsim_agents, roll_out_navsim
from tasks.rollout.yielding import (
    body_turn_at,
    intended_acceleration,
    may_enter,
    prepare_yielding,
    yielding_acceleration,
)
from tasks.settings import MOST, TrafficSettings
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import HORIZON_STEPS, MOVING_KINDS, PER_STEP, STEP_S, AgentKind, AgentTracks, Rollout, Scene
from tasks.world.frames import EGO_STATE_SIZE, HEADING, LARGEST, PACIFICA, VX, VY, all_within, ego_boxes
from tasks.world.geometry import wrapped
from tasks.world.repair.tracks import couplings, first_parts
from tasks.world.road_map import RoadMap

# Traffic that a policy of a user's own drives: what it is shown and answers, how it is named, how it is stepped.
#
# `traffic=custom` asks it every 0.1 s for the next states of the vehicles that `traffic=idm` would drive. Who they
# are, from when and along which ways, who waits, who enters and who parks is decided by the same rules.

SEEN_ROWS = 11  # of 0.1 s: the second before now, and now


@dataclass(frozen=True)
class SeenTraffic:
    """The world up to now: N agents and, in the last place, the ego. Nothing of what comes after now is in it.

    As for IDM the log says which way a vehicle takes at a fork, how far beside the lane's middle it drives, and which
    stop lines are closed to it for how long: the maps have no lights. It says no speeds.
    """

    boxes: Array  # (SEEN_ROWS, N + 1, 5) centre x, y [m], heading [rad], length, width [m]; NaN where absent
    velocities: Array  # (SEEN_ROWS, N + 1, 2) world [m/s]
    valid: Bools  # (SEEN_ROWS, N + 1)
    kinds: tuple[AgentKind, ...]  # (N + 1,)
    asked: Bools  # (N,) whose next state is wanted
    road_map: RoadMap
    way: Ints  # (N,) the way among `ways` of each agent that is driven; -1: it is not
    ways: Paths  # M of them; line_state (1, Q) is that of now


class TrafficPolicy(Protocol):
    """Moves vehicles. Pure: the same world is answered the same, whatever was asked before."""

    def digest(self) -> str:
        """Tells code, weights and settings apart: rows made with another digest are other rows."""
        ...

    def next_states(self, seen: SeenTraffic) -> Array:
        """(N, 4) centre x, y [m], heading [rad], speed along it [m/s] in 0.1 s; of who is not asked, ignored."""
        ...


class BadPolicy(ValueError):
    """There is no such policy, or it answers what is no state."""


@lru_cache(maxsize=4)
def policy_named(name: str) -> TrafficPolicy:
    """What `my_package.my_module:MyPolicy`, a class or a function, gives when it is called. Raises BadPolicy."""
    module, _, attribute = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise BadPolicy(f"traffic.policy={name}: name one as my_package.my_module:MyPolicy ({error})") from error
    policy: TrafficPolicy = found()
    missing = [member for member in ("digest", "next_states") if not hasattr(policy, member)]
    if missing:
        raise BadPolicy(f"traffic.policy: {name} is no traffic policy: it has no {', '.join(missing)}")
    return policy


def traffic_record(settings: TrafficSettings) -> dict[str, object]:
    """The settings as keys and records hold them: a policy with its digest, nothing of it where none drives.

    Raises BadPolicy.
    """
    record: dict[str, object] = asdict(settings)
    name = record.pop("policy")
    return record | ({} if settings.policy is None else {"policy": f"{name} {policy_named(settings.policy).digest()}"})


def check_same_policy(settings: TrafficSettings, recorded: object) -> None:
    """Raises OSError where the policy that drives here is not the one that `traffic_record` gave at the run's start."""
    if settings.policy is not None and traffic_record(settings)["policy"] != recorded:
        raise OSError(errno.ESTALE, "has another digest than when the run began; start it again", settings.policy)


SHORTEST_HEADWAY_S = 0.5  # of who keeps its intent: logged drivers follow as near as that
LOG_STRIDE = 3  # every third logged pose tells a way
_indexed_lanes = lru_cache(maxsize=4)(index_lanes)  # clips of one log share the map


@dataclass(frozen=True)
class TrafficScene:
    """Everything about a scene's traffic that does not depend on what the ego will do."""

    scene: Scene
    settings: TrafficSettings
    roles: Roles | None  # None: replay, or navsim
    paths: Paths | None
    navsim: NavsimAgents | None = None  # None: another mode
    yielding: Yielding | None = None  # None: drivers give way to nobody, or another mode
    # The last answer of `roll_out`, and to which ego states: one to a drive that goes on from it begins there.
    newest: list[tuple[Array, RolloutRows, Motion]] = field(default_factory=list, init=False, repr=False, compare=False)


class _LogFacts(NamedTuple):
    """Of a clip's log alone, whichever of its scenes is simulated."""

    is_vehicle: Bools  # (N,)
    moving_kind: Bools  # (N,)
    stands: Bools  # (N,) vehicles that never leave their place
    pairs: tuple[tuple[int, int], ...]  # see couplings
    first_part: Ints  # (N,)
    states: AgentStates
    poses: dict[int, Array]  # (K, 3) every LOG_STRIDE-th, of the vehicles asked for
    ways: dict[tuple[Any, ...], LanePath | None]  # the newest of `_logged_way`


@lru_cache(maxsize=4)
def _log_facts(log: AgentTracks) -> _LogFacts:
    is_vehicle = np.array([kind == AgentKind.VEHICLE for kind in log.kinds], dtype=bool)
    moving_kind = np.array([kind in MOVING_KINDS for kind in log.kinds], dtype=bool)
    pairs = couplings(log)
    return _LogFacts(
        is_vehicle=is_vehicle,
        moving_kind=moving_kind,
        stands=is_vehicle & stands_always(log),
        pairs=pairs,
        first_part=first_parts(len(log), pairs),
        states=_agent_states(log),
        poses={
            i: log.boxes[np.flatnonzero(log.valid[:, i])[::LOG_STRIDE], i, :3]
            for i in np.flatnonzero(is_vehicle).tolist()
        },
        ways={},
    )


@lru_cache(maxsize=4)
def _later_steps(log: AgentTracks, road_map: RoadMap) -> dict[tuple[int, int], int]:
    """`first_later_step_on_lane` of the steps and vehicles asked for: of a log on a map."""
    return {}


def _logged_way(scene: Scene, i: int, clock: int, ahead_m: float) -> LanePath | None:
    """The path along agent i's own log, as known ones are handed out: most of a clip's attempts ask for the same."""
    now, start, known = scene.agents, scene.step, _log_facts(scene.clip.agents).ways
    here = (getattr(now, name)[start, i].tobytes() for name in ("boxes", "velocities", "center_z", "valid"))
    key = i, clock, ahead_m, *here
    if key not in known:
        if len(known) >= KNOWN_PATHS:
            known.clear()
        known[key] = logged_path(logged_track(scene, i, clock), ahead_m)
    return known[key]


def prepare_traffic(scene: Scene, settings: TrafficSettings) -> TrafficScene:
    """Roles and paths of all agents; once per scene, however many rollouts follow."""
    if settings.mode == "replay":
        return TrafficScene(scene, settings, None, None)
    if settings.mode == "navsim":
        return TrafficScene(scene, settings, None, None, navsim_agents(scene, settings.target_speed_mps))
    now, log = scene.agents, scene.clip.agents
    n, start = len(now), scene.step
    moved = np.zeros(n, dtype=bool) if scene.ever_simulated is None else scene.ever_simulated
    is_vehicle, moving_kind, stands, pairs, first_part, states, poses, _ = _log_facts(log)
    standing = stands & ~(moved & now.valid[start])
    is_first = first_part == np.arange(n)
    index = _indexed_lanes(scene.clip.road_map)
    ahead_m = _needed_path_length(scene, settings)

    join, hold = np.full(n, NEVER), np.zeros(n, dtype=np.int64)
    here = np.flatnonzero(now.valid[start])
    join[here[on_a_lane(*lane_distances_and_turns(index, now.boxes[start, here, :3])).any(axis=1)]] = start
    clock = log_steps(scene)
    found: list[LanePath | None] = [None] * n
    logged_ways: list[LanePath | None] = [None] * n
    for i in np.flatnonzero(is_vehicle & ~standing & is_first).tolist():
        driven_before = bool(moved[i] and now.valid[start, i])
        if join[i] == NEVER and not driven_before:
            later_steps = _later_steps(log, scene.clip.road_map)
            if (start, i) not in later_steps:
                later_steps[start, i] = first_later_step_on_lane(index, scene, i)
            join[i] = later_steps[start, i]
        step = start if driven_before else int(join[i])
        if step != start:
            logged_ways[i] = _logged_way(scene, i, int(clock[i]), ahead_m)
        if step == NEVER:
            continue
        pose = (now.boxes[start, i, :3] if step == start else log.boxes[step, i, :3]).copy()
        found[i] = find_path(index, pose, poses[i], ahead_m)
        if found[i] is None:  # a driven car that left the map
            found[i] = _logged_way(scene, i, int(clock[i]), ahead_m) or straight_path(pose, ahead_m)
        if driven_before:
            join[i] = 0  # wherever its log is by now
        else:
            hold[i] = start_step(log, i, step)
    has = np.array([path is not None for path in found + logged_ways], dtype=bool)
    numbers = np.where(has, np.cumsum(has) - 1, -1)  # of each path among those there are
    roles = Roles(
        path=numbers[:n],
        logged_path=numbers[n:],
        join_step=np.where(numbers[:n] >= 0, join, NEVER),
        hold_until=hold,
        clock=clock,
        standing=standing,
        moving_kind=moving_kind,
        enters_clear=is_vehicle & ~standing,
        first_part=first_part,
        trails=trails_behind(scene, first_part, {towed: front for front, towed in pairs}),
    )
    yields = keeps_intent(settings)
    paths = stack_paths(
        scene, found, logged_ways, settings.target_speed_mps, settings.decel_max, logged_stops=not yields
    )
    yielding = prepare_yielding(scene, roles, paths, states) if yields else None
    return TrafficScene(scene, settings, roles, paths, yielding=yielding)


def simulate(scene: Scene, poses: Array, settings: TrafficSettings) -> Rollout:
    """Ego that tracks `poses` (40, 3) (world, 0.1 .. 4.0 s) and the traffic's answer to it, from the scene's step."""
    return roll_out(prepare_traffic(scene, settings), track(scene.ego_state, np.asarray(poses)[None])[0])


def roll_out(traffic: TrafficScene, ego_states: Array, steps: int = HORIZON_STEPS) -> Rollout:
    """The traffic's answer to an ego whose states (41, 11) are known. ValueError where they are none.

    steps: of the rollout that are to happen: `simulated` names who is moved by IDM in those, not who would be later.
    """
    _check_states(ego_states, HORIZON_STEPS + 1)
    traffic.newest.clear()
    return Rollout(traffic.scene.step, ego_states, *_answer(traffic, ego_states, steps))


def roll_out_longer(traffic: TrafficScene, ego_states: Array) -> AgentTracks:
    """The same for longer than H: T rows of the traffic around an ego with states (T, 11), 41 as `roll_out`'s.

    After the log's end, which is the clip's, who replays it goes straight on as fast as there, and lights stay as they
    are. ValueError where the states are none.
    """
    _check_states(ego_states, len(ego_states))
    return _answer(traffic, ego_states, HORIZON_STEPS)[0]


def _answer(traffic: TrafficScene, ego_states: Array, steps: int) -> tuple[AgentTracks, Bools]:
    """The tracks of T rows around an ego with states (T, 11), and who was driven in the first `steps` (N,)."""
    start, n_rows = traffic.scene.step, len(ego_states)
    window = _extend_tracks(traffic.scene.agents, start + n_rows).window(start, start + n_rows)
    if traffic.navsim is not None:
        return roll_out_navsim(traffic.navsim, idm_driver(traffic.settings), window, ego_states)
    if traffic.roles is None or traffic.paths is None or len(window) == 0:
        return window, np.zeros(len(window), dtype=bool)
    n, policy = len(window), traffic.settings.policy
    if policy is None:
        yielding = None if traffic.yielding is None else Yielding(*_writable(traffic.yielding))
        known = NO_ROWS
        if traffic.newest and np.array_equal(traffic.newest[0][0], ego_states[: HORIZON_STEPS + 1]):
            known = traffic.newest[0][1:]
        rows, motion = drive(*_kernel_inputs(traffic, window), *boxes_and_velocities(ego_states), yielding, known)
        if n_rows == HORIZON_STEPS + 1:
            traffic.newest[:] = [(ego_states, rows, motion)]
    else:
        rows, motion = _drive_by_policy(policy_named(policy), traffic, window, ego_states)
    return replace(window, **{name: getattr(rows, name)[:, :n].copy() for name in PER_STEP}), motion.was_driven[steps]


def _drive_by_policy(
    policy: TrafficPolicy, traffic: TrafficScene, window: AgentTracks, ego_states: Array
) -> tuple[RolloutRows, Motion]:
    """As `traffic.drive`, by a policy. Raises BadPolicy where it answers no states."""
    scene = traffic.scene
    start, log, now, roles, paths, driver = _kernel_inputs(traffic, window)
    rows, motion = initial_rows(now, roles, *boxes_and_velocities(ego_states))
    past = _agent_states(scene.agents.window(start - SEEN_ROWS + 1, start + 1))
    boxes, velocities = (
        np.concatenate([agents, of_ego[:, None]], axis=1)
        for agents, of_ego in zip((past.boxes, past.velocities), boxes_and_velocities(scene.ego_history[-SEEN_ROWS:]))
    )
    valid = np.concatenate([past.valid, np.ones((SEEN_ROWS, 1), bool)], axis=1)
    for t in range(len(rows.boxes) - 1):
        asked, mode = who_is_asked(start, roles, paths, driver, t, rows, motion)
        answer = np.zeros((len(asked), 4))
        if asked.any():
            seen = SeenTraffic(
                boxes=_up_to(t, boxes, rows.boxes),
                velocities=_up_to(t, velocities, rows.velocities),
                valid=_up_to(t, valid, rows.valid),
                kinds=(*window.kinds, AgentKind.VEHICLE),
                asked=asked.copy(),
                road_map=scene.clip.road_map,
                way=motion.path[t + 1].copy(),
                ways=paths._replace(line_state=paths.line_state[t : t + 1]),
            )
            answer = _checked(policy, policy.next_states(seen), asked)
        apply_policy_answer(start, log, roles, paths, driver, t, asked, answer, rows, mode, motion)
    return rows, motion


def _up_to(t: int, past: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
    """The SEEN_ROWS rows up to row t, copied; the past's last row is row 0."""
    return np.concatenate([past[:-1], rows[: t + 1]])[-SEEN_ROWS:]


def _checked(policy: TrafficPolicy, answer: Array, asked: Bools) -> Array:
    """The answer as the kernels take it. Raises BadPolicy."""
    name, expected = type(policy).__name__, (len(asked), 4)
    answer = np.ascontiguousarray(answer, np.float64)
    if answer.shape != expected:
        raise BadPolicy(f"{name}.next_states gave {answer.shape}, not {expected}: x, y, heading, speed")
    if not all_within(answer[asked]):
        raise BadPolicy(f"{name}.next_states gave a state that is not finite, or too large to be one")
    return answer


def _extend_tracks(agents: AgentTracks, n_steps: int) -> AgentTracks:
    """Tracks over at least so many steps: who is there at the last one goes straight on as fast as there."""
    more = n_steps - agents.n_steps
    if more <= 0:
        return agents
    steps = np.minimum(np.arange(n_steps), agents.n_steps - 1)
    out: dict[str, Any] = {name: getattr(agents, name)[steps] for name in PER_STEP}
    out["boxes"][-more:, :, :2] += STEP_S * np.arange(1, more + 1)[:, None, None] * out["velocities"][-more:]
    return replace(agents, **out)


def _check_states(ego_states: Array, n_rows: int) -> None:
    if ego_states.shape != (n_rows, EGO_STATE_SIZE):
        raise ValueError(f"ego_states must be ({n_rows}, {EGO_STATE_SIZE}), not {ego_states.shape}")
    if not all_within(ego_states):
        raise ValueError(f"ego_states are not finite or above {LARGEST:g}: leave the ego out")


def idm_driver(settings: TrafficSettings) -> IdmDriver:
    """What the kernels know of the settings."""
    driver = IdmDriver(*(getattr(settings, name) for name in IdmDriver._fields))
    return driver._replace(headway_s=min(driver.headway_s, SHORTEST_HEADWAY_S)) if keeps_intent(settings) else driver


def keeps_intent(settings: TrafficSettings) -> bool:
    """Whether drivers mean to do what their log does, and give way."""
    return settings.yields and settings.mode == "idm"


def _kernel_inputs(
    traffic: TrafficScene, window: AgentTracks
) -> tuple[int, AgentStates, AgentStates, Roles, Paths, IdmDriver]:
    """All that the kernels need to know but the ego, and who gives way."""
    assert traffic.roles is not None and traffic.paths is not None
    start, paths, log = traffic.scene.step, traffic.paths, traffic.scene.clip.agents
    longer = _extend_tracks(log, start + window.n_steps)
    if window.n_steps > len(paths.line_state):  # lights and stops stay as the last step knows them
        more = window.n_steps - len(paths.line_state)
        paths = paths._replace(line_state=np.concatenate([paths.line_state, np.repeat(paths.line_state[-1:], more, 0)]))
    return (
        start,
        _log_facts(log).states if longer is log else _agent_states(longer),
        _agent_states(window.window(0, 1)),
        Roles(*_writable(traffic.roles)),
        Paths(*_writable(paths)),
        idm_driver(traffic.settings),
    )


def boxes_and_velocities(ego_states: Array) -> tuple[Array, Array]:
    """Boxes (..., 5) about the true centre and world velocities (..., 2) of egos with states (..., 11)."""
    heading = ego_states[..., HEADING]
    cos, sin = np.cos(heading), np.sin(heading)
    vx, vy = ego_states[..., VX], ego_states[..., VY]
    return ego_boxes(ego_states, PACIFICA), np.stack([cos * vx - sin * vy, sin * vx + cos * vy], axis=-1)


def next_scene(scene: Scene, rollout: Rollout, centerline: Array, steps: int = HORIZON_STEPS) -> Scene:
    """The scene `steps` of 0.1 s into a rollout: the rollout's world up to then, the log after it.

    centerline (P, 3): the route ahead of the ego's new pose.
    """
    moved = rollout.simulated if scene.ever_simulated is None else rollout.simulated | scene.ever_simulated
    driven = np.concatenate([scene.ego_history, rollout.ego_states[1 : steps + 1]])
    return Scene(
        clip=scene.clip,
        step=rollout.start_step + steps,
        ego_history=driven[-len(scene.ego_history) :],
        agents=scene.agents.overwritten(rollout.start_step, rollout.agents.window(0, steps + 1)),
        centerline=centerline,
        ever_simulated=moved,
    )


def _agent_states(agents: AgentTracks) -> AgentStates:
    return AgentStates(*_writable(getattr(agents, name) for name in AgentStates._fields))


def _writable(arrays: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Arrays as the kernel was compiled for; a shared object store hands out read-only ones."""
    return (a if a.flags.carray else np.require(a, requirements=["C", "W"]) for a in arrays)


@lru_cache(maxsize=4)
def _highest_limit(road_map: RoadMap) -> float:
    return max((lane.speed_limit_mps or 0.0 for lane in road_map.lanes.values()), default=0.0)


def _needed_path_length(scene: Scene, settings: TrafficSettings) -> float:
    """Metres of path any vehicle can need: what the fastest covers in H, and its view beyond."""
    speeds = np.hypot(*np.moveaxis(scene.agents.velocities, -1, 0))
    limit = _highest_limit(scene.clip.road_map)
    fastest = max(settings.target_speed_mps, float(np.nanmax(speeds, initial=0.0)), limit)
    if not fastest <= MOST:
        raise ValueError(f"agents.velocities or a lane's speed limit reach {fastest:g} m/s, at most {MOST:g} do")
    return fastest * HORIZON_STEPS * STEP_S + settings.lookahead_m + 10.0


# The traffic's steps around one ego: those on a path by IDM, the rest by its log. Compiled.
#
# All agents look at the same instant and then move together, so their order does not matter. A leader is any box, the
# ego included, that reaches into the corridor the driver's own body will sweep along its path. A vehicle that replays
# its log switches to IDM, along its logged way, as soon as a driven vehicle there asks for more than the comfortable
# deceleration; it stays there for the rest of the rollout. What a driven vehicle tows follows it.


@kernel
def drive(
    start: int, log: AgentStates, now: AgentStates, roles: Roles, paths: Paths, driver: IdmDriver,
    ego_boxes: Array, ego_velocities: Array, yielding: Yielding | None, known: tuple[RolloutRows, Motion],
) -> tuple[RolloutRows, Motion]:  # fmt: skip
    """The traffic's answer to one ego: boxes (T, 5) (true centre) and world velocities (T, 2), T = 41.

    start: the clip's step of row 0; log: the clip's tracks over all its steps; now: the agents (1, N) at `start`;
    yielding: None where drivers have no intent but a target speed, and give way to nobody; known: see `begin_with`.
    """
    rows, motion = initial_rows(now, roles, ego_boxes, ego_velocities)
    begin_with(rows, motion, known[0], known[1])
    mode, scratch = np.empty(len(roles.path) + 1, np.int64), np.empty(len(roles.path) + 1, np.int64)
    for t in range(max(len(known[0].valid) - 1, 0), ego_boxes.shape[0] - 1):
        _switch_to_idm(roles, paths, driver, t, rows, mode, scratch, motion, yielding)
        _drive_on(start, roles, paths, driver, t, rows, mode, scratch, motion, yielding)
        _tow(roles, driver, t, rows, mode, motion)
        _replay(log, roles, t, rows, mode, motion)
        _admit(start, log, roles, driver, t, rows, mode, scratch, motion, yielding)
    return rows, motion


@kernel
def initial_rows(now: AgentStates, roles: Roles, ego_boxes: Array, ego_velocities: Array) -> tuple[RolloutRows, Motion]:
    """Row 0 around one ego, boxes (T, 5) and velocities (T, 2), who is in all rows."""
    n_rows, n = ego_boxes.shape[0], roles.path.shape[0]
    rows, motion = empty_rows(n_rows, n), empty_motion(n_rows, n)
    for t in range(n_rows):
        for k in range(5):
            rows.boxes[t, n, k] = ego_boxes[t, k]
        rows.velocities[t, n, 0], rows.velocities[t, n, 1] = ego_velocities[t, 0], ego_velocities[t, 1]
        rows.valid[t, n] = True
        rows.radius[t, n] = 0.5 * math.hypot(ego_boxes[t, 3], ego_boxes[t, 4])
    for i in range(n):
        motion.clock[0, i] = roles.clock[i]
        _place(rows, 0, now, 0, i)
        rows.valid[0, i] = now.valid[0, i]
        if now.valid[0, i]:
            motion.mode[0, i] = STANDING if roles.standing[i] else REPLAYED
    return rows, motion


@kernel
def who_is_asked(
    start: int, roles: Roles, paths: Paths, driver: IdmDriver, t: int, rows: RolloutRows, motion: Motion
) -> tuple[Bools, Ints]:
    """(N,) whose next state a policy is asked for at row t, those driven and not held by their log; and the modes."""
    n = motion.mode.shape[1]
    mode, asked = np.empty(n + 1, np.int64), np.zeros(n, np.bool_)
    _switch_to_idm(roles, paths, driver, t, rows, mode, np.empty(n, np.int64), motion, None)
    for i in range(len(asked)):
        held = start + t < roles.hold_until[i] and motion.path[t, i] == roles.path[i] and not motion.was_driven[t, i]
        asked[i] = mode[i] == DRIVEN and not held
    return asked, mode


@kernel
def apply_policy_answer(
    start: int, log: AgentStates, roles: Roles, paths: Paths, driver: IdmDriver, t: int, asked: Bools, answer: Array,
    rows: RolloutRows, mode: Ints, motion: Motion,
) -> None:  # fmt: skip
    """From row t to row t + 1: who is asked by the answer (N, 4) x, y, heading, speed; the others as in `drive`."""
    for i in range(len(asked)):
        if mode[i] != DRIVEN:
            continue
        _stay(rows, t, i)
        if asked[i]:
            x, y, h, speed = answer[i, 0], answer[i, 1], wrapped(answer[i, 2]), answer[i, 3]
            m, s = motion.path[t, i], project_on_path(paths, motion.path[t, i], x, y)[0]
            rows.boxes[t + 1, i, 0], rows.boxes[t + 1, i, 1], rows.boxes[t + 1, i, 2] = x, y, h
            rows.velocities[t + 1, i, 0], rows.velocities[t + 1, i, 1] = speed * math.cos(h), speed * math.sin(h)
            rows.center_z[t + 1, i] = motion.base_z[t, i] + paths.height[m, nearest_point_index(paths, s)]
            motion.was_driven[t + 1, i] = True
    _tow(roles, driver, t, rows, mode, motion)
    _replay(log, roles, t, rows, mode, motion)
    _admit(start, log, roles, driver, t, rows, mode, np.empty(len(asked), np.int64), motion, None)


@hidden_kernel
def _place(rows: RolloutRows, t: int, source: AgentStates, k: int, i: int) -> None:
    """Agent i, in row t, is where it is in step k of a world."""
    for c in range(5):
        rows.boxes[t, i, c] = source.boxes[k, i, c]
    rows.velocities[t, i, 0], rows.velocities[t, i, 1] = source.velocities[k, i, 0], source.velocities[k, i, 1]
    rows.center_z[t, i], rows.valid[t, i] = source.center_z[k, i], True
    rows.radius[t, i] = 0.5 * math.hypot(source.boxes[k, i, 3], source.boxes[k, i, 4])


@hidden_kernel
def _stay(rows: RolloutRows, t: int, i: int) -> None:
    """Agent i, in row t + 1, stands where it is in row t."""
    for k in range(5):
        rows.boxes[t + 1, i, k] = rows.boxes[t, i, k]
    rows.velocities[t + 1, i, 0], rows.velocities[t + 1, i, 1] = 0.0, 0.0
    rows.center_z[t + 1, i], rows.radius[t + 1, i] = rows.center_z[t, i], rows.radius[t, i]
    rows.valid[t + 1, i] = True


@hidden_kernel
def _switch_to_idm(
    roles: Roles, paths: Paths, driver: IdmDriver, t: int,
    rows: RolloutRows, mode: Ints, switch: Ints, motion: Motion, yielding: Yielding | None,
) -> None:  # fmt: skip
    """Who is on its path and due switches to IDM, at its own pose and speed; so does who must brake on its log.

    What it tows is moved by it from then on.
    Fills what moves each agent, and the ego, from row t on (N + 1,); row t + 1 of the motion is row t's. switch: (N,)
    scratch.
    """
    n = motion.mode.shape[1]
    mode[n] = EGO
    for i in range(n):
        mode[i], switch[i] = motion.mode[t, i], -1
    for i in range(n):
        if mode[i] == REPLAYED and rows.valid[t, i]:
            switch[i] = path_to_join(roles, paths, rows, t, i, motion.clock[t, i])
            if switch[i] < 0 and must_brake(roles, paths, driver, rows, t, i, mode):
                switch[i] = roles.logged_path[i]
    for i in range(n):
        m = switch[i]
        if m >= 0:
            mode[i] = DRIVEN
            s, offset, turn, speed = project_onto_path(paths, m, rows, t, i, driver)
            if yielding is not None:
                turn = wrapped(turn - body_turn_at(yielding, m, s))
            motion.mode[t, i], motion.path[t, i], motion.travelled[t, i] = DRIVEN, m, 0.0
            motion.s[t, i], motion.offset[t, i], motion.turn[t, i], motion.speed[t, i] = s, offset, turn, speed
            motion.base_z[t, i] = rows.center_z[t, i] - paths.height[m, nearest_point_index(paths, s)]
        first = roles.first_part[i]
        if first != i and mode[i] == REPLAYED and rows.valid[t, i] and (mode[first] == DRIVEN or switch[first] >= 0):
            mode[i] = TOWED
            away, offset, turn = hitch(rows.boxes, rows.valid, first, t, roles.trails, i)
            motion.mode[t, i], motion.s[t, i], motion.travelled[t, i] = TOWED, away, 0.0
            motion.offset[t, i], motion.turn[t, i] = offset, turn
            motion.speed[t, i] = forward_speed(rows, t, i) - forward_speed(rows, t, first)
            motion.base_z[t, i] = rows.center_z[t, i] - rows.center_z[t, first]
        motion.mode[t + 1, i], motion.path[t + 1, i] = motion.mode[t, i], motion.path[t, i]
        motion.clock[t + 1, i], motion.s[t + 1, i] = motion.clock[t, i], motion.s[t, i]
        motion.travelled[t + 1, i], motion.speed[t + 1, i] = motion.travelled[t, i], motion.speed[t, i]
        motion.offset[t + 1, i], motion.turn[t + 1, i] = motion.offset[t, i], motion.turn[t, i]
        motion.base_z[t + 1, i] = motion.base_z[t, i]
        motion.was_driven[t + 1, i] = motion.was_driven[t, i]


@hidden_kernel
def _drive_on(
    start: int, roles: Roles, paths: Paths, driver: IdmDriver, t: int,
    rows: RolloutRows, mode: Ints, near: Ints, motion: Motion, yielding: Yielding | None,
) -> None:  # fmt: skip
    """Those who are driven look at row t and move. near: (N + 1,) scratch."""
    for i in range(motion.mode.shape[1]):
        if mode[i] != DRIVEN:
            continue
        m, s, travelled, speed = motion.path[t, i], motion.s[t, i], motion.travelled[t, i], motion.speed[t, i]
        if start + t < roles.hold_until[i] and travelled == 0.0 and m == roles.path[i]:
            _advance(paths, driver, t, i, 0.0, 0.0, rows, motion, yielding)
            continue
        if yielding is None:
            accel = road_acceleration(paths, driver, t, m, s, speed, rows.boxes[t, i, 3])
        else:
            nose = s + 0.5 * rows.boxes[t, i, 3]
            accel = intended_acceleration(yielding, paths, driver, m, s, speed, start, t, nose)
        way = way_along(rows, t, i, m, s, travelled, motion.offset[t, i], motion.turn[t, i])
        accel = acceleration_for_others(roles, paths, driver, rows, t, i, way, speed, accel, yielding, near)
        if yielding is not None:
            accel = yielding_acceleration(yielding, driver, start, t, i, m, s, speed, rows, mode, motion, accel)
        motion.was_driven[t + 1, i] = True
        step_m, new_speed = advance(speed, accel)
        _advance(paths, driver, t, i, step_m, new_speed, rows, motion, yielding)


@hidden_kernel
def _advance(
    paths: Paths, driver: IdmDriver, t: int, i: int, step_m: float, new_speed: float, rows: RolloutRows, motion: Motion,
    yielding: Yielding | None,
) -> None:  # fmt: skip
    """Agent i, driven, is `step_m` on along its path in row t + 1."""
    m, s, travelled = motion.path[t + 1, i], motion.s[t + 1, i] + step_m, motion.travelled[t + 1, i] + step_m
    motion.s[t + 1, i], motion.travelled[t + 1, i], motion.speed[t + 1, i] = s, travelled, new_speed
    _stay(rows, t, i)  # a standing car keeps its box to the last bit
    if step_m != 0.0:
        offset, turn = motion.offset[t + 1, i], motion.turn[t + 1, i]
        x, y, h = pose_on_path(paths, m, s, travelled, offset, turn, driver.blend_length_m)
        rows.boxes[t + 1, i, 0], rows.boxes[t + 1, i, 1] = x, y
        if yielding is not None:
            h += body_turn_at(yielding, m, s)
        rows.boxes[t + 1, i, 2] = wrapped(h)
    h = rows.boxes[t + 1, i, 2]
    rows.velocities[t + 1, i, 0], rows.velocities[t + 1, i, 1] = new_speed * math.cos(h), new_speed * math.sin(h)
    rows.center_z[t + 1, i] = motion.base_z[t + 1, i] + paths.height[m, nearest_point_index(paths, s)]


@hidden_kernel
def _tow(roles: Roles, driver: IdmDriver, t: int, rows: RolloutRows, mode: Ints, motion: Motion) -> None:
    """Those towed come after what tows them, which is in row t + 1 already."""
    for i in range(motion.mode.shape[1]):
        if mode[i] != TOWED:
            continue
        first, since = roles.first_part[i], t
        while since > 0 and motion.mode[since - 1, i] == TOWED:
            since -= 1
        _stay(rows, t, i)
        step_m = math.hypot(
            rows.boxes[t + 1, first, 0] - rows.boxes[t, first, 0], rows.boxes[t + 1, first, 1] - rows.boxes[t, first, 1]
        )
        faster = faster_than_first(motion.speed[t, i], driver.emergency_decel)
        motion.speed[t + 1, i], motion.s[t + 1, i] = faster, motion.s[t, i] - faster * STEP_S
        motion.travelled[t + 1, i] += step_m
        if step_m > 0.0 or faster != 0.0:
            x, y, h = towed_pose(
                rows.boxes, rows.valid, first, t + 1, since, roles.trails, i,
                motion.s[t + 1, i], motion.offset[t, i], motion.turn[t, i], motion.travelled[t + 1, i],
                driver.blend_length_m,
            )  # fmt: skip
            rows.boxes[t + 1, i, 0], rows.boxes[t + 1, i, 1], rows.boxes[t + 1, i, 2] = x, y, h
        h, v = rows.boxes[t + 1, i, 2], forward_speed(rows, t + 1, first) + faster
        rows.velocities[t + 1, i, 0], rows.velocities[t + 1, i, 1] = v * math.cos(h), v * math.sin(h)
        rows.center_z[t + 1, i] = rows.center_z[t + 1, first] + motion.base_z[t, i]
        motion.was_driven[t + 1, i] = motion.was_driven[t + 1, first]


@hidden_kernel
def _replay(log: AgentStates, roles: Roles, t: int, rows: RolloutRows, mode: Ints, motion: Motion) -> None:
    """The parked stay, the replayed take the next step of their log.

    Who cannot brake along its log (who walks or cycles, or reverses) takes none to where a driven car is; one that
    walks goes on once it is touched, a vehicle would drive through. What is towed waits as what tows it does.
    """
    for towed in (False, True):  # what tows before what it tows
        for i in range(motion.mode.shape[1]):
            first = roles.first_part[i]
            if (first != i) != towed:
                continue
            if mode[i] == STANDING:
                _stay(rows, t, i)
            if mode[i] != REPLAYED:
                continue
            k = min(motion.clock[t, i] + 1, log.valid.shape[0] - 1)
            waits = False
            if towed and mode[first] == REPLAYED and rows.valid[t, first]:
                waits = rows.valid[t, i] and motion.clock[t + 1, first] == motion.clock[t, first]
            elif roles.moving_kind[i] and roles.logged_path[i] < 0 and rows.valid[t, i] and log.valid[k, i]:
                waits = touches_driven(log.boxes, k, i, rows, t + 1, mode) and (
                    roles.enters_clear[i] or not touches_driven(rows.boxes, t, i, rows, t + 1, mode)
                )
            if waits:
                _stay(rows, t, i)
            else:
                motion.clock[t + 1, i] = k
                if log.valid[k, i]:
                    _place(rows, t + 1, log, k, i)


@hidden_kernel
def _admit(
    start: int, log: AgentStates, roles: Roles, driver: IdmDriver, t: int,
    rows: RolloutRows, mode: Ints, enters: Ints, motion: Motion, yielding: Yielding | None,
) -> None:  # fmt: skip
    """Newcomers, judged against everyone who was already there. enters: (N,) scratch.

    The parts of one vehicle enter together, or by their log behind one that is not there yet, or is on its log.
    """
    n = motion.mode.shape[1]
    k = min(start + t + 1, log.valid.shape[0] - 1)
    for i in range(n):
        enters[i] = False
        if mode[i] != ABSENT or not log.valid[k, i]:
            continue
        enters[i] = far_from_ego(roles, log.boxes, k, i, rows, t + 1) and is_clear(
            roles, driver, log, k, i, rows, t + 1, mode, yielding
        )
        if yielding is not None and enters[i] and roles.path[i] >= 0:
            enters[i] = may_enter(yielding, driver, roles.path[i], k, t + 1, log, i, rows, mode, motion)
    for i in range(n):
        if roles.first_part[i] != i and mode[i] == ABSENT and not enters[i]:
            enters[roles.first_part[i]] = False
    for i in range(n):
        first = roles.first_part[i]
        kept_out = mode[first] == ABSENT and log.valid[k, first] and not enters[first]
        if first != i and (mode[first] == DRIVEN or kept_out):
            enters[i] = False
    for i in range(n):
        if enters[i]:
            motion.mode[t + 1, i], motion.clock[t + 1, i] = STANDING if roles.standing[i] else REPLAYED, k
            _place(rows, t + 1, log, k, i)

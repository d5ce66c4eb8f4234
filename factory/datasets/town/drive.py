"""One drive through the town: the ego, everybody around it and the lights, as tracks that never touch."""

import itertools
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from factory.datasets.town import curves
from factory.datasets.town.streets import Streets, TownRoad
from tasks.rollout.lqr import track
from tasks.world.arrays import Array, Bools
from tasks.world.clip import HISTORY_STEPS, HORIZON_STEPS
from tasks.world.frames import AX, AY, EGO_STATE_SIZE, PACIFICA, VX, box_corners, ego_boxes, touching
from tasks.world.road_map import arc_lengths

# Agents that drive: lights with phases, lane paths, and a driver that follows its path, its leader and the lights.
#
# Road users are planned one after another; each sees the finished tracks of those before it and yields to them. One
# that would still touch an earlier one is left out, so nobody collides, whatever the seed.

STEP_S = 0.1
GREEN, YELLOW, RED = 1, 2, 3
GREEN_S, YELLOW_S, CLEAR_S = 11.0, 3.0, 2.0
CYCLE_S = 2 * (GREEN_S + YELLOW_S + CLEAR_S)


@dataclass(frozen=True)
class Signals:
    """Two-phase lights: group 0 and group 1 are green in turn."""

    offset_s: float

    def state(self, group: int, time_s: float) -> int:
        """GREEN, YELLOW or RED."""
        phase = (time_s + self.offset_s - group * CYCLE_S / 2) % CYCLE_S
        return GREEN if phase < GREEN_S else YELLOW if phase < GREEN_S + YELLOW_S else RED


@dataclass(frozen=True)
class TownPath:
    """What one road user follows."""

    poses: Array  # (N, 3) every metre
    s: Array  # (N,) arc length [m]
    limit: Array  # (N,) speed [m/s] that bends and limits allow, braking ahead of them included
    stops: tuple[tuple[float, int], ...]  # (arc length of the stop line, signal group); group -1: always stop
    lane_ids: tuple[int, ...]


@dataclass(frozen=True)
class TownTrack:
    """One road user or parked car over the log; absent steps are NaN."""

    track_id: str
    category: str  # AV2 category
    size: tuple[float, float, float]  # length, width, height [m]
    poses: Array  # (S, 3) box centre
    look: int  # seed of its colour and shape

    def boxes(self) -> Array:
        """(S, 5) centre x, y, heading, length, width."""
        return np.column_stack([self.poses, np.broadcast_to(self.size[:2], (len(self.poses), 2))])


@dataclass(frozen=True)
class DrivingStyle:
    """How somebody drives; accelerations in m/s2."""

    speed_factor: float = 1.0
    accel: float = 1.3
    brake: float = 1.8
    jerk: float = 2.5
    headway_s: float = 1.4
    gap_m: float = 2.5
    lateral_accel: float = 2.0
    yaw_accel: float = 1.2  # rad/s2
    front_m: float = 2.3  # path point to front bumper
    half_width_m: float = 0.95


def path_of_lanes(streets: Streets, lane_ids: list[int], style: DrivingStyle, smooth_m: float = 2.5) -> TownPath:
    """The centre line of consecutive lanes, rounded so that curvature is continuous."""
    parts, stops, limits, length = [], [], [], 0.0
    for i, lane_id in enumerate(lane_ids):
        lane = streets.lanes[lane_id]
        parts.append(lane.center if i == 0 else lane.center[1:])
        limits.append(np.full(len(parts[-1]), lane.speed_mps))
        length += float(arc_lengths(lane.center)[-1])
        following = streets.lanes[lane_ids[i + 1]] if i + 1 < len(lane_ids) else None
        if following is not None and following.light_group >= 0:
            stops.append((length - lane.stop_before_end, following.light_group))
        if following is None and lane.kind == "BIKE":
            stops.append((length - lane.stop_before_end, -1))
    line = np.vstack(parts)
    s_raw = arc_lengths(line)
    even = np.linspace(0.0, s_raw[-1], int(np.ceil(s_raw[-1])) + 1)
    xy = curves.poses_at(line, even)[:, :2]
    xy = xy + gaussian_filter1d(xy - _chord(xy), smooth_m / (even[1]), axis=0, mode="nearest") - (xy - _chord(xy))
    poses = curves.resample(xy, float(line[0, 2]))
    s = arc_lengths(poses)
    curvature = gaussian_filter1d(np.gradient(np.unwrap(poses[:, 2]), s), 2.0)
    winding = np.abs(gaussian_filter1d(np.gradient(curvature, s), 2.0))
    posted = np.interp(s, s_raw, np.concatenate(limits)) * style.speed_factor
    limit = np.minimum(posted, np.sqrt(style.lateral_accel / np.maximum(np.abs(curvature), 1e-6)))
    limit = np.minimum(limit, np.sqrt(style.yaw_accel / np.maximum(winding, 1e-6)))
    for i in range(len(limit) - 2, -1, -1):
        limit[i] = min(limit[i], np.sqrt(limit[i + 1] ** 2 + 2 * 0.8 * style.brake * (s[i + 1] - s[i])))
    return TownPath(poses, s, limit, tuple(stops), tuple(lane_ids))


def _chord(xy: Array) -> Array:
    """The straight line between the ends: smoothing the difference to it keeps both ends in place."""
    t = np.linspace(0.0, 1.0, len(xy))[:, None]
    return xy[0] * (1 - t) + xy[-1] * t


def follow_path(
    path: TownPath, start_s: float, speed: float, style: DrivingStyle, others: Array, signals: Signals, times_s: Array
) -> tuple[Array, Array]:
    """Arc length (S,) [m] and speed (S,) [m/s] of a driver that sees `others` (S, J, 5): IDM with bounded jerk."""
    rear, along_speed = _obstacles_and_speeds(path, style, others)
    s_out, v_out = np.empty(len(times_s)), np.empty(len(times_s))
    s, v, a = start_s, speed, 0.0
    for i, time in enumerate(times_s):
        s_out[i], v_out[i] = s, v
        front = s + style.front_m
        wanted = float(np.interp(s + 0.6 * v, path.s, path.limit))
        command = min(max((wanted - v) / 0.9, -style.brake), style.accel)
        gaps = rear[i] - front
        ahead = gaps > -1.0
        if ahead.any():
            nearest = int(np.argmin(np.where(ahead, gaps, np.inf)))
            command = min(command, _idm_interaction(float(gaps[nearest]), v, float(along_speed[i, nearest]), style))
        for line, group in path.stops:
            state = RED if group < 0 else signals.state(group, float(time))
            distance = line - front
            can_stop = v * v / (2 * max(distance, 0.1)) < 2.6
            if distance > -1.0 and (state == RED or (state == YELLOW and can_stop)) and (distance > 0 or v < 1.0):
                command = min(command, _idm_interaction(distance + style.gap_m - 0.6, v, 0.0, style))
        a += float(np.clip(np.clip(command, -4.5, style.accel) - a, -style.jerk * STEP_S, style.jerk * STEP_S))
        if command < -2.5:
            a = min(a, command * 0.6)
        v_next = max(0.0, v + a * STEP_S)
        if v_next == 0.0:
            a = max(a, 0.0)
        s += (v + v_next) / 2 * STEP_S
        v = v_next
    return s_out, v_out


def _idm_interaction(gap: float, v: float, lead_v: float, style: DrivingStyle) -> float:
    """IDM's interaction term (Treiber et al. 2000)."""
    closing = v * (v - lead_v) / (2 * np.sqrt(style.accel * style.brake))
    wanted = style.gap_m + max(0.0, v * style.headway_s + closing)
    return style.accel * (1.0 - (wanted / max(gap, 0.3)) ** 2)


def _obstacles_and_speeds(path: TownPath, style: DrivingStyle, others: Array) -> tuple[Array, Array]:
    """Where along the path everybody in the driver's corridor ends (S, J) (inf: not in it), and speeds along it."""
    if others.shape[1] == 0:
        return np.full((len(others), 1), np.inf), np.zeros((len(others), 1))
    rear, along = np.full(others.shape[:2], np.inf), np.zeros(others.shape[:2])
    present = ~np.isnan(others[..., 0])
    box = others[present]
    _, nearest = cKDTree(path.poses[:, :2]).query(box[:, :2])
    pose = path.poses[nearest]
    dx, dy = (box[:, :2] - pose[:, :2]).T
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turn = box[:, 2] - pose[:, 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    across = box[:, 3] / 2 * sin + box[:, 4] / 2 * cos
    along[present] = position = path.s[nearest] + c * dx + s * dy
    inside = np.abs(-s * dx + c * dy) < across + style.half_width_m + 0.25
    rear[present] = np.where(inside, position - box[:, 3] / 2 * cos - box[:, 4] / 2 * sin, np.inf)
    return rear, np.nan_to_num(np.clip(np.gradient(along, STEP_S, axis=0), 0.0, 30.0))


def overlaps(boxes: Array, others: Array, margin_m: float) -> Bools:
    """(S, J): does `boxes` (S, 5), grown by `margin_m` on every side, touch `others` (S, J, 5)? NaN touches nothing."""
    return touching((boxes + 2 * margin_m * np.array([0.0, 0.0, 0.0, 1.0, 1.0]))[:, None], others)


def endangers(ego: Array, speeds: Array, others: Array) -> Bools:
    """(J,): would the ego (S, 5), straight on for up to 0.9 s, touch that track? Stricter than docs/reward.md 2g."""
    danger = np.zeros(others.shape[1], bool)
    for ahead in (0, 3, 6, 9):
        moved = ego[: len(ego) - ahead].copy()
        travel = speeds[: len(moved)] * ahead * STEP_S
        moved[:, 0] += travel * np.cos(moved[:, 2])
        moved[:, 1] += travel * np.sin(moved[:, 2])
        danger |= overlaps(moved, others[ahead:], 0.15).any(axis=0)
    return danger


# Where the ego drives: the scenario kinds, its route through the lanes, and its human-like motion.

EGO_SMOOTH_M = 3.2  # rounds the lanes' joints: steering that a person would do
SLOWEST_MPS = 1.2  # a log whose ego is ever slower is drawn again: a standing ego makes no clip


@dataclass(frozen=True)
class Scenario:
    """One kind of drive: from a road (in or against its line's direction), towards another."""

    kind: str
    road: str
    forward: bool
    target: str | None
    to_junction_m: tuple[float, float] | None  # start this far before the road's end; None: near its beginning


APPROACH = (38.0, 80.0)
SCENARIOS = (  # in turn, log by log; every run of seven holds every kind once
    Scenario("straight multi-lane", "avenue", True, None, None),
    Scenario("signalised straight", "west street", False, "avenue", APPROACH),
    Scenario("roundabout", "west street", True, "ring road 1", APPROACH),
    Scenario("narrow with parked cars", "narrow street", True, None, None),
    Scenario("curve", "south avenue", True, None, None),
    Scenario("Y-branch", "avenue", True, "left branch", APPROACH),
    Scenario("signalised turn", "avenue", False, "narrow street", APPROACH),
    Scenario("curve", "south avenue", False, None, None),
    Scenario("signalised turn", "west street", False, "south avenue", APPROACH),
    Scenario("roundabout", "ring road 2", False, "west street", APPROACH),
    Scenario("straight multi-lane", "avenue", False, None, None),
    Scenario("narrow with parked cars", "narrow street", False, None, None),
    Scenario("Y-branch", "right branch", False, "avenue", APPROACH),
    Scenario("signalised straight", "avenue", False, "west street", APPROACH),
    Scenario("signalised turn", "south avenue", False, "avenue", APPROACH),
    Scenario("curve", "west street", False, None, None),
    Scenario("roundabout", "west street", True, "ring road 2", APPROACH),
    Scenario("Y-branch", "avenue", True, "right branch", APPROACH),
)


def lane_chains(streets: Streets, road: str, forward: bool) -> list[list[int]]:
    """Lane ids of a road's VEHICLE lanes, one list per lane, inner lane first, in driving direction."""
    lanes, line = streets.lanes, next(r.line for r in streets.roads if r.name == road)
    out = []
    for lane in lanes.values():
        if lane.road != road or lane.kind != "VEHICLE" or any(lanes[p].road == road for p in lane.predecessors):
            continue
        beside = line[np.argmin(np.hypot(*(line[:, :2] - lane.center[0, :2]).T)), 2]
        if (np.cos(lane.center[0, 2] - beside) > 0) == forward:
            out.append([lane.lane_id])
            while after := [n for n in lanes[out[-1][-1]].successors if lanes[n].road == road]:
                out[-1].append(after[0])
    return out


def shortest_lane_path(streets: Streets, lane_id: int, road: str) -> list[int] | None:
    """The lanes after `lane_id` on the way with the fewest lanes to `road`; None where there is none."""
    came_from: dict[int, int] = {lane_id: -1}
    queue = deque([lane_id])
    while queue and streets.lanes[queue[0]].road != road:
        here = queue.popleft()
        for following in streets.lanes[here].successors:
            if following not in came_from:
                came_from[following] = here
                queue.append(following)
    if not queue:
        return None
    way = [queue[0]]
    while came_from[way[-1]] != lane_id:
        way.append(came_from[way[-1]])
    return way[::-1]


def extend_at_random(streets: Streets, lane_ids: list[int], rng: np.random.Generator) -> list[int]:
    """The same lanes and up to 14 more, turning at random."""
    out = list(lane_ids)
    while streets.lanes[out[-1]].successors and len(out) < len(lane_ids) + 14:
        out.append(int(rng.choice(streets.lanes[out[-1]].successors)))
    return out


def ego_path(
    streets: Streets, scenario: Scenario, style: DrivingStyle, rng: np.random.Generator
) -> tuple[TownPath, float]:
    """The ego's path and its start on it [m]."""
    near = scenario.to_junction_m
    starts = lane_chains(streets, scenario.road, scenario.forward)
    for k in rng.permutation(len(starts)):
        chain = starts[k]
        way = [] if scenario.target is None else shortest_lane_path(streets, chain[-1], scenario.target)
        if way is not None:
            length = sum(float(arc_lengths(streets.lanes[lane].center)[-1]) for lane in chain)
            start = float(rng.uniform(25.0, 55.0)) if near is None else length - float(rng.uniform(*near))
            return path_of_lanes(streets, extend_at_random(streets, chain + way, rng), style, EGO_SMOOTH_M), start
    raise ValueError(f"no way from {scenario.road!r} to {scenario.target!r}")


def track_ego(rear_axle: Array, speed: Array) -> list[tuple[int, Array]]:
    """What the factory's own tracker makes of the ego: (first step, states (41, 11)) for starts every second.

    A log is kept only if these, too, are lawful and safe: then its windows score well as human samples. (Comfort is not
    asked for: the public tracker starts with straight wheels, so a start in a tight turn always jerks.)
    """
    states = np.zeros((len(rear_axle), EGO_STATE_SIZE))
    states[:, :3] = rear_axle
    states[:, VX] = speed
    states[:, AX] = np.gradient(speed, STEP_S)
    states[:, AY] = speed * np.gradient(np.unwrap(rear_axle[:, 2]), STEP_S)
    starts = range(HISTORY_STEPS, len(states) - HORIZON_STEPS, 10)
    return [(a, track(states[a], states[None, a + 1 : a + 1 + HORIZON_STEPS, :3])[0]) for a in starts]


def is_lawful(streets: Streets, path: TownPath, boxes: Array, signals: Signals, times_s: Array) -> bool:
    """All corners on drivable surface at every step, and never on a connector of its way while that is red."""
    corners = box_corners(boxes)
    if not shapely.contains_xy(streets.surface(), *corners.reshape(-1, 2).T).all():
        return False
    body = shapely.polygons(corners)
    for lane in (streets.lanes[lane_id] for lane_id in path.lane_ids):
        if lane.light_group >= 0:
            ring = shapely.Polygon(np.vstack([lane.left, lane.right[::-1]])).buffer(0.3)
            red = np.array([signals.state(lane.light_group, float(t)) == RED for t in times_s])
            if shapely.intersects(body[red], ring).any():
                return False
    return True


WARM_STEPS = 40  # simulated before the log starts, so that it starts in the middle of things
SPAWN_RADIUS_M = 130.0
TRIES = 200
JUNCTION_CLEAR_M = 28.0  # no parked car this near to the ends of a street
EGO = DrivingStyle(
    accel=1.2,
    brake=1.5,
    jerk=2.0,
    headway_s=1.6,
    gap_m=3.0,
    lateral_accel=1.7,
    yaw_accel=0.7,
    front_m=PACIFICA.front_length,
    half_width_m=PACIFICA.half_width,
)
FLEET = (  # AV2 category, length, width, height, share
    ("REGULAR_VEHICLE", 4.5, 1.84, 1.48, 0.62),
    ("REGULAR_VEHICLE", 4.85, 1.95, 1.78, 0.22),
    ("BOX_TRUCK", 7.2, 2.35, 3.0, 0.10),
    ("BUS", 10.5, 2.5, 3.05, 0.06),
)


@dataclass(frozen=True)
class TownDrive:
    """A log's worth of behaviour, S steps of 0.1 s."""

    ego: Array  # (S, 3) rear axle
    ego_speed: Array  # (S,) m/s
    tracks: tuple[TownTrack, ...]
    signals: Signals
    times_s: Array  # (S,)


class _PlannedTraffic:
    """The streets, their lights, and the tracks planned so far."""

    def __init__(self, streets: Streets, signals: Signals, times: Array, rng: np.random.Generator) -> None:
        self.streets, self.signals, self.times, self.rng = streets, signals, times, rng
        self.tracks: list[TownTrack] = []
        self.boxes = np.full((len(times), 0, 5), np.nan)
        self.egos: list[tuple[int, Array, Array]] = []  # first step, boxes, speeds: the ego, and the ego as tracked

    def add(self, track: TownTrack, margin_m: float) -> None:
        """Adds the track unless it comes closer than the margin to an earlier one or endangers the ego."""
        boxes = track.boxes()[:, None]
        if not overlaps(boxes[:, 0], self.boxes, margin_m).any() and not self.threatened_by(boxes):
            self.tracks.append(track)
            self.boxes = np.concatenate([self.boxes, boxes], axis=1)

    def threatened_by(self, others: Array) -> bool:
        """Does anybody of `others` (S, J, 5) endanger the ego?"""
        return any(
            bool(endangers(boxes, speed, others[start : start + len(boxes)]).any()) for start, boxes, speed in self.egos
        )

    def driven(self, path: TownPath, start: float, speed: float, style: DrivingStyle) -> tuple[Array, Array]:
        """Arc length and speed (S,) of somebody who sees everybody planned so far, the ego too."""
        seen = np.concatenate([self.boxes, self.egos[0][1][:, None]], axis=1) if self.egos else self.boxes
        return follow_path(path, start, speed, style, seen, self.signals, self.times)

    def look_seed(self) -> int:
        """Of the next track."""
        return int(self.rng.integers(1 << 30))


def parked_cars(streets: Streets, rng: np.random.Generator) -> tuple[TownTrack, ...]:
    """Cars in the parking strips: part of the town, the same in all its logs (poses of one step)."""
    cars: list[TownTrack] = []
    for road in (road for road in streets.roads if road.strip == "park"):
        for line in road.both_ways:
            s = JUNCTION_CLEAR_M
            while s < arc_lengths(line)[-1] - JUNCTION_CLEAR_M:
                if rng.random() < 0.8:
                    size = 4.4 + rng.uniform(-0.4, 0.5), 1.8 + rng.uniform(-0.06, 0.06), rng.uniform(1.42, 1.8)
                    right = road.half_width - 0.18 - size[1] / 2 + rng.uniform(-0.04, 0.04)
                    pose = curves.pose_beside(line, s, right, rng.uniform(-0.012, 0.012))
                    look = int(rng.integers(1 << 30))
                    cars.append(TownTrack(f"parked-{len(cars):03d}", "REGULAR_VEHICLE", size, pose[None], look))
                s += rng.uniform(6.0, 7.2)
    return tuple(cars)


def plan_drive(
    streets: Streets, parked: tuple[TownTrack, ...], scenario: Scenario, steps: int, seed: list[int]
) -> TownDrive:
    """A drive of `steps` steps of 0.1 s; drawn again until the ego keeps moving, keeps the law and is in no danger.

    Raises RuntimeError after 200 draws (not seen).
    """
    for attempt in range(TRIES):
        if found := _attempt(streets, parked, scenario, steps, np.random.default_rng([*seed, attempt])):
            return found
    raise RuntimeError(f"no lawful drive for scenario {scenario.kind!r} with seed {seed}")


def _attempt(
    streets: Streets, parked: tuple[TownTrack, ...], scenario: Scenario, steps: int, rng: np.random.Generator
) -> TownDrive | None:
    times: Array = (np.arange(steps + WARM_STEPS, dtype=np.float64) - WARM_STEPS) * STEP_S
    style = replace(EGO, speed_factor=float(rng.uniform(0.86, 1.0)))
    path, start = ego_path(streets, scenario, style, rng)
    if start + WARM_STEPS * STEP_S * 9.0 + 60.0 > path.s[-1]:
        return None
    planned = _PlannedTraffic(streets, _signals(path, start, float(times[0]), rng), times, rng)
    near = curves.poses_at(path.poses, start + 70.0)[:2]
    for car in parked:
        if np.hypot(*(car.poses[0, :2] - near)) < 220.0:
            planned.add(replace(car, poses=np.repeat(car.poses, len(times), axis=0)), 0.0)
    ego_v = float(np.interp(start, path.s, path.limit)) * rng.uniform(0.8, 0.95)
    if rng.random() < 0.7:
        begins = start + 4.6 + ego_v * rng.uniform(1.9, 3.2)
        own = path_of_lanes(streets, list(path.lane_ids), DrivingStyle(float(rng.uniform(0.88, 1.02))))
        _vehicle(planned, "lead", own, begins, ego_v, int(rng.choice(3, p=[0.7, 0.2, 0.1])))
    s, v = planned.driven(path, start, ego_v, style)
    if v.min() < SLOWEST_MPS or v[WARM_STEPS:].mean() < 4.5 or s[-1] > path.s[-1] - 40.0:
        return None
    wander = 0.07 * np.sin(s / 13.0 + rng.uniform(0, 6.28))
    rear = curves.offset(curves.poses_at(path.poses, s), wander)
    rear[:, 2] += np.gradient(wander, s)
    boxes = ego_boxes(rear, PACIFICA)
    planned.egos = [(0, boxes, v)]
    for start_step, states in track_ego(rear[WARM_STEPS:], v[WARM_STEPS:]):
        planned.egos.append((WARM_STEPS + start_step, ego_boxes(states, PACIFICA), states[:, VX]))
    if not all(is_lawful(streets, path, b, planned.signals, times[a : a + len(b)]) for a, b, _ in planned.egos):
        return None
    if planned.threatened_by(planned.boxes):
        return None
    for add in (_cyclists, _cars, _walkers):
        add(planned, boxes[WARM_STEPS + steps // 2, :2])
    logged = [replace(track, poses=track.poses[WARM_STEPS:]) for track in planned.tracks]
    tracks = tuple(track for track in logged if not np.isnan(track.poses[:, 0]).all())
    return TownDrive(rear[WARM_STEPS:], v[WARM_STEPS:], tracks, planned.signals, times[WARM_STEPS:])


def _signals(path: TownPath, start: float, start_time_s: float, rng: np.random.Generator) -> Signals:
    """Lights that turn green 8 s before to 4 s after the ego would reach the stop line unhindered: it may brake."""
    for line, group in path.stops:
        if 0.0 < line - start < 130.0 and group >= 0:
            arrival = start_time_s + (line - start) / 9.0
            return Signals(float(rng.uniform(-4.0, 8.0)) + group * CYCLE_S / 2 - arrival)
    return Signals(float(rng.uniform(0.0, CYCLE_S)))


def _vehicle(planned: _PlannedTraffic, name: str, path: TownPath, start: float, speed: float, fleet: int) -> None:
    category, length, width, height, _ = FLEET[fleet]
    length *= float(planned.rng.uniform(0.96, 1.04))
    s, _v = planned.driven(path, start, speed, DrivingStyle(front_m=length / 2, half_width_m=width / 2))
    poses = curves.poses_at(path.poses, s)
    poses[s > path.s[-1] - 1.0] = np.nan
    planned.add(TownTrack(name, category, (length, width, height), poses, planned.look_seed()), 0.35)


def _cars(planned: _PlannedTraffic, centre: Array) -> None:
    streets, rng = planned.streets, planned.rng
    spawns = []
    for lane in streets.lanes.values():
        if lane.kind != "VEHICLE" or lane.is_intersection or lane.road == "ring":
            continue
        length = float(arc_lengths(lane.center)[-1])
        at = float(rng.uniform(0.0, 25.0))
        while at < length - 8.0:
            if np.hypot(*(curves.poses_at(lane.center, at)[:2] - centre)) < SPAWN_RADIUS_M:
                spawns.append((length - at, lane.lane_id, at))
            at += float(rng.uniform(16.0, 55.0))
    shares = [share for *_, share in FLEET]
    for k, (_to_end, lane_id, at) in enumerate(sorted(spawns)):
        style = DrivingStyle(float(rng.uniform(0.82, 1.02)))
        path = path_of_lanes(streets, extend_at_random(streets, [lane_id], rng), style)
        narrow = streets.lanes[lane_id].speed_mps < 10.0
        fleet = 0 if narrow else int(rng.choice(len(FLEET), p=shares))
        speed = float(np.interp(at, path.s, path.limit)) * float(rng.uniform(0.5, 0.95))
        _vehicle(planned, f"vehicle-{k:03d}", path, at, speed, fleet)


def _cyclists(planned: _PlannedTraffic, centre: Array) -> None:
    streets, rng = planned.streets, planned.rng
    lanes = [lane for lane in streets.lanes.values() if lane.kind == "BIKE"]
    lanes = [lane for lane in lanes if np.hypot(*(lane.center[len(lane.center) // 2, :2] - centre)) < SPAWN_RADIUS_M]
    for k, lane in enumerate(lanes):
        if rng.random() > 0.45:
            continue
        style = DrivingStyle(float(rng.uniform(3.6, 5.6)) / lane.speed_mps, front_m=0.9, half_width_m=0.3, gap_m=1.0)
        path = path_of_lanes(streets, extend_at_random(streets, [lane.lane_id], rng), style)
        s, _v = planned.driven(path, float(rng.uniform(0.0, 50.0)), 4.0, style)
        poses = curves.offset(curves.poses_at(path.poses, s), -0.15)
        poses[s > path.s[-1] - 0.5] = np.nan
        planned.add(TownTrack(f"cyclist-{k:02d}", "BICYCLIST", (1.75, 0.62, 1.72), poses, planned.look_seed()), 0.3)


def _walkers(planned: _PlannedTraffic, centre: Array) -> None:
    """Pedestrians on the pavements, and on the crosswalks while the cars they cross have red."""
    times, rng, size = planned.times, planned.rng, (0.55, 0.6, 1.75)
    for road, side in itertools.product(planned.streets.roads, (-1.0, 1.0)):
        for k in range(int(rng.poisson(9))):
            poses = _stroll(road, side, times, rng)
            if np.nanmin(np.hypot(*(poses[:, :2] - centre).T)) < 110.0:
                name = f"pedestrian-{road.name.replace(' ', '-')}-{int(side > 0)}-{k}"
                planned.add(TownTrack(name, "PEDESTRIAN", size, poses, planned.look_seed()), 0.2)
    for c, crossing in enumerate(planned.streets.crossings):
        if np.hypot(*(crossing.edge1.mean(0) - centre)) > 110.0:
            continue
        for k in range(int(rng.poisson(3))):
            speed, begin, share = rng.uniform(1.2, 1.6), rng.uniform(times[0], times[-1]), rng.uniform(0.25, 0.75)
            a, b = (crossing.edge1 * share + crossing.edge2 * (1 - share))[:: int(rng.choice([-1, 1]))]
            length = float(np.hypot(*(b - a)))
            if any(
                planned.signals.state(crossing.light_group, float(t)) != RED for t in (begin, begin + length / speed)
            ):
                continue
            along = np.clip((times - begin) * speed, -1.2, length + 1.2)  # waits and ends on the pavement
            xy = a + along[:, None] / length * (b - a)
            poses = np.column_stack([xy, np.full(len(xy), np.arctan2(b[1] - a[1], b[0] - a[0]))])
            planned.add(TownTrack(f"crossing-{c}-{k}", "PEDESTRIAN", size, poses, planned.look_seed()), 0.3)


def _stroll(road: TownRoad, side: float, times: Array, rng: np.random.Generator) -> Array:
    """A walk along one pavement of a road."""
    edge = curves.offset(road.line, side * (road.half_width + float(rng.uniform(1.3, 2.7))))
    if rng.random() < 0.5:
        edge = curves.reverse(edge)
    length = arc_lengths(edge)[-1]
    along = float(rng.uniform(6.0, length - 30.0)) + float(rng.uniform(1.0, 1.6)) * (times - times[0])
    poses = curves.poses_at(edge, np.minimum(along, length))
    poses[along > length - 1.0] = np.nan
    return poses

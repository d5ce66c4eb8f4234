"""One drive through the town: the ego, everybody around it and the lights, as tracks that never touch."""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from factory.readers.town import curves
from factory.readers.town.ego import SLOWEST_MPS, Scenario, ego_path, is_lawful, on_at_random, tracked
from factory.readers.town.streets import Streets, TownRoad
from factory.readers.town.traffic import (
    CYCLE_S,
    RED,
    STEP_S,
    DrivingStyle,
    Signals,
    TownPath,
    TownTrack,
    drive,
    endangers,
    overlaps,
    path_of_lanes,
)
from tasks.world.arrays import Array
from tasks.world.geometry import ego_boxes
from tasks.world.polygons import arc_lengths
from tasks.world.vehicle import PACIFICA, VX

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
        return drive(path, start, speed, style, seen, self.signals, self.times)

    def look(self) -> int:
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
                    pose = curves.beside(line, s, right, rng.uniform(-0.012, 0.012))
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
    near = curves.at(path.poses, start + 70.0)[:2]
    for car in parked:
        if np.hypot(*(car.poses[0, :2] - near)) < 220.0:
            planned.add(replace(car, poses=np.repeat(car.poses, len(times), axis=0)), 0.0)
    ego_v = float(np.interp(start, path.s, path.limit)) * rng.uniform(0.8, 0.95)
    if rng.random() < 0.7:
        _lead(planned, path, start + 4.6 + ego_v * rng.uniform(1.9, 3.2), ego_v)
    s, v = planned.driven(path, start, ego_v, style)
    if v.min() < SLOWEST_MPS or v[WARM_STEPS:].mean() < 4.5 or s[-1] > path.s[-1] - 40.0:
        return None
    wander = 0.07 * np.sin(s / 13.0 + rng.uniform(0, 6.28))
    rear = curves.offset(curves.at(path.poses, s), wander)
    rear[:, 2] += np.gradient(wander, s)
    boxes = ego_boxes(rear, PACIFICA)
    planned.egos = [(0, boxes, v)]
    for start_step, states in tracked(rear[WARM_STEPS:], v[WARM_STEPS:]):
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
    poses = curves.at(path.poses, s)
    poses[s > path.s[-1] - 1.0] = np.nan
    planned.add(TownTrack(name, category, (length, width, height), poses, planned.look()), 0.35)


def _lead(planned: _PlannedTraffic, path: TownPath, start: float, speed: float) -> None:
    """A vehicle in front of the ego, on the ego's own way."""
    own = path_of_lanes(planned.streets, list(path.lane_ids), DrivingStyle(float(planned.rng.uniform(0.88, 1.02))))
    _vehicle(planned, "lead", own, start, speed, int(planned.rng.choice(3, p=[0.7, 0.2, 0.1])))


def _cars(planned: _PlannedTraffic, centre: Array) -> None:
    streets, rng = planned.streets, planned.rng
    spawns = []
    for lane in streets.lanes.values():
        if lane.kind != "VEHICLE" or lane.is_intersection or lane.road == "ring":
            continue
        length = float(arc_lengths(lane.center)[-1])
        at = float(rng.uniform(0.0, 25.0))
        while at < length - 8.0:
            if np.hypot(*(curves.at(lane.center, at)[:2] - centre)) < SPAWN_RADIUS_M:
                spawns.append((length - at, lane.lane_id, at))
            at += float(rng.uniform(16.0, 55.0))
    shares = [share for *_, share in FLEET]
    for k, (_to_end, lane_id, at) in enumerate(sorted(spawns)):
        style = DrivingStyle(float(rng.uniform(0.82, 1.02)))
        path = path_of_lanes(streets, on_at_random(streets, [lane_id], rng), style)
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
        path = path_of_lanes(streets, on_at_random(streets, [lane.lane_id], rng), style)
        s, _v = planned.driven(path, float(rng.uniform(0.0, 50.0)), 4.0, style)
        poses = curves.offset(curves.at(path.poses, s), -0.15)
        poses[s > path.s[-1] - 0.5] = np.nan
        planned.add(TownTrack(f"cyclist-{k:02d}", "BICYCLIST", (1.75, 0.62, 1.72), poses, planned.look()), 0.3)


def _walkers(planned: _PlannedTraffic, centre: Array) -> None:
    """Pedestrians on the pavements, and on the crosswalks while the cars they cross have red."""
    times, rng, size = planned.times, planned.rng, (0.55, 0.6, 1.75)
    for road, side in itertools.product(planned.streets.roads, (-1.0, 1.0)):
        for k in range(int(rng.poisson(9))):
            poses = _stroll(road, side, times, rng)
            if np.nanmin(np.hypot(*(poses[:, :2] - centre).T)) < 110.0:
                name = f"pedestrian-{road.name.replace(' ', '-')}-{int(side > 0)}-{k}"
                planned.add(TownTrack(name, "PEDESTRIAN", size, poses, planned.look()), 0.2)
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
            planned.add(TownTrack(f"crossing-{c}-{k}", "PEDESTRIAN", size, poses, planned.look()), 0.3)


def _stroll(road: TownRoad, side: float, times: Array, rng: np.random.Generator) -> Array:
    """A walk along one pavement of a road."""
    edge = curves.offset(road.line, side * (road.half_width + float(rng.uniform(1.3, 2.7))))
    if rng.random() < 0.5:
        edge = curves.reverse(edge)
    length = arc_lengths(edge)[-1]
    along = float(rng.uniform(6.0, length - 30.0)) + float(rng.uniform(1.0, 1.6)) * (times - times[0])
    poses = curves.at(edge, np.minimum(along, length))
    poses[along > length - 1.0] = np.nan
    return poses

"""PDM-Closed's forecast, paths and proposals written with shapely: the slow twin of tasks.experts.pdm_*.

Geometry is shapely's own, so a corridor is what the public planner's is, to the last corner of its round joins.
"""

from dataclasses import dataclass

import numpy as np
import shapely
import shapely.ops
from numpy.typing import NDArray

from tasks.world.clip import MOVING_KINDS, AgentKind, AgentTracks
from tasks.world.frames import PACIFICA, VX, Vehicle, X, Y, box_corners, ego_boxes, wrap_angle

Array = NDArray[np.float64]
STEP_S = 0.1
SAMPLE_STEPS = 2  # one forecast per 0.2 s: step i of the plan sees sample i // 2
RADIUS_M = 100.0  # from the ego centre
NEAREST = {AgentKind.VEHICLE: 50, AgentKind.PEDESTRIAN: 25, AgentKind.BICYCLE: 10}
NEAREST_STATIC = 50
SPEED_FRACTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)
MIN_PROGRESS_M = 1e-5  # interpolation never asks for the very first point: joints may repeat it
SCORED_STEPS = 40
PROPOSAL_STEPS = 50  # the chosen one is driven on to 5 s


@dataclass(frozen=True)
class DrivePath:
    """A path by arc length."""

    poses: Array  # (P, 3) x, y [m], unwrapped heading [rad], world frame
    progress: Array  # (P,) arc length of each pose [m], not decreasing (lane joints repeat a point)
    line: shapely.LineString

    @property
    def length_m(self) -> float:
        return float(self.progress[-1])

    def at(self, progress: Array) -> Array:
        """Poses (..., 3) at arc lengths (...) [m]: linear in x, y and unwrapped heading, clipped to the path's ends."""
        distance = np.clip(progress, MIN_PROGRESS_M, self.length_m)
        # side="left": the segment found starts strictly before the distance, so a repeated point divides by nothing
        above = np.clip(np.searchsorted(self.progress, distance), 1, len(self.progress) - 1)
        below = above - 1
        slope = (self.poses[above] - self.poses[below]) / (self.progress[above] - self.progress[below])[..., None]
        out = slope * (distance - self.progress[below])[..., None] + self.poses[below]
        out[..., 2] = np.arctan2(np.sin(out[..., 2]), np.cos(out[..., 2]))
        return out

    def project(self, points: Array) -> Array:
        """Arc length [m] of the nearest point of the path to each of `points` (..., 2)."""
        found: Array = shapely.line_locate_point(self.line, shapely.points(points))
        return found

    def ahead(self, start_m: float, stop_m: float) -> shapely.LineString:
        """The part between two arc lengths, made of the path's own points where at least two lie inside."""
        start_m, stop_m = float(np.clip(start_m, 0.0, self.length_m)), float(np.clip(stop_m, 0.0, self.length_m))
        inside = (start_m <= self.progress) & (self.progress <= stop_m)
        if np.count_nonzero(inside) > 1:
            return shapely.LineString(self.poses[inside, :2])
        return shapely.ops.substring(self.line, start_m, stop_m)


def drive_path(poses: Array) -> DrivePath:
    """The path through `poses` (P, 3)."""
    poses = poses.copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    progress = np.concatenate([[0.0], np.cumsum(steps)])
    return DrivePath(poses, progress, shapely.LineString(poses[:, :2]))


def parallel(poses: Array, offset_m: float) -> Array:
    """`poses` (P, 3) moved sideways, to the left where `offset_m` > 0; headings stay."""
    side = poses[:, 2] + np.pi / 2.0
    moved = poses.copy()
    moved[:, 0] += np.cos(side) * offset_m
    moved[:, 1] += np.sin(side) * offset_m
    moved[:, 2] = wrap_angle(moved[:, 2])
    return moved


@dataclass(frozen=True)
class Forecast:
    """M objects as seen now: standing ones first, then vehicles, pedestrians, bicycles, each by distance."""

    track: NDArray[np.intp]  # (M,) column in the agents it was made from
    boxes: Array  # (M, 5) now
    drift: Array  # (M, 2) velocity used to move the box [m/s]: along its heading or straight against it
    speed: Array  # (M,) [m/s]
    is_agent: NDArray[np.bool_]  # (M,) vehicles, pedestrians and bicycles
    touches_ego: NDArray[np.bool_]  # (M,) at the start; such objects are ignored for good
    red_lights: tuple[shapely.Polygon, ...] = ()  # on-route connectors that are red now, kept red
    red_light_holds_ego: tuple[bool, ...] = ()  # the ego's footprint lies within it already: it is no lead

    def polygons(self, samples: int) -> NDArray[np.object_]:
        """(samples, M) shapely polygons at 0, 0.2, 0.4 ... s."""
        times = np.arange(samples) * SAMPLE_STEPS * STEP_S
        corners = box_corners(self.boxes)[None] + (times[:, None, None] * self.drift[None])[:, :, None]
        polygons: NDArray[np.object_] = shapely.polygons(corners)
        return polygons


def forecast(ego_state: Array, agents: AgentTracks, red_lights: tuple[shapely.Polygon, ...] = ()) -> Forecast:
    """What is nearest to `ego_state` (11,), object by object: the first of each kind that may be as many as it says."""
    ego = ego_boxes(ego_state, PACIFICA)
    body = shapely.Polygon(box_corners(ego))
    away = {i: float(np.hypot(*(agents.boxes[0, i, :2] - ego[:2]))) for i in np.flatnonzero(agents.valid[0])}
    near = sorted((i for i in away if away[i] <= RADIUS_M), key=lambda i: away[i])
    track = [i for i in near if agents.kinds[i] not in MOVING_KINDS][:NEAREST_STATIC]
    for kind, count in NEAREST.items():
        track += [i for i in near if agents.kinds[i] == kind][:count]
    boxes, velocities = agents.boxes[0, track].reshape(-1, 5), agents.velocities[0, track].reshape(-1, 2)
    ahead = np.stack([np.cos(boxes[:, 2]), np.sin(boxes[:, 2])], axis=1)
    is_agent = np.array([agents.kinds[i] in MOVING_KINDS for i in track], dtype=bool)
    speed = np.hypot(*velocities.T)
    along = np.where((ahead * velocities).sum(axis=1) > 0.0, speed, -speed) * is_agent
    return Forecast(
        track=np.array(track, dtype=np.intp),
        boxes=boxes,
        drift=along[:, None] * ahead,
        speed=speed,
        is_agent=is_agent,
        touches_ego=np.array([body.intersects(shapely.Polygon(box)) for box in box_corners(boxes)], dtype=bool),
        red_lights=red_lights,
        red_light_holds_ego=tuple(body.within(light) for light in red_lights),
    )


@dataclass(frozen=True)
class Proposals:
    """P = lateral x speed proposals, index = speeds * lateral + speed."""

    poses: Array  # (P, 51, 3) rear axle on the path, world frame
    progress_velocity: Array  # (P, 51, 2) arc length [m], speed [m/s]
    leads: Array  # (P, 51, 3) lead's arc length [m], velocity [m/s], own half length on a free road [m]


@dataclass(frozen=True)
class _Traffic:
    """Objects in the corridor of each path, L paths, S samples, M objects with red lights last."""

    polygons: NDArray[np.object_]  # (S, M)
    in_corridor: NDArray[np.bool_]  # (L, S, M)
    progress: Array  # (L, S, M) arc length of the centroid [m]
    speed: Array  # (M,) [m/s], 0 for standing things
    heading: Array  # (M,)
    is_light: NDArray[np.bool_]  # (M,)


def proposals(
    ego_state: Array,
    centerline: Array,
    seen: Forecast,
    speed_limit_mps: float | None,
    vehicle: Vehicle = PACIFICA,
) -> Proposals:
    """The proposals from `ego_state` (11,) along `centerline` (N, 3) through the forecast traffic.

    Each starts at the projection of the rear axle on its path with the ego's longitudinal speed.
    """
    paths = [drive_path(parallel(centerline, offset)) for offset in (0.0, -1.0, 1.0)]
    limit = 15.0 if speed_limit_mps is None else speed_limit_mps
    targets = np.tile(np.array(SPEED_FRACTIONS) * limit, len(paths))
    lateral = np.repeat(np.arange(len(paths)), len(SPEED_FRACTIONS))
    start = np.array([float(path.project(ego_state[[X, Y]])) for path in paths])
    reach_m = abs(targets).max() * PROPOSAL_STEPS * STEP_S
    traffic = _traffic(paths, start, reach_m, seen, vehicle)

    count = len(targets)
    motion = np.zeros((count, PROPOSAL_STEPS + 1, 2))
    leads = np.zeros((count, PROPOSAL_STEPS + 1, 3))
    poses = np.zeros((count, PROPOSAL_STEPS + 1, 3))
    motion[:, 0, 0], motion[:, 0, 1] = start[lateral], ego_state[VX]
    poses[:, 0] = _on_paths(paths, lateral, motion[:, 0, 0])
    for step in range(1, PROPOSAL_STEPS + 1):
        if step % SAMPLE_STEPS == 0:
            memory = step <= SCORED_STEPS  # beyond, the chosen one is driven alone
            before = motion[:, step - 1], poses[:, step - 1]
            found = _leads(paths, lateral, traffic, step // SAMPLE_STEPS, *before, vehicle)
            leads[:, step] = _remembered(found, len(SPEED_FRACTIONS)) if memory else np.nan_to_num(found)
        else:
            leads[:, step] = leads[:, step - 1]  # at step 1 all zeros: every proposal first brakes at its hardest
        motion[:, step] = idm_step(motion[:, step - 1], leads[:, step], targets)
        poses[:, step] = _on_paths(paths, lateral, motion[:, step, 0])
    return Proposals(poses, motion, leads)


def idm_step(motion: Array, leads: Array, target_mps: Array) -> Array:
    """One Euler step of 0.1 s of the intelligent driver model (Treiber et al. 2000), rows (P, 2) progress, speed.

    s* = gap + v T + v (v - v_lead) / (2 sqrt(a b));  dv/dt = a (1 - (v / v0)^n - (s* / s)^2), clipped to [-b, a].
    The speed is not clipped at 0.
    """
    progress, speed = motion[:, 0], motion[:, 1]
    closing = speed * (speed - leads[:, 1]) / (2.0 * np.sqrt(1.5 * 3.0))
    wanted = 1.0 + speed * 1.5 + closing
    gap = np.maximum(leads[:, 0] - progress - leads[:, 2], 1.0)
    accel = 1.5 * (1.0 - (speed / target_mps) ** 10 - (wanted / gap) ** 2)
    accel = np.clip(accel, -3.0, 1.5)
    return np.stack([progress + STEP_S * speed, speed + STEP_S * accel], axis=-1)


def _on_paths(paths: list[DrivePath], lateral: NDArray[np.intp], progress: Array) -> Array:
    poses = np.empty((len(lateral), 3))
    for index, path in enumerate(paths):
        here = lateral == index
        poses[here] = path.at(progress[here])
    return poses


def _traffic(paths: list[DrivePath], start: Array, reach_m: float, seen: Forecast, vehicle: Vehicle) -> _Traffic:
    samples = PROPOSAL_STEPS // SAMPLE_STEPS + 1
    lights = np.empty((samples, len(seen.red_lights)), dtype=object)
    lights[:] = seen.red_lights
    polygons = np.concatenate([seen.polygons(samples), lights], axis=1)
    ignored = np.concatenate([seen.touches_ego, np.array(seen.red_light_holds_ego, dtype=bool)])
    in_corridor = np.zeros((len(paths), *polygons.shape), dtype=bool)
    progress = np.zeros((len(paths), *polygons.shape))
    centroids = shapely.centroid(polygons)
    for index, path in enumerate(paths):
        corridor = shapely.buffer(
            path.ahead(start[index], start[index] + reach_m), vehicle.half_width, cap_style="square"
        )
        shapely.prepare(corridor)
        in_corridor[index] = shapely.intersects(corridor, polygons) & ~ignored
        inside = in_corridor[index]
        progress[index][inside] = shapely.line_locate_point(path.line, centroids[inside])
    n_lights = len(seen.red_lights)
    return _Traffic(
        polygons=polygons,
        in_corridor=in_corridor,
        progress=progress,
        speed=np.concatenate([seen.speed * seen.is_agent, np.zeros(n_lights)]),
        heading=np.concatenate([seen.boxes[:, 2], np.zeros(n_lights)]),
        is_light=np.concatenate([np.zeros(len(seen.boxes), dtype=bool), np.ones(n_lights, dtype=bool)]),
    )


def _leads(
    paths: list[DrivePath],
    lateral: NDArray[np.intp],
    traffic: _Traffic,
    sample: int,
    motion: Array,
    poses: Array,
    vehicle: Vehicle,
) -> Array:
    """(P, 3) lead of each proposal; NaN marks a field that the search does not write."""
    ahead = traffic.in_corridor[lateral, sample] & (traffic.progress[lateral, sample] > motion[:, :1])
    proposal, thing = np.nonzero(ahead)
    distance = np.full(ahead.shape, np.inf)
    footprints = shapely.polygons(box_corners(ego_boxes(poses, vehicle)))
    distance[proposal, thing] = shapely.distance(footprints[proposal], traffic.polygons[sample, thing])

    found = np.full((len(lateral), 3), np.nan)
    free = ~ahead.any(axis=1)
    found[free, 0] = np.array([path.line.length for path in paths])[lateral[free]]
    found[free, 2] = vehicle.half_length
    if not free.all():
        led = ~free
        nearest = distance[led].argmin(axis=1)
        found[led, 0] = motion[led, 0] + distance[led].min(axis=1)
        relative = traffic.heading[nearest] - poses[led, 2]
        # a red light is a lead whose velocity is never written: 0, or what the slower proposal left there
        found[led, 1] = np.where(traffic.is_light[nearest], np.nan, traffic.speed[nearest] * np.cos(relative))
    return found


def _remembered(found: Array, speeds: int) -> Array:
    """Fills unwritten fields with the last value written by a slower proposal of the same path, else 0."""
    out = found.reshape(-1, speeds, 3).copy()
    last = np.zeros((len(out), 3))
    for index in range(speeds):
        last = np.where(np.isnan(out[:, index]), last, out[:, index])
        out[:, index] = last
    return out.reshape(found.shape)

"""The planner expert: PDM-Closed (Dauner et al. 2023), as the public metric runs it (docs/reward.md 4).

Fifteen proposals along the route are driven by the tracker, scored against a constant-velocity forecast of the others,
and the first best PROPOSAL (not its simulated states) is the plan. Red lights: an on-route lane connector that is red
now is kept red; its polygon is a standing lead unless the ego's footprint lies within it already, and touching it makes
the proposal fail traffic light compliance, as in nuPlan's PDM.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
import shapely.ops

from tasks.experts.protocol import Plan
from tasks.kernels.compiled import hidden_kernel, kernel
from tasks.reward.epdms import Scores, prepare, score
from tasks.rollout.corridor import least_and_largest
from tasks.rollout.lqr import track
from tasks.stages import Rejected
from tasks.world.arrays import Array, Bools, Indices, Ints
from tasks.world.clip import AgentKind, AgentTracks, Scene
from tasks.world.frames import HALF_LENGTH, HALF_WIDTH, PACIFICA, REAR_AXLE_TO_CENTER, VX, X, Y, box_corners, ego_boxes
from tasks.world.geometry import (
    nearest_on_edge,
    ring_contains,
    rings_distance,
    rings_touch,
    segments_touch,
    to_segment,
    wrapped,
)
from tasks.world.road_map import LightState, MapLayer, MapPolygon, polygons_near

# Parallel polylines that can be driven by arc length (docs/reward.md 4). Compiled.

MIN_PROGRESS_M = 1e-5  # interpolation never asks for the very first point: joints may repeat it
_REPEATED_M2 = 1e-300  # below it the inverse of a squared length would overflow
_TIE_M2 = 1e-6  # segments whose squared distance is this near the least are looked at again, in the exact arithmetic


class DrivePaths(NamedTuple):
    """L parallel paths of P points, world frame."""

    x: Array  # (L, P) [m]
    y: Array  # (L, P) [m]
    heading: Array  # (L, P) [rad], unwrapped along the path
    progress: Array  # (L, P) arc length [m], not decreasing (lane joints repeat a point)
    inverse_square: Array  # (L, P - 1) 1 / squared length of each segment [1/m2], 0 where a point is repeated


def path_length_m(poses: Array) -> float:
    """Length [m] of the polyline through `poses` (P, >= 2)."""
    return float(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum())


def drive_paths(centerline: Array, offsets_m: Sequence[float]) -> DrivePaths:
    """`centerline` (P >= 2, 3) moved sideways by each of the L offsets, to the left where positive; headings stay.

    Raises ValueError where one of the paths has no length.
    """
    centerline = np.array(centerline, dtype=np.float64)  # a copy: kernels compile once more for read-only arrays
    paths = _moved_sideways(centerline, np.asarray(offsets_m, dtype=np.float64))
    if paths.progress[:, -1].min() <= MIN_PROGRESS_M:
        raise ValueError("centerline needs a length: all its points are one")
    return paths


@kernel
def _moved_sideways(centerline: Array, offsets_m: Array) -> DrivePaths:
    n_paths, n_points = offsets_m.shape[0], centerline.shape[0]
    x, y, heading, progress = np.empty((4, n_paths, n_points))
    inverse_square = np.zeros((n_paths, n_points - 1))
    for path in range(n_paths):
        unwrap = 0.0
        for k in range(n_points):
            side = centerline[k, 2] + math.pi / 2.0
            x[path, k] = centerline[k, 0] + math.cos(side) * offsets_m[path]
            y[path, k] = centerline[k, 1] + math.sin(side) * offsets_m[path]
            here = wrapped(centerline[k, 2])
            if k == 0:
                heading[path, k], progress[path, k] = here, 0.0
                continue
            turn = here - wrapped(centerline[k - 1, 2])
            if abs(turn) >= math.pi:
                unwrap += wrapped(turn) - turn
            heading[path, k] = here + unwrap
            dx, dy = x[path, k] - x[path, k - 1], y[path, k] - y[path, k - 1]
            square = dx * dx + dy * dy
            progress[path, k] = progress[path, k - 1] + math.sqrt(square)
            if square > _REPEATED_M2:
                inverse_square[path, k - 1] = 1.0 / square
    return DrivePaths(x, y, heading, progress, inverse_square)


@kernel
def pose_at(paths: DrivePaths, path: int, progress: float) -> tuple[float, float, float]:
    """x, y, heading at an arc length [m]: linear in x, y and unwrapped heading, clipped to the path's ends."""
    along = paths.progress[path]
    last = along.shape[0] - 1
    distance = min(max(progress, MIN_PROGRESS_M), along[last])
    # the segment found starts strictly before the distance, so a repeated point divides by nothing
    k = min(max(np.searchsorted(along, distance), 1), last) - 1
    length, rest = along[k + 1] - along[k], distance - along[k]
    x, y, heading = paths.x[path], paths.y[path], paths.heading[path]
    h = (heading[k + 1] - heading[k]) / length * rest + heading[k]
    return (
        (x[k + 1] - x[k]) / length * rest + x[k],
        (y[k + 1] - y[k]) / length * rest + y[k],
        math.atan2(math.sin(h), math.cos(h)),
    )


@kernel
def project(paths: DrivePaths, path: int, px: float, py: float) -> float:
    """Arc length [m] of the point of a path nearest to (px, py), the first of several.

    The least squared distance is found over all segments, then the few that come near it are compared with the
    arithmetic of GEOS, so that ties between segments fall as they do for the public planner.
    """
    x, y, along, inverse = paths.x[path], paths.y[path], paths.progress[path], paths.inverse_square[path]
    squares, bound = np.empty(inverse.shape[0]), np.inf
    next_x, next_y = x[1:], y[1:]
    for k in range(inverse.shape[0]):
        ex, ey = next_x[k] - x[k], next_y[k] - y[k]
        ux, uy = px - x[k], py - y[k]
        squares[k] = nearest_on_edge(ux, uy, ex, ey, (ux * ex + uy * ey) * inverse[k])[1]
        bound = min(bound, squares[k])
    bound += _TIE_M2 * (1.0 + bound)
    nearest, found = np.inf, 0.0
    for k in range(inverse.shape[0]):
        if squares[k] <= bound:
            ex, ey = x[k + 1] - x[k], y[k + 1] - y[k]
            distance, fraction = to_segment(px, py, x[k], y[k], x[k + 1], y[k + 1])
            if distance < nearest:
                nearest, found = distance, along[k] + fraction * math.sqrt(ex * ex + ey * ey)
    return found


# What PDM-Closed believes the others will do: keep their velocity (docs/reward.md 4).

STEP_S = 0.1
SAMPLE_STEPS = 2  # one forecast per 0.2 s: step i of the plan sees sample i // 2
RADIUS_M = 100.0  # from the ego centre
STANDING = 0  # every kind that is not among the moving ones
GROUP_OF = {AgentKind.VEHICLE: 1, AgentKind.PEDESTRIAN: 2, AgentKind.BICYCLE: 3}
NEAREST = np.array([50, 50, 25, 10])  # of each group


class LeadCandidates(NamedTuple):
    """M closed rings that may stand in the way, at S samples of time; the V vertices of all lie behind one another."""

    first: Ints  # (M + 1,) ring m: vertices first[m] .. first[m + 1] - 1, the first not repeated
    x: Array  # (S, V) [m], world frame
    y: Array  # (S, V)
    center_x: Array  # (S, M) centroid of the area [m]
    center_y: Array  # (S, M)
    radius: Array  # (M,) the farthest vertex from the centroid [m]
    pace: Array  # (M,) what it moves from one sample to the next [m]
    speed: Array  # (M,) as a lead [m/s], 0 for standing things
    heading: Array  # (M,) [rad]
    is_light: Bools  # (M,) a red light


@dataclass(frozen=True)
class Forecast:
    """M objects as seen now: standing ones first, then vehicles, pedestrians, bicycles, each by distance."""

    track: Indices  # (M,) column in the agents it was made from
    boxes: Array  # (M, 5) now
    corners: Array  # (M, 4, 2) of the boxes
    drift: Array  # (M, 2) velocity used to move the box [m/s]: along its heading or straight against it
    speed: Array  # (M,) [m/s]
    is_agent: Bools  # (M,) vehicles, pedestrians and bicycles
    touches_ego: Bools  # (M,) at the start; such objects are ignored for good
    red_lights: tuple[shapely.Polygon, ...] = ()  # on-route connectors that are red now, kept red
    red_light_holds_ego: tuple[bool, ...] = ()  # the ego's footprint lies within it already: it is no lead

    def things(self, samples: int) -> LeadCandidates:
        """What can be a lead at 0, 0.2, 0.4 ... s: what does not touch the ego, then red lights that do not hold it."""
        keep = ~self.touches_ego
        lights = [light for light, holds in zip(self.red_lights, self.red_light_holds_ego) if not holds]
        rings = [np.asarray(light.exterior.coords)[:-1, :2] for light in lights]
        middles = shapely.get_coordinates(shapely.centroid(np.array(lights, dtype=object)))
        n_boxes, still = np.count_nonzero(keep), np.zeros(len(lights))

        first = np.cumsum([0] + [4] * n_boxes + [len(ring) for ring in rings])
        vertices = np.concatenate([self.corners[keep].reshape(-1, 2), *rings])
        centers = np.concatenate([self.boxes[keep, :2], middles])
        drift = np.concatenate([self.drift[keep], np.zeros((len(lights), 2))])
        return LeadCandidates(
            first,
            *_over_time(first, vertices, centers, drift, samples),
            speed=np.append(self.speed[keep] * self.is_agent[keep], still),
            heading=np.append(self.boxes[keep, 2], still),
            is_light=np.arange(len(centers)) >= n_boxes,
        )

    def tracks(self, agents: AgentTracks, steps: int) -> AgentTracks:
        """The forecast as (steps,) tracks for the reward; objects that touch the ego now are left out."""
        keep = ~self.touches_ego
        index = self.track[keep]
        times = (np.arange(steps) // SAMPLE_STEPS) * SAMPLE_STEPS * STEP_S
        boxes = np.repeat(self.boxes[keep][None], steps, axis=0)
        boxes[..., :2] += times[:, None, None] * self.drift[keep][None]
        seen = agents.velocities[0, index]  # the reward asks for the measured velocity, not the drift
        return AgentTracks(
            track_ids=tuple(agents.track_ids[i] for i in index),
            kinds=tuple(agents.kinds[i] for i in index),
            boxes=boxes,
            velocities=np.repeat(seen[None], steps, axis=0),
            valid=np.ones((steps, len(index)), bool),
            center_z=np.repeat(agents.center_z[:1, index], steps, axis=0),
            heights=agents.heights[index],
        )


def forecast(ego_state: Array, agents: AgentTracks, red_lights: tuple[shapely.Polygon, ...] = ()) -> Forecast:
    """The objects to reckon with, seen from `ego_state` (11,): `agents` at its first step, none further than 100 m.

    The nearest 50 vehicles, 25 pedestrians, 10 bicycles and 50 standing objects, by the distance of their centres to
    the ego's. Source: docs/reward.md 4.
    """
    ego = ego_boxes(ego_state, PACIFICA)
    distance = np.hypot(agents.boxes[0, :, 0] - ego[0], agents.boxes[0, :, 1] - ego[1])
    group = np.array([GROUP_OF.get(kind, STANDING) for kind in agents.kinds], dtype=np.intp)
    track = _nearest(np.flatnonzero(agents.valid[0] & (distance <= RADIUS_M)), distance, group)

    boxes, is_agent = agents.boxes[0, track], group[track] != STANDING
    footprint = box_corners(ego)
    corners, drift, speed, touches_ego = _expected(boxes, agents.velocities[0, track], is_agent, footprint)
    body = shapely.polygons(footprint) if red_lights else None
    return Forecast(
        track=track,
        boxes=boxes,
        corners=corners,
        drift=drift,
        speed=speed,
        is_agent=is_agent,
        touches_ego=touches_ego,
        red_lights=red_lights,
        red_light_holds_ego=tuple(bool(shapely.within(body, light)) for light in red_lights),
    )


def _nearest(found: Indices, distance: Array, group: Indices) -> Indices:
    """Those of `found` that are among the nearest of their group: group by group, each by distance."""
    ordered = found[np.lexsort((distance[found], group[found]))]
    of = group[ordered]
    rank = np.arange(len(of)) - np.searchsorted(of, of)
    return ordered[rank < NEAREST[of]]


@kernel
def _expected(boxes: Array, velocities: Array, is_agent: Bools, footprint: Array) -> tuple[Array, Array, Array, Bools]:
    """corners (M, 4, 2), drift (M, 2), speed (M,) and touches_ego (M,) of Forecast. footprint: (4, 2) of the ego."""
    count = boxes.shape[0]
    corners, drift, speed = np.empty((count, 4, 2)), np.zeros((count, 2)), np.empty(count)
    touches_ego = np.empty(count, dtype=np.bool_)
    for m in range(count):
        x, y, heading, length, width = boxes[m]
        c, s = math.cos(heading), math.sin(heading)
        for i in range(4):
            along = 0.5 * length if i == 0 or i == 3 else -0.5 * length
            across = 0.5 * width if i < 2 else -0.5 * width
            corners[m, i, 0] = x + c * along - s * across
            corners[m, i, 1] = y + s * along + c * across
        speed[m] = math.hypot(velocities[m, 0], velocities[m, 1])
        if is_agent[m]:
            off_course = abs(wrapped(heading - math.atan2(velocities[m, 1], velocities[m, 0])))
            direction = heading if off_course < math.pi / 2.0 else heading + math.pi
            drift[m, 0], drift[m, 1] = speed[m] * math.cos(direction), speed[m] * math.sin(direction)
        touches_ego[m] = rings_touch(footprint[:, 0], footprint[:, 1], corners[m, :, 0], corners[m, :, 1])
    return corners, drift, speed, touches_ego


@kernel
def _over_time(
    first: Ints, vertices: Array, centers: Array, drift: Array, samples: int
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """x, y (S, V), center_x, center_y (S, M), radius, pace (M,) of Things from V vertices now and M drifts."""
    count = centers.shape[0]
    x, y = np.empty((samples, len(vertices))), np.empty((samples, len(vertices)))
    center_x, center_y = np.empty((samples, count)), np.empty((samples, count))
    radius, pace = np.zeros(count), np.empty(count)
    for m in range(count):
        pace[m] = SAMPLE_STEPS * STEP_S * math.hypot(drift[m, 0], drift[m, 1])
        for v in range(first[m], first[m + 1]):
            radius[m] = max(radius[m], math.hypot(vertices[v, 0] - centers[m, 0], vertices[v, 1] - centers[m, 1]))
        for sample in range(samples):
            time = sample * SAMPLE_STEPS * STEP_S
            dx, dy = time * drift[m, 0], time * drift[m, 1]
            center_x[sample, m], center_y[sample, m] = centers[m, 0] + dx, centers[m, 1] + dy
            for v in range(first[m], first[m + 1]):
                x[sample, v], y[sample, v] = vertices[v, 0] + dx, vertices[v, 1] + dy
    return x, y, center_x, center_y, radius, pace


# Who stands in the corridor that the ego may sweep along a path, when, and how far along (docs/reward.md 4).
#
# The corridor itself is made by GEOS, as for the public planner: its buffer drops shallow bends of the path and cuts
# its round joins into chords, which moves the edge by up to 5 mm from where half a width would put it, and an object
# that reaches into those millimetres must be a lead, or none, as it is for the public one. Who lies in it is then
# compiled.

ROUNDING_M = 1e-9  # what is decided by circles stays this far from the edge


class Corridors(NamedTuple):
    """One polygon, with holes where the path closes on itself, around a stretch of each of L paths."""

    first: Ints  # (L + 1,) polygon l: edges first[l] .. first[l + 1] - 1, of all its rings
    ax: Array  # (E,) start of each edge [m], world frame
    ay: Array  # (E,)
    bx: Array  # (E,) its end
    by: Array  # (E,)
    inverse_square: Array  # (E,) 1 / squared length [1/m2]
    bounds: Array  # (L, 4) min x, min y, max x, max y [m]


def corridors(paths: DrivePaths, start_m: Array, reach_m: float, half_width_m: float) -> Corridors:
    """The corridor of each path from `start_m` (L,) [m] on over `reach_m`, with square ends."""
    lines = np.array(
        [path_section(paths, index, start, start + reach_m) for index, start in enumerate(start_m)], dtype=object
    )
    polygons = shapely.buffer(lines, half_width_m, cap_style="square")
    rings, of_polygon = shapely.get_rings(polygons, return_index=True)
    points, of_ring = shapely.get_coordinates(rings, return_index=True)
    edge = np.flatnonzero(of_ring[1:] == of_ring[:-1])
    (ax, ay), (bx, by) = points[edge].T.copy(), points[edge + 1].T.copy()
    return Corridors(
        first=np.searchsorted(of_polygon[of_ring[edge]], np.arange(len(lines) + 1)),
        ax=ax,
        ay=ay,
        bx=bx,
        by=by,
        inverse_square=1.0 / ((bx - ax) ** 2 + (by - ay) ** 2),
        bounds=shapely.bounds(polygons),
    )


def path_section(paths: DrivePaths, path: int, start_m: float, stop_m: float) -> shapely.LineString | shapely.Point:
    """The part of a path between two arc lengths, made of its own points where at least two lie inside."""
    along, x, y = paths.progress[path], paths.x[path], paths.y[path]
    start_m, stop_m = max(start_m, 0.0), min(stop_m, along[-1])
    inside = slice(np.searchsorted(along, start_m), np.searchsorted(along, stop_m, side="right"))
    if inside.stop - inside.start > 1:
        return shapely.linestrings(x[inside], y[inside])
    return shapely.ops.substring(shapely.linestrings(x, y), start_m, stop_m)


@kernel
def lead_progress(paths: DrivePaths, swept: Corridors, things: LeadCandidates) -> Array:
    """(L, S, M) arc length of each thing's centroid [m] at each sample; NaN where it is not in the path's corridor."""
    n_paths, (n_samples, n_things) = paths.x.shape[0], things.center_x.shape
    out = np.full((n_paths, n_samples, n_things), np.nan)
    for path in range(n_paths):
        squares = np.empty(swept.first[path + 1] - swept.first[path])
        for m in range(n_things):
            inside, clearance = False, -1.0  # [m] it can move before it reaches the corridor's edge
            for sample in range(n_samples):
                if sample > 0 and things.pace[m] == 0.0:
                    out[path, sample, m] = out[path, 0, m]
                    continue
                clearance -= things.pace[m]
                if clearance < 0.0:
                    inside, clearance = _in_corridor(swept, path, things, m, sample, squares)
                if inside:
                    out[path, sample, m] = project(paths, path, things.center_x[sample, m], things.center_y[sample, m])
    return out


@hidden_kernel
def _in_corridor(
    swept: Corridors, path: int, things: LeadCandidates, m: int, sample: int, squares: Array
) -> tuple[bool, float]:
    """Whether thing m has a point in common with a path's corridor, and its clearance to the corridor's edge [m].

    squares: scratch, one for each edge of the corridor. The clearance is negative where the edge runs through the
    thing's circle, and never more than there is.
    """
    x, y, radius = things.center_x[sample, m], things.center_y[sample, m], things.radius[m]
    low_x, low_y, high_x, high_y = swept.bounds[path]
    outside = max(low_x - x, x - high_x, low_y - y, y - high_y) - radius - ROUNDING_M
    if not outside < 0.0:  # also where the corridor is empty (NaN)
        return False, outside
    inside = _edges_around(swept, path, x, y, squares)
    clearance = math.sqrt(least_and_largest(squares)[0]) - radius - ROUNDING_M
    if clearance >= 0.0:
        return inside, clearance
    ring_x = things.x[sample, things.first[m] : things.first[m + 1]]
    ring_y = things.y[sample, things.first[m] : things.first[m + 1]]
    return _ring_touches(swept, path, ring_x, ring_y, (radius + ROUNDING_M) ** 2, squares), clearance


@hidden_kernel
def _ring_touches(swept: Corridors, path: int, x: Array, y: Array, limit: float, squares: Array) -> bool:
    """Whether a ring has a point in common with a path's corridor, edge by edge.

    squares: the squared distance of the ring's centroid to each edge [m2]; the edges up to `limit` are looked at.
    """
    first = swept.first[path]
    for e in range(squares.shape[0]):
        if squares[e] <= limit:
            ax, ay, bx, by = swept.ax[first + e], swept.ay[first + e], swept.bx[first + e], swept.by[first + e]
            j = x.shape[0] - 1
            for i in range(x.shape[0]):
                if segments_touch(ax, ay, bx, by, x[j], y[j], x[i], y[i]):
                    return True
                j = i
    corridor_in_ring = ring_contains(x, y, swept.ax[first], swept.ay[first])
    return corridor_in_ring or _edges_around(swept, path, x[0], y[0], squares)


@hidden_kernel
def _edges_around(swept: Corridors, path: int, x: float, y: float, squares: Array) -> bool:
    """Whether (x, y) is in a path's corridor, by the even-odd rule; fills the squared distance to each edge [m2]."""
    first, stop = swept.first[path], swept.first[path + 1]
    ax, ay, bx, by = swept.ax[first:stop], swept.ay[first:stop], swept.bx[first:stop], swept.by[first:stop]
    inverse_square = swept.inverse_square[first:stop]
    crossings = 0
    for e in range(squares.shape[0]):
        ex, ey = bx[e] - ax[e], by[e] - ay[e]
        ux, uy = x - ax[e], y - ay[e]
        squares[e] = nearest_on_edge(ux, uy, ex, ey, (ux * ex + uy * ey) * inverse_square[e])[1]
        straddles = (ay[e] > y) != (by[e] > y)
        crossings += straddles & ((ux * ey < uy * ex) == (ey > 0.0))
    return crossings % 2 == 1


# The proposals themselves: IDM at five target speeds along three parallel paths. What does not depend on them (who
# stands in a path's corridor when, and how far along) was found for all forecast samples; each is driven in steps of
# 0.1 s, a path's speeds side by side from slow to fast.

# As published with NAVSIM; those of the intelligent driver model are of the planner alone, traffic has others.
SPEED_FRACTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the lane's speed limit
LATERAL_OFFSETS_M = (0.0, -1.0, 1.0)  # + is to the left
FALLBACK_SPEED_MPS = 15.0  # where the lane has no speed limit
MIN_GAP_M, HEADWAY_S = 1.0, 1.5
ACCEL_MAX_MPS2, DECEL_MAX_MPS2 = 1.5, 3.0
EXPONENT = 10.0  # of the free-road term
SCORED_STEPS = 40
PROPOSAL_STEPS = 50  # the chosen one is driven on to 5 s
SAMPLES = PROPOSAL_STEPS // SAMPLE_STEPS + 1


@dataclass(frozen=True)
class Proposals:
    """P = lateral x speed proposals, index = speeds * lateral + speed."""

    poses: Array  # (P, 51, 3) rear axle on the path, world frame
    progress_velocity: Array  # (P, 51, 2) arc length [m], speed [m/s]
    leads: Array  # (P, 51, 3) lead's arc length [m], velocity [m/s], own half length on a free road [m]


def proposals(
    ego_state: Array,
    centerline: Array,
    seen: Forecast,
    speed_limit_mps: float | None,
) -> Proposals:
    """The proposals from `ego_state` (11,) along `centerline` (N, 3) through the forecast traffic.

    Each starts at the projection of the rear axle on its path with the ego's longitudinal speed.
    Raises ValueError where the centerline is without length or the speed limit not positive.
    """
    if speed_limit_mps is not None and not 0.0 < speed_limit_mps < math.inf:
        raise ValueError(
            f"speed_limit_mps: {speed_limit_mps} m/s cannot be driven; it must be positive and finite, None is unknown"
        )
    paths = drive_paths(centerline, LATERAL_OFFSETS_M)
    targets = np.array(SPEED_FRACTIONS) * (FALLBACK_SPEED_MPS if speed_limit_mps is None else speed_limit_mps)
    start = np.array([project(paths, i, ego_state[X], ego_state[Y]) for i in range(len(LATERAL_OFFSETS_M))])
    things = seen.things(SAMPLES)
    swept = corridors(paths, start, targets.max() * PROPOSAL_STEPS * STEP_S, HALF_WIDTH)
    progress = lead_progress(paths, swept, things)
    return Proposals(*_drive(paths, things, progress, start, ego_state[VX], targets))


@kernel
def idm_step(progress: float, speed: float, lead: Array, target_mps: float) -> tuple[float, float]:
    """One Euler step of 0.1 s of the intelligent driver model (Treiber et al. 2000): progress [m], speed [m/s].

    s* = gap + v T + v (v - v_lead) / (2 sqrt(a b));  dv/dt = a (1 - (v / v0)^n - (s* / s)^2), clipped to [-b, a].
    lead: (3,) its arc length [m], velocity [m/s], and what is kept off the gap to it [m]. Speeds are not clipped at 0,
    as published: a stop before an oncoming car overshoots into creeping backwards.
    """
    closing = speed * (speed - lead[1]) / (2.0 * math.sqrt(ACCEL_MAX_MPS2 * DECEL_MAX_MPS2))
    wanted = MIN_GAP_M + speed * HEADWAY_S + closing
    gap = max(lead[0] - progress - lead[2], MIN_GAP_M)
    accel = ACCEL_MAX_MPS2 * (1.0 - (speed / target_mps) ** EXPONENT - (wanted / gap) ** 2)
    after = speed + STEP_S * min(max(accel, -DECEL_MAX_MPS2), ACCEL_MAX_MPS2)
    return progress + STEP_S * speed, after


@kernel
def _drive(
    paths: DrivePaths,
    things: LeadCandidates,
    lead_progress_m: Array,
    start_m: Array,
    speed0_mps: float,
    targets_mps: Array,
) -> tuple[Array, Array, Array]:
    """poses (P, 51, 3), motion (P, 51, 2) and leads (P, 51, 3) of Proposals. lead_progress_m: (L, S, M)."""
    n_paths, n_speeds = start_m.shape[0], targets_mps.shape[0]
    poses = np.empty((n_paths * n_speeds, PROPOSAL_STEPS + 1, 3))
    motion = np.empty((n_paths * n_speeds, PROPOSAL_STEPS + 1, 2))
    leads = np.zeros((n_paths * n_speeds, PROPOSAL_STEPS + 1, 3))
    footprint = np.empty((2, 4))
    for path in range(n_paths):
        first = path * n_speeds
        for p in range(first, first + n_speeds):
            motion[p, 0, 0], motion[p, 0, 1] = start_m[path], speed0_mps
            poses[p, 0, 0], poses[p, 0, 1], poses[p, 0, 2] = pose_at(paths, path, start_m[path])
        for step in range(1, PROPOSAL_STEPS + 1):
            looks = step % SAMPLE_STEPS == 0
            # As published, a speed inherits the lead fields that a slower one of its path wrote and its own search
            # does not; beyond the scored steps the chosen one is driven alone.
            shared = step <= SCORED_STEPS
            written = np.zeros(3)
            for p in range(first, first + n_speeds):
                progress, speed = motion[p, step - 1, 0], motion[p, step - 1, 1]
                if looks:
                    if not shared:
                        written[:] = 0.0
                    set_footprint(poses[p, step - 1], footprint)
                    sample = step // SAMPLE_STEPS
                    nearest = nearest_lead(things, lead_progress_m[path, sample], sample, progress, footprint)
                    write_lead(paths, path, things, nearest, progress, poses[p, step - 1, 2], written)
                for k in range(3):  # before the first search all zeros: no gap, so it brakes hard
                    leads[p, step, k] = written[k] if looks else leads[p, step - 1, k]
                after = idm_step(progress, speed, leads[p, step], targets_mps[p - first])
                motion[p, step, 0], motion[p, step, 1] = after
                poses[p, step, 0], poses[p, step, 1], poses[p, step, 2] = pose_at(paths, path, after[0])
    return poses, motion, leads


@hidden_kernel
def write_lead(
    paths: DrivePaths,
    path: int,
    things: LeadCandidates,
    nearest: tuple[float, int],
    progress: float,
    heading: float,
    lead: Array,
) -> None:
    """Write into `lead` (3,) what a search found: arc length, velocity, own half length on a free road.

    A free road leaves the velocity as it was, a thing the half length, a red light both: what was there is the memory.
    """
    distance, thing = nearest
    if thing < 0:
        lead[0], lead[2] = paths.progress[path, -1], HALF_LENGTH
        return
    lead[0] = progress + distance
    if not things.is_light[thing]:
        lead[1] = things.speed[thing] * math.cos(things.heading[thing] - heading)


@hidden_kernel
def nearest_lead(
    things: LeadCandidates, ahead_m: Array, sample: int, progress: float, footprint: Array
) -> tuple[float, int]:
    """Distance [m] from the footprint (2, 4) to the nearest thing farther along than `progress`, and which; -1: none.

    ahead_m: (M,) arc length of each thing in the corridor, NaN for those that are not in it.
    """
    nearest, found = np.inf, -1
    x, y = 0.5 * (footprint[0, 0] + footprint[0, 2]), 0.5 * (footprint[1, 0] + footprint[1, 2])
    own_radius = math.hypot(footprint[0, 0] - x, footprint[1, 0] - y)
    for m in range(ahead_m.shape[0]):
        if ahead_m[m] > progress:
            between = math.hypot(things.center_x[sample, m] - x, things.center_y[sample, m] - y)
            if between - things.radius[m] - own_radius <= nearest:
                of_ring = slice(things.first[m], things.first[m + 1])
                ring_x, ring_y = things.x[sample, of_ring], things.y[sample, of_ring]
                distance = rings_distance(footprint[0], footprint[1], ring_x, ring_y)
                if distance < nearest:
                    nearest, found = distance, m
    return nearest, found


@hidden_kernel
def set_footprint(pose: Array, out: Array) -> None:
    """Corners (2, 4) x, y of the ego's body, its rear axle at `pose` (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] + REAR_AXLE_TO_CENTER * c, pose[1] + REAR_AXLE_TO_CENTER * s
    for i in range(4):
        along = HALF_LENGTH if i == 0 or i == 3 else -HALF_LENGTH
        across = HALF_WIDTH if i < 2 else -HALF_WIDTH
        out[0, i] = x + c * along - s * across
        out[1, i] = y + s * along + c * across


@dataclass(frozen=True)
class PdmPlan:
    """What PDM-Closed considered and chose."""

    proposals: Proposals
    simulated: Array  # (P, 41, 11) the proposals as the tracker drives them
    scores: Scores  # (P,) progress relative to the batch, no history comfort
    chosen: int  # the first best

    @property
    def poses(self) -> Array:
        """(40, 3) of the chosen proposal, world frame, 0.1 .. 4.0 s."""
        return self.proposals.poses[self.chosen, 1 : SCORED_STEPS + 1]

    @property
    def driven(self) -> Array:
        """(41, 11) the chosen proposal as the tracker drives it, its own first pose as reference row 0."""
        return self.simulated[self.chosen]


def plan_pdm_closed(
    *,
    ego_state: Array,
    centerline: Array,
    agents: AgentTracks,
    polygons: Sequence[MapPolygon],
    route_lane_ids: frozenset[str],
    red_lane_ids: frozenset[str] = frozenset(),
    speed_limit_mps: float | None = None,
) -> PdmPlan:
    """Plan from `ego_state` (11,) along `centerline` (N, 3).

    agents: only their first step is looked at; polygons: the map within 100 m; red_lane_ids: connectors that are red
    now, of which the on-route ones matter; speed_limit_mps: of the lane the centerline starts on, None where unknown.
    Raises ValueError where the centerline has no length or the speed limit is not positive.
    """
    lit = red_lane_ids & route_lane_ids
    connectors = [one for one in polygons if one.layer is MapLayer.LANE_CONNECTOR and one.token in lit]
    red = tuple(one.token for one in connectors)
    lights = tuple(shapely.Polygon(one.ring[:, :2]) for one in connectors)
    seen = forecast(ego_state, agents, lights)
    candidates = proposals(ego_state, centerline, seen, speed_limit_mps)
    driven = candidates.poses[:, : SCORED_STEPS + 1]
    simulated = track(ego_state, driven[:, 1:], planned_pose0=driven[:, 0])
    prepared = prepare(
        past_states=None,
        centerline=centerline,
        polygons=polygons,
        route_lane_ids=route_lane_ids,
        objects=seen.tracks(agents, SCORED_STEPS + 1),
        red_lanes=(red, np.ones((SCORED_STEPS + 1, len(red)), dtype=bool)),
        drop_touching=False,  # the forecast's tracks are without them
    )
    scores = score(prepared, simulated)
    return PdmPlan(candidates, simulated, scores, int(np.argmax(scores.pdm_score)))


def plan_for(scene: Scene) -> PdmPlan:
    """PDM-Closed from a scene, seeing its agents and lights at the scene's step only."""
    clip = scene.clip
    center = ego_boxes(scene.ego_state, PACIFICA)[:2]
    on_route = (clip.road_map.lanes.get(lane_id) for lane_id in sorted(clip.route.lane_ids))
    start = scene.centerline[:2]
    first = next((lane for lane in on_route if lane is not None and np.array_equal(lane.centerline[:2], start)), None)
    return plan_pdm_closed(
        ego_state=scene.ego_state,
        centerline=scene.centerline,
        agents=scene.agents.window(scene.step, scene.step + 1),
        polygons=polygons_near(clip.road_map, center, RADIUS_M),
        route_lane_ids=clip.route.lane_ids,
        red_lane_ids=red_lane_ids(scene),
        speed_limit_mps=None if first is None else first.speed_limit_mps,
    )


def red_lane_ids(scene: Scene) -> frozenset[str]:
    """Lanes whose light is red at the scene's step."""
    lights = scene.clip.lights
    states = lights.states[scene.step] if lights.lane_ids else ()
    return frozenset(lane_id for lane_id, state in zip(lights.lane_ids, states) if state == LightState.RED)


@dataclass(frozen=True)
class PdmClosed:
    """PDM-Closed as an expert."""

    name: str = "pdm_closed"

    def digest(self) -> str:
        """Of the planner as published. Attempt ids hold it: with another, tables would not go on."""
        return "4fac618d98e870fc"

    def plan(self, scene: Scene, rng: np.random.Generator) -> Plan | Rejected:
        """The best proposal; "no_plan" where the route ahead has no length to drive along."""
        length_m = path_length_m(scene.centerline)
        if length_m <= MIN_PROGRESS_M:
            return Rejected("expert", "no_plan", f"the route ahead is {length_m:g} m long")
        return Plan(plan_for(scene).poses)

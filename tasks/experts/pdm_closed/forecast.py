"""What PDM-Closed believes the others will do: keep their velocity (docs/reward.md 4)."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely

from tasks.kernels.compiled import kernel
from tasks.world.agents import AgentKind, AgentTracks
from tasks.world.arrays import Array, Bools, Indices, Ints
from tasks.world.boxes import ego_boxes
from tasks.world.frames import box_corners
from tasks.world.geometry import rings_touch, wrapped
from tasks.world.vehicle import PACIFICA

STEP_S = 0.1
SAMPLE_STEPS = 2  # one forecast per 0.2 s: step i of the plan sees sample i // 2
RADIUS_M = 100.0  # from the ego centre
STANDING = 0  # every kind that is not among the moving ones
GROUP_OF = {AgentKind.VEHICLE: 1, AgentKind.PEDESTRIAN: 2, AgentKind.BICYCLE: 3}
NEAREST = np.array([50, 50, 25, 10])  # of each group


class Things(NamedTuple):
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

    def things(self, samples: int) -> Things:
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
        return Things(
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

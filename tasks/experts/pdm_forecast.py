"""What PDM-Closed believes the others will do: keep their velocity (METRIC.md section 4)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.world.agents import MOVING_KINDS, AgentKind, AgentTracks
from tasks.world.frames import box_corners, wrap_angle
from tasks.world.vehicle import HEADING, PACIFICA, Vehicle, X, Y

Array = NDArray[np.float64]
STEP_S = 0.1
SAMPLE_STEPS = 2  # one forecast per 0.2 s: step i of the plan sees sample i // 2
RADIUS_M = 100.0  # from the ego centre
NEAREST = {AgentKind.VEHICLE: 50, AgentKind.PEDESTRIAN: 25, AgentKind.BICYCLE: 10}
NEAREST_STATIC = 50


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


def ego_boxes(poses: Array, vehicle: Vehicle = PACIFICA) -> Array:
    """Footprints (..., 5) of rear-axle poses (..., 3)."""
    heading = poses[..., 2]
    x = poses[..., 0] + vehicle.rear_axle_to_center * np.cos(heading)
    y = poses[..., 1] + vehicle.rear_axle_to_center * np.sin(heading)
    size = np.broadcast_to([vehicle.length, vehicle.width], (*heading.shape, 2))
    return np.concatenate([np.stack([x, y, heading], axis=-1), size], axis=-1)


def forecast(
    ego_state: Array,
    agents: AgentTracks,
    red_lights: tuple[shapely.Polygon, ...] = (),
    vehicle: Vehicle = PACIFICA,
) -> Forecast:
    """The objects to reckon with, seen from `ego_state` (11,): `agents` at its first step, none further than 100 m.

    The nearest 50 vehicles, 25 pedestrians, 10 bicycles and 50 standing objects, by the distance of their centres to
    the ego's. Source: METRIC.md section 4.
    """
    ego_box = ego_boxes(ego_state[[X, Y, HEADING]], vehicle)
    boxes, velocities = agents.boxes[0], agents.velocities[0]
    distance = np.hypot(boxes[:, 0] - ego_box[0], boxes[:, 1] - ego_box[1])
    near = agents.valid[0] & (distance <= RADIUS_M)
    kinds = np.array([str(kind) for kind in agents.kinds], dtype=object)
    moving = np.isin(kinds, [str(kind) for kind in MOVING_KINDS])

    def nearest(wanted: NDArray[np.bool_], count: int) -> NDArray[np.intp]:
        found = np.flatnonzero(wanted & near)
        return found[np.argsort(distance[found], kind="stable")][:count]

    groups = [nearest(~moving, NEAREST_STATIC)]
    groups += [nearest(kinds == str(kind), count) for kind, count in NEAREST.items()]
    track = np.concatenate(groups)
    speed = np.hypot(velocities[track, 0], velocities[track, 1])
    heading = boxes[track, 2]
    forward = np.abs(wrap_angle(heading - np.arctan2(velocities[track, 1], velocities[track, 0]))) < np.pi / 2.0
    direction = np.where(forward, heading, heading + np.pi)
    drift = (speed * moving[track])[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    ego_polygon = shapely.polygons(box_corners(ego_box))
    touches = shapely.intersects(ego_polygon, shapely.polygons(box_corners(boxes[track])))
    return Forecast(
        track=track,
        boxes=boxes[track],
        drift=drift,
        speed=speed,
        is_agent=moving[track],
        touches_ego=np.asarray(touches, dtype=bool).reshape(len(track)),
        red_lights=red_lights,
        red_light_holds_ego=tuple(bool(shapely.within(ego_polygon, light)) for light in red_lights),
    )

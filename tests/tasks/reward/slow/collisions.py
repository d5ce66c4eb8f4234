"""No at-fault collision, time to collision, red lights (docs/reward.md 2b, 2d, 2g).

Both collision rules keep, per trajectory, a list of objects they stop looking at once a contact was harmless. An
object's contacts therefore count exactly up to its first harmless one, which is how they are evaluated here: all
contacts first, their order second.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.world.frames import HEADING, VX, VY, X, Y, box_corners, touching
from tests.tasks.reward.slow.areas import EgoAreas
from tests.tasks.reward.slow.prepare import Obstacles, RedLanes

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

STOPPED_EGO_MPS = 0.05
STOPPED_EGO_TTC_MPS = 5e-3
BEHIND_RAD = np.deg2rad(150.0)
AHEAD_RAD = np.deg2rad(30.0)
TTC_STEPS = (0, 3, 6, 9)  # projections 0, 0.3, 0.6, 0.9 s ahead
PAIRS_AT_ONCE = 1_000_000  # bounds the memory of the distance test


@dataclass(frozen=True)
class Contacts:
    """C contacts of an ego body with an object."""

    row: Ints  # (C,) trajectory
    time: Ints  # (C,) index of the ego state
    item: Ints  # (C,) object


def no_at_fault_collision(obstacles: Obstacles, states: Array, boxes: Array, areas: EgoAreas) -> tuple[Array, Array]:
    """NC (K,) in {0, 0.5, 1} and the time index (K,) of the first collision at fault, inf where there is none.

    states: (K, 41, 11); boxes: (K, 41, 5) the ego's bodies.
    """
    times = np.arange(states.shape[1])
    hit = find_contacts(obstacles, boxes, times)
    ego, body = states[hit.row, hit.time], boxes[hit.row, hit.time]
    moving_ego = np.hypot(ego[:, VX], ego[:, VY]) > STOPPED_EGO_MPS
    behind = angle_to(ego, obstacles.centroids[hit.time, hit.item]) > BEHIND_RAD
    frontal = touching(front_edges(body), obstacles.boxes[hit.time, hit.item])
    blamed = obstacles.is_stopped[hit.item] | (~behind & (frontal | areas.off_lane[hit.row, hit.time]))
    counted = _before_first_harmless(hit, hit.time, moving_ego & blamed, states.shape[0], len(obstacles.is_stopped))

    nc = np.ones(states.shape[0])
    np.minimum.at(nc, hit.row[counted], obstacles.collision_score[hit.item[counted]])
    first = np.full(states.shape[0], np.inf)
    np.minimum.at(first, hit.row[counted], hit.time[counted].astype(np.float64))
    return nc, first


def time_to_collision(obstacles: Obstacles, states: Array, boxes: Array, areas: EgoAreas) -> tuple[Array, Array]:
    """TTC (K,) in {0, 1} and the first violating time index (K,), inf where there is none.

    The ego's body goes on straight at its speed for up to 0.9 s, at each of the times 0 .. 31.
    """
    n_times = states.shape[1] - max(TTC_STEPS)
    ego, now = states[:, :n_times], boxes[:, :n_times]
    speed = np.hypot(ego[..., VX], ego[..., VY])
    heading = np.stack([np.cos(ego[..., HEADING]), np.sin(ego[..., HEADING])], axis=-1)
    parts = []
    for step in TTC_STEPS:
        projected = now.copy()
        projected[..., :2] += heading * (speed * (step * 0.1))[..., None]
        found = find_contacts(obstacles, projected, np.arange(n_times) + step)
        parts.append(np.stack([found.row, found.time, found.item, np.full_like(found.row, step)]))
    row, time, item, step_of = np.concatenate(parts, axis=1)
    driving = speed[row, time] >= STOPPED_EGO_TTC_MPS
    row, time, item, step_of = row[driving], time[driving], item[driving], step_of[driving]

    angle = angle_to(ego[row, time], obstacles.centroids[time + step_of, item])
    exposed = (areas.off_lane | areas.rear_axle_in_intersection)[row, time]
    violating = (angle < AHEAD_RAD) | (exposed & ~(angle > BEHIND_RAD))
    order = time * (max(TTC_STEPS) + 1) + step_of
    counted = _before_first_harmless(
        Contacts(row, time, item), order, violating, states.shape[0], len(obstacles.is_stopped)
    )
    first = np.full(states.shape[0], np.inf)
    np.minimum.at(first, row[counted], time[counted].astype(np.float64))
    return np.where(np.isinf(first), 1.0, 0.0), first


def traffic_light_compliance(red_lanes: RedLanes, boxes: Array) -> tuple[Array, Array]:
    """TLC (K,) in {0, 1} and the first time index (K,) on a red lane connector (inf: none); standing inside counts."""
    first = np.full(boxes.shape[0], np.inf)
    radius = circumradius(boxes)
    for lane, (shape, is_red) in enumerate(zip(red_lanes.shapes, red_lanes.is_red.T)):
        low_x, low_y, high_x, high_y = shapely.bounds(red_lanes.shapes[lane])
        near = (boxes[..., 0] + radius >= low_x) & (boxes[..., 0] - radius <= high_x)
        near &= (boxes[..., 1] + radius >= low_y) & (boxes[..., 1] - radius <= high_y)
        row, time = np.nonzero(near & is_red)
        inside = shapely.intersects(shape, shapely.polygons(box_corners(boxes[row, time])))
        np.minimum.at(first, row[inside], time[inside].astype(np.float64))
    return np.where(np.isinf(first), 1.0, 0.0), first


def find_contacts(obstacles: Obstacles, boxes: Array, times: Ints) -> Contacts:
    """All contacts of ego bodies (K, T, 5) with the objects at time indices `times` (T,); touching counts."""
    objects = obstacles.boxes[times]  # (T, N, 5)
    reach_sq = (circumradius(objects) + circumradius(boxes[:1, :1, None])[0]) ** 2  # (T, N)
    rows_at_once = max(1, PAIRS_AT_ONCE // max(1, reach_sq.size))
    found = [np.empty((3, 0), dtype=np.int64)]
    for start in range(0, boxes.shape[0], rows_at_once):
        part = boxes[start : start + rows_at_once, :, None]
        distance_sq = (part[..., 0] - objects[..., 0]) ** 2 + (part[..., 1] - objects[..., 1]) ** 2
        row, time, item = np.nonzero(distance_sq <= reach_sq)
        hit = touching(boxes[start + row, time], objects[time, item])
        found.append(np.stack([start + row[hit], time[hit], item[hit]]))
    return Contacts(*np.concatenate(found, axis=1))


def front_edges(boxes: Array) -> Array:
    """The front edge of boxes (..., 5), as boxes of length zero."""
    heading, half_length = boxes[..., 2], boxes[..., 3] / 2.0
    edges = boxes.copy()
    edges[..., 0] += half_length * np.cos(heading)
    edges[..., 1] += half_length * np.sin(heading)
    edges[..., 3] = 0.0
    return edges


def circumradius(boxes: Array) -> Array:
    """Radius (...) [m] of the circle around each box."""
    return 0.5 * np.hypot(boxes[..., 3], boxes[..., 4])


def angle_to(ego: Array, points: Array) -> Array:
    """Angle (C,) [rad] between the heading of ego states (C, 11) and the ray from their rear axle to points (C, 2).

    The cosine is not clipped, as in the public metric: where rounding lifts it above 1 the angle is NaN, so a
    perfectly aligned object is neither ahead nor behind (docs/reward.md 2g); so is one centred on the rear axle.
    """
    offset = points - ego[:, [X, Y]]
    with np.errstate(invalid="ignore"):
        ray = offset / np.hypot(offset[:, 0], offset[:, 1])[:, None]
        angle: Array = np.arccos(np.cos(ego[:, HEADING]) * ray[:, 0] + np.sin(ego[:, HEADING]) * ray[:, 1])
    return angle


def _before_first_harmless(hit: Contacts, order: Ints, harmful: Bools, n_rows: int, n_items: int) -> Bools:
    """Which harmful contacts (C,) come before their object's first harmless one in the same trajectory."""
    first_harmless = np.full((n_rows, n_items), np.iinfo(np.int64).max)
    np.minimum.at(first_harmless, (hit.row[~harmful], hit.item[~harmful]), order[~harmful])
    return harmful & (order < first_harmless[hit.row, hit.item])

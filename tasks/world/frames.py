"""SE(2) poses, arrays whose last axis is x [m], y [m], heading [rad]; the ego's body and the columns of its state."""

from dataclasses import dataclass

import numpy as np

from tasks.world.arrays import Array, Bools


def wrap_angle(angle: Array) -> Array:
    """Angles [rad] wrapped to [-pi, pi), any shape."""
    return (np.asarray(angle) + np.pi) % (2.0 * np.pi) - np.pi


def to_world(origin: Array, local: Array) -> Array:
    """Poses (..., 3) given in the frame of `origin` (3,), as world poses (..., 3); heading by atan2."""
    c, s = np.cos(origin[2]), np.sin(origin[2])
    cl, sl = np.cos(local[..., 2]), np.sin(local[..., 2])
    return np.stack(
        [
            c * local[..., 0] - s * local[..., 1] + origin[0],
            s * local[..., 0] + c * local[..., 1] + origin[1],
            np.arctan2(s * cl + c * sl, c * cl - s * sl),
        ],
        axis=-1,
    )


def to_local(origin: Array, world: Array) -> Array:
    """World poses (..., 3) expressed in the frame of `origin` (3,); heading wrapped to [-pi, pi)."""
    c, s = np.cos(origin[2]), np.sin(origin[2])
    dx, dy = world[..., 0] - origin[0], world[..., 1] - origin[1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy, wrap_angle(world[..., 2] - origin[2])], axis=-1)


def points_to_local(origin: Array, points: Array) -> Array:
    """World points (..., 2) expressed in the frame of the pose `origin` (3,)."""
    c, s = np.cos(origin[2]), np.sin(origin[2])
    dx, dy = points[..., 0] - origin[0], points[..., 1] - origin[1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy], axis=-1)


def planar_matrices(poses: Array) -> Array:
    """Poses (N, 3) as matrices (N, 4, 4) on the plane z = 0, z up."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = c, -s, s, c
    out[:, :2, 3] = poses[:, :2]
    return out


# Columns of an ego state row (docs/reward.md 0). The pose is the REAR AXLE in the world frame;
# velocity and acceleration are in the ego body frame.
X, Y, HEADING, VX, VY, AX, AY, STEERING, STEERING_RATE, YAW_RATE, YAW_ACCEL = range(11)
EGO_STATE_SIZE = 11


@dataclass(frozen=True)
class Vehicle:
    """Body of a car; lengths in metres. Defaults: Chrysler Pacifica, docs/reward.md 0.

    It is used on every data set, so that scores are comparable.
    """

    width: float = 2.297
    front_length: float = 4.049  # rear axle to front bumper
    rear_length: float = 1.127  # rear axle to rear bumper
    rear_axle_to_center: float = 1.461
    wheel_base: float = 3.089

    @property
    def length(self) -> float:
        return self.front_length + self.rear_length

    @property
    def half_length(self) -> float:
        return self.length / 2.0

    @property
    def half_width(self) -> float:
        return self.width / 2.0


PACIFICA = Vehicle()
REAR_AXLE_TO_CENTER, HALF_LENGTH, HALF_WIDTH = PACIFICA.rear_axle_to_center, PACIFICA.half_length, PACIFICA.half_width


def pose_on_ground(logged: Array, ego_states: Array) -> Array:
    """3-D poses (F, 4, 4) of planar ego states (F, 11), standing on the road as the log knows it.

    `logged` (S, 4, 4) world_from_ego: each state takes height, roll and pitch from the plane under the nearest logged
    pose.
    """
    xy = ego_states[:, [X, Y]]
    distance = np.linalg.norm(logged[None, :, :2, 3] - xy[:, None, :], axis=-1)
    base = logged[np.argmin(distance, axis=1)]
    up = base[:, :3, 2]
    out = np.tile(np.eye(4), (len(xy), 1, 1))
    out[:, :2, 3] = xy
    offset = xy - base[:, :2, 3]
    out[:, 2, 3] = base[:, 2, 3] - (offset * up[:, :2]).sum(axis=1) / up[:, 2]
    flat = np.stack([np.cos(ego_states[:, HEADING]), np.sin(ego_states[:, HEADING])], axis=-1)
    forward = np.column_stack([flat, -(flat * up[:, :2]).sum(axis=1) / up[:, 2]])
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    out[:, :3, 0], out[:, :3, 1], out[:, :3, 2] = forward, np.cross(up, forward), up
    return out


# Oriented boxes in the plane, arrays whose last axis is centre x [m], centre y [m], heading [rad], length [m], width
# [m], as in AgentTracks: where the ego's body is, and which boxes touch.


def box_corners(boxes: Array) -> Array:
    """Corners (..., 4, 2) of boxes (..., 5) = centre x, y, heading, length, width; order FL, RL, RR, FR."""
    c, s = np.cos(boxes[..., 2]), np.sin(boxes[..., 2])
    half_length, half_width = boxes[..., 3] / 2.0, boxes[..., 4] / 2.0
    along = np.stack([half_length, -half_length, -half_length, half_length], axis=-1)
    across = np.stack([half_width, half_width, -half_width, -half_width], axis=-1)
    x = boxes[..., 0, None] + c[..., None] * along - s[..., None] * across
    y = boxes[..., 1, None] + s[..., None] * along + c[..., None] * across
    return np.stack([x, y], axis=-1)


def ego_boxes(states: Array, vehicle: Vehicle) -> Array:
    """The ego's body (..., 5) at states (..., 11); the state's pose is the rear axle."""
    heading, shift = states[..., HEADING], vehicle.rear_axle_to_center
    boxes = np.empty((*heading.shape, 5))
    boxes[..., 0] = states[..., X] + shift * np.cos(heading)
    boxes[..., 1] = states[..., Y] + shift * np.sin(heading)
    boxes[..., 2], boxes[..., 3], boxes[..., 4] = heading, vehicle.length, vehicle.width
    return boxes


def touching(first: Array, second: Array) -> Bools:
    """Whether boxes (..., 5) intersect pairwise, touching included (separating axes).

    A pair with a NaN does not touch.
    """
    dx, dy = second[..., 0] - first[..., 0], second[..., 1] - first[..., 1]
    turn = second[..., 2] - first[..., 2]
    c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    near: Bools = np.ones(dx.shape, dtype=bool)
    for one, other in ((first, second), (second, first)):
        along = np.cos(one[..., 2]) * dx + np.sin(one[..., 2]) * dy
        across = np.cos(one[..., 2]) * dy - np.sin(one[..., 2]) * dx
        near &= 2.0 * np.abs(along) <= one[..., 3] + other[..., 3] * c + other[..., 4] * s
        near &= 2.0 * np.abs(across) <= one[..., 4] + other[..., 3] * s + other[..., 4] * c
    return near


# How large a number of a scene may be: no road has a length [m], heading [rad] or speed [m/s] like it; kernels number
# cells and turns of a circle, which stops working far above it.
LARGEST = 1e8
SLACK_M = 1e-6  # above what rounding can do to a coordinate of a city


def all_within(values: Array) -> bool:
    """Whether all values are finite and at most LARGEST in size; takes no memory of the values' own size."""
    return bool(values.max(initial=0.0) <= LARGEST and values.min(initial=0.0) >= -LARGEST)  # NaN is neither

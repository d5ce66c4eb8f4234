"""Oriented boxes in the plane: where the ego's body is, and which boxes touch.

Boxes are arrays whose last axis is centre x [m], centre y [m], heading [rad], length [m], width [m], as in AgentTracks.
"""

import numpy as np

from tasks.world.arrays import Array, Bools
from tasks.world.vehicle import HEADING, Vehicle, X, Y


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

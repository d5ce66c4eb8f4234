"""The ego's body along one trajectory, laid out as the rules' kernels read it."""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from tasks.kernels.compiled import kernel
from tasks.kernels.trig import sincos
from tasks.world.arrays import Array, Bytes
from tasks.world.vehicle import HEADING, VX, VY, X, Y

# Bits of an instant's flags (docs/reward.md 2a)
MULTIPLE_LANES = 1  # corners in more than one lane, and no lane holds all four
NON_DRIVABLE = 2  # some corner is in no drivable polygon
ONCOMING = 4  # the centre is in no lane of the route
CENTER_IN_INTERSECTION = 8
OFF_LANE = MULTIPLE_LANES | NON_DRIVABLE  # where a lateral contact is the ego's fault


class Body(NamedTuple):
    """Scratch for one trajectory, 41 instants; world frame."""

    x: Array  # (41,) centre of the body [m]
    y: Array  # (41,)
    cos: Array  # (41,) of the heading
    sin: Array  # (41,)
    speed: Array  # (41,) hypot(vx, vy) [m/s]
    flags: Bytes  # (41,) bits above


@register_jitable
def empty_body(n_times: int) -> Body:
    """Scratch to be filled by `place`."""
    return Body(
        np.empty(n_times),
        np.empty(n_times),
        np.empty(n_times),
        np.empty(n_times),
        np.empty(n_times),
        np.zeros(n_times, np.uint8),
    )


@kernel
def place(states: Array, rear_axle_to_center: float, body: Body) -> None:
    """Fill everything but the flags from the states (41, 11) of one trajectory; their pose is the rear axle."""
    x, y, cos, sin, speed = body.x, body.y, body.cos, body.sin, body.speed
    for t in range(states.shape[0]):
        s, c = sincos(states[t, HEADING])
        cos[t], sin[t] = c, s
        x[t] = states[t, X] + rear_axle_to_center * c
        y[t] = states[t, Y] + rear_axle_to_center * s
        speed[t] = math.sqrt(states[t, VX] * states[t, VX] + states[t, VY] * states[t, VY])

"""The ego's body along one trajectory, laid out as the rules' kernels read it."""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from tasks.kernels.compiled import kernel
from tasks.kernels.trig import sincos
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import HORIZON_STEPS
from tasks.world.frames import EGO_STATE_SIZE, HEADING, VX, VY, X, Y
from tasks.world.geometry import LARGEST, all_within

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


def shaped(name: str, states: Array) -> Array:
    """Contiguous float64 states (K >= 1, 41, 11) of any values. Raises ValueError where they are of another shape."""
    states = np.ascontiguousarray(states, dtype=np.float64)
    if states.ndim != 3 or states.shape[1:] != (HORIZON_STEPS + 1, EGO_STATE_SIZE) or len(states) == 0:
        raise ValueError(f"{name} must be (K >= 1, {HORIZON_STEPS + 1}, {EGO_STATE_SIZE}), got {states.shape}")
    return states if states.flags.writeable else states.copy()


def checked(name: str, states: Array) -> Array:
    """As `shaped`, and of drives. Raises ValueError."""
    states = shaped(name, states)
    if not all_within(states):
        raise no_drive(name)
    return states


def no_drive(name: str) -> ValueError:
    """The error that states are refused with."""
    return ValueError(f"{name} must be finite and at most {LARGEST:g}: leave out what is not a drive")


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

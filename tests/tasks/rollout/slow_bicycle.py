"""Kinematic bicycle with first-order actuators: the ego's motion model (docs/reward.md 1b).

    ax'    = ax + dt / (dt + 0.2) (accel_cmd - ax)          steer' = steer + dt / (dt + 0.05) dt rate_cmd
    x      += v cos(h) dt        y += v sin(h) dt            h += v tan(steer) / L dt      (old v, old steer)
    v      += ax' dt             yaw rate = v_new tan(steer_new) / L

One explicit Euler step of 0.1 s. Speed is not clipped at zero, as in the public metric.
"""

import numpy as np
from numpy.typing import NDArray

from tasks.world.clip import STEP_S
from tasks.world.frames import (
    AX,
    EGO_STATE_SIZE,
    HEADING,
    PACIFICA,
    STEERING,
    STEERING_RATE,
    VX,
    YAW_ACCEL,
    YAW_RATE,
    Vehicle,
    X,
    Y,
    wrap_angle,
)

Array = NDArray[np.float64]

MAX_STEERING_RAD = np.pi / 3.0
ACCEL_TIME_CONSTANT_S = 0.2
STEERING_TIME_CONSTANT_S = 0.05


def step(state: Array, accel_command: Array, steering_rate_command: Array, vehicle: Vehicle = PACIFICA) -> Array:
    """The states (K, 11) 0.1 s later.

    state: (K, 11), columns tasks.world.frames; accel_command: (K,) [m/s^2]; steering_rate_command: (K,) [rad/s].
    Lateral velocity and acceleration of the result are zero.
    """
    dt = STEP_S
    heading, speed, steering = state[:, HEADING], state[:, VX], state[:, STEERING]
    accel = dt / (dt + ACCEL_TIME_CONSTANT_S) * (accel_command - state[:, AX]) + state[:, AX]
    wanted_steering = dt / (dt + STEERING_TIME_CONSTANT_S) * (steering_rate_command * dt) + steering
    steering_rate = (wanted_steering - steering) / dt

    after = np.zeros((state.shape[0], EGO_STATE_SIZE))
    after[:, X] = state[:, X] + speed * np.cos(heading) * dt
    after[:, Y] = state[:, Y] + speed * np.sin(heading) * dt
    after[:, HEADING] = wrap_angle(heading + speed * np.tan(steering) / vehicle.wheel_base * dt)
    after[:, VX] = speed + accel * dt
    after[:, AX] = accel
    after[:, STEERING] = np.clip(steering + steering_rate * dt, -MAX_STEERING_RAD, MAX_STEERING_RAD)
    after[:, STEERING_RATE] = steering_rate
    after[:, YAW_RATE] = after[:, VX] * np.tan(after[:, STEERING]) / vehicle.wheel_base
    after[:, YAW_ACCEL] = (after[:, YAW_RATE] - state[:, YAW_RATE]) / dt
    return after

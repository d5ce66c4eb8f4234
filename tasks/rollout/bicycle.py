"""Kinematic bicycle with first-order actuators: the ego's motion model (docs/reward.md 1b).

    ax'    = ax + dt / (dt + 0.2) (accel_cmd - ax)          steer' = steer + dt / (dt + 0.05) dt rate_cmd
    x      += v cos(h) dt        y += v sin(h) dt            h += v tan(steer) / L dt      (old v, old steer)
    v      += ax' dt             yaw rate = v_new tan(steer_new) / L

One explicit Euler step of 0.1 s. Speed is not clipped at zero, as in the public metric.
"""

import numpy as np

from tasks.kernels.compiled import inlined
from tasks.kernels.trig import sincos, wrap
from tasks.world.clip import STEP_S

MAX_STEERING_RAD = np.pi / 3.0
ACCEL_TIME_CONSTANT_S = 0.2
STEERING_TIME_CONSTANT_S = 0.05
ACCEL_SHARE = STEP_S / (STEP_S + ACCEL_TIME_CONSTANT_S)  # of a command that is reached within a step
STEERING_SHARE = STEP_S / (STEP_S + STEERING_TIME_CONSTANT_S)


@inlined
def actuate(accel: float, steering: float, accel_command: float, rate_command: float) -> tuple[float, float, float]:
    """Acceleration [m/s^2], steering angle [rad] and steering rate [rad/s] 0.1 s later.

    The rate is the one wanted: the clipping of the angle does not show in it.
    """
    steering_rate = STEERING_SHARE * rate_command
    wanted = steering + steering_rate * STEP_S
    wanted = wanted if wanted < MAX_STEERING_RAD else MAX_STEERING_RAD
    wanted = wanted if wanted > -MAX_STEERING_RAD else -MAX_STEERING_RAD
    return accel + ACCEL_SHARE * (accel_command - accel), wanted, steering_rate


@inlined
def travel(x: float, y: float, heading: float, speed: float, path_curvature: float) -> tuple[float, float, float]:
    """Rear-axle pose 0.1 s later; path_curvature: tan(steering) / wheel base [1/m]."""
    sine, cosine = sincos(heading)
    step_m = speed * STEP_S
    return x + step_m * cosine, y + step_m * sine, wrap(heading + step_m * path_curvature)


@inlined
def path_curvature(steering: float, wheel_base: float) -> float:
    """Curvature [1/m] of the rear axle's path at a steering angle [rad]."""
    sine, cosine = sincos(steering)
    return sine / (cosine * wheel_base)

"""LQR trajectory tracker on the kinematic bicycle, as the public metric drives a plan (docs/reward.md 1a).

Per plan, a velocity and a curvature profile are fitted to the poses (regularised least squares); per step, a scalar
LQR over a 1 s horizon gives the acceleration and another the steering rate.

Two identities make it fast. The normal matrix of the velocity fit does not depend on the plan, because the heading
enters only through cos^2 + sin^2 = 1: the whole fit is one constant 40 x 40 matrix. The curvature fit, written in
curvatures instead of their rates, is tridiagonal: minimise
    sum_i (dh_i - v_i dt k_i)^2 + 1e-2 sum_i ((k_{i+1} - k_i) / dt)^2 + 1e-10 k_0^2.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from tasks.world.clip import HORIZON_STEPS, STEP_S
from tasks.world.frames import EGO_STATE_SIZE, HEADING, PACIFICA, STEERING, VX, Vehicle, X, Y, wrap_angle
from tests.tasks.rollout import slow_bicycle as bicycle

Array = NDArray[np.float64]

TRACKING_STEPS = 10  # LQR horizon, 1 s
Q_VELOCITY, R_ACCEL = 10.0, 1.0
Q_LATERAL, Q_HEADING, R_STEERING_RATE = 1.0, 10.0, 1.0  # the steering angle itself costs nothing
ACCEL_PENALTY = 1e-4  # the public "jerk penalty": its difference matrix penalises accelerations (docs/reward.md 1a)
CURVATURE_RATE_PENALTY = 1e-2
INITIAL_CURVATURE_PENALTY = 1e-10
STOPPING_GAIN = 0.5
STOPPING_SPEED_MPS = 0.2


def track(ego_state0: Array, poses: Array, vehicle: Vehicle = PACIFICA, *, planned_pose0: Array | None = None) -> Array:
    """Simulated ego states (K, 41, 11) that follow each plan; row 0 is `ego_state0`.

    ego_state0: (11,) columns tasks.world.frames; poses: (K, 40, 3) world x, y, heading at 0.1 .. 4.0 s.
    planned_pose0: (K, 3) where each plan says the ego is now, when that is not the ego's own pose: the proposals of
    PDM-Closed start on their path, beside the ego.
    """
    n_plans = poses.shape[0]
    pose0 = np.asarray(ego_state0)[[X, Y, HEADING]] if planned_pose0 is None else planned_pose0
    start = np.broadcast_to(pose0, (n_plans, 3))[:, None]
    reference = np.concatenate([start, poses], axis=1)  # (K, 41, 3)
    velocity = velocity_profile(reference)
    curvature = curvature_profile(reference, velocity)
    padding = np.repeat(curvature[:, -1:], TRACKING_STEPS, axis=1)
    padded_curvature = np.concatenate([curvature, padding], axis=1)

    states = np.empty((n_plans, HORIZON_STEPS + 1, EGO_STATE_SIZE))
    states[:, 0] = ego_state0
    for k in range(HORIZON_STEPS):
        target = min(k + TRACKING_STEPS, HORIZON_STEPS - 1)
        horizon = padded_curvature[:, k : k + TRACKING_STEPS].copy()
        horizon[:, target - k :] = curvature[:, target, None]
        accel, steering_rate = _commands(states[:, k], reference[:, k], velocity[:, target], horizon, vehicle)
        states[:, k + 1] = bicycle.step(states[:, k], accel, steering_rate, vehicle)
    return states


def velocity_profile(reference: Array) -> Array:
    """Fitted speeds (K, 40) [m/s] at the starts of the displacements of `reference` (K, 41, 3)."""
    delta = np.diff(reference[:, :, :2], axis=1)
    heading = reference[:, :-1, 2]
    forward = delta[..., 0] * np.cos(heading) + delta[..., 1] * np.sin(heading)
    fit = _velocity_fit()
    velocity = np.zeros_like(forward)
    for i in range(HORIZON_STEPS):  # not a matrix product: the same bits for any number of plans
        velocity += forward[:, i, None] * fit[:, i]
    return velocity


@cache
def _velocity_fit() -> Array:
    """(40, 40) matrix from forward displacements [m] to fitted speeds [m/s]."""
    n = HORIZON_STEPS
    integrate = np.tril(np.full((n, n), STEP_S**2), k=-1)  # unknowns: v0, a_0 .. a_38; displacement = sum
    integrate = np.concatenate([np.full((n, 1), STEP_S), integrate[:, : n - 1]], axis=1)
    # The public matrix of "first differences" keeps the -1 band only, but for its last row.
    penalty = np.zeros((n - 2, n))
    penalty[:, 1 : n - 1] = -np.eye(n - 2)
    penalty[-1, -1] = 1.0
    unknowns = np.linalg.solve(integrate.T @ integrate + ACCEL_PENALTY * penalty.T @ penalty, integrate.T)
    return integrate @ unknowns / STEP_S


def curvature_profile(reference: Array, velocity: Array) -> Array:
    """Fitted curvatures (K, 40) [1/m] from the heading steps of `reference` (K, 41, 3) and speeds (K, 40)."""
    step_m = velocity * STEP_S
    heading_step = wrap_angle(np.diff(reference[:, :, 2], axis=1))
    coupling = CURVATURE_RATE_PENALTY / STEP_S**2
    diagonal = step_m**2 + 2.0 * coupling
    diagonal[:, 0] += INITIAL_CURVATURE_PENALTY - coupling
    diagonal[:, -1] -= coupling
    right = step_m * heading_step
    for i in range(1, HORIZON_STEPS):  # Thomas: symmetric tridiagonal with off-diagonal -coupling
        factor = coupling / diagonal[:, i - 1]
        diagonal[:, i] -= factor * coupling
        right[:, i] += factor * right[:, i - 1]
    curvature = np.empty_like(right)
    curvature[:, -1] = right[:, -1] / diagonal[:, -1]
    for i in range(HORIZON_STEPS - 2, -1, -1):
        curvature[:, i] = (right[:, i] + coupling * curvature[:, i + 1]) / diagonal[:, i]
    return curvature


def _commands(
    state: Array, reference: Array, target_speed: Array, curvature: Array, vehicle: Vehicle
) -> tuple[Array, Array]:
    """Acceleration (K,) and steering rate (K,) for states (K, 11).

    reference: (K, 3) pose of this step; target_speed: (K,) 1 s ahead; curvature: (K, 10) over the horizon.
    """
    speed = state[:, VX]
    speed_error = speed - target_speed
    horizon_s = TRACKING_STEPS * STEP_S
    accel = -horizon_s * Q_VELOCITY / (horizon_s * Q_VELOCITY * horizon_s + R_ACCEL) * speed_error

    speeds = speed[:, None] + accel[:, None] * (STEP_S * np.arange(TRACKING_STEPS))
    steering_rate = _steering_rate(state, reference, speeds * STEP_S, curvature, vehicle)

    stopping = (target_speed <= STOPPING_SPEED_MPS) & (speed <= STOPPING_SPEED_MPS)
    accel = np.where(stopping, -STOPPING_GAIN * speed_error, accel)
    return accel, np.where(stopping, 0.0, steering_rate)


def _steering_rate(state: Array, reference: Array, step_m: Array, curvature: Array, vehicle: Vehicle) -> Array:
    """Steering rate (K,) [rad/s] that minimises the error one horizon ahead.

    Linearised error dynamics per step of length step_m[:, t] = v dt:
        lateral += v dt heading;  heading += v dt (steering / L - curvature);  steering += dt rate.
    """
    dx, dy = state[:, X] - reference[:, 0], state[:, Y] - reference[:, 1]
    c, s = np.cos(reference[:, 2]), np.sin(reference[:, 2])
    lateral = -dx * s + dy * c
    heading = wrap_angle(state[:, HEADING] - reference[:, 2])

    # heading error before step t, free response and response to a unit steering rate
    steps = np.arange(TRACKING_STEPS)
    turn_free = np.cumsum(step_m * (state[:, STEERING, None] / vehicle.wheel_base - curvature), axis=1)
    turn_unit = np.cumsum(step_m / vehicle.wheel_base * (steps * STEP_S), axis=1)
    lateral_free = lateral + (step_m[:, 0] * heading) + (step_m[:, 1:] * (heading[:, None] + turn_free[:, :-1])).sum(1)
    lateral_unit = (step_m[:, 1:] * turn_unit[:, :-1]).sum(1)
    heading_free = heading + turn_free[:, -1]
    heading_free = np.arctan2(np.sin(heading_free), np.cos(heading_free))
    heading_unit = turn_unit[:, -1]

    pull = lateral_unit * Q_LATERAL * lateral_free + heading_unit * Q_HEADING * heading_free
    weight = lateral_unit * Q_LATERAL * lateral_unit + heading_unit * Q_HEADING * heading_unit + R_STEERING_RATE
    return -pull / weight

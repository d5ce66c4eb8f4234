"""LQR trajectory tracker on the kinematic bicycle, as the public metric drives a plan (docs/reward.md 1a).

Per plan, a velocity and a curvature profile are fitted to the poses; per step, a scalar LQR over a 1 s horizon gives
the acceleration and another the steering rate.

The horizon needs no simulation. Its ten steps have the lengths s_i = (v + w i) dt with w = accel dt, and per step
    lateral += s_i heading;  heading += s_i (steering / L - curvature_i);  steering += dt rate,
so after it the heading is linear and the lateral error quadratic in (v, w), with weights that are polynomials in i.
With k_i = steering / L - curvature_i and K_j = sum_i binomial(i, j) k_i, they grow by
    turn = dt (v K_0 + w K_1)
    bend = dt^2 (v^2 (9 K_0 - K_1) + v w (45 K_0 + 7 K_1 - 3 K_2) + w^2 (44 K_1 - 4 K_2 - 3 K_3)).
A unit steering rate adds the same with k_i = i dt / L. Sums with binomial weights take additions only.
"""

from math import comb
from typing import NamedTuple

import numpy as np

from tasks.kernels.compiled import inlined, kernel, read_only
from tasks.kernels.trig import sincos, wrap
from tasks.world.arrays import Array
from tasks.world.clip import HORIZON_STEPS, STEP_S
from tasks.world.frames import (
    AX,
    AY,
    EGO_STATE_SIZE,
    HEADING,
    LARGEST,
    PACIFICA,
    STEERING,
    STEERING_RATE,
    VX,
    VY,
    YAW_ACCEL,
    YAW_RATE,
    Vehicle,
    X,
    Y,
)

# Kinematic bicycle with first-order actuators: the ego's motion model (docs/reward.md 1b).
#
#     ax'    = ax + dt / (dt + 0.2) (accel_cmd - ax)          steer' = steer + dt / (dt + 0.05) dt rate_cmd
#     x      += v cos(h) dt        y += v sin(h) dt            h += v tan(steer) / L dt      (old v, old steer)
#     v      += ax' dt             yaw rate = v_new tan(steer_new) / L
#
# One explicit Euler step of 0.1 s. Speed is not clipped at zero, as in the public metric.

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


# Speeds and curvatures fitted to the poses of a plan, and what the tracker looks at of them (docs/reward.md 1a).
#
# Both fits are regularised least squares, and both are banded systems in the right unknowns, so that 40 instants cost
# 40 short steps:
#
# Speeds. The heading enters the normal equations only through cos^2 + sin^2 = 1, and a displacement is v_i dt. With f_i
# the forward displacement, minimise
#     sum_i (f_i - v_i dt)^2 + 1e-4 sum_{i <= 36} ((v_{i+1} - v_i) / dt)^2 + 1e-4 ((v_39 - 2 v_38 + v_37) / dt)^2
# (the public matrix of first differences keeps the -1 band only, but for its last row). The matrix is the same for all
# plans and is factorised once.
#
# Curvatures. Written in curvatures instead of their rates, with h_i the heading step, minimise
#     sum_i (h_i - v_i dt k_i)^2 + 1e-2 sum_i ((k_{i+1} - k_i) / dt)^2 + 1e-10 k_0^2.

TRACKING_STEPS = 10  # LQR horizon, 1 s
ACCEL_PENALTY = 1e-4  # the public "jerk penalty"
CURVATURE_RATE_PENALTY = 1e-2
INITIAL_CURVATURE_PENALTY = 1e-10
COUPLING = CURVATURE_RATE_PENALTY / STEP_S**2


class Plans(NamedTuple):
    """Scratch for a block of B plans in the world frame; instants first, so that loops over the plans vectorise."""

    x: Array  # (41, B) rear axle [m]
    y: Array  # (41, B)
    heading: Array  # (41, B) [rad]
    cos: Array  # (41, B) of the heading
    sin: Array  # (41, B)
    speed: Array  # (40, B) fitted [m/s]
    curvature: Array  # (50, B) fitted [1/m]; the last one is held over the horizon past the plan's end
    inverse: Array  # (40, B) of the curvature fit's pivots
    excess: Array  # (B,) of the last pivot over the coupling


@inlined
def empty_plans(size: int) -> Plans:
    """Scratch for `size` plans, to be filled."""
    poses, steps = (HORIZON_STEPS + 1, size), (HORIZON_STEPS, size)
    return Plans(
        x=np.empty(poses),
        y=np.empty(poses),
        heading=np.empty(poses),
        cos=np.empty(poses),
        sin=np.empty(poses),
        speed=np.empty(steps),
        curvature=np.empty((HORIZON_STEPS + TRACKING_STEPS, size)),
        inverse=np.empty(steps),
        excess=np.empty(size),
    )


def _speed_fit() -> Array:
    """(5, 40) factors of the speed fit's elimination, forwards (own, last, last but one) and back (next, next but one).

    Plain Python, not LAPACK: the same bits on every machine.
    """
    n, penalty = HORIZON_STEPS, ACCEL_PENALTY / STEP_S**4
    differences = [{i: -1.0, i + 1: 1.0} for i in range(n - 3)] + [{n - 3: 1.0, n - 2: -2.0, n - 1: 1.0}]
    normal = np.eye(n)
    for row in differences:
        for i, a in row.items():
            for j, b in row.items():
                normal[i, j] += penalty * a * b
    diagonal, below, below2 = np.zeros((3, n + 2))
    for i in range(n):
        below2[i] = normal[i, i - 2] / diagonal[i - 2] if i > 1 else 0.0
        below[i] = (normal[i, i - 1] - below2[i] * diagonal[i - 2] * below[i - 1]) / diagonal[i - 1] if i > 0 else 0.0
        diagonal[i] = normal[i, i] - below[i] ** 2 * diagonal[i - 1] - below2[i] ** 2 * diagonal[i - 2]
    own = 1.0 / diagonal[:n]
    last, last2 = -below[:n] * np.roll(diagonal, 1)[:n] * own, -below2[:n] * np.roll(diagonal, 2)[:n] * own
    return np.stack([own / STEP_S, last, last2, -below[1 : n + 1], -below2[2:]])


SPEED_FIT = _speed_fit()


@inlined
def fit_speeds(n_plans: int, plans: Plans) -> None:
    """Fill `speed` from the poses and their cos and sin."""
    last = HORIZON_STEPS - 1
    for t in range(HORIZON_STEPS):
        for b in range(n_plans):
            dx, dy = plans.x[t + 1, b] - plans.x[t, b], plans.y[t + 1, b] - plans.y[t, b]
            plans.speed[t, b] = dx * plans.cos[t, b] + dy * plans.sin[t, b]
    for t in range(HORIZON_STEPS):
        own, before, before2 = SPEED_FIT[0, t], SPEED_FIT[1, t], SPEED_FIT[2, t]
        t1, t2 = max(t - 1, 0), max(t - 2, 0)
        for b in range(n_plans):
            plans.speed[t, b] = own * plans.speed[t, b] + before * plans.speed[t1, b] + before2 * plans.speed[t2, b]
    for t in range(last, -1, -1):
        after, after2 = SPEED_FIT[3, t], SPEED_FIT[4, t]
        t1, t2 = min(t + 1, last), min(t + 2, last)
        for b in range(n_plans):
            plans.speed[t, b] += after * plans.speed[t1, b] + after2 * plans.speed[t2, b]


@inlined
def fit_curvatures(n_plans: int, plans: Plans) -> None:
    """Fill `curvature` from the headings and fitted speeds: a symmetric tridiagonal system.

    Gaussian elimination keeps what a pivot exceeds the coupling by instead of the pivot itself: for a plan that hardly
    moves the excess is 1e-10 of the pivot, and their difference would have lost it.
    """
    last = HORIZON_STEPS - 1
    for b in range(n_plans):
        plans.excess[b], plans.curvature[0, b] = INITIAL_CURVATURE_PENALTY, 0.0  # what comes before the first row
    for t in range(HORIZON_STEPS):
        before = max(t - 1, 0)
        ahead = COUPLING if t < last else 0.0
        for b in range(n_plans):
            step_m = plans.speed[t, b] * STEP_S
            turn = wrap(plans.heading[t + 1, b] - plans.heading[t, b])
            excess = step_m * step_m + plans.excess[b]
            inverse = reciprocal(excess + ahead)
            plans.inverse[t, b] = inverse
            plans.excess[b] = COUPLING * excess * inverse
            plans.curvature[t, b] = (step_m * turn + COUPLING * plans.curvature[before, b]) * inverse
    for t in range(last - 1, -1, -1):
        for b in range(n_plans):
            plans.curvature[t, b] += COUPLING * plans.inverse[t, b] * plans.curvature[t + 1, b]
    for t in range(HORIZON_STEPS, HORIZON_STEPS + TRACKING_STEPS):
        for b in range(n_plans):
            plans.curvature[t, b] = plans.curvature[last, b]


@inlined
def reciprocal(value: float) -> float:
    """1 / value without the check for zero."""
    return 1.0 / value


Sums = tuple[float, float, float, float]

Q_VELOCITY, R_ACCEL = 10.0, 1.0
Q_LATERAL, Q_HEADING, R_STEERING_RATE = 1.0, 10.0, 1.0  # the steering angle itself costs nothing
STOPPING_GAIN = 0.5
STOPPING_SPEED_MPS = 0.2

HORIZON_S = TRACKING_STEPS * STEP_S
ACCEL_GAIN = HORIZON_S * Q_VELOCITY / (HORIZON_S * Q_VELOCITY * HORIZON_S + R_ACCEL)

BLOCK = 64  # plans simulated side by side; their scratch stays in the second-level cache
ANY = -1  # length of an axis in a wanted shape
_NO_STARTS = np.empty((0, 3))  # every plan starts where the ego is
TILE = 8  # plans written out side by side: one cache line of each row of scratch

# sum_i binomial(i, j) and sum_i i binomial(i, j) over the horizon, j = 0 .. 3
N = TRACKING_STEPS
ONES = (float(N), float(comb(N, 2)), float(comb(N, 3)), float(comb(N, 4)))
RAMP = (ONES[1], 2.0 * ONES[2] + ONES[1], 3.0 * ONES[3] + 2.0 * ONES[2], 4.0 * comb(N, 5) + 3.0 * ONES[3])


class Motions(NamedTuple):
    """Scratch for the simulated states of a block of B plans; instants first, 41 of them."""

    x: Array  # (41, B) rear axle, world frame [m]
    y: Array  # (41, B)
    heading: Array  # (41, B) [rad]
    speed: Array  # (41, B) [m/s]
    accel: Array  # (41, B) [m/s^2]
    steering: Array  # (41, B) [rad]
    steering_rate: Array  # (41, B) [rad/s]
    yaw_rate: Array  # (41, B) [rad/s]
    curvature: Array  # (41, B) tan(steering) / wheel base [1/m]


def track(
    ego_state0: Array,
    poses: Array,
    vehicle: Vehicle = PACIFICA,
    *,
    planned_pose0: Array | None = None,
    local: bool = False,
    out: Array | None = None,
) -> Array:
    """Simulated ego states (K, 41, 11), world frame, that follow each plan; row 0 is `ego_state0`.

    ego_state0: (11,) columns tasks.world.frames; poses: (K, 40, 3) x, y, heading at 0.1 .. 4.0 s, in the world or, if
    `local`, in the frame of `ego_state0`, as a vocabulary holds them.
    planned_pose0: (K, 3) where each plan says the ego is now, when that is not the ego's own pose: the proposals of
    PDM-Closed start on their path, beside the ego. out: filled and returned instead of a new array.
    Raises ValueError, with the field's name, on other shapes or values that are not finite.
    """
    name = "trajectories" if local else "poses"
    plans = _shaped(name, poses, (ANY, HORIZON_STEPS, 3))
    starts = _NO_STARTS if planned_pose0 is None else _shaped("planned_pose0", planned_pose0, (len(plans), 3))
    ego = _shaped("ego_state0", ego_state0, (EGO_STATE_SIZE,))
    shape = (len(plans), HORIZON_STEPS + 1, EGO_STATE_SIZE)
    states = np.empty(shape) if out is None else out
    if states.shape != shape or not states.flags.c_contiguous:
        raise ValueError(f"out must be contiguous, of the shape {shape}, got {states.shape}")
    given = read_only(ego), read_only(starts), read_only(plans)
    if not follow(*given, local, float(vehicle.wheel_base), states):
        for what, array in (("ego_state0", ego), (name, plans), ("planned_pose0", starts)):
            beyond = np.argwhere(~(np.abs(array) <= LARGEST))
            if len(beyond):
                at = beyond[0].tolist()
                raise ValueError(f"{what} must be finite and at most {LARGEST:g}, element {at} is not")
    return states


def _shaped(name: str, value: Array, shape: tuple[int, ...]) -> Array:
    """`value` as a contiguous float64 array of `shape`, where ANY stands for the number of plans."""
    array = np.ascontiguousarray(value, dtype=np.float64)
    if array.ndim != len(shape) or any(want not in (ANY, have) for want, have in zip(shape, array.shape)):
        wanted = ", ".join("K" if want == ANY else str(want) for want in shape)
        raise ValueError(f"{name} must have the shape ({wanted}), got {array.shape}")
    return array


@kernel
def follow(ego: Array, starts: Array, poses: Array, local: bool, wheel_base: float, states: Array) -> bool:
    """Fill `states` (K, 41, 11); poses (K, 40, 3), and starts (K, 3) or none, are in the ego's frame if `local`.

    False, and nothing filled, where something given is not finite or above LARGEST.
    """
    if not (_within(ego) and _within(starts.reshape(-1)) and _within(poses.reshape(-1))):
        return False
    frame, own = np.zeros(3), np.zeros((1, 3))
    for i in range(3):
        if local:
            frame[i] = ego[i]
        else:
            own[0, i] = ego[i]
    if len(starts) > 0:
        own = starts.copy()
    size = min(BLOCK, len(poses))
    plans, motions = empty_plans(size), _empty_motions(size)
    for first in range(0, len(poses), BLOCK):
        n_plans = min(BLOCK, len(poses) - first)
        _gather(own, poses, first, n_plans, plans)
        _place(frame, n_plans, plans)
        fit_speeds(n_plans, plans)
        fit_curvatures(n_plans, plans)
        _start(ego, wheel_base, n_plans, motions)
        for t in range(HORIZON_STEPS):
            _apply_commands(plans, t, n_plans, wheel_base, motions)
            _move(t, n_plans, wheel_base, motions)
        _write(ego, motions, states[first : first + n_plans])
    return True


@inlined
def _within(values: Array) -> bool:
    """Whether all of (N,) are finite and at most LARGEST in size."""
    beyond = 0
    for value in values:
        beyond += not abs(value) <= LARGEST
    return beyond == 0


@inlined
def _gather(starts: Array, poses: Array, first: int, n_plans: int, plans: Plans) -> None:
    """The block's poses as they are given, into `x`, `y`, `heading`."""
    for b in range(n_plans):
        start = starts[min(first + b, len(starts) - 1)]
        plans.x[0, b], plans.y[0, b], plans.heading[0, b] = start[X], start[Y], start[HEADING]
        for t in range(HORIZON_STEPS):
            pose = poses[first + b, t]
            plans.x[t + 1, b], plans.y[t + 1, b], plans.heading[t + 1, b] = pose[X], pose[Y], pose[HEADING]


@inlined
def _place(frame: Array, n_plans: int, plans: Plans) -> None:
    """From poses in `frame` to world poses, with cos and sin of their headings."""
    sine, cosine = sincos(frame[HEADING])
    for t in range(HORIZON_STEPS + 1):
        for b in range(n_plans):
            x, y, heading = plans.x[t, b], plans.y[t, b], wrap(plans.heading[t, b] + frame[HEADING])
            plans.x[t, b] = cosine * x - sine * y + frame[X]
            plans.y[t, b] = sine * x + cosine * y + frame[Y]
            plans.heading[t, b] = heading
            plans.sin[t, b], plans.cos[t, b] = sincos(heading)


@inlined
def _empty_motions(size: int) -> Motions:
    shape = (HORIZON_STEPS + 1, size)
    return Motions(
        x=np.empty(shape),
        y=np.empty(shape),
        heading=np.empty(shape),
        speed=np.empty(shape),
        accel=np.empty(shape),
        steering=np.empty(shape),
        steering_rate=np.empty(shape),
        yaw_rate=np.empty(shape),
        curvature=np.empty(shape),
    )


@inlined
def _start(ego: Array, wheel_base: float, n_plans: int, motions: Motions) -> None:
    """Every plan of the block starts as the ego is."""
    curvature = path_curvature(ego[STEERING], wheel_base)
    for b in range(n_plans):
        motions.x[0, b], motions.y[0, b], motions.heading[0, b] = ego[X], ego[Y], ego[HEADING]
        motions.speed[0, b], motions.accel[0, b], motions.steering[0, b] = ego[VX], ego[AX], ego[STEERING]
        motions.yaw_rate[0, b], motions.curvature[0, b] = ego[YAW_RATE], curvature


@inlined
def _apply_commands(plans: Plans, t: int, n_plans: int, wheel_base: float, motions: Motions) -> None:
    """Speed, acceleration and steering at t + 1, by the LQR's commands at t."""
    ahead = min(t + TRACKING_STEPS, HORIZON_STEPS - 1)
    for b in range(n_plans):
        dx, dy = motions.x[t, b] - plans.x[t, b], motions.y[t, b] - plans.y[t, b]
        accel_command, rate_command = _commands(
            dy * plans.cos[t, b] - dx * plans.sin[t, b],
            wrap(motions.heading[t, b] - plans.heading[t, b]),
            motions.speed[t, b],
            motions.steering[t, b],
            plans.speed[ahead, b],
            _binomial_sums(plans.curvature, t, b),
            wheel_base,
        )
        accel, steering, rate = actuate(motions.accel[t, b], motions.steering[t, b], accel_command, rate_command)
        motions.accel[t + 1, b], motions.steering[t + 1, b], motions.steering_rate[t + 1, b] = accel, steering, rate
        motions.speed[t + 1, b] = motions.speed[t, b] + accel * STEP_S


@inlined
def _binomial_sums(values: Array, t: int, b: int) -> Sums:
    """sum_i binomial(i, j) values[t + i, b] over the horizon, j = 0 .. 3."""
    zeroth, first, second, third = 0.0, 0.0, 0.0, 0.0
    for i in range(TRACKING_STEPS - 1, -1, -1):
        zeroth += values[t + i, b]
        if i > 0:
            first += zeroth
        if i > 1:
            second += first
        if i > 2:
            third += second
    return zeroth, first, second, third


@inlined
def _turn_and_bend(k: Sums, speed: float, w: float) -> tuple[float, float]:
    """`turn` / dt and `bend` / dt^2 of the module's docstring."""
    turn = speed * k[0] + w * k[1]
    vv = (N - 1.0) * k[0] - k[1]
    vw = ONES[1] * k[0] + (N - 3.0) * k[1] - 3.0 * k[2]
    ww = (ONES[1] - 1.0) * k[1] - 4.0 * k[2] - 3.0 * k[3]
    return turn, speed * (speed * vv + w * vw) + w * w * ww


@inlined
def _commands(
    lateral: float, heading: float, speed: float, steering: float, target_speed: float, path: Sums, wheel_base: float
) -> tuple[float, float]:
    """Acceleration [m/s^2] and steering rate [rad/s] for the errors `lateral` [m] and `heading` [rad].

    target_speed: of the plan 1 s ahead; path: binomial sums of its curvature over that second.
    """
    dt, per_wheel_base = STEP_S, 1.0 / wheel_base
    accel = -ACCEL_GAIN * (speed - target_speed)
    w = accel * dt
    own = steering * per_wheel_base
    k = (own * ONES[0] - path[0], own * ONES[1] - path[1], own * ONES[2] - path[2], own * ONES[3] - path[3])
    turn, bend = _turn_and_bend(k, speed, w)
    lateral_free = lateral + dt * (speed * ONES[0] + w * ONES[1]) * heading + dt * dt * bend
    heading_free = wrap(heading + dt * turn)
    turn_unit, bend_unit = _turn_and_bend(RAMP, speed, w)
    lateral_unit = dt * dt * dt * per_wheel_base * bend_unit
    heading_unit = dt * dt * per_wheel_base * turn_unit
    pull = lateral_unit * Q_LATERAL * lateral_free + heading_unit * Q_HEADING * heading_free
    weight = lateral_unit * Q_LATERAL * lateral_unit + heading_unit * Q_HEADING * heading_unit + R_STEERING_RATE
    stopping = (target_speed <= STOPPING_SPEED_MPS) & (speed <= STOPPING_SPEED_MPS)
    return -STOPPING_GAIN * (speed - target_speed) if stopping else accel, 0.0 if stopping else -pull / weight


@inlined
def _move(t: int, n_plans: int, wheel_base: float, motions: Motions) -> None:
    """Pose and yaw rate at t + 1; the pose moves with the speed and steering of t."""
    for b in range(n_plans):
        motions.x[t + 1, b], motions.y[t + 1, b], motions.heading[t + 1, b] = travel(
            motions.x[t, b], motions.y[t, b], motions.heading[t, b], motions.speed[t, b], motions.curvature[t, b]
        )
        curvature = path_curvature(motions.steering[t + 1, b], wheel_base)
        motions.curvature[t + 1, b] = curvature
        motions.yaw_rate[t + 1, b] = motions.speed[t + 1, b] * curvature


@inlined
def _write(ego: Array, motions: Motions, states: Array) -> None:
    """State rows (B, 41, 11) of a block; row 0 is `ego` (11,)."""
    for tile in range(0, len(states), TILE):
        for b in range(tile, min(tile + TILE, len(states))):
            for column in range(EGO_STATE_SIZE):
                states[b, 0, column] = ego[column]
        for t in range(1, HORIZON_STEPS + 1):
            for b in range(tile, min(tile + TILE, len(states))):
                row = states[b, t]
                row[X], row[Y], row[HEADING] = motions.x[t, b], motions.y[t, b], motions.heading[t, b]
                row[VX], row[VY] = motions.speed[t, b], 0.0
                row[AX], row[AY] = motions.accel[t, b], 0.0
                row[STEERING], row[STEERING_RATE] = motions.steering[t, b], motions.steering_rate[t, b]
                row[YAW_RATE] = motions.yaw_rate[t, b]
                row[YAW_ACCEL] = (motions.yaw_rate[t, b] - motions.yaw_rate[t - 1, b]) * (1.0 / STEP_S)

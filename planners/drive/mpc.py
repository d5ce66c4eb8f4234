"""AlpaSim's controller: a linear MPC before a dynamic bicycle, by which a plan is followed there.

The rule is that of NVlabs/alpasim 9177bd0, src/controller/alpasim_controller (mpc_controller.py, vehicle_model.py,
mpc_impl/linear_mpc.py, system.py): every 0.1 s the model is linearised at the car, a QP over the next 2 s is solved,
and its first command drives the car for 0.1 s, ten midpoint steps of 10 ms. Errors cost nothing in the first 0.9 s, so
of a plan only what lies 1.0 to 2.0 s ahead of each of these instants is looked at.

Ours: the QP is solved exactly, where theirs stops at a tolerance of 1e-4, and poses stay float64. The board has the
nonlinear controller, which minimises the errors of the model itself and penalises changes of commands; this one, which
is AlpaSim's default, penalises commands.
"""

import math

import numpy as np
import osqp
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, expm

from tasks.world import frames
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S
from tasks.world.frames import EGO_STATE_SIZE, to_local

# The car, a Ford Fusion: masses [kg], lengths [m], stiffnesses [N/rad].
MASS, INERTIA, WHEELBASE, REAR_TO_CG = 2014.4, 3414.2, 2.85, 1.59
FRONT_STIFFNESS, REAR_STIFFNESS = 93534.5, 176162.1
FRONT_TO_CG = WHEELBASE - REAR_TO_CG
ACTUATOR_S = 0.1  # time constant of steering and acceleration
KINEMATIC_BELOW_MPS, KINEMATIC_GAIN = 5.0, 10.0  # the model without slip, and how fast it is pulled to it [1/s]
SUBSTEPS = 10  # of a step of 0.1 s

# Its state: pose of the rear axle, velocity of the centre of gravity in the body frame, yaw rate, the two actuators.
X, Y, YAW, VX, VY, YAW_RATE, STEERING, ACCEL = range(8)
N_STATES, N_COMMANDS = 8, 2  # commands: front steering angle [rad], acceleration [m/s2]

HORIZON, FIRST_COUNTED = 20, 10  # steps of 0.1 s; errors before the tenth cost nothing
WEIGHTS = np.diag([2.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.1])  # along, across, heading, ..., acceleration
COMMAND_WEIGHTS = np.array([5.0, 1.0])
REGULARISATION = 1e-6
BOUNDED = (YAW, VX, STEERING, ACCEL)
LOW, HIGH = np.array([-math.pi / 2, 0.0, -math.pi / 4, -8.0]), np.array([math.pi / 2, 35.0, math.pi / 4, 6.0])
COMMAND_LOW, COMMAND_HIGH = np.array([-2.0, -9.0]), np.array([2.0, 6.0])
WITHIN = 1e-9  # of a bound that counts as kept


def car_that_moves(pose: Array, later: Array, after_s: float) -> Array:
    """(8,) the car at a rear-axle pose (3,) that is at `later` (3,) after so long: by the chord, as AlpaSim has it."""
    moved = to_local(pose, later)
    rate = 2.0 * math.sin(moved[2] / 2.0) / after_s
    return _car(pose, moved[0] / after_s, moved[1] / after_s, rate, 0.0)


def car_at(state: Array) -> Array:
    """(8,) the car in an ego's state (11,), which has come there in another way."""
    rate = state[frames.YAW_RATE]
    accel = state[frames.AX] - rate**2 * REAR_TO_CG
    return _car(state[: YAW + 1], state[frames.VX], state[frames.VY], rate, accel)


def _car(pose: Array, vx: float, vy: float, rate: float, accel: float) -> Array:
    """(8,) from the velocity of the rear axle."""
    steering = math.atan(rate / vx * WHEELBASE) if vx > 0.25 else 0.0
    return np.array([*pose, vx, vy + REAR_TO_CG * rate, rate, steering, accel])


def follow(car: Array, plan: Array, steps: int) -> tuple[Array, Array]:
    """The car `steps` of 0.1 s on (8,), and the ego's states there (steps, 11), columns of tasks.world.frames.

    plan: (P, 3) world poses of the rear axle at 0.1 s, 0.2 s, ...; after its end its last one holds.
    """
    states = np.empty((steps, EGO_STATE_SIZE))
    for step in range(steps):
        index = np.minimum(step + np.arange(HORIZON), len(plan) - 1)
        command = best_command(car, to_local(car[: YAW + 1], plan[index]))
        car = advanced(car, command)
        states[step] = ego_state(car, command)
    return car, states


def ego_state(car: Array, command: Array) -> Array:
    """(11,) of the rear axle: x, y, heading, velocity and acceleration in the body frame, steering, yaw."""
    slope, rate = derivative(car, command), car[YAW_RATE]
    return np.array(
        [
            *(car[X], car[Y], (car[YAW] + math.pi) % (2.0 * math.pi) - math.pi),
            *(car[VX], car[VY] - rate * REAR_TO_CG),
            *(slope[VX] + rate**2 * REAR_TO_CG, slope[VY] - slope[YAW_RATE] * REAR_TO_CG),
            *(car[STEERING], slope[STEERING], rate, slope[YAW_RATE]),
        ]
    )


def advanced(car: Array, command: Array) -> Array:
    """(8,) 0.1 s later; a car does not roll backwards."""
    car, dt = car.copy(), STEP_S / SUBSTEPS
    for _ in range(SUBSTEPS):
        car += dt * derivative(car + dt / 2.0 * derivative(car, command), command)
        car[VX] = max(0.0, car[VX])
    return car


def derivative(car: Array, command: Array) -> Array:
    """(8,) change of the car's state by the second."""
    vx, yaw = car[VX], car[YAW]
    lateral, side = _lateral(vx), car[VY] - car[YAW_RATE] * REAR_TO_CG if vx >= KINEMATIC_BELOW_MPS else 0.0
    vy_rate, yaw_accel = lateral @ car[[VY, YAW_RATE, STEERING]]
    return np.array(
        [
            vx * math.cos(yaw) - side * math.sin(yaw),
            vx * math.sin(yaw) + side * math.cos(yaw),
            car[YAW_RATE],
            car[ACCEL],
            vy_rate,
            yaw_accel,
            *((command - car[[STEERING, ACCEL]]) / ACTUATOR_S),
        ]
    )


def _lateral(vx: float) -> Array:
    """(2, 3): what sideways velocity, yaw rate and steering change sideways velocity and yaw rate by, at a speed."""
    if vx < KINEMATIC_BELOW_MPS:
        turned = KINEMATIC_GAIN * vx / WHEELBASE
        return np.array([[-KINEMATIC_GAIN, 0.0, turned * REAR_TO_CG], [0.0, -KINEMATIC_GAIN, turned]])
    front, rear = FRONT_TO_CG * FRONT_STIFFNESS, REAR_TO_CG * REAR_STIFFNESS
    mass, inertia = MASS * vx, INERTIA * vx
    return -2.0 * np.array(
        [
            [(FRONT_STIFFNESS + REAR_STIFFNESS) / mass, vx / 2.0 + (front - rear) / mass, -FRONT_STIFFNESS / MASS],
            [(front - rear) / inertia, (FRONT_TO_CG * front + REAR_TO_CG * rear) / inertia, -front / INERTIA],
        ]
    )


def linearised(car: Array) -> tuple[Array, Array]:
    """(8, 8), (8, 2): the state 0.1 s later from the state now and a command, linear around the car at the origin.

    The speed in lateral dynamics is held, as AlpaSim holds it.
    """
    slope = np.zeros((N_STATES + N_COMMANDS,) * 2)
    vx = car[VX]
    slope[X, VX] = slope[YAW, YAW_RATE] = slope[VX, ACCEL] = 1.0
    slope[Y, YAW] = vx
    if vx >= KINEMATIC_BELOW_MPS:
        slope[X, YAW] = -(car[VY] - REAR_TO_CG * car[YAW_RATE])
        slope[Y, VY], slope[Y, YAW_RATE] = 1.0, -REAR_TO_CG
    slope[np.ix_((VY, YAW_RATE), (VY, YAW_RATE, STEERING))] = _lateral(vx)
    for command, actuator in enumerate((STEERING, ACCEL)):
        slope[actuator, actuator], slope[actuator, N_STATES + command] = -1.0 / ACTUATOR_S, 1.0 / ACTUATOR_S
    step = expm(STEP_S * slope)
    return step[:N_STATES, :N_STATES], step[:N_STATES, N_STATES:]


def best_command(car: Array, ahead: Array) -> Array:
    """(2,) the first command of the QP; none at all where it has no solution.

    ahead: (20, 3) where the plan is 0.1 .. 2.0 s on, in the car's frame.
    """
    now = car.copy()
    now[: YAW + 1] = 0.0
    step, pushed = linearised(now)
    free, response = np.empty((HORIZON, N_STATES)), np.zeros((HORIZON, N_STATES, HORIZON, N_COMMANDS))
    state, effect = now, pushed
    for k in range(HORIZON):
        state = free[k] = step @ state
        for j in range(HORIZON - k):
            response[j + k, :, j] = effect
        effect = step @ effect
    counted = slice(FIRST_COUNTED - 1, None)  # row k is k + 1 steps ahead
    wanted = np.zeros((HORIZON, N_STATES))
    wanted[:, : YAW + 1] = ahead
    errors, moved = (free - wanted)[counted], response[counted].reshape(-1, N_STATES, HORIZON * N_COMMANDS)
    hessian = np.einsum("kaz,ab,kby->zy", moved, WEIGHTS, moved, optimize=True)
    hessian += np.diag(np.tile(COMMAND_WEIGHTS, HORIZON) + REGULARISATION)
    gradient = np.einsum("kaz,ab,kb->z", moved, WEIGHTS, errors, optimize=True)
    rows = np.concatenate([np.eye(HORIZON * N_COMMANDS), response[:, BOUNDED].reshape(-1, HORIZON * N_COMMANDS)])
    offset = np.concatenate([np.zeros(HORIZON * N_COMMANDS), free[:, BOUNDED].ravel()])
    low = np.concatenate([np.tile(COMMAND_LOW, HORIZON), np.tile(LOW, HORIZON)]) - offset
    high = np.concatenate([np.tile(COMMAND_HIGH, HORIZON), np.tile(HIGH, HORIZON)]) - offset
    return _minimum(hessian, gradient, rows, low, high)[:N_COMMANDS]


def _minimum(hessian: Array, gradient: Array, rows: Array, low: Array, high: Array) -> Array:
    """argmin 1/2 u' H u + g' u, low <= rows u <= high; zeros, as AlpaSim takes them, where nothing keeps the bounds.

    Where the bounds bind, the solver adapts by iterations, never by the clock: the same question, the same bits.
    """
    best: Array = cho_solve(cho_factor(hessian), -gradient)
    reached = rows @ best
    if (reached >= low - WITHIN).all() and (reached <= high + WITHIN).all():
        return best
    solver = osqp.OSQP()
    solver.setup(
        P=sparse.csc_matrix(np.triu(hessian)),
        q=gradient,
        A=sparse.csc_matrix(rows),
        l=low,
        u=high,
        verbose=False,
        max_iter=4000,
        eps_abs=1e-8,
        eps_rel=1e-8,
        adaptive_rho=1,
        adaptive_rho_interval=25,
        check_termination=25,
        warm_starting=False,
        polishing=True,
    )
    result = solver.solve(raise_error=False)
    return np.asarray(result.x, np.float64) if result.info.status.startswith("solved") else np.zeros_like(gradient)

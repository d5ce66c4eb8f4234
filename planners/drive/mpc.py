"""AlpaSim's controllers: an MPC before a dynamic bicycle, by which a plan is followed there.

The rules are those of NVlabs/alpasim 9177bd0, src/controller/alpasim_controller (mpc_controller.py, vehicle_model.py,
mpc_impl, system.py): every 0.1 s the best commands of the next 2 s are looked for, and the first of them drives the car
for 0.1 s, ten midpoint steps of 10 ms. Errors cost nothing in the first 0.9 s, so of a plan only what lies 1.0 to 2.0 s
ahead of each of these instants is looked at.

* Linear, AlpaSim's default: the model is linearised at the car, and commands cost. A QP.
* Nonlinear, the board's: the errors are those of the model itself, by collocation at Radau's two points of each 0.1 s,
  and changes of commands cost, from the last one driven on.

Ours: QPs are solved exactly, where theirs stop at a tolerance, the nonlinear problem by QPs one after the other, where
theirs takes an interior point; poses stay float64.
"""

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from scipy.linalg import expm

from tasks.quadratic import minimum
from tasks.world import frames
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S
from tasks.world.frames import EGO_STATE_SIZE, to_local, wrap_angle

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
PUSHED = np.zeros((N_STATES, N_COMMANDS))  # what commands change the state by, by the second
PUSHED[[STEERING, ACCEL], [0, 1]] = 1.0 / ACTUATOR_S

HORIZON, FIRST_COUNTED = 20, 10  # steps of 0.1 s; errors before the tenth cost nothing
WEIGHTS = np.array([2.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.1])  # along, across, heading, ..., acceleration
COMMAND_WEIGHTS = np.array([5.0, 1.0])
REGULARISATION = 1e-6
DIFFERENCES = np.eye(HORIZON * N_COMMANDS) - np.eye(HORIZON * N_COMMANDS, k=-N_COMMANDS)  # of a command to the next
COMMAND_LOW, COMMAND_HIGH = np.array([-2.0, -9.0]), np.array([2.0, 6.0])

# Of states, (BOUNDED,) each: of the linear problem, and of the nonlinear one.
BOUNDED = (YAW, VX, STEERING, ACCEL)
LOW, HIGH = np.array([-math.pi / 2, 0.0, -math.pi / 4, -8.0]), np.array([math.pi / 2, 35.0, math.pi / 4, 6.0])
BOUNDED_NONLINEAR = (X, Y, YAW, VX, VY, YAW_RATE, STEERING)
HIGH_NONLINEAR = np.array([500.0, 20.0, 0.78, 35.0, 10.0, 3.0, 0.785])
LOW_NONLINEAR = np.where(np.array(BOUNDED_NONLINEAR) == VX, 0.0, -HIGH_NONLINEAR)

RADAU = STEP_S * np.array([[5.0, -1.0], [9.0, 3.0]]) / 12.0  # the states at 1/3 and 1 of a step by the slopes there
SEARCHES = 30  # QPs of a nonlinear problem at most, as iterations there
FOUND = 1e-7  # no command and no state changes by more in the last of them

ControllerName = Literal["linear", "nonlinear"]
Controller = Callable[[Array, Array], Array]  # best command (2,) of a car (8,) and where its plan is (20, 3)


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


def follow(car: Array, plan: Array, steps: int, controller: Controller | None = None) -> tuple[Array, Array]:
    """The car `steps` of 0.1 s on (8,), and the ego's states there (steps, 11), columns of tasks.world.frames.

    plan: (P, 3) world poses of the rear axle at 0.1 s, 0.2 s, ...; after its end its last one holds. controller: one
    for all of a drive, by default the linear one.
    """
    controller = controller or linear_command
    states = np.empty((steps, EGO_STATE_SIZE))
    for step in range(steps):
        index = np.minimum(step + np.arange(HORIZON), len(plan) - 1)
        command = controller(car, to_local(car[: YAW + 1], plan[index]))
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


def jacobians(cars: Array) -> Array:
    """(M, 8, 8) by what the derivatives of cars (M, 8) change with their states."""
    vx, yaw = cars[:, VX], cars[:, YAW]
    slips = vx >= KINEMATIC_BELOW_MPS
    side = slips * (cars[:, VY] - cars[:, YAW_RATE] * REAR_TO_CG)
    ahead, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    slope = np.zeros((len(cars), N_STATES, N_STATES))
    slope[:, : Y + 1, VX], slope[:, : Y + 1, YAW] = ahead.T, (vx * across - side * ahead).T
    slope[:, : Y + 1, VY], slope[:, : Y + 1, YAW_RATE] = (slips * across).T, (-REAR_TO_CG * slips * across).T
    slope[:, YAW, YAW_RATE] = slope[:, VX, ACCEL] = 1.0
    lateral = np.stack([_lateral(speed) for speed in vx])
    fast = -lateral / np.where(slips, vx, 1.0)[:, None, None]  # what falls with the speed, and below what grows with it
    fast[:, 0, 1] -= 2.0
    fast[:, :, 2] = 0.0
    slow = KINEMATIC_GAIN / WHEELBASE * np.array([[0.0, 0.0, REAR_TO_CG], [0.0, 0.0, 1.0]])
    by_speed = np.where(slips[:, None, None], fast, slow)
    slope[:, VY : YAW_RATE + 1, VY : STEERING + 1] = lateral
    slope[:, VY : YAW_RATE + 1, VX] = np.einsum("mab,mb->ma", by_speed, cars[:, VY : STEERING + 1])
    slope[:, STEERING, STEERING] = slope[:, ACCEL, ACCEL] = -1.0 / ACTUATOR_S
    return slope


def linearised(car: Array) -> tuple[Array, Array]:
    """(8, 8), (8, 2): the state 0.1 s later from the state now and a command, linear around the car at the origin.

    The speed in lateral dynamics is held, as AlpaSim holds it.
    """
    slope = np.zeros((N_STATES + N_COMMANDS,) * 2)
    slope[:N_STATES, :N_STATES], slope[:N_STATES, N_STATES:] = jacobians(car[None])[0], PUSHED
    slope[[VY, YAW_RATE], VX] = 0.0
    step = expm(STEP_S * slope)
    return step[:N_STATES, :N_STATES], step[:N_STATES, N_STATES:]


def linear_command(car: Array, ahead: Array) -> Array:
    """(2,) the first command of the linear MPC; none at all where nothing keeps its bounds, as there.

    ahead: (20, 3) where the plan is 0.1 .. 2.0 s on, in the car's frame.
    """
    now = _at_origin(car)
    step, pushed = linearised(now)
    free, response = _unrolled(now, [step] * HORIZON, [pushed] * HORIZON, [0.0] * HORIZON)
    hessian, gradient = _cost(_errors(free, ahead), response)
    hessian += np.diag(np.tile(COMMAND_WEIGHTS, HORIZON) + REGULARISATION)
    rows = response[:, BOUNDED].reshape(-1, HORIZON * N_COMMANDS)
    offset = np.concatenate([np.zeros(HORIZON * N_COMMANDS), free[:, BOUNDED].ravel()])
    low = np.concatenate([np.tile(COMMAND_LOW, HORIZON), np.tile(LOW, HORIZON)]) - offset
    high = np.concatenate([np.tile(COMMAND_HIGH, HORIZON), np.tile(HIGH, HORIZON)]) - offset
    best = minimum(hessian, gradient, rows, low, high)
    return np.zeros(N_COMMANDS) if isinstance(best, str) else best[:N_COMMANDS]


class NonlinearController:
    """The nonlinear MPC of one drive: it begins to search at the commands that it found 0.1 s before."""

    def __init__(self) -> None:
        self._commands = np.zeros((HORIZON, N_COMMANDS))
        self._driven = np.zeros(N_COMMANDS)  # the last one, from which a change costs

    def __call__(self, car: Array, ahead: Array) -> Array:
        """(2,) as `linear_command`'s; of the last QP where they do not settle, none where one has no solution."""
        now = _at_origin(car)
        commands = np.concatenate([self._commands[1:], self._commands[-1:]])
        states = _guess(now, commands)
        for _ in range(SEARCHES):
            change = self._change(now, commands, states, ahead)
            if change is None:
                commands = np.zeros_like(commands)
                break
            commands, states = commands + change[0], states + change[1]
            if max(np.abs(change[0]).max(), np.abs(change[1]).max()) < FOUND:
                break
        self._commands, self._driven = commands, commands[0]
        return self._driven

    def _change(self, now: Array, commands: Array, states: Array, ahead: Array) -> tuple[Array, Array] | None:
        """Of commands (20, 2) and states (20, 2, 8) at Radau's points, to the best of what is linear around them."""
        free, response = _collocated(now, commands, states)
        reached = states.reshape(HORIZON, -1) + free
        errors = _errors(reached[:, N_STATES:], ahead)
        errors[:, YAW] = wrap_angle(errors[:, YAW])  # which the linear one does not
        hessian, gradient = _cost(errors, response[:, N_STATES:])
        weights = np.tile(COMMAND_WEIGHTS, HORIZON)
        changes = DIFFERENCES @ commands.ravel() - np.concatenate([self._driven, np.zeros(commands.size - N_COMMANDS)])
        hessian += DIFFERENCES.T @ (weights[:, None] * DIFFERENCES)
        gradient += DIFFERENCES.T @ (weights * changes)
        bounded = [N_STATES * point + state for point in range(2) for state in BOUNDED_NONLINEAR]
        rows = response[:-1, bounded].reshape(-1, commands.size)  # nothing bounds the last 0.1 s, as there
        offset = np.concatenate([commands.ravel(), reached[:-1, bounded].ravel()])
        low = np.concatenate([np.tile(COMMAND_LOW, HORIZON), np.tile(LOW_NONLINEAR, 2 * HORIZON - 2)]) - offset
        high = np.concatenate([np.tile(COMMAND_HIGH, HORIZON), np.tile(HIGH_NONLINEAR, 2 * HORIZON - 2)]) - offset
        best = minimum(hessian, gradient, rows, low, high)
        if isinstance(best, str):
            return None
        return best.reshape(commands.shape), (free + response @ best).reshape(states.shape)


def controller_of(name: ControllerName) -> Controller:
    """A fresh one, for one drive."""
    return NonlinearController() if name == "nonlinear" else linear_command


def _at_origin(car: Array) -> Array:
    now = car.copy()
    now[: YAW + 1] = 0.0
    return now


def _guess(now: Array, commands: Array) -> Array:
    """(20, 2, 8) states at Radau's points of each step by the linear model."""
    step, pushed = linearised(now)
    ends, _ = _unrolled(now, [step] * HORIZON, [pushed] * HORIZON, commands @ pushed.T)
    begins = np.concatenate([now[None], ends[:-1]])
    return np.stack([begins + (ends - begins) / 3.0, ends], axis=1)


def _collocated(now: Array, commands: Array, states: Array) -> tuple[Array, Array]:
    """How states at both points of each step must change so that the model holds, linear around them: (20, 16), and
    (20, 16, 40) what they change by with the commands."""
    slopes = np.array([[derivative(state, command) for state in both] for both, command in zip(states, commands)])
    bends = jacobians(states.reshape(-1, N_STATES)).reshape(*states.shape, N_STATES)
    begins = np.concatenate([now[None], states[:-1, 1]])
    missed = begins[:, None] + np.einsum("pq,kqa->kpa", RADAU, slopes) - states
    system = np.eye(2 * N_STATES) - np.einsum("pq,kqab->kpaqb", RADAU, bends).reshape(HORIZON, 2 * N_STATES, -1)
    begun, pushed = np.tile(np.eye(N_STATES), (2, 1)), np.kron(RADAU.sum(axis=1)[:, None], PUSHED)
    given = np.concatenate([np.broadcast_to(part, (HORIZON, *part.shape)) for part in (begun, pushed)], axis=2)
    solved = np.linalg.solve(system, np.concatenate([given, missed.reshape(HORIZON, -1, 1)], axis=2))
    steps, pushes, left = np.split(solved, [N_STATES, N_STATES + N_COMMANDS], axis=2)
    return _unrolled(np.zeros(N_STATES), steps, pushes, left[:, :, 0])


def _unrolled(state: Array, steps: Any, pushes: Any, added: Any) -> tuple[Array, Array]:
    """What linear steps from a state (8,) lead to: (20, n) without commands, and (20, n, 40) by all commands.

    Of steps, (n, 8) each by the state before, (n, 2) by the command and (n,) in any case, the last 8 are the state
    after it.
    """
    free, response = [], []
    effect = np.zeros((N_STATES, HORIZON * N_COMMANDS))
    for k, (step, push, more) in enumerate(zip(steps, pushes, added)):
        free.append(step @ state + more)
        effect = step @ effect
        effect[:, N_COMMANDS * k : N_COMMANDS * (k + 1)] += push
        response.append(effect)
        state, effect = free[-1][-N_STATES:], effect[-N_STATES:]
    return np.stack(free), np.stack(response)


def _errors(states: Array, ahead: Array) -> Array:
    """(20, 8) of states (20, 8) from where the plan is (20, 3)."""
    errors = states.copy()
    errors[:, : YAW + 1] -= ahead
    return errors


def _cost(errors: Array, response: Array) -> tuple[Array, Array]:
    """Hessian (40, 40) and gradient (40,), halved, of the errors (20, 8) that count, by their response (20, 8, 40)."""
    errors, moved = errors[FIRST_COUNTED - 1 :], response[FIRST_COUNTED - 1 :]  # row k is k + 1 steps ahead
    hessian = np.einsum("kaz,a,kay->zy", moved, WEIGHTS, moved, optimize=True)
    return hessian, np.einsum("kaz,a,ka->z", moved, WEIGHTS, errors, optimize=True)

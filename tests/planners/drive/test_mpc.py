"""AlpaSim's two MPCs against closed forms, slow twins, and what AlpaSim's own do."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from planners.drive import mpc
from planners.drive.mpc import (
    NonlinearController,
    advanced,
    car_that_moves,
    controller_of,
    derivative,
    follow,
    jacobians,
    linear_command,
    linearised,
)
from tasks.world.frames import VX, YAW_RATE, to_world

JUDGED = json.loads((Path(__file__).parent / "alpasim_judged.json").read_text())
TIMES = 0.1 * np.arange(1, 41)


def moving(speed: float, pose: np.ndarray | None = None) -> np.ndarray:
    """(8,) straight on."""
    pose = np.zeros(3) if pose is None else pose
    return car_that_moves(pose, to_world(pose, np.array([0.5 * speed, 0.0, 0.0])), 0.5)


def straight(speed: float) -> np.ndarray:
    return np.column_stack([speed * TIMES, np.zeros((40, 2))])


@pytest.mark.parametrize("controller", ["linear", "nonlinear"])
@pytest.mark.parametrize("speed", [0.0, 3.0, 8.0, 25.0])
def test_a_straight_plan_at_the_car_s_own_speed_is_followed_exactly(speed: float, controller: str) -> None:
    _, states = follow(moving(speed), straight(speed), 5, controller_of(controller))
    np.testing.assert_allclose(
        states[:, :4], np.column_stack([speed * TIMES[:5], *np.zeros((2, 5)), [speed] * 5]), atol=1e-9
    )


@pytest.mark.parametrize("controller", ["linear", "nonlinear"])
def test_only_what_lies_a_second_and_more_ahead_is_looked_at(controller: str) -> None:
    """Of the plan's instants 0.1 .. 0.9 s and from 2.5 s on none is, over five steps of 0.1 s."""
    plan = straight(8.0)
    expected = follow(moving(6.0), plan, 5, controller_of(controller))[1]
    for instants, same in ((slice(0, 9), True), (slice(24, 40), True), (slice(9, 10), False), (slice(23, 24), False)):
        other = plan.copy()
        other[instants] += 1.0, 2.0, 0.5
        found = follow(moving(6.0), other, 5, controller_of(controller))[1]
        assert (found.tobytes() == expected.tobytes()) == same, instants


@pytest.mark.parametrize("case", JUDGED["followed"], ids=lambda case: f"{case['car'][3]} m/s")
def test_it_drives_as_alpasim_s_own(case: dict[str, list[float]]) -> None:
    """Its solver stops at 1e-4 and its poses are float32."""
    _, states = follow(np.array(case["car"]), np.array(case["plan"]), 5)
    np.testing.assert_allclose(states[:, :3], case["poses"], atol=2e-4)


@pytest.mark.parametrize("case", JUDGED["followed_by_nonlinear"], ids=lambda case: f"{case['car'][3]} m/s")
def test_the_nonlinear_one_drives_as_alpasim_s_own(case: dict[str, list[float]]) -> None:
    """Across 5 m/s, where the model changes, into a stop, and where heading and speed reach their bounds."""
    _, states = follow(np.array(case["car"]), np.array(case["plan"]), len(case["poses"]), NonlinearController())
    np.testing.assert_allclose(states[:, :3], case["poses"], atol=1e-5)


@pytest.mark.parametrize("speed", [2.0, 7.0])
def test_no_other_commands_cost_less_by_the_model_stepped_one_by_one(
    speed: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All twenty commands, found where the solver is asked, against ones beside them."""
    rng, car = np.random.default_rng(0), moving(speed)
    car[[mpc.VY, mpc.YAW_RATE, mpc.STEERING, mpc.ACCEL]] = 0.1, 0.05, 0.02, -0.3
    ahead = np.column_stack([speed * TIMES[:20] + 0.3, 0.05 * TIMES[:20] ** 2, 0.01 * TIMES[:20]])
    asked: list[np.ndarray] = []
    solve = mpc.minimum
    monkeypatch.setattr(mpc, "minimum", lambda *question: asked.append(solve(*question)) or asked[-1])
    linear_command(car, ahead)
    step, pushed = linearised(car)

    def cost(commands: np.ndarray) -> float:
        state, total = car, 1e-6 * (commands**2).sum()
        for k, command in enumerate(commands):
            total += 5.0 * command[0] ** 2 + command[1] ** 2
            state = step @ state + pushed @ command
            if k + 1 >= 10:
                error = state[:3] - ahead[k]
                total += 2.0 * error[0] ** 2 + error[1] ** 2 + error[2] ** 2 + 0.1 * state[mpc.ACCEL] ** 2
        return float(total)

    best = asked[0].reshape(20, 2)
    for _ in range(50):
        assert cost(best + rng.normal(0.0, 1e-3, best.shape)) > cost(best)


@pytest.mark.parametrize("speed", [3.0, 7.0])
def test_no_other_commands_cost_the_nonlinear_one_less_by_the_model_integrated(speed: float) -> None:
    """By another integrator, to a tolerance that is far finer than what the commands beside the best ones cost more."""
    car = moving(speed)
    car[[mpc.VY, mpc.YAW_RATE, mpc.STEERING, mpc.ACCEL]] = 0.05, 0.04, 0.03, -0.3
    ahead = np.column_stack([speed * TIMES[:20] + 0.3, 0.05 * TIMES[:20] ** 2, 0.01 * TIMES[:20]])
    controller, driven = NonlinearController(), np.array([0.1, -0.5])
    controller._driven = driven
    controller(car, ahead)

    def cost(commands: np.ndarray) -> float:
        state, total = car, 0.0
        for k, command in enumerate(commands):
            before = commands[k - 1] if k else driven
            total += 5.0 * (command[0] - before[0]) ** 2 + (command[1] - before[1]) ** 2
            told = solve_ivp(lambda _, now: derivative(now, command), (0.0, 0.1), state, rtol=1e-9, atol=1e-9)  # noqa: B023
            state = told.y[:, -1]
            if k + 1 >= 10:
                error = state[:3] - ahead[k]
                total += 2.0 * error[0] ** 2 + error[1] ** 2 + error[2] ** 2 + 0.1 * state[mpc.ACCEL] ** 2
        return float(total)

    rng, best = np.random.default_rng(0), controller._commands
    least = cost(best)
    for _ in range(10):
        assert cost(best + rng.normal(0.0, 2e-2, best.shape)) > least


def test_derivatives_change_with_the_state_as_their_differences_say() -> None:
    rng = np.random.default_rng(3)
    cars = rng.normal(0.0, [5.0, 5.0, 1.0, 0.0, 0.5, 0.3, 0.2, 1.0], (40, 8))
    cars[:, VX] = rng.uniform(0.0, 12.0, 40)
    cars = cars[np.abs(cars[:, VX] - 5.0) > 1e-3]
    for car, told in zip(cars, jacobians(cars)):
        for state, slope in enumerate(told.T):
            beside = 1e-6 * np.eye(8)[state]
            found = (derivative(car + beside, np.zeros(2)) - derivative(car - beside, np.zeros(2))) / 2e-6
            np.testing.assert_allclose(slope, found, atol=1e-6, rtol=1e-6, err_msg=f"{state} of {car}")


def test_only_the_nonlinear_one_takes_a_heading_for_the_same_a_turn_further() -> None:
    """AlpaSim's wraps the error of the heading there alone."""
    ahead = np.column_stack([7.0 * TIMES[:20], 0.1 * TIMES[:20], 0.05 * TIMES[:20]])
    once, again = (
        [controller_of(name)(moving(7.0), ahead + turn) for turn in ([0.0, 0.0, 0.0], [0.0, 0.0, 2.0 * np.pi])]
        for name in ("nonlinear", "linear")
    )
    np.testing.assert_allclose(once[0], once[1], atol=1e-9)
    assert np.abs(again[0] - again[1]).max() > 0.1


@pytest.mark.parametrize("controller", ["linear", "nonlinear"])
def test_without_a_solution_there_is_no_command(controller: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether bounds exclude each other or the solver gives up."""
    car, stand = moving(12.0), np.zeros((20, 3))
    assert controller_of(controller)(car, stand)[1] < -7.0
    with monkeypatch.context() as patch:
        patch.setattr(mpc, "minimum", lambda *_: "none found")
        assert not controller_of(controller)(car, stand).any()
    monkeypatch.setattr(mpc, "COMMAND_HIGH", np.array([2.0, -9.5]))
    assert not controller_of(controller)(car, stand).any()


@pytest.mark.parametrize("speed", [4.0, 12.0])
def test_the_linear_model_is_the_car_s_own_near_straight_on(speed: float) -> None:
    car, command = moving(speed), np.array([1e-4, 1e-3])
    step, pushed = linearised(car)
    np.testing.assert_allclose(step @ car + pushed @ command, advanced(car, command), rtol=5e-3, atol=2e-7)


def test_a_car_that_is_to_stand_brakes_within_its_bounds_and_stands() -> None:
    car = moving(12.0)
    speeds, accelerations = [], []
    for _ in range(12):
        car, states = follow(car, np.repeat(car[None, :3], 40, axis=0), 5)
        speeds += states[:, VX].tolist()
        accelerations.append(car[mpc.ACCEL])
    assert min(speeds) >= 0.0 and speeds[-1] < 0.01 and -8.0 - 1e-6 <= min(accelerations) < -7.9


def test_a_drive_does_not_depend_on_where_the_world_lies() -> None:
    origin = np.array([300.0, -80.0, 2.1])
    plan = np.column_stack([7.0 * TIMES, 0.2 * TIMES**2, 0.05 * TIMES])
    here, there = follow(moving(8.0), plan, 5)[1], follow(moving(8.0, origin), to_world(origin, plan), 5)[1]
    np.testing.assert_allclose(to_world(origin, here[:, :3]), there[:, :3], atol=1e-9)
    np.testing.assert_allclose(here[:, 3:], there[:, 3:], atol=1e-9)


def test_on_an_arc_the_first_state_has_the_arc_s_yaw_rate() -> None:
    """A chord of 4 m that turns by 0.2 rad in 0.5 s: 2 sin(0.1) / 0.5, as AlpaSim takes it from the quaternion."""
    car = car_that_moves(np.zeros(3), np.array([4.0, 0.4, 0.2]), 0.5)
    assert car[mpc.YAW_RATE] == pytest.approx(4.0 * np.sin(0.1))
    assert car[mpc.VY] == pytest.approx(0.8 + mpc.REAR_TO_CG * car[mpc.YAW_RATE])
    assert mpc.ego_state(car, np.zeros(2))[YAW_RATE] == car[mpc.YAW_RATE]

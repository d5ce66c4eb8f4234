"""The compiled tracker gives the states of the slow twin, whatever the plan, the batch and the frame."""

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tasks.rollout.lqr import STOPPING_SPEED_MPS, track
from tasks.world.frames import AX, AY, HEADING, STEERING, VX, VY, YAW_RATE, Vehicle, X, Y, to_world, wrap_angle
from tests.tasks.rollout import slow_lqr

DRIVEN, MOVED = settings(max_examples=60), settings(max_examples=25)
SPEEDS = st.sampled_from([0.0, 0.19, 0.21, 1.0, 9.0, 30.0, -2.0]) | st.floats(-3.0, 30.0)


@st.composite
def egos(draw: st.DrawFn) -> np.ndarray:
    """Ego states (11,) anywhere, facing anywhere, with a measured motion."""
    state = np.zeros(11)
    state[X], state[Y] = draw(st.floats(-2000.0, 2000.0)), draw(st.floats(-2000.0, 2000.0))
    state[HEADING] = draw(st.sampled_from([0.0, np.pi, -np.pi, 3.1415, 7.0]) | st.floats(-np.pi, np.pi))
    state[VX] = draw(SPEEDS)
    state[[VY, AX, AY]] = draw(st.floats(-0.5, 0.5)), draw(st.floats(-4.0, 3.0)), draw(st.floats(-2.0, 2.0))
    state[STEERING], state[YAW_RATE] = draw(st.floats(-1.2, 1.2)), draw(st.floats(-0.5, 0.5))
    return state


@st.composite
def plans(draw: st.DrawFn, speed: float) -> np.ndarray:
    """Trajectories (K, 40, 3), ego frame: standing, stopping, reversing, fast, tight, straight, noisy, wrapping."""
    n_plans = draw(st.integers(1, 7))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["steady", "free", "standing", "stopping", "other speed"]))
    speeds = {
        "steady": np.full((n_plans, 40), speed),
        "free": speed + np.cumsum(rng.normal(0.0, 0.4, (n_plans, 40)), axis=1),
        "standing": np.zeros((n_plans, 40)),
        "stopping": np.maximum(speed - rng.uniform(0.5, 5.0, (n_plans, 1)) * 0.1 * np.arange(40), 0.0),
        "other speed": np.broadcast_to(rng.uniform(-4.0, 35.0, (n_plans, 1)), (n_plans, 40)),
    }[kind]
    curvature = rng.normal(0.0, draw(st.sampled_from([0.0, 0.01, 0.1, 0.5])), (n_plans, 1)) * np.ones((1, 40))
    heading = np.cumsum(0.1 * np.clip(speeds * curvature, -2.0, 2.0), axis=1)
    ahead = np.cumsum(speeds * 0.1 * np.exp(1j * heading), axis=1)
    poses = np.stack([ahead.real, ahead.imag, heading], axis=-1)
    poses += draw(st.sampled_from([0.0, 1e-3, 0.1])) * rng.normal(size=poses.shape)
    if draw(st.booleans()):
        poses[..., 2] = wrap_angle(poses[..., 2])
    return poses


@st.composite
def drives(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    ego = draw(egos())
    return ego, draw(plans(ego[VX]))


def apart(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Greatest difference (11,) per column, headings as directions."""
    difference = here - there
    difference[..., HEADING] = wrap_angle(difference[..., HEADING])
    return np.abs(difference).max(axis=(0, 1))


def well_posed(states: np.ndarray, reference: np.ndarray) -> bool:
    """No speed is so near the stopping controller's limit that the last bit chooses the controller, and no plan moves
    so little, yet not nothing, that the twin's elimination loses the digits of its curvature (see test_profiles)."""
    planned = slow_lqr.velocity_profile(reference)
    speeds = np.concatenate([states[..., VX], planned], axis=1)
    moved = np.sum((0.1 * planned) ** 2, axis=1)
    return bool(np.abs(speeds - STOPPING_SPEED_MPS).min() > 1e-9 and np.all((moved == 0.0) | (moved > 1e-2)))


def twin(ego: np.ndarray, poses: np.ndarray, vehicle: Vehicle, starts: np.ndarray | None = None) -> np.ndarray:
    """States of the slow twin; drives that are not well posed are left out of the test."""
    states = slow_lqr.track(ego, poses, vehicle, planned_pose0=starts)
    first = np.broadcast_to(ego[:3] if starts is None else starts, (len(poses), 3))[:, None]
    assume(well_posed(states, np.concatenate([first, poses], axis=1)))
    return states


@DRIVEN
@given(drive=drives(), wheel_base=st.sampled_from([3.089, 2.5]))
def test_states_equal_the_slow_twin(drive: tuple[np.ndarray, np.ndarray], wheel_base: float):
    ego, local = drive
    poses, vehicle = to_world(ego[:3], local), Vehicle(wheel_base=wheel_base)
    expected = twin(ego, poses, vehicle)
    states = track(ego, poses, vehicle)
    assert np.array_equal(states[:, 0], np.tile(ego, (len(poses), 1)))
    assert apart(states, expected).max() < 1e-9


@DRIVEN
@given(drive=drives(), seed=st.integers(0, 99))
def test_a_plan_that_starts_beside_the_ego_equals_the_slow_twin(drive: tuple[np.ndarray, np.ndarray], seed: int):
    ego, local = drive
    poses = to_world(ego[:3], local)
    starts = ego[:3] + np.random.default_rng(seed).normal(0.0, [1.0, 1.0, 0.2], (len(poses), 3))
    expected = twin(ego, poses, Vehicle(), starts)
    assert apart(track(ego, poses, planned_pose0=starts), expected).max() < 1e-9


@MOVED
@given(drive=drives())
def test_ego_frame_trajectories_drive_as_their_world_poses_do(drive: tuple[np.ndarray, np.ndarray]):
    ego, local = drive
    poses = to_world(ego[:3], local)
    twin(ego, poses, Vehicle())  # leaves out what is not well posed
    difference = apart(track(ego, local, local=True), track(ego, poses))
    assert difference[: HEADING + 1].max() < 1e-11
    assert difference.max() < 1e-9


@MOVED
@given(drive=drives(), shift=st.tuples(*[st.floats(-1000.0, 1000.0)] * 2), turn=st.floats(-np.pi, np.pi))
def test_shifting_and_rotating_the_world_moves_the_states_with_it(
    drive: tuple[np.ndarray, np.ndarray], shift: tuple[float, float], turn: float
):
    ego, local = drive
    twin(ego, to_world(ego[:3], local), Vehicle())
    frame = np.array([*shift, turn])
    moved_ego = ego.copy()
    moved_ego[:3] = to_world(frame, ego[:3])
    expected = track(ego, local, local=True)
    expected[..., :3] = to_world(frame, expected[..., :3])
    assert apart(track(moved_ego, local, local=True), expected).max() < 1e-8


@MOVED
@given(drive=drives(), n_plans=st.integers(1, 150), seed=st.integers(0, 99))
def test_neither_order_nor_chunks_change_a_bit(drive: tuple[np.ndarray, np.ndarray], n_plans: int, seed: int):
    ego, few = drive
    rng = np.random.default_rng(seed)
    local = few[rng.integers(len(few), size=n_plans)] + rng.normal(0.0, 0.05, (n_plans, 40, 3))
    together = track(ego, local, local=True)
    order = rng.permutation(n_plans)
    assert np.array_equal(track(ego, local[order], local=True), together[order])
    cuts = np.sort(rng.integers(0, n_plans + 1, size=3))
    chunks = [track(ego, chunk, local=True) for chunk in np.split(local, cuts)]
    assert np.array_equal(np.concatenate(chunks), together)

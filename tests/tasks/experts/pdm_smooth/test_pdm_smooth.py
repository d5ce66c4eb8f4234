"""The smooth planner on a straight road: what its motion keeps, whom it stops for, and that its plans agree."""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest

from tasks.experts.pdm_closed.forecast import forecast
from tasks.experts.pdm_closed.planner import PdmClosed
from tasks.experts.pdm_smooth.paths import bend_speeds, line_ahead, merging_paths
from tasks.experts.pdm_smooth.planner import PdmSmooth, plan_smooth
from tasks.experts.pdm_smooth.proposals import SAMPLES, SmoothDriver, smooth_proposals, smooth_step, wanted_accel
from tasks.experts.pdm_smooth.settings import DEFAULTS, SmoothSettings
from tasks.experts.protocol import Expert, Plan
from tasks.reward.rules.comfort import extended_comfort
from tasks.rollout.lqr import track
from tasks.stages import Rejected
from tasks.world.agents import AgentKind, AgentTracks
from tasks.world.clip import HISTORY_STEPS, NOW, Scene
from tasks.world.frames import to_local, to_world
from tasks.world.kinematic_vocabulary import kinematic_trajectories
from tasks.world.vehicle import AX, EGO_STATE_SIZE, HEADING, PACIFICA, STEERING, VX, X, Y
from tests.tasks.experts import slow_pdm
from tests.tasks.experts.pdm_closed.test_pdm_twin import SHAPES, World, world_of

Road = Callable[..., Scene]
Objects = Callable[..., AgentTracks]
RNG = np.random.default_rng(0)  # not drawn from
CAR = (4.5, 2.0)
DRIVER = SmoothDriver(*(getattr(DEFAULTS, name) for name in SmoothDriver._fields))


def moving_as(scene: Scene, **columns: float) -> Scene:
    """The scene with the ego's present state changed."""
    history = scene.ego_history.copy()
    for name, value in columns.items():
        history[-1, {"accel": AX, "steering": STEERING, "heading": HEADING, "speed": VX}[name]] = value
    return replace(scene, ego_history=history)


def test_idm_keeps_the_speed_where_the_closed_form_says_so() -> None:
    speed, target = 8.0, 15.0
    gap = (DRIVER.min_gap_m + speed * DRIVER.headway_s) / np.sqrt(1.0 - (speed / target) ** DRIVER.exponent)
    np.testing.assert_allclose(wanted_accel(speed, gap, speed, target, DRIVER), 0.0, atol=1e-12)
    free = wanted_accel(16.0, 1e9, 16.0, 8.0, DRIVER)
    np.testing.assert_allclose(free, -DRIVER.decel_comfort_mps2 * (1.0 - 0.5**4.0), atol=1e-9)
    assert wanted_accel(10.0, 0.0, 0.0, 15.0, DRIVER) == -DRIVER.decel_max_mps2


def test_acceleration_tends_to_what_is_wanted_within_the_bound_of_jerk() -> None:
    speed, accel, way = 5.0, 0.0, 0.0
    for step in range(1, 41):
        moved, speed, accel = smooth_step(speed, accel, 1.0, DRIVER)
        way += moved
        np.testing.assert_allclose(accel, 1.0 - 0.9**step)
    _, _, after = smooth_step(10.0, 2.0, -3.0, DRIVER)
    np.testing.assert_allclose(after, 2.0 - 0.1 * DRIVER.jerk_max_mps3)
    assert smooth_step(0.05, -2.0, -3.0, DRIVER)[1:] == (0.0, 0.0), "it stands, and does not roll back"


@pytest.mark.parametrize("state", [{"accel": 1.5}, {"accel": -2.5, "steering": 0.1}, {"heading": 0.2}, {"speed": 0.5}])
def test_every_proposal_continues_the_ego_s_motion_within_the_bounds(road: Road, state: dict[str, float]) -> None:
    scene = moving_as(road(speed=9.0, y=1.2), **state)
    found = plan_smooth(scene)
    assert found is not None
    ego, motion, poses = scene.ego_state, found.proposals.motion, found.proposals.poses
    assert len(poses) == len(DEFAULTS.speed_fractions) * len(DEFAULTS.lateral_offsets_m) * len(DEFAULTS.merge_s)
    np.testing.assert_allclose(poses[:, 0], np.broadcast_to(ego[: HEADING + 1], (len(poses), 3)), atol=5e-3)
    np.testing.assert_array_equal(motion[:, 0, 1:], np.broadcast_to(ego[[VX, AX]], (len(poses), 2)))
    way, speed, accel = np.moveaxis(motion, -1, 0)
    assert (speed >= 0.0).all()
    driving = speed[:, 1:] > 0.0
    jerk = np.diff(accel, axis=1) / 0.1
    assert np.abs(jerk[driving]).max() < DEFAULTS.jerk_max_mps3 + 1e-9
    np.testing.assert_allclose(np.diff(way, axis=1)[driving], (0.1 * (speed[:, 1:] + speed[:, :-1]) / 2.0)[driving])
    step = np.hypot(*np.moveaxis(np.diff(poses[..., :2], axis=1), -1, 0))
    np.testing.assert_allclose(step, np.diff(way, axis=1), atol=0.01)  # poses are as far apart as it drives


def slow_drive(world: World, limit_mps: float, settings: SmoothSettings) -> tuple[np.ndarray, np.ndarray]:
    """poses and motion of the proposals, leads found with shapely, one proposal and step after the other."""
    ego = world.ego_state
    line = line_ahead(world.centerline, ego, settings.line_smoothing_m)
    assert line is not None
    laid = merging_paths(line, ego, settings.lateral_offsets_m, settings.merge_s, settings.merge_least_m)
    bends = bend_speeds(laid, settings.lateral_accel_max_mps2, settings.bend_decel_mps2)
    paths = [slow_pdm.drive_path(np.stack(xyh, axis=1)) for xyh in zip(laid.x, laid.y, laid.heading)]
    seen = slow_pdm.forecast(ego, world.agents, world.lights)
    targets = np.array(settings.speed_fractions) * limit_mps
    reach_m = max(targets.max(), ego[VX]) * 4.0
    traffic = slow_pdm._traffic(paths, np.zeros(len(paths)), reach_m, seen, PACIFICA)
    poses, motions = [], []
    for p in range(len(paths) * len(targets)):
        path, target = p // len(targets), targets[p % len(targets)]
        motion = np.array([0.0, max(ego[VX], 0.0), ego[AX]])
        rows, moved = [paths[path].at(np.array(0.0))], [motion]
        for step in range(1, 41):
            before = np.array([[motion[0], motion[1]]]), rows[-1][None]
            lead = np.nan_to_num(slow_pdm._leads(paths, np.array([path]), traffic, step // 2, *before, PACIFICA))[0]
            k = min(
                np.searchsorted(laid.progress[path], motion[0] + motion[1] * settings.response_s), len(bends[0]) - 1
            )
            wanted = wanted_accel(
                motion[1], lead[0] - motion[0] - lead[2], lead[1], min(target, bends[path, k]), DRIVER
            )
            ahead, speed, accel = smooth_step(motion[1], motion[2], wanted, DRIVER)
            motion = np.array([motion[0] + ahead, speed, accel])
            rows.append(paths[path].at(np.array(motion[0])))
            moved.append(motion)
        poses.append(rows)
        motions.append(moved)
    return np.array(poses), np.array(motions)


@pytest.mark.parametrize(("shape", "seed"), [(shape, seed) for shape in SHAPES[:4] for seed in (3, 4)])
def test_proposals_equal_their_slow_twin(shape: str, seed: int) -> None:
    world = world_of(shape, 30, False, False, seed)
    few = SmoothSettings(speed_fractions=(0.4, 1.0), lateral_offsets_m=(0.0, 1.0), merge_s=(3.0,))
    line = line_ahead(world.centerline, world.ego_state, few.line_smoothing_m)
    assert line is not None and SAMPLES == 21
    seen = forecast(world.ego_state, world.agents, world.lights)
    fast = smooth_proposals(world.ego_state, line, seen, 10.0, few)
    poses, motion = slow_drive(world, 10.0, few)
    np.testing.assert_allclose(fast.motion, motion, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(fast.poses[..., :2], poses[..., :2], rtol=0.0, atol=1e-8)


def test_a_standing_car_ahead_is_stopped_for(road: Road, objects: Objects) -> None:
    blocked = road(speed=8.0, agents=objects([[85.0, 0.0, 0.0, *CAR]], [0.0], [AgentKind.VEHICLE]))
    found = plan_smooth(blocked)
    assert found is not None
    front = found.proposals.poses[:, -1, 0] + PACIFICA.front_length
    assert (front < 85.0 - CAR[0] / 2.0).all()
    assert found.scores.nc[found.chosen] == 1.0 and found.simulated[found.chosen, -1, VX] < 4.0


def test_a_red_light_is_stopped_for_and_a_green_one_is_not(road: Road) -> None:
    ends = []
    for red in (True, False):
        found = plan_smooth(road(speed=10.0, red=red, limit=12.0))
        assert found is not None
        ends.append(found.simulated[found.chosen, -1, X] + PACIFICA.front_length)
    assert ends[0] < 100.0 < 120.0 < ends[1] + 35.0


def test_the_lane_s_middle_is_come_back_to(road: Road) -> None:
    found = plan_smooth(moving_as(road(speed=9.0, y=1.4), heading=0.1))
    assert found is not None and found.scores.lk[found.chosen] == 1.0
    assert abs(found.simulated[found.chosen, -1, Y]) < 0.5


def half_a_second_later(scene: Scene, states: np.ndarray) -> Scene:
    """The scene after five steps of a drive (41, 11)."""
    history = np.concatenate([scene.ego_history, states[1:6]])[-HISTORY_STEPS - 1 :]
    return replace(scene, step=scene.step + 5, ego_history=history)


def ec_rms(scene: Scene, expert: Expert, kicked: float) -> np.ndarray:
    """(4,) of extended comfort, of two plans half a second apart; the car does as planned, but for a kick."""
    driven = []
    for _ in range(2):
        plan = expert.plan(scene, RNG)
        assert isinstance(plan, Plan)
        driven.append(track(scene.ego_state, plan.poses[None]))
        scene = moving_as(half_a_second_later(scene, driven[-1][0]), accel=driven[0][0, 5, AX] + kicked)
    return extended_comfort(driven[1], driven[0]).rms[0]


@pytest.mark.parametrize(("y", "kicked"), [(0.0, 0.0), (0.0, 0.8), (1.0, 0.0), (-1.5, -0.8)])
def test_two_plans_half_a_second_apart_agree_as_extended_comfort_asks(road: Road, y: float, kicked: float) -> None:
    scene = replace(road(speed=9.0, y=y, step=NOW + 10, limit=12.0))
    assert (ec_rms(scene, PdmSmooth(), kicked) <= [0.7, 0.5, 0.1, 0.1]).all()


def perturbed_drives(count: int) -> list[np.ndarray]:
    """(41, 11) each: drives of the kinematic vocabulary that end at x = 50 m, near the lane's middle and turned to it.

    As candidates lead there: at 10 to 15 km/h and more, up to 1.5 m and 0.2 rad off.
    """
    rng, drives = np.random.default_rng(5), []
    for trajectory in kinematic_trajectories(200, 5):
        ego = np.zeros(EGO_STATE_SIZE)
        ego[VX] = 10.0 * np.hypot(*(trajectory[1] - trajectory[0])[:2])
        states = track(ego, trajectory[None])[0]
        end = np.array([50.0, rng.uniform(-1.5, 1.5), rng.uniform(-0.2, 0.2)])
        if 3.0 < ego[VX] < 13.0 and states[-1, VX] > 2.0:
            states[:, : HEADING + 1] = to_world(end, to_local(states[-1, : HEADING + 1], states[:, : HEADING + 1]))
            drives.append(states)
    return drives[:count]


@pytest.mark.slow
def test_from_perturbed_states_its_plans_agree_more_often_than_pdm_closed_s(road: Road) -> None:
    """What it is for. The second plan is made half a second on along the perturbation, which followed neither."""
    agree = {PdmClosed: 0.0, PdmSmooth: 0.0}
    for kind in agree:
        for states in perturbed_drives(24):
            driven = []
            for step in (50, 55):
                scene = road(limit=13.0, step=NOW)
                history = states[step - 15 - HISTORY_STEPS : step - 14]
                plan = kind().plan(replace(scene, step=step, ego_history=history), RNG)
                assert isinstance(plan, Plan)
                driven.append(track(history[-1], plan.poses[None]))
            agree[kind] += float(extended_comfort(driven[1], driven[0]).ec[0]) / 24.0
    assert agree[PdmSmooth] > 0.4 > 0.3 > agree[PdmClosed], agree


def test_hardly_any_route_is_no_plan(road: Road) -> None:
    scene = road()
    ended = replace(scene, centerline=scene.centerline[:45])
    result = PdmSmooth().plan(ended, RNG)
    assert isinstance(result, Rejected) and (result.stage, result.reason) == ("expert", "no_plan")


def test_every_setting_is_in_the_digest() -> None:
    digests = {PdmSmooth().digest()}
    for field in fields(SmoothSettings):
        value = getattr(DEFAULTS, field.name)
        other = (*value, 0.5) if isinstance(value, tuple) else value * 1.5
        digests.add(PdmSmooth(replace(DEFAULTS, **{field.name: other})).digest())
    assert len(digests) == len(fields(SmoothSettings)) + 1


@pytest.mark.parametrize(("name", "value"), [("merge_s", (0.0,)), ("speed_fractions", ()), ("response_s", 0.0)])
def test_settings_that_make_no_sense_are_refused(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        SmoothSettings(**{name: value})  # type: ignore[arg-type]

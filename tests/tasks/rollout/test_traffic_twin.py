"""The traffic against its slow twin: the same to the last bit."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tasks.rollout.idm import AgentStates, IdmDriver
from tasks.rollout.lane_following import NEVER
from tasks.rollout.simulate import (
    SHORTEST_HEADWAY_S,
    TrafficScene,
    TrafficSettings,
    next_scene,
    prepare_traffic,
    roll_out,
)
from tasks.world.clip import NOW, AgentTracks, Rollout
from tasks.world.frames import HEADING, PACIFICA, VX, X, Y
from tests.tasks.rollout import slow_idm, worlds

Array = NDArray[np.float64]

IDM = TrafficSettings()
BOTH = pytest.mark.parametrize("yields", [False, True])
seeds = st.integers(0, 2**31)


def slow_roll_out(traffic: TrafficScene, ego_states: Array) -> Rollout:
    """As `roll_out`, by the twin that looks at every pair at every step."""
    scene, of = traffic.scene, traffic.settings
    window = scene.agents.window(scene.step, scene.step + 41)
    assert traffic.roles is not None and traffic.paths is not None
    heading, speed = ego_states[:, HEADING], ego_states[:, VX]
    cos, sin = np.cos(heading), np.sin(heading)
    size = np.full((41, 2), (PACIFICA.length, PACIFICA.width))
    x, y = (ego_states[:, k] + PACIFICA.rear_axle_to_center * d for k, d in ((X, cos), (Y, sin)))
    headway_s = of.headway_s if traffic.yielding is None else min(of.headway_s, SHORTEST_HEADWAY_S)
    driver = IdmDriver(
        of.min_gap_m, headway_s, of.accel_max, of.decel_max, of.exponent, of.emergency_decel, of.lookahead_m,
        of.blend_length_m,
    )  # fmt: skip
    boxes, velocities, valid, center_z, driven = slow_idm.drive(
        scene.step,
        slow_world(scene.clip.agents, slice(None)),
        slow_world(scene.agents, scene.step),
        traffic.roles,
        traffic.paths,
        np.column_stack([x, y, heading, size]),
        np.column_stack([cos * speed, sin * speed]),
        driver,
        traffic.yielding is not None,
        traffic.yielding or prepare_traffic(scene, IDM).yielding,  # type: ignore[arg-type]
    )
    agents = replace(window, boxes=boxes, velocities=velocities, valid=valid, center_z=center_z)
    return Rollout(scene.step, ego_states, agents, driven)


def slow_world(agents: AgentTracks, steps: int | slice) -> AgentStates:
    return AgentStates(
        *(np.ascontiguousarray(a[steps]) for a in (agents.boxes, agents.velocities, agents.valid, agents.center_z))
    )


def stages(seed: int, of: TrafficSettings = IDM) -> list[tuple[TrafficScene, Array]]:
    """A random world and eight egos in it, and the world that the first of them leaves behind, with eight others."""
    scene = worlds.random_scene(seed)
    egos = worlds.random_egos(scene, seed, 8)
    first = prepare_traffic(scene, of)
    after = next_scene(scene, roll_out(first, egos[0]), scene.centerline)
    return [(first, egos), (prepare_traffic(after, of), worlds.random_egos(after, seed + 1, 8))]


def assert_same(rollout: Rollout, other: Rollout) -> None:
    for name in ("boxes", "velocities", "valid", "center_z"):
        assert getattr(rollout.agents, name).tobytes() == getattr(other.agents, name).tobytes(), name
    assert rollout.simulated.tolist() == other.simulated.tolist()


@BOTH
@given(seed=seeds)
@settings(max_examples=6)
def test_the_traffic_equals_its_slow_twin(yields: bool, seed: int) -> None:
    for traffic, egos in stages(seed, TrafficSettings(yields=yields)):
        for ego in egos[:2]:
            assert_same(roll_out(traffic, ego), slow_roll_out(traffic, ego))


@BOTH
@given(
    seed=seeds, blend_length_m=st.sampled_from([0.5, 3.0, 20.0]), lookahead_m=st.sampled_from([3.0, 25.0, 200.0])
)  # fmt: skip
@settings(max_examples=8)
def test_so_it_does_under_other_settings(yields: bool, seed: int, blend_length_m: float, lookahead_m: float) -> None:
    """Also where the corridor reaches beyond the path's end."""
    of = TrafficSettings(
        blend_length_m=blend_length_m, lookahead_m=lookahead_m, min_gap_m=3.0, emergency_decel=5.0, yields=yields
    )
    for traffic, egos in stages(seed, of):
        assert_same(roll_out(traffic, egos[0]), slow_roll_out(traffic, egos[0]))


def train(rng: np.random.Generator) -> list[worlds.Track]:
    """A cab with one trailer or two on the lane of the random worlds, from some step on."""
    x, speed, first = rng.uniform(-60.0, 30.0), rng.uniform(2.0, 10.0), int(rng.choice([0, 0, NOW + 5, NOW + 20]))
    return [
        worlds.Track(x - 7.3 * k, rng.normal(0.0, 0.2), 0.0, speed, size=(8.0 - k, 2.5), first=first + (k % 2))
        for k in range(rng.integers(2, 4))
    ][:: rng.choice([-1, 1])]


@BOTH
@given(seed=seeds)
@settings(max_examples=10)
def test_a_train_in_a_crowd_equals_its_slow_twin(yields: bool, seed: int) -> None:
    of, crowd = TrafficSettings(yields=yields), worlds.random_scene(seed)
    scene = worlds.with_members(crowd, *train(np.random.default_rng(seed)))
    egos = worlds.random_egos(scene, seed, 3)
    first = prepare_traffic(scene, of)
    assert first.roles is not None and (first.roles.first_part[-2:] != np.arange(len(scene.agents))[-2:]).any()
    after = next_scene(scene, roll_out(first, egos[0]), scene.centerline)
    for traffic in (first, prepare_traffic(after, of)):
        for ego in egos:
            assert_same(roll_out(traffic, ego), slow_roll_out(traffic, ego))


def test_what_a_log_does_on_one_map_is_not_told_of_it_on_another() -> None:
    """Who comes onto a lane later is kept for the attempts that ask again."""
    later = 0
    for seed in range(8):
        scene = worlds.random_scene(seed)
        nowhere = replace(scene, clip=replace(scene.clip, road_map=replace(scene.clip.road_map, lanes={})))
        first, other, again = (prepare_traffic(s, IDM).roles for s in (scene, nowhere, scene))
        assert first is not None and other is not None and again is not None
        later += int(((first.join_step > scene.step) & (first.join_step < NEVER)).sum())
        assert (other.path < 0).all(), "on a map without lanes nobody has a path on one"
        assert again.join_step.tolist() == first.join_step.tolist()
    assert later > 0


def test_the_random_worlds_reach_every_rule() -> None:
    """Someone brakes on its log, someone waits, someone is kept out, and what the ego does changes what others do."""
    braked, waited, kept_out, answers = 0, 0, 0, 0
    for seed in range(30):
        for traffic, egos in stages(seed):
            assert traffic.roles is not None
            start, log = traffic.scene.step, traffic.scene.clip.agents
            logged = log.window(start, start + 41)
            rollouts = [roll_out(traffic, ego) for ego in egos]
            for rollout in rollouts:
                agents = rollout.agents
                walks = traffic.roles.moving_kind & (traffic.roles.logged_path < 0) & ~rollout.simulated
                late = (
                    (agents.boxes != logged.boxes).any(axis=(0, 2))
                    & agents.valid.all(axis=0)
                    & logged.valid.all(axis=0)
                )
                braked += int((rollout.simulated & (traffic.roles.path < 0)).sum())
                waited += int((walks & late & ~traffic.roles.standing).sum())
                kept_out += int((logged.valid & ~agents.valid).any(axis=0).sum())
                answers += agents.boxes.tobytes() != rollouts[0].agents.boxes.tobytes()
    assert min(braked, waited, kept_out, answers) > 20

"""Reactive traffic on the two Argoverse 2 logs: nobody jumps, nobody drives into anybody that the log kept apart."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from factory.datasets.av2.reader import AV2Reader
from tasks.rollout.corridor import boxes_overlap
from tasks.rollout.simulate import TrafficSettings, next_scene, simulate
from tasks.world.clip import HORIZON_STEPS, NOW, STEP_S, AgentKind, AgentTracks, Clip, Rollout, Scene, scene_of_clip
from tasks.world.frames import wrap_angle

GRAZE_M = 0.1  # boxes are annotated by hand: smaller by this on each side before they count as touching


@pytest.fixture(scope="module")
def clips(shared_root: Path) -> list[Clip]:
    reader = AV2Reader(shared_root / "data" / "av2" / "sensor" / "val")
    return [reader.read(ref) for ref in reader.index().refs[::3]]


def two_rollouts(clip: Clip, settings: TrafficSettings) -> list[tuple[Scene, Rollout]]:
    """H seconds against the logged ego, and H more from the simulated world."""
    out: list[tuple[Scene, Rollout]] = []
    scene = scene_of_clip(clip)
    for _ in range(2):
        rollout = simulate(scene, clip.ego_states[scene.step + 1 : scene.step + 1 + HORIZON_STEPS, :3], settings)
        out.append((scene, rollout))
        scene = next_scene(scene, rollout, clip.centerline)
    return out


def touching(agents: AgentTracks) -> set[tuple[int, int]]:
    """Pairs with a vehicle in them whose boxes share area at some step."""
    boxes = agents.boxes - [0.0, 0.0, 0.0, 2 * GRAZE_M, 2 * GRAZE_M]
    is_vehicle = np.array([kind == AgentKind.VEHICLE for kind in agents.kinds])
    pairs = set()
    for step in range(0, agents.n_steps, 2):
        present = np.flatnonzero(agents.valid[step])
        for i, j in combinations(present.tolist(), 2):
            if (is_vehicle[i] or is_vehicle[j]) and boxes_overlap(boxes[step, i], boxes[step, j]):
                pairs.add((i, j))
    return pairs


def test_driven_cars_hardly_ever_touch_what_the_log_kept_apart(clips: list[Clip]) -> None:
    new, logged = 0, 0
    for clip in clips:
        in_log = touching(clip.agents.window(NOW, NOW + 2 * HORIZON_STEPS + 1))
        simulated = set().union(*(touching(rollout.agents) for _, rollout in two_rollouts(clip, TrafficSettings())))
        new, logged = new + len(simulated - in_log), logged + len(in_log)
    assert logged > 20, "the log's own boxes do touch"
    assert new <= 1  # a bus that squeezes in beside a car


def test_driven_cars_move_as_their_velocity_says_and_turn_like_cars(clips: list[Clip]) -> None:
    for clip in clips:
        for scene, rollout in two_rollouts(clip, TrafficSettings()):
            agents = rollout.agents
            assert np.array_equal(agents.boxes[0], scene.agents.boxes[scene.step], equal_nan=True)
            driven = rollout.simulated
            both = (agents.valid[1:] & agents.valid[:-1])[:, driven]
            moved = np.hypot(*np.moveaxis(np.diff(agents.boxes[:, driven, :2], axis=0), -1, 0))
            speed: NDArray[np.float64] = np.hypot(*np.moveaxis(agents.velocities[:, driven], -1, 0))
            expected = 0.5 * STEP_S * (speed[1:] + speed[:-1])
            difference = np.abs(moved - expected)[both]
            assert difference.max(initial=0.0) < 0.25
            assert (difference < 0.05).mean() > 0.98  # logged velocities are smoothed before a late entrant is driven
            turned = np.abs(wrap_angle(np.diff(agents.boxes[:, driven, 2], axis=0)))[both]
            assert turned.max(initial=0.0) < 0.15


def test_no_vehicle_stops_harder_than_tyres_can(clips: list[Clip]) -> None:
    """Also not one that replays its log towards a driven car."""
    settings = TrafficSettings()
    for clip in clips:
        is_vehicle = np.array([kind == AgentKind.VEHICLE for kind in clip.agents.kinds])
        for _, rollout in two_rollouts(clip, settings):
            agents = rollout.agents
            speed: NDArray[np.float64] = np.hypot(*np.moveaxis(agents.velocities, -1, 0))
            lost = -np.diff(speed, axis=0)[(agents.valid[1:] & agents.valid[:-1]) & is_vehicle]
            assert lost.max(initial=0.0) < settings.emergency_decel * STEP_S + 0.3  # logged velocities are noisy


def test_driven_cars_stay_within_reach_of_a_lane(clips: list[Clip]) -> None:
    """At the end of H, 9 of 10 are within 2.5 m of a centreline; the others drove straight on off the map's crop."""
    distances = []
    for clip in clips:
        centers = np.concatenate([lane.centerline[:, :2] for lane in clip.road_map.lanes.values() if lane.drives_cars])
        low, high = centers.min(axis=0), centers.max(axis=0)
        rollout = two_rollouts(clip, TrafficSettings())[0][1]
        for x, y in rollout.agents.boxes[-1, rollout.simulated, :2]:
            if (low < (x, y)).all() and ((x, y) < high).all():
                distances.append(np.hypot(centers[:, 0] - x, centers[:, 1] - y).min())
    assert np.mean(np.array(distances) < 2.5) > 0.9


def test_who_follows_a_stopping_ego_stops_behind_it(clips: list[Clip]) -> None:
    """The ego brakes at 3 m/s2 wherever it is: no driven car runs into its back."""
    for clip in clips:
        scene = scene_of_clip(clip)
        x, y, heading, speed = scene.ego_state[:4]
        time = STEP_S * np.arange(1, HORIZON_STEPS + 1)
        time = np.minimum(time, speed / 3.0)
        way = speed * time - 1.5 * time**2
        poses = np.column_stack([x + way * np.cos(heading), y + way * np.sin(heading), np.full(len(way), heading)])
        rollout = simulate(scene, poses, TrafficSettings())
        for step, state in enumerate(rollout.ego_states):
            c, s = np.cos(state[2]), np.sin(state[2])
            rear = np.array([state[0] - 0.2 * c, state[1] - 0.2 * s, state[2], 1.6, 1.8])  # the last two metres
            for box in rollout.agents.boxes[step, rollout.simulated & rollout.agents.valid[step]]:
                assert not boxes_overlap(rear, box)

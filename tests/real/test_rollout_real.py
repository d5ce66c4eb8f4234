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

"""Pairs of frames of a benchmark: the earlier one lies on the way to the later one, and shares what became of it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tasks.attempt import Judged, perturbed_scene
from tasks.hard_scenes import BenchmarkClip, drive_follow_up, frame_digest, seen_half_a_second_earlier
from tasks.rollout.simulate import TrafficSettings
from tasks.stages import FRAMES, Rejected
from tasks.world.clip import HISTORY_STEPS, HORIZON_STEPS, NOW, Clip, Rollout, Scene
from tests.tasks.streets import street_clip
from tests.tasks.test_attempt import first_stage

BEFORE = NOW + 35  # T+H - 0.5 s


@pytest.fixture(scope="module")
def clip() -> Clip:
    return street_clip()


@pytest.fixture(scope="module")
def stage_one(clip: Clip) -> Rollout:
    return first_stage(clip)


@pytest.fixture(scope="module")
def scenes(clip: Clip, stage_one: Rollout) -> BenchmarkClip:
    return BenchmarkClip(clip, replace(clip, clip_id="earlier"), ((3, stage_one),))


@pytest.fixture(scope="module")
def judged(clip: Clip, stage_one: Rollout) -> Judged:
    result = drive_follow_up(clip, stage_one, TrafficSettings())
    assert isinstance(result, Judged)
    return result


def test_the_earlier_scene_is_the_rollout_up_to_its_step_and_the_log_after(
    scenes: BenchmarkClip, clip: Clip, stage_one: Rollout
) -> None:
    scene = scenes.stage_two(3, before=True)
    assert scene.step == BEFORE
    assert np.array_equal(scene.ego_history, stage_one.ego_states[35 - HISTORY_STEPS : 36])
    for name in ("boxes", "velocities", "valid"):
        mixed, rolled, logged = (getattr(part, name) for part in (scene.agents, stage_one.agents, clip.agents))
        assert np.array_equal(mixed[NOW : BEFORE + 1], rolled[:36], equal_nan=name != "valid")
        assert np.array_equal(mixed[BEFORE + 1 :], logged[BEFORE + 1 :], equal_nan=name != "valid")
    assert scene.ever_simulated is stage_one.simulated


def test_the_four_kinds_of_scenes(scenes: BenchmarkClip, clip: Clip, stage_one: Rollout) -> None:
    later = scenes.stage_two(3)
    assert later.step == NOW + HORIZON_STEPS
    assert np.array_equal(later.ego_state, stage_one.ego_states[-1])
    assert np.array_equal(later.centerline, perturbed_scene(clip, stage_one).centerline)
    assert scenes.stage_one().clip.clip_id == clip.clip_id
    assert scenes.stage_one(before=True).clip.clip_id == "earlier"
    with pytest.raises(KeyError):
        scenes.stage_two(0)


def test_the_earlier_frame_drives_the_end_of_the_perturbation_and_then_the_same_drive(
    judged: Judged, stage_one: Rollout, scenes: BenchmarkClip
) -> None:
    before = seen_half_a_second_earlier(judged, stage_one)
    states = before.rollout.ego_states
    assert np.array_equal(states[:6], stage_one.ego_states[35:])
    assert np.array_equal(states[5:], judged.rollout.ego_states[:36])
    agents = before.rollout.agents
    assert np.array_equal(agents.boxes[:6], stage_one.agents.boxes[35:], equal_nan=True)
    assert np.array_equal(agents.boxes[5:], judged.rollout.agents.boxes[:36], equal_nan=True)
    assert np.array_equal(before.scene.ego_history, scenes.stage_two(3, before=True).ego_history)
    assert before.rollout.start_step == before.scene.step == BEFORE
    assert np.isfinite(before.scores.pdm_score).all()


def test_a_bad_drive_is_a_follow_up_too(clip: Clip, stage_one: Rollout) -> None:
    nowhere = replace(clip, road_map=replace(clip.road_map, drivable_areas=()))
    judged = drive_follow_up(nowhere, stage_one, TrafficSettings())
    assert isinstance(judged, Judged) and judged.scores.dac[1] == 0.0


@pytest.mark.parametrize("ended_at", [BEFORE, NOW + HORIZON_STEPS])
def test_a_route_that_has_ended_at_either_frame_drops_both(
    clip: Clip, stage_one: Rollout, ended_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def perturbed(*arguments: Any) -> Scene:
        scene = perturbed_scene(*arguments)
        return replace(scene, centerline=scene.centerline[[-1, -1]]) if scene.step == ended_at else scene

    monkeypatch.setattr("tasks.hard_scenes.perturbed_scene", perturbed)
    lost = drive_follow_up(clip, stage_one, TrafficSettings())
    assert isinstance(lost, Rejected)
    assert (lost.stage, lost.reason) == ("rollout", "route_ended")


def test_the_two_of_a_pair_have_digests_of_their_own() -> None:
    assert len({frame_digest(frame) for frame in FRAMES}) == 3

"""Worlds that go on past their log, and where drives begin aside of it."""

from dataclasses import replace

import numpy as np
import pytest

from planners.drive.starts import extend_clip, perturbed_starts
from tasks.settings import TrafficSettings
from tasks.world.clip import CLIP_STEPS, NOW, Block
from tasks.world.road_map import LightState
from tests.tasks.streets import perturbed, street_clip


def test_after_the_log_things_stay_and_who_moved_is_gone() -> None:
    clip = extend_clip(street_clip(), 200)
    there = dict(zip(clip.agents.track_ids, clip.agents.valid[CLIP_STEPS:].T))
    assert there["cone"].all()
    assert not any(there[name].any() for name in ("ahead", "left", "walker"))
    assert (clip.agents.boxes[CLIP_STEPS:, 3] == clip.agents.boxes[CLIP_STEPS - 1, 3]).all()
    assert clip.lights.states.shape == (200, 1)
    assert (clip.lights.states[CLIP_STEPS:] == LightState.UNKNOWN).all()


def test_what_the_block_knows_of_the_log_is_used() -> None:
    """A block that begins a second before the clip and ends a second after it."""
    clip = street_clip()
    log = extend_clip(clip, CLIP_STEPS + 20).agents
    boxes = np.arange(log.n_steps)[:, None, None] * np.ones(log.boxes.shape[1:])
    known = replace(log, boxes=boxes, valid=np.ones_like(log.valid))
    longer = extend_clip(replace(clip, block=Block(clip.start_s - 1.0, known, (), ())), 200)
    assert (longer.agents.boxes[: CLIP_STEPS + 10, 0, 0] == np.arange(10, CLIP_STEPS + 20)).all()
    assert not longer.agents.valid[CLIP_STEPS + 10 :, 0].any()


def test_lights_that_somebody_knows_are_taken() -> None:
    clip = street_clip()
    lights = replace(clip.lights, states=np.full((200, 1), LightState.RED, np.int8))
    assert (extend_clip(clip, 200, lights).lights.states == LightState.RED).all()
    with pytest.raises(ValueError, match="must span 201 steps, got 200"):
        extend_clip(clip, 201, lights)


def test_perturbed_starts_are_those_that_pdm_closed_can_drive_on_from() -> None:
    """In the order of the candidates; more are not there than asked for."""
    clip = extend_clip(street_clip(), 300)
    listed = perturbed(clip, 400)
    found = perturbed_starts(clip, listed, 2, TrafficSettings())
    assert [start.number for start in found] == list(range(len(found)))
    assert 0 < len(found) <= 2
    for start in found:
        assert start.scene.step == NOW + 40
        assert (start.scene.ego_state == listed.candidates[start.candidate_index].rollout.ego_states[-1]).all()

"""What planners are ranked by equals the public scorer on the recorded scenes, from the raw log on.

The frames are prepared, driven and filtered by planners.evaluation.scoring alone; plans and numbers are the recorded
ones.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from reference_scenes import loader

from factory.datasets.av2.reader import AV2Reader, log_folders
from factory.readers.base import ClipRef
from planners.evaluation.frames import Pair
from planners.evaluation.scoring import PreparedFrame, prepare_frame, score_pair
from tasks.reward.aggregate import COLUMNS
from tasks.rollout.simulate import TrafficSettings
from tasks.world.clip import NOW, STEP_S, scene_of_clip
from tasks.world.frames import to_local

WHOLE = ("7fab2350_20", "7fab2350_44", "adcf7d18_64")  # the log holds a whole clip there
REPLAY = TrafficSettings(mode="replay")


@cache
def frame_of(root: Path, name: str, earlier_steps: int = 0) -> PreparedFrame:
    """The recorded frame, or one some steps of 0.1 s before it."""
    log, step = name.split("_")
    reader = AV2Reader(root / "data/av2/sensor/val")
    log_id = next(log_id for log_id in log_folders(reader.root) if log_id.startswith(log))
    start = round(1000 * STEP_S) * (int(step) - NOW - earlier_steps)
    return prepare_frame(scene_of_clip(reader.read(ClipRef("av2", log_id, start))), REPLAY, logged=True)


@pytest.mark.parametrize("name", WHOLE[:2])
def test_extended_comfort_of_a_plan_and_the_humans_before_is_the_recorded_one(shared_root: Path, name: str) -> None:
    module = loader(shared_root)
    now, before = frame_of(shared_root, name), frame_of(shared_root, name, earlier_steps=5)
    recorded, plans = module.metrics(name, 256), module.proposals(name, 256)
    scene = before.scene
    human = to_local(scene.ego_state[:3], scene.clip.ego_states[scene.step + 1 : scene.step + 41, :3])
    expected = recorded["two_frame_extended_comfort"]
    some = np.concatenate([np.flatnonzero(expected == value)[:4] for value in (0.0, 1.0)])
    assert set(expected[some]) == {0.0, 1.0}
    for k in some:
        (of_now, _), (of_before, driven) = score_pair(Pair(now, before), (plans[k], human))
        np.testing.assert_allclose(driven.states, recorded["prev_human_simulated_states"], rtol=0, atol=1e-6)
        assert of_now.unfiltered[COLUMNS.index("ec")] == of_before.unfiltered[COLUMNS.index("ec")] == expected[k]

"""Every trajectory among the traffic that answers to it: the batch equals one rollout after the other."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tasks.reward import labels
from tasks.reward.epdms import Scores, prepare_scene, score
from tasks.reward.labels import reactive_scores
from tasks.rollout.simulate import TrafficSettings, prepare_traffic, roll_out
from tests.tasks.rollout.worlds import random_egos, random_scene

IDM = TrafficSettings()
RELATIVE = ("ep", "pdm_score")  # to row 0


@pytest.mark.parametrize("seed", range(6))
def test_the_batch_equals_one_rollout_and_score_after_the_other(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = random_scene(seed)
    scene = replace(scene, centerline=next(iter(scene.clip.road_map.lanes.values())).centerline)
    states = random_egos(scene, seed, 13)
    states[:, 0] = scene.ego_state
    monkeypatch.setattr(labels, "EGOS_AT_ONCE", 5)
    every = reactive_scores(scene, states, IDM)
    ready = prepare_traffic(scene, IDM)
    for k, one in enumerate(states):
        alone = score(prepare_scene(scene, roll_out(ready, one).agents), one[None])
        for field in fields(Scores):
            if field.name not in RELATIVE:
                np.testing.assert_array_equal(getattr(every, field.name)[k], getattr(alone, field.name)[0], field.name)
        pair = score(prepare_scene(scene, roll_out(ready, one).agents), states[[0, k]], normalise="pairs")
        if k > 0 and every.multiplier[0] == pair.multiplier[0]:
            assert every.pdm_score[k] == pair.pdm_score[1]

"""The human expert."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tasks.experts.protocol import Human
from tasks.world.clip import NOW, Scene


def test_the_human_plan_is_the_log(road: Callable[..., Scene]) -> None:
    scene = road(speed=7.0)
    poses = Human().plan(scene, np.random.default_rng(0)).poses
    np.testing.assert_array_equal(poses, scene.clip.ego_states[NOW + 1 : NOW + 41, :3])
    np.testing.assert_allclose(poses[:, 0], 50.0 + 0.7 * np.arange(1, 41))


def test_a_plan_beyond_the_clip_is_refused(road: Callable[..., Scene]) -> None:
    with pytest.raises(ValueError, match="the clip ends 39 steps after step 56"):
        Human().plan(replace(road(), step=56), np.random.default_rng(0))

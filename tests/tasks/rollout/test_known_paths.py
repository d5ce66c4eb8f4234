"""A path that was found before is handed out again, and is the one that would be found anew."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tasks.rollout import lane_following
from tasks.rollout.lane_following import LanePath, find_path, index_lanes
from tasks.rollout.simulate import TrafficSettings, simulate
from tests.tasks.rollout import worlds
from tests.tasks.rollout.worlds import Track


def same(a: LanePath, b: LanePath) -> bool:
    return all(np.array_equal(getattr(a, each.name), getattr(b, each.name), equal_nan=True) for each in fields(a)[:4])


def test_it_is_kept_for_one_pose_and_one_log_and_no_more_are_kept_than_there_is_room_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=5.0))
    index, pose, log = index_lanes(scene.clip.road_map), np.array([3.0, 0.4, 0.0]), np.zeros((4, 3))
    first = find_path(index, pose, log, 60.0)
    assert first is not None and find_path(index, pose.copy(), log.copy(), 60.0) is first
    for other in (find_path(index, pose + 0.1, log, 60.0), find_path(index, pose, log, 70.0)):
        assert other is not None and other is not first and not np.array_equal(other.xy, first.xy)
    again = find_path(index_lanes(scene.clip.road_map), pose, log, 60.0)
    assert again is not None and again is not first and same(again, first)
    assert find_path(index, pose + 50.0, log, 60.0) is None and len(index.known_paths) == 4
    monkeypatch.setattr(lane_following, "KNOWN_PATHS", 5)
    for shift in range(12):
        find_path(index, pose + np.array([0.01 * shift, 0.0, 0.0]), log, 60.0)
        assert len(index.known_paths) <= 5


def test_rollouts_on_one_map_change_none_of_the_paths_that_they_share() -> None:
    """A second drive among the same traffic comes out as the first, and as on a map of its own."""
    scene = worlds.scene(worlds.straight_road(), Track(0.0, speed=5.0), Track(30.0, speed=2.0))
    plan = worlds.straight_plan(scene)
    drives = [simulate(scene, plan, TrafficSettings()) for _ in range(2)]
    clip = replace(scene.clip, road_map=replace(scene.clip.road_map))
    drives.append(simulate(replace(scene, clip=clip), plan, TrafficSettings()))
    for drive in drives[1:]:
        np.testing.assert_array_equal(drive.agents.boxes, drives[0].agents.boxes)

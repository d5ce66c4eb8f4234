"""Where the route goes on from a drive's end, in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tasks.reward.ends import NEAR_M, NEAR_RAD, way_on_m
from tasks.world.clip import Clip
from tasks.world.lanes import Route
from tests.tasks.streets import LANE_M, street_clip


def way(clip: Clip, x: float, y: float, heading: float = 0.0) -> float | None:
    return way_on_m(clip.road_map, clip.route, np.array([x, y, heading]))


def test_half_a_metre_and_thirty_degrees_decide_what_is_on_the_route() -> None:
    """Both lanes of the street are on it: y from -2 to 6 m."""
    clip, edge = street_clip(), LANE_M / 2.0
    for x in (0.0, 70.0, 200.0):
        assert way(clip, x, -edge - NEAR_M + 0.01) == math.inf
        assert way(clip, x, -edge - NEAR_M - 0.01) is None
        assert way(clip, x, 0.0, NEAR_RAD - 0.01) == way(clip, x, 0.0, 0.01 - NEAR_RAD) == math.inf
        assert way(clip, x, 0.0, NEAR_RAD + 0.01) is way(clip, x, 0.0, math.pi) is None


def test_a_lane_beside_the_driven_one_that_ends_in_front_of_the_junction_is_no_way_on() -> None:
    """The left lane leads nowhere: 20 m before its end it is as good as the other, nearer it is not."""
    clip = street_clip()
    lanes = dict(clip.road_map.lanes)
    lanes["in_left"] = replace(lanes["in_left"], successors=())
    ends = replace(clip, road_map=replace(clip.road_map, lanes=lanes))
    assert way(ends, 39.0, LANE_M) == math.inf
    assert way(ends, 47.0, LANE_M) == pytest.approx(13.0)
    assert way(ends, 47.0, 0.0) == way(ends, 47.0, LANE_M / 2.0 + 0.4) == math.inf  # nearly on the other


def test_to_the_route_s_end_is_far_enough() -> None:
    clip = street_clip()
    short = replace(clip, route=Route(("in",), ("rb_in",), frozenset({"in", "in_left"})))
    assert way(short, 59.0, 0.0) == math.inf
    assert way(short, 65.0, 0.0) is None

"""Where the route goes on from a drive's end, in closed form."""

import math

import numpy as np

from tasks.attempt import NEAR_M, NEAR_RAD, route_ahead_m
from tasks.world.clip import Clip
from tests.tasks.streets import LANE_M, street_clip


def way(clip: Clip, x: float, y: float, heading: float = 0.0) -> float | None:
    return route_ahead_m(clip.road_map, clip.route, np.array([x, y, heading]))


def test_half_a_metre_and_thirty_degrees_decide_what_is_on_the_route() -> None:
    """Both lanes of the street are on it: y from -2 to 6 m."""
    clip, edge = street_clip(), LANE_M / 2.0
    for x in (0.0, 70.0, 200.0):
        assert way(clip, x, -edge - NEAR_M + 0.01) == math.inf
        assert way(clip, x, -edge - NEAR_M - 0.01) is None
        assert way(clip, x, 0.0, NEAR_RAD - 0.01) == way(clip, x, 0.0, 0.01 - NEAR_RAD) == math.inf
        assert way(clip, x, 0.0, NEAR_RAD + 0.01) is way(clip, x, 0.0, math.pi) is None

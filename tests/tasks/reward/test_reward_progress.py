"""Drivable area, driving direction, lane keeping and progress have closed forms on a straight street."""

import numpy as np
import pytest

from tasks.reward.epdms import score
from tasks.world.frames import HEADING, X, Y
from tasks.world.road_map import MapLayer
from tests.tasks.reward.straight_street import drive, rectangle, street


def test_progress_is_the_distance_driven_and_related_to_the_best_of_the_batch():
    states = np.concatenate([drive(8.0), drive(2.0), drive(0.0)])
    scores = score(street(), states)
    np.testing.assert_allclose(scores.ep_raw_m, [32.0, 8.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(scores.ep, [1.0, 0.25, 0.0], atol=1e-9)


def test_progress_counts_for_everybody_where_nobody_gets_beyond_five_metres():
    assert score(street(), np.concatenate([drive(1.2), drive(0.0)])).ep.tolist() == [1.0, 1.0]


def test_an_offender_does_not_set_the_mark_for_progress():
    off_road = drive(10.0, y=-3.0)
    scores = score(street(), np.concatenate([drive(8.0), off_road]))
    assert scores.dac.tolist() == [1.0, 0.0]
    assert scores.ep.tolist() == [1.0, 1.0]  # clipped: 40 m of 32 m
    assert scores.pdm_score.tolist() == [1.0, 0.0]


def test_leaving_the_drivable_area_is_seen_when_the_first_corner_leaves():
    heading = -0.1
    states = drive(5.0, heading=heading)
    lowest = -(4.049 * np.sin(-heading) + 1.1485 * np.cos(heading))  # front right corner at t = 0
    scores = score(street(), states)
    assert scores.dac[0] == 0.0
    assert scores.dac_index[0] == np.floor((2.0 + lowest) / (0.5 * np.sin(-heading))) + 1


@pytest.mark.parametrize(("speed", "ddc"), [(1.7, 1.0), (3.0, 0.5), (6.0, 0.0)])
def test_driving_direction_sums_the_last_eleven_steps_off_route(speed, ddc):
    scores = score(street(), drive(speed, y=4.0))
    assert scores.ddc[0] == ddc
    first = np.ceil(2.0 / (0.1 * speed) - 1e-9) if 1.1 * speed >= 2.0 else np.inf
    assert scores.ddc_index[0] == first


def test_what_is_driven_against_traffic_inside_an_intersection_is_not_added_to_what_is_outside():
    """0.6 m a step; the centre, 1.461 m before the axle, is outside for the first steps alone: less than 2 m."""
    junction = rectangle("int_j", MapLayer.INTERSECTION, (3.0, 2), (120, 6))
    scores = score(street(extra=[junction]), drive(6.0, y=4.0))
    assert scores.ddc[0] == 1.0 and np.isinf(scores.ddc_index[0])
    assert score(street(), drive(6.0, y=4.0)).ddc[0] == 0.0


def test_lane_keeping_fails_after_twenty_steps_more_than_half_a_metre_off():
    scores = score(street(), np.concatenate([drive(3.0, y=0.6), drive(3.0, y=0.5)]))
    assert scores.lk.tolist() == [0.0, 1.0]
    assert scores.lk_index.tolist() == [19.0, np.inf]


def test_an_intersection_neither_counts_nor_resets_lane_keeping():
    junction = rectangle("int_j", MapLayer.INTERSECTION, (3.0, -2), (6.0, 2))  # centre inside for 10 of 41 steps
    scores = score(street(extra=[junction]), drive(3.0, y=0.6))
    assert scores.lk_index[0] == 29.0


def test_a_short_return_to_the_centreline_resets_lane_keeping():
    states = drive(3.0, y=0.6)
    states[0, 19, Y] = 0.1
    assert score(street(), states).lk_index[0] == 39.0
    assert states[0, 19, HEADING] == 0.0 and states[0, 19, X] > 0

"""Who is at fault, what lies ahead, and red lights, on a straight street."""

from dataclasses import replace

import numpy as np
import pytest

from tasks.reward.epdms import score
from tasks.world.clip import AgentKind
from tasks.world.frames import VX, X
from tasks.world.road_map import MapLayer
from tests.tasks.reward.straight_street import Thing, drive, rectangle, street, tracks

FRONT, REAR = 4.049, 1.127  # rear axle to bumpers


def test_a_stopped_ego_is_never_at_fault():
    rammed = street([Thing(20.0, 0.0, np.pi, (-8.0, 0.0)), Thing(1.5, 9.0, -np.pi / 2, (0.0, -4.0))])
    scores = score(rammed, drive(0.0))
    assert scores.nc[0] == 1.0 and scores.ttc[0] == 1.0
    assert np.isinf(scores.collision_index[0])


@pytest.mark.parametrize(
    ("kind", "nc"), [(AgentKind.VEHICLE, 0.0), (AgentKind.PEDESTRIAN, 0.0), (AgentKind.TRAFFIC_CONE, 0.5)]
)
def test_driving_into_a_standing_object_is_at_fault_at_the_moment_of_contact(kind, nc):
    scores = score(street([Thing(22.0, 0.0, kind=kind)]), drive(8.0))
    assert scores.nc[0] == nc
    gap = 20.0 - FRONT
    assert scores.collision_index[0] == np.ceil(gap / 0.8)
    # 0.9 s ahead is the farthest projection
    assert scores.ttc[0] == 0.0 and scores.ttc_index[0] == np.ceil((gap - 0.9 * 8.0) / 0.8)


def test_being_hit_from_behind_is_not_at_fault_between_lanes_either():
    """Where a contact at the side would be: what lies behind by more than 150 degrees is never the ego's fault."""
    behind = Thing(-6.0, 1.5, 0.0, (5.0, 0.0))
    assert score(street([behind]), drive(2.0, y=1.5)).nc[0] == 1.0
    beside = Thing(0.5, 4.4, 0.0, (2.0, -1.0))
    assert score(street([beside]), drive(2.0, y=1.5)).nc[0] == 0.0


def test_a_car_ahead_that_drives_on_is_no_ttc_violation_and_one_that_stands_is():
    """0.2 m behind it at 8 m/s: within 0.9 s the ego is where it was, not where it is then."""
    ahead = Thing(FRONT + 0.2 + 2.0, 0.0, 0.0, (8.0, 0.0))
    assert score(street([ahead]), drive(8.0)).ttc[0] == 1.0
    assert score(street([replace(ahead, velocity=(0.0, 0.0))]), drive(8.0)).ttc_index[0] == 0.0


def test_who_touches_the_ego_at_first_is_left_out_for_good_and_nobody_else() -> None:
    """Driving on into a thing is the ego's fault, unless they touched before the drive began."""
    contact = FRONT + 2.0
    for ahead_m, nc in ((contact - 0.1, 1.0), (contact + 0.1, 0.0)):
        assert score(street([Thing(ahead_m, 0.0)]), drive(8.0)).nc[0] == nc


def test_what_stands_when_it_is_first_seen_counts_as_standing() -> None:
    """Half a second in, something is behind the ego and touches it: only what stands is the ego's fault there."""
    for speed_mps, nc in ((0.0, 0.0), (1.0, 1.0)):
        behind = Thing(-1.9 - 0.5 * speed_mps, 0.0, velocity=(speed_mps, 0.0), first=5)
        assert score(street([behind]), drive(2.0)).nc[0] == nc


def test_a_chaser_may_count_as_ahead_because_bearings_start_at_the_unprojected_ego():
    scores = score(street([Thing(-15.0, 0.0, 0.0, (12.0, 0.0))]), drive(5.0))
    assert scores.nc[0] == 1.0 and scores.ttc[0] == 0.0  # as the public metric does


def test_an_object_that_stood_when_first_seen_counts_as_standing_for_good():
    chaser = Thing(-15.0, 0.0, 0.0, (12.0, 0.0))
    assert score(street([chaser]), drive(5.0)).nc[0] == 1.0
    seen = tracks([chaser])
    seen.velocities[0] = 0.0
    assert score(street(seen), drive(5.0)).nc[0] == 0.0


def test_a_side_contact_is_at_fault_only_between_lanes():
    cutting_in = Thing(0.0, 3.9, 0.0, (5.0, -1.0))
    assert score(street([cutting_in]), drive(5.0)).nc[0] == 1.0
    assert score(street([replace(cutting_in, y=5.4)]), drive(5.0, y=1.5)).nc[0] == 0.0


def test_after_a_harmless_contact_an_object_is_never_looked_at_again():
    pushed = drive(0.0)
    pushed[0, 10:, VX] = 6.0
    pushed[0, 10:, X] = 0.6 * np.arange(31)
    parked_later = Thing(6.5, 0.0, np.pi, (-1.0, 0.0))  # touches the standing ego's front after 0.5 s
    scores = score(street([parked_later]), pushed)
    assert scores.nc[0] == 1.0
    ahead = Thing(9.5, 0.0, np.pi, (-1.0, 0.0))  # the same, but only once the ego drives
    assert score(street([ahead]), pushed).nc[0] == 0.0


def test_an_object_beside_the_lane_is_no_ttc_violation_unless_the_ego_is_between_lanes():
    crossing = Thing(2.0, -6.0, np.pi / 2, (0.0, 3.0), length=1.0, width=1.0, kind=AgentKind.PEDESTRIAN)
    in_lane = score(street([crossing]), drive(0.5, y=-0.4))
    between = score(street([crossing]), drive(0.5, y=1.4))
    assert in_lane.ttc[0] == 1.0
    assert between.ttc[0] == 0.0


def test_a_track_that_appears_later_is_hit_only_then():
    scores = score(street([Thing(10.0, 0.0, first=30)]), drive(4.0))
    assert scores.collision_index[0] == 30


def test_standing_on_a_red_connector_fails_and_a_green_one_does_not():
    connector = rectangle("turn", MapLayer.LANE_CONNECTOR, (15, -2), (30, 2))
    assert score(street(extra=[connector]), drive(6.0)).tlc[0] == 1.0
    red = score(street(extra=[connector], red_lanes=(("turn",), np.ones((41, 1), dtype=bool))), drive(6.0))
    assert red.tlc[0] == 0.0
    assert red.tlc_index[0] == np.ceil((15 - FRONT) / 0.6)
    phase = np.zeros((41, 1), dtype=bool)
    phase[:10] = True  # red until the ego is there
    assert score(street(extra=[connector], red_lanes=(("turn",), phase)), drive(6.0)).tlc[0] == 1.0
    phase[:] = False
    phase[30:] = True  # turns red under the ego
    assert score(street(extra=[connector], red_lanes=(("turn",), phase)), drive(6.0)).tlc_index[0] == 30

"""Roadblocks, car parks and intersections of a map, by hand: what is drivable, what is a lane, what is a junction."""

import numpy as np
import pytest

from tasks.reward.centerline import CENTER_IN_INTERSECTION, MULTIPLE_LANES, NON_DRIVABLE, ONCOMING
from tasks.reward.map_index import index_map
from tasks.world.frames import PACIFICA, X, Y
from tasks.world.road_map import MapLayer
from tests.tasks.reward.body_flags import flags_along
from tests.tasks.reward.straight_street import rectangle

MAP = [
    rectangle("own", MapLayer.LANE, (0.0, -2.0), (50.0, 2.0)),
    rectangle("group", MapLayer.ROADBLOCK, (0.0, -2.0), (50.0, 12.0)),  # reaches beyond its lane
    rectangle("park", MapLayer.CARPARK_AREA, (0.0, -20.0), (50.0, -10.0)),
    rectangle("turn", MapLayer.LANE_CONNECTOR, (50.0, -2.0), (90.0, 2.0)),
    rectangle("junction", MapLayer.INTERSECTION, (50.0, -8.0), (90.0, 8.0)),
    rectangle("bare", MapLayer.LANE, (0.0, 30.0), (50.0, 34.0)),  # a lane outside every roadblock
]


@pytest.mark.parametrize(
    ("x", "y", "wanted"),
    [
        (20.0, 0.0, 0),  # in its lane
        (20.0, 8.0, ONCOMING),  # in the roadblock beside the lane: drivable, in no lane of the route
        (20.0, -15.0, ONCOMING),  # in the car park
        (20.0, -6.0, NON_DRIVABLE | ONCOMING),  # between the two
        (70.0, 0.0, CENTER_IN_INTERSECTION),  # on the connector
        (70.0, 6.0, CENTER_IN_INTERSECTION | ONCOMING),  # beside it
        (20.0, 32.0, NON_DRIVABLE | ONCOMING),  # a lane alone is not drivable
        (50.0 - PACIFICA.rear_axle_to_center, 0.0, MULTIPLE_LANES | ONCOMING),  # the centre on the shared edge: in none
    ],
)
def test_layers_of_a_nuplan_map(x: float, y: float, wanted: int) -> None:
    states = np.zeros((1, 41, 11))
    states[..., X], states[..., Y] = x, y
    assert (flags_along(index_map(MAP, frozenset({"own", "turn"})), states) == wanted).all()

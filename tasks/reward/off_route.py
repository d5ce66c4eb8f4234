"""Whether the route goes on where a drive ends (docs/reward.md 2m)."""

import math

from tasks.world.arrays import Array
from tasks.world.lanes import RoadMap, Route
from tasks.world.route import RouteFinder

NEAR_M, NEAR_RAD = 0.5, math.radians(30.0)  # of a lane of the route
ONWARD_M = 20.0  # as far as the driving command looks


def way_on_m(road_map: RoadMap, route: Route, pose: Array) -> float | None:
    """Metres of the route's lanes ahead of a rear-axle pose (3,), along the longest way; inf: as far as is asked.

    Asked is for ONWARD_M, or to the route's end. None where the pose is on no lane of the route: farther than NEAR_M
    from its polygon, or turned against its centreline by more than NEAR_RAD. Raises NoRoute where the map has none of
    the route's lanes.
    """
    metres = RouteFinder(road_map, route).metres_ahead(pose, NEAR_M, NEAR_RAD, ONWARD_M)
    return metres if metres is None or metres < ONWARD_M else math.inf

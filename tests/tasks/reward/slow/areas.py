"""Which parts of the map the ego's body is on (docs/reward.md 2a)."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from tasks.world.frames import X, Y, box_corners
from tests.tasks.reward.slow.prepare import Regions

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

CORNERS = slice(0, 4)
CENTER, REAR_AXLE = 4, 5  # points of the ego that are looked up, after its four corners


@dataclass(frozen=True)
class EgoAreas:
    """Per trajectory and time, each (K, T)."""

    multiple_lanes: Bools  # corners in more than one lane, and no lane holds all four
    non_drivable: Bools  # some corner is in no drivable polygon
    oncoming: Bools  # the centre is in no lane of the route
    center_in_intersection: Bools
    rear_axle_in_intersection: Bools

    @property
    def off_lane(self) -> Bools:
        """Where lateral contacts are the ego's fault."""
        return self.multiple_lanes | self.non_drivable


def ego_areas(regions: Regions, states: Array, boxes: Array) -> EgoAreas:
    """Areas of ego states (K, T, 11) with bodies (K, T, 5). A point on a polygon's boundary is outside."""
    points = np.concatenate(
        [box_corners(boxes), boxes[..., None, :2], states[..., None, [X, Y]]], axis=-2
    )  # (K, T, 6, 2)
    shape = points.shape[:-1]
    x, y = points[..., 0].ravel(), points[..., 1].ravel()

    lanes_touched = np.zeros(shape[:-1], dtype=np.int64)
    in_one_lane = np.zeros(shape[:-1], dtype=bool)
    drivable = np.zeros(shape, dtype=bool)
    on_route = np.zeros(shape[:-1], dtype=bool)
    intersection = np.zeros(shape, dtype=bool)
    low_x, low_y, high_x, high_y = regions.bounds.T
    in_reach = (low_x <= x.max()) & (high_x >= x.min()) & (low_y <= y.max()) & (high_y >= y.min())
    for r in np.nonzero(in_reach)[0]:
        near = np.nonzero((x >= low_x[r]) & (x <= high_x[r]) & (y >= low_y[r]) & (y <= high_y[r]))[0]
        if near.size == 0:
            continue
        inside_flat = np.zeros(x.size, dtype=bool)
        inside_flat[near] = shapely.contains_xy(regions.shapes[r], x[near], y[near])
        inside = inside_flat.reshape(shape)
        if regions.is_lane[r]:
            lanes_touched += inside[..., CORNERS].any(axis=-1)
            in_one_lane |= inside[..., CORNERS].all(axis=-1)
        if regions.is_on_route[r]:
            on_route |= inside[..., CENTER]
        if regions.is_drivable[r]:
            drivable |= inside
        if regions.is_intersection[r]:
            intersection |= inside
    return EgoAreas(
        multiple_lanes=(lanes_touched > 1) & ~in_one_lane,
        non_drivable=np.any(~drivable[..., CORNERS], axis=-1),
        oncoming=~on_route,
        center_in_intersection=intersection[..., CENTER],
        rear_axle_in_intersection=intersection[..., REAR_AXLE],
    )

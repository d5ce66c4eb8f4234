"""Areas under the ego: the kernels equal the numpy version in random small maps."""

import math
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import minimum_filter

from tasks.kernels.compiled import kernel
from tasks.reward.areas import empty_places, in_intersection
from tasks.reward.centerline import (
    CENTER_IN_INTERSECTION,
    MULTIPLE_LANES,
    NON_DRIVABLE,
    ONCOMING,
)
from tasks.reward.collisions import CIRCUMRADIUS
from tasks.reward.map_index import MapIndex, index_map, with_clearance
from tasks.world.frames import HEADING, PACIFICA, Vehicle, X, Y, ego_boxes
from tasks.world.road_map import MapLayer, MapPolygon
from tests.tasks.reward.body_flags import flags_along
from tests.tasks.reward.slow.areas import EgoAreas, ego_areas
from tests.tasks.reward.slow.prepare import _regions
from tests.tasks.reward.small_maps import small_maps

EXACT = Vehicle(width=2.0, front_length=4.0, rear_length=1.0, rear_axle_to_center=1.5)  # no rounding on a lattice


@kernel
def _in_intersection(index: MapIndex, x: float, y: float) -> bool:
    return in_intersection(index, x, y, empty_places(index, 1))


def as_flags(areas: EgoAreas) -> np.ndarray:
    return (
        MULTIPLE_LANES * areas.multiple_lanes
        | NON_DRIVABLE * areas.non_drivable
        | ONCOMING * areas.oncoming
        | CENTER_IN_INTERSECTION * areas.center_in_intersection
    )


def lattice_states(rng: np.random.Generator, n: int, step: float) -> np.ndarray:
    """States (n, 41, 11) along x on a lattice: their corners often lie on boundaries, without any rounding."""
    states = np.zeros((n, 41, 11))
    states[..., X] = np.round(rng.uniform(-40.0, 40.0, (n, 41)) / step) * step
    states[..., Y] = np.round(rng.uniform(-40.0, 40.0, (n, 41)) / step) * step
    return states


def drives(rng: np.random.Generator, n: int) -> np.ndarray:
    """States (n, 41, 11) of curved drives, some of them beyond the map."""
    speed, rate = rng.uniform(-2.0, 30.0, (n, 1)), rng.normal(0.0, 0.3, (n, 1))
    states = np.zeros((n, 41, 11))
    states[..., HEADING] = rng.uniform(-4.0, 4.0, (n, 1)) + rate * 0.1 * np.arange(41)
    start = rng.uniform(-40.0, 40.0, (n, 1, 2))
    for column, turned in ((X, np.cos), (Y, np.sin)):
        states[..., column] = start[..., column] + np.cumsum(0.1 * speed * turned(states[..., HEADING]), axis=1)
    return states


@settings(max_examples=80)
@given(small_maps(step=0.0), st.integers(0, 2**32 - 1))
def test_flags_equal_the_numpy_version(polygons: list[MapPolygon], seed: int) -> None:
    states = drives(np.random.default_rng(seed), 6)
    route = frozenset(polygon.token for polygon in polygons[::3])
    slow, index = (
        as_flags(ego_areas(_regions(polygons, route), states, ego_boxes(states, PACIFICA))),
        index_map(polygons, route),
    )
    assert np.array_equal(flags_along(index, states), slow)
    assert np.array_equal(flags_along(with_clearance(index, CIRCUMRADIUS), states), slow)


@settings(max_examples=80)
@given(st.data(), st.sampled_from([0.25, 1.0]), st.integers(0, 2**32 - 1))
def test_a_corner_on_a_boundary_is_outside(data: st.DataObject, step: float, seed: int) -> None:
    polygons = data.draw(small_maps(step))
    states = lattice_states(np.random.default_rng(seed), 6, 0.25)
    slow = as_flags(ego_areas(_regions(polygons, frozenset()), states, ego_boxes(states, EXACT)))
    index = index_map(polygons, frozenset())
    assert np.array_equal(flags_along(index, states, EXACT), slow)
    reach_m = math.hypot(EXACT.half_length, EXACT.half_width)
    assert np.array_equal(flags_along(with_clearance(index, reach_m), states, EXACT), slow)


def test_a_body_is_known_to_be_on_the_road_where_no_boundary_is_near() -> None:
    """And where boundaries are near that another road covers; not beside one that nothing covers."""

    def road(token: str, low_y: float, high_y: float) -> MapPolygon:
        ring = np.array([[-50, low_y], [50, low_y], [50, high_y], [-50, high_y], [-50, low_y]], dtype=float)
        return MapPolygon(token, MapLayer.DRIVABLE_AREA, ring)

    def is_clear(polygons: list[MapPolygon], x: float, y: float) -> bool:
        index = with_clearance(index_map(polygons, frozenset()), CIRCUMRADIUS)
        row, column = int((y - index.low_y) / index.cell_m), int((x - index.low_x) / index.cell_m)
        return bool(index.clear.reshape(index.cells.shape)[row, column])

    touching = [road("left", 0.0, 20.0), road("right", -20.0, 0.0)]
    covered = [*touching, road("whole", -20.0, 20.0)]
    assert is_clear(touching, 0.0, 10.0) and not is_clear(touching, 0.0, 1.0) and is_clear(covered, 0.0, 1.0)
    assert not is_clear(covered, 0.0, 17.5) and not is_clear(covered, 48.0, 0.0) and not is_clear(covered, 50.2, 0.0)


@settings(max_examples=40)
@given(small_maps(step=0.0), st.floats(0.0, 8.0))
def test_cells_are_clear_where_all_around_them_are_clear_of_less(polygons: list[MapPolygon], more_m: float) -> None:
    index = index_map(polygons, frozenset())
    least, cells = with_clearance(index, 0.0).clear.reshape(index.cells.shape), int(more_m / index.cell_m)
    expected = minimum_filter(least, size=2 * cells + 1, mode="constant", cval=0)
    assert np.array_equal(with_clearance(index, more_m).clear.reshape(index.cells.shape), expected)


@settings(max_examples=40)
@given(small_maps(step=0.0), st.integers(0, 2**32 - 1))
def test_the_rear_axle_is_in_the_intersections_of_the_numpy_version(polygons: list[MapPolygon], seed: int) -> None:
    crossings = [replace(polygon, layer=MapLayer.INTERSECTION) for polygon in polygons[::2]]
    index = index_map([*polygons, *crossings], frozenset())
    states = drives(np.random.default_rng(seed), 6)
    slow = ego_areas(_regions([*polygons, *crossings], frozenset()), states, ego_boxes(states, PACIFICA))
    for k, one in enumerate(states):
        inside = [_in_intersection(index, x, y) for x, y in one[:, [X, Y]]]
        assert np.array_equal(inside, slow.rear_axle_in_intersection[k])


def test_a_lane_that_holds_all_corners_is_enough() -> None:
    def lane(token: str, low: float, high: float) -> MapPolygon:
        ring = np.array([[-50, low], [50, low], [50, high], [-50, high], [-50, low]], dtype=float)
        return MapPolygon(token, MapLayer.LANE, ring)

    states = np.zeros((1, 2, 11))
    states[0, 1, Y] = 2.0
    two, merging = [lane("own", -2, 2), lane("other", 2, 6)], [lane("both", -2, 6)]
    flags = flags_along(index_map(two, frozenset({"own"})), states)
    assert (flags & MULTIPLE_LANES).tolist() == [[0, MULTIPLE_LANES]]
    assert not (flags_along(index_map(two + merging, frozenset()), states) & MULTIPLE_LANES).any()

"""Areas under the ego: the kernels equal the numpy version in random small maps."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.kernels.compiled import kernel
from tasks.reward.areas import N_POINTS, empty_places, in_intersection, set_area_flags
from tasks.reward.centerline import (
    CENTER_IN_INTERSECTION,
    MULTIPLE_LANES,
    NON_DRIVABLE,
    ONCOMING,
    Body,
    empty_body,
    place_body,
)
from tasks.reward.map_index import MapIndex, index_map
from tasks.world.frames import HEADING, PACIFICA, Vehicle, X, Y, ego_boxes
from tasks.world.road_map import MapLayer, MapPolygon
from tests.tasks.reward.slow.areas import EgoAreas, ego_areas
from tests.tasks.reward.slow.prepare import _regions
from tests.tasks.reward.small_maps import small_maps

EXACT = Vehicle(width=2.0, front_length=4.0, rear_length=1.0, rear_axle_to_center=1.5)  # no rounding on a lattice


def flags_along(polygons: list[MapPolygon], route: frozenset[str], states: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """(K, T) flags by the kernels."""
    body = empty_body(states.shape[0] * states.shape[1])
    place_body(states.reshape(-1, states.shape[2]), vehicle.rear_axle_to_center, body)
    _set_area_flags(index_map(polygons, route), body, vehicle.half_length, vehicle.half_width)
    return body.flags.reshape(states.shape[:2])


@kernel
def _set_area_flags(index: MapIndex, body: Body, half_length: float, half_width: float) -> None:
    set_area_flags(index, body, half_length, half_width, empty_places(index, N_POINTS * len(body.x)))


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
    slow = ego_areas(_regions(polygons, route), states, ego_boxes(states, PACIFICA))
    assert np.array_equal(flags_along(polygons, route, states, PACIFICA), as_flags(slow))


@settings(max_examples=80)
@given(st.data(), st.sampled_from([0.25, 1.0]), st.integers(0, 2**32 - 1))
def test_a_corner_on_a_boundary_is_outside(data: st.DataObject, step: float, seed: int) -> None:
    polygons = data.draw(small_maps(step))
    states = lattice_states(np.random.default_rng(seed), 6, 0.25)
    slow = ego_areas(_regions(polygons, frozenset()), states, ego_boxes(states, EXACT))
    assert np.array_equal(flags_along(polygons, frozenset(), states, EXACT), as_flags(slow))


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
    assert (flags_along(two, frozenset({"own"}), states, PACIFICA) & MULTIPLE_LANES).tolist() == [[0, MULTIPLE_LANES]]
    assert not (flags_along(two + merging, frozenset(), states, PACIFICA) & MULTIPLE_LANES).any()

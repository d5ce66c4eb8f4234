"""Red lanes under the ego: the kernel equals the shapely version in random small maps, touching included."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_areas_twin import EXACT, drives, lattice_states

from tasks.reward.areas import first_red, index_red_lanes
from tasks.reward.centerline import empty_body, place_body
from tasks.world.frames import PACIFICA, Vehicle, X, Y, ego_boxes
from tasks.world.road_map import MapLayer, MapPolygon
from tests.tasks.reward.slow.collisions import traffic_light_compliance
from tests.tasks.reward.slow.prepare import RedLanes, _shape
from tests.tasks.reward.small_maps import small_maps


def first_reds(lanes: list[MapPolygon], is_red: np.ndarray, states: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """(K,) by the kernel."""
    red = index_red_lanes(lanes, is_red)
    found = []
    for one in states:
        body = empty_body(len(one))
        place_body(one, vehicle.rear_axle_to_center, body)
        found.append(first_red(red, body, vehicle.half_length, vehicle.half_width))
    return np.array(found)


def slow_first_reds(lanes: list[MapPolygon], is_red: np.ndarray, states: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    shapes = np.array([_shape(lane) for lane in lanes], dtype=object)
    return traffic_light_compliance(RedLanes(shapes, is_red), ego_boxes(states, vehicle))[1]


def mask(rng: np.random.Generator, lanes: list[MapPolygon]) -> np.ndarray:
    return rng.random((41, len(lanes))) < rng.choice([0.0, 0.02, 0.5, 1.0], len(lanes))


@settings(max_examples=80)
@given(small_maps(step=0.0), st.integers(0, 2**32 - 1))
def test_the_first_red_instant_equals_the_shapely_version(polygons: list[MapPolygon], seed: int) -> None:
    rng = np.random.default_rng(seed)
    lanes, states = polygons[:6], drives(rng, 8)
    is_red = mask(rng, lanes)
    ours = first_reds(lanes, is_red, states, PACIFICA)
    assert np.array_equal(ours, slow_first_reds(lanes, is_red, states, PACIFICA))


@settings(max_examples=80)
@given(small_maps(step=0.25), st.integers(0, 2**32 - 1))
def test_touching_a_red_lane_counts(polygons: list[MapPolygon], seed: int) -> None:
    rng = np.random.default_rng(seed)
    lanes, states = polygons[:3], lattice_states(rng, 8, 0.25)
    is_red = mask(rng, lanes)
    assert np.array_equal(first_reds(lanes, is_red, states, EXACT), slow_first_reds(lanes, is_red, states, EXACT))


def ring(x: float, y: float, half: float) -> np.ndarray:
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half + np.array([x, y])


def at(x: float, y: float) -> np.ndarray:
    """One state (1, 1, 11) whose body's centre is at x, y."""
    states = np.zeros((1, 1, 11))
    states[..., X], states[..., Y] = x - PACIFICA.rear_axle_to_center, y
    return states


@pytest.mark.parametrize(
    ("lane", "position", "is_on"),
    [
        (MapPolygon("wide", MapLayer.LANE_CONNECTOR, ring(0.0, 0.0, 50.0)), (3.0, 1.0), True),
        (MapPolygon("small", MapLayer.LANE_CONNECTOR, ring(0.0, 0.0, 0.2)), (0.1, 0.0), True),
        (MapPolygon("holed", MapLayer.LANE_CONNECTOR, ring(0.0, 0.0, 50.0), (ring(0, 0, 20.0),)), (3.0, 1.0), False),
        (MapPolygon("holed", MapLayer.LANE_CONNECTOR, ring(0.0, 0.0, 50.0), (ring(0, 0, 20.0),)), (18.0, 0.0), True),
        (MapPolygon("away", MapLayer.LANE_CONNECTOR, ring(9.0, 0.0, 2.0)), (0.0, 0.0), False),
    ],
)
def test_a_body_inside_a_lane_or_around_one_is_on_it_and_in_its_hole_is_not(
    lane: MapPolygon, position: tuple[float, float], is_on: bool
) -> None:
    assert np.isfinite(first_reds([lane], np.ones((1, 1), dtype=bool), at(*position), PACIFICA))[0] == is_on

"""The map's index says what shapely says of every point, and refuses rings that make no sense."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.kernels.compiled import kernel
from tasks.reward.areas import Places, empty_places, find_regions
from tasks.reward.map_index import DRIVABLE, INTERSECTION, LANE, ON_ROUTE, MapIndex, index_map
from tasks.world.road_map import MapLayer, MapPolygon
from tests.tasks.reward.small_maps import small_maps

NOBODY: frozenset[str] = frozenset()


def found_at(index: MapIndex, points: np.ndarray) -> Places:
    """The regions at points (P, 2)."""
    found = empty_places(index, len(points))
    found.x[:], found.y[:] = np.asarray(points).T
    _find_regions(index, found)
    return found


@kernel
def _find_regions(index: MapIndex, places: Places) -> None:
    find_regions(index, places)


def held(index: MapIndex, points: np.ndarray) -> np.ndarray:
    """Which regions hold points (P, 2): (P, R padded to whole words)."""
    found = found_at(index, points)
    words = np.concatenate([index.sets, found.others[::-1]])[found.number]
    return np.unpackbits(words.view(np.uint8), axis=1, bitorder="little").astype(bool)


def shapes_of(polygons: list[MapPolygon]) -> list[shapely.Polygon]:
    """Distinct shapes in the index's order: lanes first, a region being a lane when one of its polygons is."""
    is_lane: dict[shapely.Polygon, bool] = {}
    for polygon in polygons:
        shape = shapely.Polygon(polygon.ring, polygon.holes)
        is_lane[shape] = is_lane.get(shape, False) or polygon.layer in (MapLayer.LANE, MapLayer.LANE_CONNECTOR)
    return sorted(is_lane, key=lambda shape: not is_lane[shape])


def telling_points(polygons: list[MapPolygon], seed: int, step: float) -> np.ndarray:
    """Points everywhere, far away, on the vertices' rows and columns, and, where `step` is exact, on the vertices."""
    rng = np.random.default_rng(seed)
    anywhere = [rng.uniform(-70.0, 70.0, (300, 2)), rng.normal(0.0, 1e5, (20, 2)), [[np.inf, 0.0], [0.0, -1e300]]]
    corners = np.concatenate([np.zeros((1, 2)), *[p.ring for p in polygons], *[h for p in polygons for h in p.holes]])
    chosen = corners[rng.integers(len(corners), size=(200, 2))]
    rows = np.stack([chosen[:, 0, 0], rng.uniform(-40.0, 40.0, 200)], axis=1)
    columns = np.stack([rng.uniform(-40.0, 40.0, 200), chosen[:, 1, 1]], axis=1)
    if not step:
        return np.concatenate([*anywhere, rows, columns])
    snapped = np.round(np.concatenate([rows, columns]) / step) * step
    crossings = np.stack([chosen[:, 0, 0], chosen[:, 1, 1]], axis=1)
    between = (chosen[:, 0] + chosen[:, 1]) / 2.0
    return np.concatenate([*anywhere, snapped, corners, crossings, between])


@pytest.mark.slow
@settings(max_examples=80)
@given(st.data(), st.sampled_from([0.0, 0.25, 1.0]), st.integers(0, 1000))
def test_every_point_is_in_the_regions_that_shapely_says(data: st.DataObject, step: float, seed: int) -> None:
    polygons = data.draw(small_maps(step))
    points = telling_points(polygons, seed, step)
    index = index_map(polygons, NOBODY)
    shapes = shapes_of(polygons)
    ours = held(index, points)
    for r, shape in enumerate(shapes):
        expected = shapely.contains_xy(shape, points[:, 0], points[:, 1])
        assert np.array_equal(ours[:, r], expected), points[ours[:, r] != expected]
    assert not ours[:, len(shapes) :].any()


def square(token: str, x: float, y: float, side: float, layer: MapLayer = MapLayer.LANE) -> MapPolygon:
    ring = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * side + np.array([x, y])
    return MapPolygon(token, layer, ring)


def test_polygons_with_the_same_rings_are_one_region_that_plays_all_parts() -> None:
    polygons = [
        square("da", 0.0, 0.0, 9.0, MapLayer.DRIVABLE_AREA),
        square("c", 0.0, 0.0, 4.0, MapLayer.LANE_CONNECTOR),
        square("int_c", 0.0, 0.0, 4.0, MapLayer.INTERSECTION),
    ]
    index = index_map(polygons, frozenset({"c", "da"}))
    assert held(index, np.array([[1.0, 1.0], [5.0, 5.0], [9.5, 1.0]])).sum(axis=1).tolist() == [2, 1, 0]
    parts = found_at(index, np.array([[1.0, 1.0], [5.0, 1.0], [9.5, 1.0]])).parts.tolist()
    assert parts == [1 << LANE | 1 << ON_ROUTE | 1 << DRIVABLE | 1 << INTERSECTION, 1 << DRIVABLE, 0]


def test_a_point_is_in_a_ring_that_touches_itself_where_it_is_enclosed_once() -> None:
    two_squares = np.array([[0, 0], [1, 0], [1, 1], [2, 1], [2, 2], [1, 2], [1, 1], [0, 1]], dtype=float)
    keyhole = np.array([[0, 0], [6, 0], [6, 6], [0, 6], [0, 3], [2, 3], [3, 2], [4, 3], [3, 4], [2, 3], [0, 3]])
    for ring, inside in ((two_squares, [True, True, False]), (keyhole.astype(float), [True, True, True])):
        index = index_map([MapPolygon("lane", MapLayer.LANE, ring)], NOBODY)
        assert held(index, np.array([[0.5, 0.5], [1.5, 1.5], [0.5, 1.5]]))[:, 0].tolist() == inside
    assert not held(index, np.array([[3.0, 3.0]])).any()


BOW_TIE = [[0, 0], [4, 4], [4, 0], [0, 4]]
HOLE_ACROSS = [[2, 2], [9, 2], [9, 3], [2, 3]]


@pytest.mark.parametrize(
    ("ring", "holes", "problem"),
    [
        ([[0, 0], [4, 0]], [], "fewer than three distinct points"),
        ([[0, 0], [4, 0], [4, 0], [0, 0]], [], "fewer than three distinct points"),
        ([[0, 0], [4, 0], [np.nan, 4]], [], "not finite"),
        ([[0, 0], [4, 0], [4, np.inf]], [], "not finite"),
        ([[0, 0], [1, 1], [3, 3], [2, 2]], [], "bounds no area"),
        ([[0, 0], [4, 0], [0, 0], [4, 0]], [], "bounds no area"),
        (BOW_TIE, [], "crosses itself near"),
        ([[0, 0], [8, 0], [8, 8], [6, -1], [0, 8]], [], "crosses itself near"),
        ([[0, 0], [5, 0], [5, 5], [0, 5]], [HOLE_ACROSS], "crosses itself near"),
        ([[0, 0], [9, 0], [9, 9], [0, 9]], [BOW_TIE], "crosses itself near"),
        ([[0, 0], [9, 0], [9, 9], [0, 9]], [[[1, 1], [2, 2]]], "fewer than three distinct points"),
        ([[0, 0, 1], [9, 0, 1], [9, 9, 1]], [], r"must be \(M, 2\)"),
    ],
)
def test_a_ring_that_makes_no_sense_is_refused_by_the_polygons_name(ring: list, holes: list, problem: str) -> None:
    arrays = [np.array(points, dtype=float) for points in (ring, *holes)]
    bad = MapPolygon("lane_7", MapLayer.LANE_CONNECTOR, arrays[0], tuple(arrays[1:]))
    good = [square(f"g{i}", 30.0 * i, 0.0, 20.0) for i in range(70)]
    with pytest.raises(ValueError, match=f"LANE_CONNECTOR 'lane_7'.*{problem}"):
        index_map([*good, bad], NOBODY)

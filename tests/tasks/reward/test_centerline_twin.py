"""Progress, lane keeping and driving direction on kernels equal GEOS and the numpy versions, and what paper says."""

from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.reward.centerline import (
    CENTER_IN_INTERSECTION,
    NON_DRIVABLE,
    ONCOMING,
    Body,
    arc_length_at,
    driving_direction_compliance,
    index_centerline,
    is_off_centerline,
    lane_keeping_failure,
    progress_m,
)
from tests.tasks.reward.slow import progress as slow

ALONG_X = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 0.0], [25.0, 0.0], [60.0, 0.0]])  # with a joint of lanes
HAIRPIN = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 1.0], [0.0, 1.0]])
EIGHT = np.array([[0.0, 0.0], [10.0, 10.0], [10.0, 0.0], [0.0, 10.0]])  # crosses itself at (5, 5)


def body_at(x: np.ndarray, y: np.ndarray, flags: np.ndarray | int = 0) -> Body:
    n = len(x)
    ones = np.ones(n)
    return Body(
        x=np.array(x, float),
        y=np.array(y, float),
        cos=ones,
        sin=0 * ones,
        speed=ones,
        flags=np.broadcast_to(np.uint8(flags), n).astype(np.uint8),
    )


@st.composite
def lines(draw: st.DrawFn) -> np.ndarray:
    """Points (P, 2): short, long, winding, repeated, turning back, crossing themselves; near the origin or far away."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["winding", "hairpin", "eight", "two points", "lattice"]))
    if kind == "winding":
        n_points = draw(st.integers(3, 120))
        heading = np.cumsum(rng.normal(0.0, draw(st.sampled_from([0.0, 0.05, 0.6])), n_points))
        step = draw(st.sampled_from([0.3, 0.75, 6.0]))
        points = np.cumsum(step * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    elif kind == "lattice":
        points = rng.integers(0, 6, (draw(st.integers(2, 30)), 2)).astype(float)
        points[-1] = [7.0, 7.0]
    else:
        points = {"hairpin": HAIRPIN, "eight": EIGHT, "two points": rng.uniform(-300, 300, (2, 2))}[kind]
    if draw(st.booleans()):
        points = np.repeat(points, rng.integers(1, 4, len(points)), axis=0)
    return points + draw(st.sampled_from([0.0, 1024.0, -7531.25]))


def places_around(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(200, 2): on it, beside it, beyond its ends, far away, on a lattice where ties abound."""
    share = rng.uniform(size=(80, 1))
    segment = rng.integers(len(points) - 1, size=80)
    on_it = points[segment] + share * (points[segment + 1] - points[segment])
    near = on_it + rng.normal(0.0, 0.6, on_it.shape)
    lattice = points[rng.integers(len(points), size=30)] + rng.integers(-4, 5, (30, 2)) * 0.5
    far = points[0] + rng.normal(0.0, 1e5, (10, 2))
    return np.concatenate([on_it, near, lattice, far])


@settings(max_examples=80)
@given(points=lines(), seed=st.integers(0, 2**32 - 1))
def test_place_and_deviation_are_those_of_geos(points: np.ndarray, seed: int) -> None:
    line, shape = index_centerline(points), shapely.LineString(points)
    places = places_around(points, np.random.default_rng(seed))
    located = [arc_length_at(line, x, y) for x, y in places]
    np.testing.assert_allclose(located, shapely.line_locate_point(shape, shapely.points(places)), rtol=0, atol=1e-9)
    off = [is_off_centerline(line, x, y) for x, y in places]
    assert np.array_equal(off, shapely.distance(shape, shapely.points(places)) > 0.5)


@st.composite
def walks(draw: st.DrawFn, points: np.ndarray) -> Body:
    """A body of 41 steps that strays about the points, with flags that come and go; at times it stands."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    speed = draw(st.sampled_from([0.0, 0.5, 2.0, 5.45, 10.0]))
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0.0, 0.05, 41))
    steps = 0.1 * speed * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    place = points[rng.integers(len(points))] + rng.normal(0.0, draw(st.sampled_from([0.0, 0.5, 3.0])), 2)
    xy = place + np.cumsum(steps, axis=0)
    flags = np.zeros(41, dtype=np.uint8)
    for bit in (CENTER_IN_INTERSECTION, ONCOMING, NON_DRIVABLE):
        a, b = np.sort(rng.integers(0, 42, 2))
        flags[a:b] |= np.uint8(bit * draw(st.booleans()))
    return body_at(xy[:, 0], xy[:, 1])._replace(flags=flags)


@pytest.mark.slow
@settings(max_examples=120)
@given(data=st.data(), points=lines())
def test_the_three_rules_equal_their_slow_twins(data: st.DataObject, points: np.ndarray) -> None:
    line, shape = index_centerline(points), shapely.LineString(points)
    body = data.draw(walks(points))
    centers = np.stack([body.x, body.y], axis=-1)[None]
    areas = SimpleNamespace(
        oncoming=(body.flags & ONCOMING > 0)[None],
        center_in_intersection=(body.flags & CENTER_IN_INTERSECTION > 0)[None],
    )
    gained = progress_m(line, body.x[0], body.y[0], body.x[-1], body.y[-1], np.full(3, np.nan))
    np.testing.assert_allclose(gained, slow.progress_along(shape, centers)[0], rtol=0, atol=1e-9)
    assert lane_keeping_failure(line, body) == slow.lane_keeping(shape, centers, areas)[1][0]
    ddc, first = driving_direction_compliance(body, np.empty(51))
    slow_ddc, slow_first = slow.driving_direction_compliance(centers, areas)
    assert (ddc, first) == (slow_ddc[0], slow_first[0])


def test_the_first_of_several_nearest_places_counts() -> None:
    hairpin, eight = index_centerline(HAIRPIN), index_centerline(EIGHT)
    assert arc_length_at(hairpin, 5.0, 0.5) == 5.0  # half-way to y = 1, where it would be 36
    assert arc_length_at(eight, 5.0, 5.0) == np.hypot(5.0, 5.0)  # at the crossing, not 10 root 2 + 10 + 5 root 2
    assert arc_length_at(eight, 10.0, 5.0) == np.hypot(10.0, 10.0) + 5.0


def test_beyond_its_ends_a_line_goes_no_further() -> None:
    line = index_centerline(ALONG_X)
    for x, place in ((-5.0, 0.0), (-1e9, 0.0), (10.0, 10.0), (12.5, 12.5), (61.0, 60.0), (1e9, 60.0)):
        assert arc_length_at(line, x, 3.0) == place
    begun = np.full(3, np.nan)
    assert progress_m(line, -20.0, 0.0, 80.0, 0.0, begun) == 60.0
    assert progress_m(line, 30.0, 0.0, 20.0, 0.0, begun) == 0.0  # backwards is none
    assert [progress_m(line, 30.0, y, 50.0, 0.0, begun) for y in (0.0, 1.0)] == [20.0, 20.0]


@pytest.mark.parametrize("origin", [(0.0, 0.0), (4096.0, -2048.0)])
def test_exactly_half_a_metre_is_not_off(origin: tuple[float, float]) -> None:
    line = index_centerline(ALONG_X + origin)
    for x in (0.0, 5.0, 10.0, 17.0, 60.0):
        for y, off in ((0.5, False), (-0.5, False), (0.5000001, True), (-0.5000001, True), (0.0, False)):
            assert is_off_centerline(line, x + origin[0], y + origin[1]) == off
    assert not is_off_centerline(line, origin[0] - 0.5, origin[1]) and is_off_centerline(
        line, origin[0] - 0.5000001, origin[1]
    )
    assert not is_off_centerline(line, origin[0] + 60.5, origin[1])


@pytest.mark.parametrize(
    ("step_m", "ddc", "first"),
    # 11 steps in the window; steps 1.. count, so that after t steps it holds min(t, 11) of them
    [(0.125, 1.0, np.inf), (0.1875, 0.5, 11.0), (0.25, 0.5, 8.0), (0.5, 0.5, 4.0), (0.5625, 0.0, 4.0), (2.0, 0.0, 1.0)],
)
def test_driving_direction_sums_eleven_steps_against_traffic(step_m: float, ddc: float, first: float) -> None:
    x = step_m * np.arange(41)
    assert driving_direction_compliance(body_at(x, 0 * x, ONCOMING), np.empty(51)) == (ddc, first)
    assert driving_direction_compliance(body_at(0 * x, -x, ONCOMING | NON_DRIVABLE), np.empty(51)) == (ddc, first)
    assert driving_direction_compliance(body_at(x, 0 * x, ONCOMING | CENTER_IN_INTERSECTION), np.empty(51)) == (
        1.0,
        np.inf,
    )
    assert driving_direction_compliance(body_at(x, 0 * x, NON_DRIVABLE), np.empty(51)) == (1.0, np.inf)


def test_a_long_centreline_stays_exact() -> None:
    rng = np.random.default_rng(0)
    for points in (
        np.array([[0.0, 0.0], [40000.0, 30000.0]]),
        np.stack([np.linspace(0, 3e4, 20001), 50 * np.sin(np.linspace(0, 300, 20001))], axis=-1),
    ):
        line, shape = index_centerline(points), shapely.LineString(points)
        places = places_around(points, rng)
        assert [is_off_centerline(line, *place) for place in places] == (
            shapely.distance(shape, shapely.points(places)) > 0.5
        ).tolist()
        np.testing.assert_allclose(
            [arc_length_at(line, *place) for place in places],
            shapely.line_locate_point(shape, shapely.points(places)),
            rtol=0,
            atol=1e-9,
        )


def test_a_centreline_without_length_is_refused() -> None:
    with pytest.raises(ValueError, match=r"centerline.*length"):
        index_centerline(np.full((3, 3), 7.0))


def test_further_columns_of_the_points_are_not_looked_at() -> None:
    with_heading = np.column_stack([ALONG_X, np.full(len(ALONG_X), np.nan)])
    assert arc_length_at(index_centerline(with_heading), 12.0, 1.0) == 12.0

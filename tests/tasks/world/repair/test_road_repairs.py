"""Passes on maps and lights: closed forms, slow twins, the second application, moved and turned worlds."""

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.world.arrays import Array
from tasks.world.repair.records import LEFT_OUT, RepairCount, repair_counts
from tasks.world.repair.road import (
    LaneSides,
    crossing_between,
    distinct_points,
    facing_boundaries,
    lights_on_map,
    simple_area,
    simple_crossing,
    sound_lanes,
)
from tasks.world.road_map import LightState, TrafficLights, centerline_from_boundaries

SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])


def moved(points: Array, angle: float, by: tuple[float, float]) -> Array:
    """Points (N, 2+) turned about the origin and moved in x, y."""
    c, s = np.cos(angle), np.sin(angle)
    xy = points[:, :2] @ np.array([[c, s], [-s, c]]) + by
    return np.column_stack([xy, points[:, 2:]])


def arc_lane(at: float, to: float, radius: float = 30.0, **links: object) -> LaneSides:
    """A lane along a circle about the origin, counterclockwise from one angle to another, 4 m wide."""
    angle = np.linspace(at, to, 9)
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(9)])
    return LaneSides((radius - 2.0) * around, (radius + 2.0) * around, **links)  # type: ignore[arg-type]


def chain(n: int) -> dict[str, LaneSides]:
    """n lanes one after the other, half of the links said by either side alone."""
    ends = np.linspace(0.0, 0.5 * n, n + 1)
    return {
        str(k): arc_lane(
            ends[k],
            ends[k + 1],
            successors=(str(k + 1),) if k % 2 else (),
            predecessors=(str(k - 1),) if k % 2 else (),
        )
        for k in range(n)
    }


def reverse(lane: LaneSides, side: str) -> LaneSides:
    return replace(lane, **{side: getattr(lane, side)[::-1]})


def same_lines(one: LaneSides, other: LaneSides) -> bool:
    return np.array_equal(one.left, other.left) and np.array_equal(one.right, other.right)


# Outlines.


def crosses_itself(ring: Array) -> bool:
    """Two sides that do not follow one another share a point: every pair of sides looked at, by orientation."""

    def turn(a: Array, b: Array, c: Array) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    sides = [(ring[i], ring[i + 1]) for i in range(len(ring) - 1)]
    return any(
        turn(a, b, c) * turn(a, b, d) < 0.0 and turn(c, d, a) * turn(c, d, b) < 0.0
        for (a, b), (c, d) in combinations(sides, 2)
    )


def shoelace(ring: Array) -> float:
    x, y = ring.T
    return abs(float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())) / 2.0


@pytest.mark.parametrize("edge2", [[[0.0, 3.0], [4.0, 3.0]], [[4.0, 3.0], [0.0, 3.0]]])
def test_a_crossing_is_the_same_rectangle_whichever_way_its_second_edge_is_listed(edge2: list[list[float]]) -> None:
    ring, repairs = crossing_between(SQUARE[:2], np.array(edge2), "7")
    assert ring is not None and shapely.Polygon(ring).area == 12.0
    assert np.array_equal(ring, np.concatenate([SQUARE, SQUARE[:1]]))
    if edge2[0][0] == 0.0:
        assert repairs == ()
    else:
        (repair,) = repairs
        assert (repair.what, repair.thing) == ("crossing", "7") and np.isnan(repair.time_s)
        assert "6.0 m2" in repair.was and "12.0 m2" in repair.now


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 5), st.integers(2, 5), st.booleans(), st.floats(0.0, 6.28))
def test_edges_of_any_shape_make_the_ring_whose_sides_do_not_cross(
    seed: int, n: int, m: int, turned: bool, angle: float
) -> None:
    """The twin tries the second edge both ways and looks at every pair of sides."""
    random = np.random.default_rng(seed)
    first, second = (
        moved(
            np.column_stack([np.linspace(0.0, 12.0, k), y + random.uniform(-0.8, 0.8, k)])
            + random.uniform(-0.5, 0.5, (k, 2)),
            angle,
            (5e3, -2e3),
        )
        for k, y in ((n, 0.0), (m, 4.0))
    )
    listed = second[::-1] if turned else second
    ways = [np.concatenate([first, way[::-1], first[:1]]) for way in (listed, listed[::-1])]
    twin = next(ring for ring in ways if not crosses_itself(ring))
    ring, repairs = crossing_between(first, listed, "x")
    assert ring is not None and np.array_equal(ring, twin)
    assert len(repairs) == int(turned)
    again, found = simple_crossing(ring, "x")
    assert again is not None and np.array_equal(again, ring) and found == ()


@pytest.mark.parametrize("order", [(0, 2, 1, 3), (0, 1, 3, 2), (0, 2, 3, 1)])
def test_four_corners_in_any_order_bound_the_square_between_them(order: tuple[int, ...]) -> None:
    ring, _ = simple_crossing(SQUARE[list(order)], "x")
    assert ring is not None and shapely.Polygon(ring).area == 12.0


def test_a_crossing_that_no_turn_puts_right_keeps_its_largest_part() -> None:
    star = np.array([[np.cos(a), np.sin(a)] for a in 2.0 * np.pi * np.array([0, 2, 4, 1, 3]) / 5.0])  # a pentagram
    ring, (repair,) = simple_crossing(10.0 * star, "x")
    assert ring is not None and shapely.Polygon(ring).is_valid
    assert repair.now.startswith("its largest part")
    area, (left,) = simple_area(np.array([[0, 0], [4, 3], [4, 0], [0, 9.0]]), "y")
    assert area is not None and left.now.startswith("its largest part") and left.what == "area"


@pytest.mark.parametrize(
    "outline", [SQUARE[:2], SQUARE[[0, 1, 0, 1]], np.full((5, 2), np.nan), np.array([[0, 0], [1, 1], [2, 2.0]]), []]
)
def test_an_outline_of_no_area_is_left_out(outline: Array) -> None:
    for rule in (simple_crossing, simple_area):
        ring, repairs = rule(np.asarray(outline, np.float64).reshape(-1, 2), "x")
        assert ring is None and [repair.now for repair in repairs] == [LEFT_OUT]


def test_an_edge_that_is_no_line_leaves_its_crossing_out() -> None:
    for edges in (
        (SQUARE[:1], SQUARE[2:]),
        (SQUARE[:2], np.array([[0, 3], [np.nan, 3]])),
        (SQUARE[:2], SQUARE[[3, 3]]),
    ):
        ring, repairs = crossing_between(*edges, "x")
        assert ring is None and [repair.now for repair in repairs] == [LEFT_OUT]


def test_a_sound_outline_is_the_very_same_array() -> None:
    closed = np.concatenate([SQUARE, SQUARE[:1]])
    assert simple_area(closed, "x")[0] is closed and simple_crossing(closed, "x")[0] is closed


# Points.


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([0.0, 1.0, 2.0, 3e8, float("nan"), float("inf")]), max_size=12))
def test_points_are_kept_as_one_that_walks_along_them_would(xs: list[float]) -> None:
    points = np.array([[x, 0.0, float(k)] for k, x in enumerate(xs)]).reshape(-1, 3)
    walked: list[Array] = []
    for point in points:
        if (abs(point) < 1e8).all() and not (walked and walked[-1][0] == point[0]):
            walked.append(point)
    kept, repairs = distinct_points(points, "boundary", "1", "left")
    assert np.array_equal(kept, np.array(walked).reshape(-1, 3))
    assert bool(repairs) == (len(kept) < len(points)) and all(repair.now != LEFT_OUT for repair in repairs)
    assert distinct_points(kept, "boundary", "1")[1] == ()


# Boundaries.


def test_a_boundary_that_runs_against_the_other_is_turned_by_the_lanes_before_and_after() -> None:
    lanes = chain(5)
    for turned in product((None, "left", "right"), repeat=5):
        given_lanes = {k: reverse(lane, side) if side else lane for (k, lane), side in zip(lanes.items(), turned)}
        found, repairs = sound_lanes(given_lanes)
        assert all(same_lines(found[k], lane) for k, lane in lanes.items())
        assert [(r.what, r.thing, r.now) for r in repairs] == [
            ("boundary", k, f"{side} turned") for k, side in zip(lanes, turned) if side
        ]
        assert sound_lanes(found)[1] == ()


def test_the_lanes_around_are_believed_before_the_names_of_the_sides() -> None:
    """A lane whose sides are named the wrong way round: what follows it says where it leads."""
    lanes = chain(3)
    swapped = replace(lanes["1"], left=lanes["1"].right, right=lanes["1"].left)
    for side in ("left", "right"):
        found, _ = facing_boundaries(lanes | {"1": reverse(swapped, side)})
        assert same_lines(found["1"], swapped)
        alone, _ = facing_boundaries({"1": reverse(swapped, side)})  # nothing but the names tells here
        assert same_lines(alone["1"], replace(swapped, left=swapped.left[::-1], right=swapped.right[::-1]))


def test_boundaries_are_laid_along_a_centreline_that_the_source_has() -> None:
    lane = arc_lane(0.0, 1.0)
    lane = replace(lane, centerline=(lane.left + lane.right) / 2.0)
    both = reverse(reverse(lane, "left"), "right")
    found, repairs = facing_boundaries({"a": lane, "b": reverse(lane, "left"), "c": reverse(lane, "right"), "d": both})
    assert all(same_lines(one, lane) for one in found.values())
    assert {r.thing: r.now for r in repairs} == {
        "b": "left turned",
        "c": "right turned",
        "d": "left and right turned",
    }
    assert facing_boundaries(found)[1] == ()


def test_a_turned_boundary_no_longer_shrinks_its_lane() -> None:
    x = np.linspace(0.0, 17.4, 3)
    left, right = (np.column_stack([x, np.full(3, y), np.zeros(3)]) for y in (1.5, -1.5))
    found, _ = sound_lanes({"1": LaneSides(left, right[::-1])})
    line = centerline_from_boundaries(found["1"].left, found["1"].right)
    assert np.hypot(*np.diff(line[:, :2], axis=0).T).sum() == pytest.approx(17.4)
    assert np.allclose(line[:, 2], 0.0)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.sampled_from([None, "left", "right"]), min_size=5, max_size=5),
    st.floats(0.0, 6.28),
    st.permutations(range(5)),
)
def test_which_boundary_is_turned_depends_on_neither_place_nor_order(
    turned: list[str | None], angle: float, order: list[int]
) -> None:
    lanes = {k: reverse(v, side) if side else v for (k, v), side in zip(chain(5).items(), turned)}
    elsewhere = {
        k: replace(v, left=moved(v.left, angle, (9e3, -4e3)), right=moved(v.right, angle, (9e3, -4e3)))
        for k, v in (list(lanes.items())[i] for i in order)
    }
    here, there = facing_boundaries(lanes), facing_boundaries(elsewhere)
    assert (set(here[1]) and set(map(str, here[1])) == set(map(str, there[1]))) or not any(turned)
    for k, lane in here[0].items():
        assert np.allclose(moved(lane.left, angle, (9e3, -4e3)), there[0][k].left)


def test_lanes_that_are_none_are_left_out_and_their_links_hurt_nobody() -> None:
    lanes = chain(3)
    middle = lanes["1"]
    point = np.repeat(middle.left[:1], 4, axis=0)
    for broken in (
        replace(middle, left=point, right=point),
        replace(middle, right=middle.right[:1]),
        replace(middle, left=np.full((3, 3), np.nan)),
        replace(middle, right=middle.left),
        replace(middle, left=middle.left * 1e-5, right=middle.right * 1e-5),
        replace(middle, left=middle.left * [1e5, 1.0, 1.0]),
    ):
        found, repairs = sound_lanes(lanes | {"1": broken})
        assert list(found) == ["0", "2"] and all(same_lines(found[k], lanes[k]) for k in found)
        assert repair_counts(repairs) == (RepairCount("lane", 0, 1),)
        assert [(repair.thing, repair.now) for repair in repairs] == [("1", LEFT_OUT)]


def test_sound_lanes_are_the_very_same_arrays() -> None:
    lanes = chain(3)
    found, repairs = sound_lanes(lanes)
    assert repairs == () and list(found) == list(lanes)
    assert all(found[k].left is lane.left and found[k].right is lane.right for k, lane in lanes.items())


# Lights.


def test_lights_of_no_lane_are_left_out_and_those_of_lanes_far_away_without_a_word() -> None:
    states = np.arange(6, dtype=np.int8).reshape(2, 3) % 4
    lights = TrafficLights(("near", "far", "nowhere"), states)
    found, repairs = lights_on_map(lights, {"near": None, "other": None}, {"far"})
    assert found.lane_ids == ("near",) and np.array_equal(found.states, states[:, :1])
    assert [(r.what, r.thing, r.now) for r in repairs] == [("light", "nowhere", LEFT_OUT)]
    assert lights_on_map(found, {"near"}) == (found, ())
    assert LightState(int(found.states[0, 0])) == LightState.UNKNOWN

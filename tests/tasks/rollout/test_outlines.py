"""Outlines of strips and boxes against GEOS's own: `shapely.buffer`, `union_all`, `simplify`, `distance`."""

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tasks.kernels.compiled import kernel
from tasks.rollout.outlines import (
    QUADRANT,
    ROUNDING_M,
    UNSURE,
    apart,
    bounds,
    box_ring,
    is_firm,
    joined_ring,
    outlines_touch,
    strip_ring,
)

Array = NDArray[np.float64]
MOST = 200
ORIGIN = np.zeros(2)
seeds = st.integers(0, 2**31)


@kernel
def strip_of(line: Array, half_width: float, ring: Array) -> int:
    return strip_ring(line, line.shape[1], half_width, ring)


@kernel
def footprint_of(line: Array, box: Array, strip: Array, ring: Array) -> int:
    outer, inner = np.empty((3, 4)), np.empty((3, 4))
    box_ring(box, ORIGIN, 0.0, outer)
    box_ring(box, ORIGIN, ROUNDING_M, inner)
    n = strip_ring(line, line.shape[1], 0.5 * box[4], strip)
    return joined_ring(strip, n, outer, inner, ring) if n > 0 else UNSURE


@kernel
def gap_of(a: Array, b: Array) -> tuple[float, bool]:
    around_a, around_b, n, m = np.empty(4), np.empty(4), a.shape[1], b.shape[1]
    bounds(a, n, around_a)
    bounds(b, m, around_b)
    if outlines_touch(a, n, b, m, around_b):
        return 0.0, True
    gap = apart(a, n, b, m, around_b)
    return gap, is_firm(a, n, b, m, around_b, gap) and is_firm(b, m, a, n, around_a, gap)


def path(rng: np.random.Generator) -> Array:
    """(2, P) a line that bends by as much at each point as lanes do, or hardly, or not at all."""
    n, bend = int(rng.integers(3, 15)), 10.0 ** rng.uniform(-7.0, -1.0)
    turns = rng.normal(bend, bend, n) * (rng.random() < 0.9) * rng.choice([-1.0, 1.0])
    heading = rng.uniform(-3.0, 3.0) + np.cumsum(turns)
    steps = rng.uniform(0.3, 1.5, n) * [np.cos(heading), np.sin(heading)]
    return np.cumsum(np.column_stack([rng.uniform(-20.0, 20.0, 2), steps]), axis=1)


def footprint(rng: np.random.Generator) -> tuple[Array, shapely.Geometry] | None:
    """Of a box that stands somewhere on a path, in both ways; None where ours is not sure."""
    line, length, width = path(rng), rng.uniform(0.5, 5.0), rng.uniform(1.5, 2.5)
    step = line[:, 1] - line[:, 0]
    heading = np.arctan2(step[1], step[0]) + rng.choice([0.0, rng.normal(0.0, 0.05)])
    box = np.array(
        [*(line[:, 0] + 0.5 * length * np.array([np.cos(heading), np.sin(heading)])), heading, length, width]
    )
    strip, ring = np.empty((3, MOST)), np.empty((3, MOST))
    corners = footprint_of(line, box, strip, ring)
    if corners == UNSURE:
        return None
    outer = np.empty((3, 4))
    box_ring_of(box, outer)
    buffered = shapely.buffer(shapely.LineString(line.T), width / 2.0, quad_segs=QUADRANT, cap_style="flat")
    return ring[:, :corners].copy(), shapely.union_all([buffered, shapely.Polygon(outer[:2].T)])


@kernel
def box_ring_of(box: Array, ring: Array) -> int:
    return box_ring(box, ORIGIN, 0.0, ring)


@given(seeds)
@settings(max_examples=300, deadline=None)
def test_a_strip_is_outlined_as_geos_outlines_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    line, half_width, ring = path(rng), rng.uniform(0.5, 1.3), np.empty((3, MOST))
    n = strip_of(line, half_width, ring)
    if n != UNSURE:
        theirs = shapely.buffer(shapely.LineString(line.T), half_width, quad_segs=QUADRANT, cap_style="flat")
        assert shapely.hausdorff_distance(shapely.Polygon(ring[:2, :n].T), theirs) < 1e-9


@given(seeds)
@settings(max_examples=300, deadline=None)
def test_a_footprint_is_the_union_of_strip_and_box(seed: int) -> None:
    found = footprint(np.random.default_rng(seed))
    if found is not None:
        ring, theirs = found
        assert shapely.symmetric_difference(shapely.Polygon(ring[:2].T), theirs).area < 1e-8


@given(seeds)
@settings(max_examples=500, deadline=None)
def test_a_firm_gap_is_geos_s_however_often_it_simplifies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one, other = footprint(rng), footprint(rng)
    if one is None or other is None:
        return
    gap, firm = gap_of(one[0], other[0])
    a, b = one[1], other[1]
    for _ in range(3):
        a, b = (shapely.simplify(shape, 1e-5, preserve_topology=True) for shape in (a, b))
        if firm:
            assert abs(shapely.distance(a, b) - gap) < 1e-9
        else:
            assert abs(shapely.distance(a, b) - gap) < 1e-4


def test_a_turn_on_the_spot_and_a_point_twice_are_not_sure() -> None:
    ring = np.empty((3, MOST))
    for line in ([[0.0, 1.0, 0.5], [0.0, 0.0, 0.0]], [[0.0, 1.0, 1.0, 2.0], [0.0, 0.0, 0.0, 0.0]]):
        assert strip_of(np.array(line), 1.0, ring) == UNSURE
    assert strip_of(np.array([[0.0, 1.0], [0.0, 0.0]]), 1.0, ring) == 4

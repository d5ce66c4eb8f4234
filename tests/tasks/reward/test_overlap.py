"""Pairs of boxes: the kernels agree with polygon geometry and with the numpy version."""

import math

import numpy as np
import pytest
import shapely

from tasks.kernels.compiled import kernel
from tasks.reward.collisions import ROUNDING_M, Box, centroid, gap_m, touching
from tasks.world import frames
from tasks.world.frames import box_corners


def box(x: float, y: float, heading: float, length: float, width: float) -> Box:
    return Box(x, y, heading, math.cos(heading), math.sin(heading), length, width)


def random_boxes(rng: np.random.Generator, n: int, shift_m: float = 0.0) -> np.ndarray:
    """Boxes (n, 5); headings are often multiples of a right angle, sizes often equal, so that edges align."""
    center = rng.uniform(-4, 4, (n, 2))
    center[::3] = np.round(center[::3])
    heading = np.where(rng.random(n) < 0.5, rng.integers(-4, 5, n) * np.pi / 2, rng.uniform(-7, 7, n))
    size = np.where(rng.random((n, 2)) < 0.5, rng.integers(0, 4, (n, 2)), rng.uniform(0.0, 5.0, (n, 2)))
    return np.concatenate([center + shift_m, heading[:, None], size], axis=1)


def test_boxes_touch_exactly_where_the_numpy_version_says_so() -> None:
    rng = np.random.default_rng(1)
    first, second = random_boxes(rng, 4000), random_boxes(rng, 4000)
    verdict = np.array([touching(box(*a), box(*b)) for a, b in zip(first, second)])
    assert 0.1 < verdict.mean() < 0.9
    assert np.array_equal(verdict, frames.touching(first, second))


@kernel
def gap(first: Box, second: Box) -> float:
    return gap_m(first, second)


def test_boxes_with_a_gap_never_touch_and_those_that_overlap_always_do() -> None:
    rng = np.random.default_rng(3)
    pairs = [(box(*a), box(*b)) for a, b in zip(random_boxes(rng, 4000), random_boxes(rng, 4000))]
    gaps = np.array([gap(a, b) for a, b in pairs])
    touches = np.array([touching(a, b) for a, b in pairs])
    assert not touches[gaps > ROUNDING_M].any() and touches[gaps < -ROUNDING_M].all()
    assert (np.abs(gaps) > ROUNDING_M).mean() > 0.9  # the rest are edges that meet


def test_boxes_that_share_an_edge_touch_and_absent_ones_do_not() -> None:
    one = box(0.0, 0.0, 0.0, 4.0, 2.0)
    assert touching(one, box(4.0, 0.0, 0.0, 4.0, 2.0)) and gap(one, box(4.0, 0.0, 0.0, 4.0, 2.0)) == 0.0
    assert not touching(one, box(4.0 + 1e-9, 0.0, 0.0, 4.0, 2.0))
    assert not touching(one, box(*[math.nan] * 5))


@pytest.mark.parametrize("shift_m", [0.0, 1e3, 1e6])
@pytest.mark.parametrize("flat", ["no", "length", "width", "both", "nearly"])
def test_centroids_equal_those_of_geos_to_the_last_bit(shift_m: float, flat: str) -> None:
    boxes = random_boxes(np.random.default_rng(4), 1000, shift_m)
    if flat in ("length", "both"):
        boxes[:, 3] = 0.0
    if flat in ("width", "both"):
        boxes[:, 4] = 0.0
    if flat == "nearly":
        boxes[:, 4] = 1e-13
    expected = shapely.get_coordinates(shapely.centroid(shapely.polygons(box_corners(boxes))))
    assert np.array_equal([centroid(box(*row)) for row in boxes], expected)

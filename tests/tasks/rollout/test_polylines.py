"""Small kernels along polylines, against numpy's own."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tasks.rollout.corridor import least_and_largest
from tasks.rollout.lane_following import _order_along

NUMBERS = st.lists(st.integers(-3, 3), min_size=1, max_size=12)


@given(NUMBERS)
def test_rows_go_by_their_place_along_and_equals_as_they_came(places: list[int]) -> None:
    beside = np.array([(place, 0.0) for place in places], float)
    np.testing.assert_array_equal(_order_along(beside), np.argsort(beside[:, 0], kind="stable"))


@given(NUMBERS)
def test_an_extent_is_the_least_and_the_largest(values: list[int]) -> None:
    assert least_and_largest(np.array(values, float)) == (min(values), max(values))

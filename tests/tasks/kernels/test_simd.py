"""Sixteen numbers as one value, against numpy."""

from typing import Any

import numpy as np
import pytest

from tasks.kernels.compiled import kernel
from tasks.kernels.simd import (
    fill,
    fma,
    greatest,
    lane_indices,
    larger,
    load,
    smaller,
    store,
    sums,
    where_at_least,
    where_below,
)

RNG = np.random.default_rng(0)
A, B, C = RNG.normal(size=(3, 16)).astype(np.float32)


@kernel
def _all(a: Any, b: Any, c: Any, out: Any) -> Any:
    x, y, z = load(a, np.uint64(0)), load(b, np.uint64(0)), load(c, np.uint64(0))
    results = (
        x + y,
        x - y,
        x * y,
        x / y,
        fma(x, y, z),
        smaller(x, y),
        larger(x, y),
        where_at_least(x, y, z),
        where_below(x, y, z),
        fill(a[3]),
        lane_indices(),
        sums((x, y, z, x, y)),
    )
    for k, result in enumerate(results):
        store(out, np.uint64(16 * k), result)
    return greatest(x)


def in_halves(values: np.ndarray) -> np.float32:
    """The sum in the one order that is promised."""
    while len(values) > 1:
        values = values[: len(values) // 2] + values[len(values) // 2 :]
    return values[0]


def test_lanes_do_what_numpy_does_to_the_bit() -> None:
    out = np.empty((12, 16), np.float32)
    assert _all(A, B, C, out) == A.max()
    exact = (A.astype(np.float64) * B + C).astype(np.float32)
    five = [in_halves(v) for v in (A, B, C, A, B)]
    expected = [
        A + B,
        A - B,
        A * B,
        A / B,
        exact,
        np.minimum(A, B),
        np.maximum(A, B),
        np.where(A >= B, C, 0),
        np.where(A < B, C, 0),
        np.full(16, A[3]),
        np.arange(16),
        np.concatenate([five, np.zeros(11)]),
    ]
    np.testing.assert_array_equal(out, np.array(expected, np.float32))


@kernel
def _shifted(array: Any, at: int, out: Any) -> None:
    store(out, np.uint64(at), load(array, np.uint64(at)))


@pytest.mark.parametrize("at", [0, 1, 5, 16])
def test_rows_are_read_and_written_from_any_place(at: int) -> None:
    array, out = np.arange(32, dtype=np.float32), np.full(32, -1, np.float32)
    _shifted(array, at, out)
    np.testing.assert_array_equal(out[at : at + 16], array[at : at + 16])
    assert (np.delete(out, np.arange(at, at + 16)) == -1).all()

"""Intervals and p of few clusters: closed forms, and twins that compute every draw as the papers have it."""

from itertools import product

import numpy as np
import pytest
from scipy import stats

from planners.evaluation.bootstrap import paired_interval
from planners.evaluation.few_clusters import (
    WEBB,
    ClusterScores,
    cluster_weights,
    sign_flip_p,
    student_interval,
    wild_interval,
    wild_p,
)


def of_values(values: list[float], sizes: list[int] | None = None) -> ClusterScores:
    """One value of each cluster, which weighs as much as its size."""
    x, weights = np.array(values), np.array(sizes or [1] * len(values), float)
    share = weights / weights.sum()
    mean = float((share * x).sum())
    return ClusterScores(mean, share * (x - mean), share)


def t_of(x: np.ndarray, weights: np.ndarray, null: float) -> float:
    """Of the weighted mean, with the cluster-robust error of G / (G - 1), step by step."""
    mean = sum(w * v for w, v in zip(weights, x)) / sum(weights)
    squares = sum((w * (v - mean)) ** 2 for w, v in zip(weights, x)) / sum(weights) ** 2
    error = np.sqrt(len(x) / (len(x) - 1) * squares)
    return (mean - null) / error if error > 1e-12 else np.inf


def test_of_equal_clusters_the_interval_is_that_of_a_mean() -> None:
    values = [3.0, 1.0, 4.0, 1.5, 9.0, 2.6]
    low, high = student_interval(of_values(values), 0.95)
    expected = stats.t.interval(0.95, 5, np.mean(values), stats.sem(values))
    assert (low, high) == pytest.approx(expected)


@pytest.mark.parametrize("sizes", [[1] * 7, [1, 5, 2, 2, 8, 3, 1]])
@pytest.mark.parametrize("null", [0.0, 2.0, -3.5])
def test_p_of_the_wild_bootstrap_is_that_of_data_drawn_under_the_null(sizes: list[int], null: float) -> None:
    """The twin makes each draw's data, null + v (x - null), and computes its t anew."""
    values, weights = [3.0, 1.0, 4.0, -1.5, 9.0, 2.6, 0.1], np.array(sizes, float)
    scores = of_values(values, sizes)
    v = cluster_weights(7, 400, 3)
    x = np.array(values)
    found = [abs(t_of(null + draw * (x - null), weights, null)) for draw in v]
    slow = np.mean(np.array(found) >= abs(t_of(x, weights, null)) * (1.0 - 1e-9))
    assert wild_p(scores, v)(scores.difference - null) == pytest.approx(slow)


def test_the_interval_is_what_is_not_refused() -> None:
    scores = of_values([3.0, 1.0, 4.0, -1.5, 9.0, 2.6, 0.1, 5.0])
    low, high = wild_interval(scores, 0.9, 2000, 0)
    p = wild_p(scores, cluster_weights(8, 2000, 0))
    for end, out in ((low, -1e-6), (high, 1e-6)):
        assert p(scores.difference - end - out) < 0.1 <= p(scores.difference - end + out)


def test_of_many_clusters_it_is_near_students_and_of_two_it_has_no_end() -> None:
    many = of_values(np.random.default_rng(1).normal(0.4, 1.0, 19).tolist())
    np.testing.assert_allclose(wild_interval(many, 0.95, 9999, 0), student_interval(many, 0.95), atol=0.05)
    assert np.isinf(wild_interval(of_values([1.0, 2.0]), 0.95, 999, 0)).all()
    assert wild_interval(of_values([2.0, 2.0, 2.0]), 0.95, 999, 0) == (2.0, 2.0)


def test_weights_have_mean_0_and_variance_1() -> None:
    for n in (5, 15):
        v = cluster_weights(n, 20_000, 0)
        assert set(np.unique(v)) == set(WEBB if n < 12 else [-1.0, 1.0])
        np.testing.assert_allclose([v.mean(), v.var()], [0.0, 1.0], atol=0.01)
    every = cluster_weights(12, 5000, 0)
    assert len({tuple(one) for one in every}) == len(every) == 2**12


def test_flips_are_all_tried_and_six_of_one_sign_are_1_in_32() -> None:
    assert sign_flip_p(of_values([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), 10, 0) == 2 / 64
    rng = np.random.default_rng(0)
    for n in (2, 5, 9):
        values = rng.normal(0.5, 1.0, n)
        slow = np.mean([abs(np.dot(s, values)) >= abs(values.sum()) - 1e-9 for s in product((-1, 1), repeat=n)])
        assert sign_flip_p(of_values(values.tolist()), 10, 0) == pytest.approx(slow)
    assert sign_flip_p(of_values([0.0] * 4), 10, 0) == 1.0


def test_of_many_clusters_flips_are_drawn() -> None:
    values = np.random.default_rng(0).normal(0.3, 1.0, 40)
    found = sign_flip_p(of_values(values.tolist()), 20_000, 0)
    assert found == pytest.approx(stats.ttest_1samp(values, 0.0).pvalue, abs=0.02)


def test_what_is_clear_is_clear_by_each_of_them() -> None:
    """Five towns of the paper's kind: the interval holds both, and rates per km whose weights differ have one too."""
    a, b = np.zeros((1, 5)), np.array([[0.1, 0.02, 0.09, 0.01, 0.3]])
    found = paired_interval(a, b, clusters=list("abcde"), draws=2000)
    assert found.low == min(found.student[0], found.wild[0]) and found.high == max(found.student[1], found.wild[1])
    assert found.p == 2 / 32
    weights = np.ones((1, 5)), np.array([[1.0, 2.0, 3.0, 1.0, 1.0]])
    rates = paired_interval(a, b, weights=weights, clusters=list("abcde"), draws=500)
    assert np.isfinite([*rates.student, *rates.wild, rates.p]).all()
    alone = paired_interval(a, b, draws=500)
    assert np.isnan([*alone.student, *alone.wild, alone.p]).all()

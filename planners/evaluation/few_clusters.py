"""Where a difference lies that few clusters decide: Student's t over them, the wild cluster bootstrap, sign flips.

All three take a difference as the sum of what G clusters add to it. A percentile bootstrap over whole clusters has too
few different draws and takes their spread for known, so that of few clusters its intervals are too narrow.

* `student_interval`: the cluster-robust standard error, with G / (G - 1), times Student's t of G - 1 degrees of freedom
  (Cameron & Miller 2015, "A practitioner's guide to cluster-robust inference", VI.A).
* `wild_interval`: the wild cluster bootstrap of t with the null imposed (Cameron, Gelbach & Miller 2008, "Bootstrap-
  based improvements for inference with clustered errors"), turned into an interval: what is not refused. Weights of
  clusters are Rademacher's +-1 from 12 clusters on, all of them where these are fewer than the draws; below, where
  these would be few, Webb's six (Webb 2013, QED working paper 1315, "Reworking wild bootstrap-based inference").
* `sign_flip_p`: how often the sum is as large where each cluster's part has the other sign at random (Fisher 1935),
  which would change nothing if both sides were alike. Of six clusters it is at least 1/32.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from tasks.world.arrays import Array

Span = tuple[float, float]
FEWEST_RADEMACHER = 12  # clusters: 2^11 different sizes of t
WEBB = np.array([-np.sqrt(1.5), -1.0, -np.sqrt(0.5), np.sqrt(0.5), 1.0, np.sqrt(1.5)])
MOST_EXACT = 20  # clusters whose flips are all tried: 2^19 sums
NEVER = 1e9  # standard errors from the difference, where an interval has no end
STEPS = 60  # of bisection
EQUAL = 1e-9  # relative: sums and sizes of t this near are equal but for rounding


@dataclass(frozen=True, eq=False)
class ClusterScores:
    """A difference of weighted means, cluster by cluster."""

    difference: float
    off: Array  # (G,) by how much each moves the difference, sum 0: sum of w (x - mean) / sum of all w
    share: Array  # (G,) of all weights, sum 1

    @property
    def error(self) -> float:
        """The standard error of the difference; needs two clusters."""
        n = len(self.off)
        return float(np.sqrt(n / (n - 1) * (self.off**2).sum()))


def student_interval(scores: ClusterScores, confidence: float) -> Span:
    """Of Student's t with a degree of freedom less than there are clusters."""
    half = float(stdtrit(len(scores.off) - 1, (1.0 + confidence) / 2.0)) * scores.error
    return scores.difference - half, scores.difference + half


def wild_interval(scores: ClusterScores, confidence: float, draws: int, seed: int) -> Span:
    """Where the wild cluster bootstrap does not refuse the null; ends may be infinite, as of two or three clusters."""
    if scores.error <= EQUAL * abs(scores.difference):
        return scores.difference, scores.difference
    p = wild_p(scores, cluster_weights(len(scores.off), draws, seed))
    below = _farthest(lambda errors: p(errors * scores.error), 1.0 - confidence)
    above = _farthest(lambda errors: p(-errors * scores.error), 1.0 - confidence)
    return scores.difference - below * scores.error, scores.difference + above * scores.error


def cluster_weights(n: int, draws: int, seed: int) -> Array:
    """(D, n) of mean 0 and variance 1: Webb's six below FEWEST_RADEMACHER clusters, else +-1, each once if D allows."""
    rng = np.random.default_rng(seed)
    if n < FEWEST_RADEMACHER:
        return rng.choice(WEBB, (draws, n))
    if 2**n <= draws:
        return np.where(np.arange(2**n)[:, None] >> np.arange(n) & 1, -1.0, 1.0)
    return rng.choice([-1.0, 1.0], (draws, n))


def wild_p(scores: ClusterScores, weights: Array) -> Callable[[float], float]:
    """p of the null that the true difference lies `shift` below the measured one: shift -> p.

    A draw is sum_g v_g u_g of u_g = off_g + shift * share_g, whose own standard error is of v_g u_g - share_g * draw:
    both are linear in the shift, so that of each draw three sums are enough for every null.
    """
    n = len(scores.off)
    off, share = weights * scores.off, weights * scores.share
    sums = off.sum(axis=1), share.sum(axis=1)
    left, along = (part - scores.share * total[:, None] for part, total in zip((off, share), sums))
    squares = [(one * other).sum(axis=1) * n / (n - 1) for one, other in ((left, left), (left, along), (along, along))]

    def p(shift: float) -> float:
        draw = sums[0] + shift * sums[1]
        variance = squares[0] + 2.0 * shift * squares[1] + shift**2 * squares[2]
        return float(np.mean((draw * scores.error) ** 2 >= (1.0 - EQUAL) * shift**2 * variance))

    return p


def sign_flip_p(scores: ClusterScores, draws: int, seed: int) -> float:
    """Two-sided; exact where there are at most MOST_EXACT clusters, else of random flips, the measured among them."""
    parts = scores.off + scores.share * scores.difference
    if len(parts) > MOST_EXACT:
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], (draws, len(parts)))
        sums = np.append(signs @ parts, parts.sum())
    else:
        sums = parts[:1]  # of either sign alike, so the first keeps its own
        for part in parts[1:]:
            sums = np.concatenate([sums + part, sums - part])
    return float(np.mean(np.abs(sums) >= abs(parts.sum()) - EQUAL * np.abs(parts).sum()))


def _farthest(p: Callable[[float], float], alpha: float) -> float:
    """The largest x whose p(x) is not below alpha, by doubling and bisection from 0, where it is 1."""
    low, high = 0.0, 1.0
    while p(high) >= alpha:
        low, high = high, 2.0 * high
        if high > NEVER:
            return np.inf
    for _ in range(STEPS):
        middle = (low + high) / 2.0
        low, high = (middle, high) if p(middle) >= alpha else (low, middle)
    return high

"""How far the difference of two planners may lie from the measured one, over clips, logs or towns, and seeds.

Both planners were scored on the same clips, so clips are drawn once for both and the differences keep their pairs.
Several trainings of each are a second level: with equally many on both sides they are pairs (the same seeds) and are
drawn as pairs, else on each side by itself. An interval runs between percentiles of the drawn differences
(Efron & Tibshirani 1993, ch. 13).

Clips that share a log or a town are no independent draws: where their clusters are given, whole clusters are drawn.
From few clusters, as six towns are, such a bootstrap is too narrow, so the interval then holds the one of Student's t
with a degree of freedom less than there are clusters as well (Cameron & Miller 2015, VI.A; trainings as they are) and,
of fewer than FEW_CLUSTERS, that of the wild cluster bootstrap. What is clear is clear by each of them; beside them
stands a p of sign flips (planners/evaluation/few_clusters.py).
"""

import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from planners.evaluation.few_clusters import ClusterScores, Span, sign_flip_p, student_interval, wild_interval
from tasks.world.arrays import Array, Indices

LEVELS = ("clip", "log", "town")
_SYNTHETIC_LOG = re.compile(r"(town-\d+)-\d{4}-")  # as the synthetic town calls its logs


def town_of(log_id: str) -> str:
    """The town of a synthetic log; empty for logs of other data sets, whose ids name no place."""
    found = _SYNTHETIC_LOG.match(log_id)
    return found[1] if found else ""


def cluster_labels_by_level(clips: Sequence[str], logs: Sequence[str]) -> Mapping[str, tuple[str, ...]]:
    """Level -> cluster of each clip, for those of LEVELS that are known of every clip; logs: empty where unknown."""
    towns = [town_of(log) for log in logs]
    known = {"clip": clips, "log": logs, "town": towns}
    return {level: tuple(names) for level, names in known.items() if all(names)}


DRAWS_AT_ONCE = 256  # bounds memory
FEW_CLUSTERS = 20  # fewer are drawn wildly too


@dataclass(frozen=True)
class Interval:
    """A mean difference and where it lies; NaN bounds where one cluster is all there is."""

    difference: float  # b - a
    low: float
    high: float
    a: float = np.nan
    b: float = np.nan
    n: int = 0  # clips, or clusters of them, that were drawn
    student: Span = (np.nan, np.nan)  # of Student's t over clusters alone; NaN over clips
    wild: Span = (np.nan, np.nan)  # of the wild cluster bootstrap; NaN from FEW_CLUSTERS on
    p: float = np.nan  # of sign flips of whole clusters, two-sided; exact up to 20 clusters

    @property
    def is_clear(self) -> bool:
        """Whether zero lies outside; not where there is no interval."""
        return self.low > 0.0 or self.high < 0.0


def paired_interval(
    a: Array,
    b: Array,
    *,
    weights: tuple[Array, Array] | None = None,
    clusters: Sequence[Hashable] | None = None,
    confidence: float = 0.95,
    draws: int = 10_000,
    seed: int = 0,
) -> Interval:
    """The mean of b minus that of a over the same C clips, with its interval.

    a, b: (S_a, C), (S_b, C) scores of each training on each clip; weights: of the same shapes, what each score counts
    in a mean (the number of frames), by default equal; clusters: of each clip, whose interval is the wider of both, by
    default each clip is drawn alone. From a single cluster nothing can be drawn, and the interval is NaN. Raises
    ValueError for other shapes, no clip, scores that are not finite, or a confidence that is not between 0 and 1.
    """
    counts = weights if weights is not None else (np.ones_like(a), np.ones_like(b))
    _check(a, b, counts, confidence, draws)
    own = list(clusters) if clusters is not None else list(range(a.shape[1]))
    if len(own) != a.shape[1]:
        raise ValueError(f"clusters must name one for each of {a.shape[1]} clips, got {len(own)}")
    place = {cluster: i for i, cluster in enumerate(dict.fromkeys(own))}
    cluster_of_clip, n_clusters = np.array([place[cluster] for cluster in own]), len(place)
    mean_a, mean_b = (float((x * w).sum() / w.sum()) for x, w in zip((a, b), counts))
    if n_clusters == 1 and clusters is not None:
        return Interval(mean_b - mean_a, np.nan, np.nan, mean_a, mean_b, n_clusters)
    rng = np.random.default_rng(seed)
    paired = len(a) == len(b)
    differences = np.empty(draws)
    for start in range(0, draws, DRAWS_AT_ONCE):
        size = min(DRAWS_AT_ONCE, draws - start)
        clips = _draw_counts(rng, size, n_clusters)[:, cluster_of_clip]
        of_a = _draw_counts(rng, size, len(a))
        of_b = of_a if paired else _draw_counts(rng, size, len(b))
        differences[start : start + size] = _means(b, counts[1], of_b, clips) - _means(a, counts[0], of_a, clips)
    low, high = np.quantile(differences, [(1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0])
    if clusters is None:
        return Interval(mean_b - mean_a, float(low), float(high), mean_a, mean_b, n_clusters)
    (off_b, size_b), (off_a, size_a) = (_moved(x, w, cluster_of_clip) for x, w in ((b, counts[1]), (a, counts[0])))
    scores = ClusterScores(mean_b - mean_a, off_b - off_a, (size_a + size_b) / 2.0)
    least, most = float(b.min() - a.max()), float(b.max() - a.min())  # no mean leaves the range of its scores
    spans = [student_interval(scores, confidence)]
    spans += [wild_interval(scores, confidence, draws, seed)] if n_clusters < FEW_CLUSTERS else []
    spans = [(max(one[0], least), min(one[1], most)) for one in spans]
    low, high = (float(end(each)) for end, each in zip((min, max), zip(*spans, (low, high))))
    wild = spans[1] if len(spans) > 1 else (np.nan, np.nan)
    p = sign_flip_p(scores, draws, seed)
    return Interval(mean_b - mean_a, low, high, mean_a, mean_b, n_clusters, spans[0], wild, p)


def _moved(scores: Array, weights: Array, cluster_of_clip: Indices) -> tuple[Array, Array]:
    """(G,) by how much the scores of each cluster move the weighted mean, and each cluster's share of its weights."""
    off = weights * (scores - (scores * weights).sum() / weights.sum())
    moved, shares = (np.bincount(cluster_of_clip, x.sum(axis=0)) / weights.sum() for x in (off, weights))
    return moved, shares


def _draw_counts(rng: np.random.Generator, size: int, n: int) -> Array:
    """How often each of n is drawn in `size` draws of n with replacement: (size, n)."""
    return rng.multinomial(n, np.full(n, 1.0 / n), size=size).astype(np.float64)


def _means(scores: Array, weights: Array, seeds: Array, clips: Array) -> Array:
    """Weighted mean of (S, C) in each of the draws: seeds (D, S), clips (D, C)."""
    total: Array = np.einsum("ds,sc,dc->d", seeds, scores * weights, clips, optimize=True)
    count: Array = np.einsum("ds,sc,dc->d", seeds, weights, clips, optimize=True)
    return total / count


def _check(a: Array, b: Array, weights: tuple[Array, Array], confidence: float, draws: int) -> None:
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1] or 0 in a.shape or 0 in b.shape:
        raise ValueError(f"a and b must be (seeds, clips) over the same clips, got {a.shape} and {b.shape}")
    for name, scores, counts in (("a", a, weights[0]), ("b", b, weights[1])):
        if counts.shape != scores.shape or not (counts > 0.0).all():
            raise ValueError(f"weights of {name} must be positive and {scores.shape}, got {counts.shape}")
        if not np.isfinite(scores).all():
            raise ValueError(f"{name} holds scores that are not numbers: leave out what was not scored")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie between 0 and 1, not {confidence}")
    if draws < 1:
        raise ValueError(f"draws must be at least 1, not {draws}")

"""What a budget is spent on: which clips are drawn, and which of their candidates are tried first.

A clip weighs by its tags, by how rare its cluster is (the clips with the same tags), by how often the planner fails in
that cluster and by how it scored in the clip itself. A lot is a function of (seed, clip) alone, so that a larger draw
holds every smaller one (Efraimidis and Spirakis 2006: the smallest -ln(u) / w are a draw without replacement).
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tasks.settings import SampleWeights
from tasks.world.arrays import Array, Ints
from tasks.world.chance import stream

LEAST = 0.05  # of 1 - EPDMS, so that a clip in which a planner does well is drawn now and then
PRIOR = 2.0  # drives that a cluster or cell is thought to have had beside its own, failing as often as all did

Cell = tuple[int, int]


@dataclass(frozen=True)
class ClipFacts:
    """What is known of a clip before it is drawn."""

    clip_id: str
    tags: tuple[str, ...]
    score: float  # EPDMS of the planner's drive from the log
    n_drives: int  # of the planner, from the log and from where it drifted to
    n_failing: int  # of them


@dataclass(frozen=True)
class CellWeights:
    """How much a candidate is wanted by where it ends."""

    by_cell: Mapping[Cell, float]
    elsewhere: float

    def of(self, cells: Ints) -> Array:
        """(n,) of cells (n, 2)."""
        return np.array([self.by_cell.get((int(i), int(j)), self.elsewhere) for i, j in cells])


def clip_weights(clips: Sequence[ClipFacts], weights: SampleWeights) -> dict[str, float]:
    """clip_id -> weight, above 0 but for tags that weigh 0. Raises ValueError where all weigh 0."""
    cluster = defaultdict(list)
    for clip in clips:
        cluster[clip.tags].append(clip)
    overall = _rate(sum(clip.n_failing for clip in clips), sum(clip.n_drives for clip in clips), 0.5)
    found = {}
    for tags, members in cluster.items():
        fails = _rate(sum(one.n_failing for one in members), sum(one.n_drives for one in members), overall)
        of_cluster = (len(clips) / len(members)) ** weights.rarity * fails**weights.cluster
        of_cluster *= math.prod(factor for tag, factor in weights.tags.items() if tag in tags)
        for one in members:
            found[one.clip_id] = of_cluster * max(1.0 - one.score, LEAST) ** weights.score
    if found and not any(found.values()):
        raise ValueError("sample.tags: every clip weighs 0")
    return found


def cell_weights(ends: Sequence[tuple[Cell, bool]]) -> CellWeights:
    """By how often a planner fails from there; ends: the cell of each state that it drifted into, whether it failed."""
    counts: dict[Cell, list[int]] = defaultdict(lambda: [0, 0])
    for cell, fails in ends:
        counts[cell][0] += fails
        counts[cell][1] += 1
    overall = _rate(sum(fails for _, fails in ends), len(ends), 0.5)
    return CellWeights({cell: _rate(n, of, overall) for cell, (n, of) in sorted(counts.items())}, overall)


def drawn(clip_ids: Sequence[str], weight_of: Mapping[str, float], n: int, seed: int) -> list[str]:
    """n of the clips, drawn without replacement, in the order of the draw; those that weigh 0 never.

    A clip without a weight weighs as the others do on average, 1 where there are none.
    """
    known = [weight_of[clip_id] for clip_id in clip_ids if clip_id in weight_of]
    mean = sum(known) / len(known) if known else 1.0
    waits = {}
    for clip_id in clip_ids:
        weight = weight_of.get(clip_id, mean)
        if weight > 0.0:
            waits[clip_id] = -math.log1p(-stream(seed, clip_id, "sample").random()) / weight
    return sorted(waits, key=lambda clip_id: (waits[clip_id], clip_id))[:n]


def by_lot(weights: Array, rng: np.random.Generator) -> Ints:
    """Places in the order of a draw without replacement; weights (n,) above 0."""
    order: Ints = np.argsort(-np.log1p(-rng.random(len(weights))) / weights, kind="stable")
    return order


def _rate(n: float, of: float, prior: float) -> float:
    """A share of few, drawn towards what is usual."""
    return (n + PRIOR * prior) / (of + PRIOR)

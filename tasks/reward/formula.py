"""What sub-scores weigh in a score, and what progress counts as (docs/reward.md 2k)."""

from collections.abc import Mapping
from functools import reduce
from operator import add, mul

from tasks.subscores import RECORDS
from tasks.world.arrays import Array

_IN_ORDER = sorted(RECORDS, key=lambda record: record.section)
MULTIPLIERS = tuple(record.name for record in _IN_ORDER if record.weight is None)
WEIGHTS = {record.name: record.weight for record in _IN_ORDER if record.weight is not None}
EC_WEIGHT = WEIGHTS.pop("ec")  # which takes two plans: a score has it or has it not
TOTAL_WEIGHT = sum(WEIGHTS.values())
PROGRESS_THRESHOLD_M = 5.0


def multiplied(scores: Mapping[str, Array]) -> Array:
    """What the weighted mean is multiplied by (K,), of sub-scores (K,) by name."""
    return reduce(mul, (scores[name] for name in MULTIPLIERS))


def weighted(scores: Mapping[str, Array]) -> Array:
    """The weighted sum (K,) of sub-scores (K,) of one plan by name; its mean is over TOTAL_WEIGHT."""
    return reduce(add, (weight * scores[name] for name, weight in WEIGHTS.items()))

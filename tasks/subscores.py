"""The sub-scores of EPDMS, a record each, and what they weigh: what every other place that lists them is drawn from.

A sub-score is its record here and its rule, which tasks/reward/epdms.py calls; docs/extend.md says how to add one.
Light: no numpy.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import add, mul
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True)
class SubScore:
    """One sub-score."""

    name: str  # of its columns, settings and rejections
    long_name: str  # in the public code
    section: str  # of docs/reward.md; they follow the public code's order, which its formula has too
    wrong: str  # words for people
    weight: float | None  # in the mean; None: the mean is multiplied by it
    levels: tuple[float, ...] = (0.0, 1.0)  # what its rule may say; none: anything from 0 to 1
    plans: int = 1  # that its rule compares
    index: str = ""  # Scores' name for the instant at which it first fails, where that is not <name>_index


THREE = (0.0, 0.5, 1.0)
RECORDS = (
    SubScore("nc", "no_at_fault_collisions", "2b", "collision at fault", None, THREE, index="collision_index"),
    SubScore("dac", "drivable_area_compliance", "2c", "left the drivable area", None),
    SubScore("ddc", "driving_direction_compliance", "2e", "against the driving direction", None, THREE),
    SubScore("tlc", "traffic_light_compliance", "2d", "ran a red light", None),
    SubScore("ep", "ego_progress", "2f", "too little progress", 5.0, levels=()),
    SubScore("ttc", "time_to_collision_within_bound", "2g", "time to collision", 5.0),
    SubScore("lk", "lane_keeping", "2h", "lane keeping", 2.0),
    SubScore("hc", "history_comfort", "2i", "uncomfortable against the history", 2.0),
    SubScore("ec", "two_frame_extended_comfort", "2j", "unlike the plan before", 2.0, plans=2),
)
SUBSCORES = tuple(record.name for record in RECORDS)
OF_ONE_PLAN = tuple(record.name for record in RECORDS if record.plans == 1)
JUDGED = tuple(record.name for record in RECORDS if record.plans == 1 and record.levels)  # they fail at an instant
LABELLED = (*JUDGED, "ep")  # of every trajectory of a vocabulary
HALVES = tuple(record.name for record in RECORDS if record.levels == THREE)
WHOLES = tuple(name for name in JUDGED if name not in HALVES)
INDEX = {record.name: record.index or f"{record.name}_index" for record in RECORDS if record.name in JUDGED}


# What sub-scores weigh in a score, and what progress counts as (docs/reward.md 2k).

_IN_ORDER = sorted(RECORDS, key=lambda record: record.section)
MULTIPLIERS = tuple(record.name for record in _IN_ORDER if record.weight is None)
WEIGHTS = {record.name: record.weight for record in _IN_ORDER if record.weight is not None}
EC_WEIGHT = WEIGHTS.pop("ec")  # which takes two plans: a score has it or has it not
TOTAL_WEIGHT = sum(WEIGHTS.values())
PROGRESS_THRESHOLD_M = 5.0


def multiplier_product(scores: Mapping[str, "NDArray[np.float64]"]) -> "NDArray[np.float64]":
    """What the weighted mean is multiplied by (K,), of sub-scores (K,) by name."""
    return reduce(mul, (scores[name] for name in MULTIPLIERS))


def weighted_sum(scores: Mapping[str, "NDArray[np.float64]"]) -> "NDArray[np.float64]":
    """The weighted sum (K,) of sub-scores (K,) of one plan by name; its mean is over TOTAL_WEIGHT."""
    return reduce(add, (weight * scores[name] for name, weight in WEIGHTS.items()))

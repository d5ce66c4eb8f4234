"""SimScale's rewards of one token as a sample's vocabulary labels.

The pickles hold progress divided (PROGRESS_MODE=gen_gt: compliant progress over the best of it and PDM-Closed's), ours
hold metres. Metres are not in them, so a length is chosen for PDM-Closed's: 256 m times the least multiplier, in whose
units of 1/128 m a float16 from 1/32 up (1/8 where a trajectory has a multiplier of 1/4) comes back exactly, a smaller
one rounded up by less than 1/8,000. `VocabularyLabels.ep("masked")`, which trainings take, is therefore the pickle's
own; progress in metres, and that of trajectories whose multiplier is 0, is lost. EC was never in them.
"""

from collections.abc import Mapping

import numpy as np

from tasks.reward.formula import multiplied
from tasks.reward.label_bytes import VocabularyLabels
from tasks.world.arrays import Array

METRICS = {  # SimScale's name of a sub-score -> ours
    "no_at_fault_collisions": "nc",
    "drivable_area_compliance": "dac",
    "driving_direction_compliance": "ddc",
    "traffic_light_compliance": "tlc",
    "time_to_collision_within_bound": "ttc",
    "lane_keeping": "lk",
    "history_comfort": "hc",
}
PROGRESS = "ego_progress"
NOMINAL_M = 256.0


def vocabulary_labels(rewards: Mapping[str, Array], vocabulary: str, k: int) -> VocabularyLabels:
    """Of metrics (K,) by their names; vocabulary: the digest of its K trajectories.

    Raises ValueError naming the metric that is missing, or holds what the public code does not write.
    """
    if missing := [name for name in (*METRICS, PROGRESS) if name not in rewards]:
        raise ValueError(f"metric {missing[0]} is missing")
    scores = {ours: rewards[name] for name, ours in METRICS.items()}
    ep = rewards[PROGRESS]
    if len(ep) != k:
        raise ValueError(f"rewards of {len(ep)} trajectories, the vocabulary has {k}")
    if not ((ep >= 0.0) & (ep <= 1.0)).all():
        raise ValueError(f"{PROGRESS}: must lie within 0 .. 1")
    multiplier = multiplied(scores)
    stopped = multiplier == 0.0
    reference_m, raw_m = 0.0, np.zeros(k)
    if not (ep == 1.0).all():  # else nothing counts as progress, and nobody's is wanting
        if (ep[stopped] > 0.0).any():
            raise ValueError(f"{PROGRESS} is above 0 where a multiplier is 0: not as PROGRESS_MODE=gen_gt writes it")
        reference_m = NOMINAL_M * float(multiplier[~stopped].min(initial=1.0))
        raw_m = np.divide(ep * reference_m, multiplier, out=raw_m, where=~stopped)
    return VocabularyLabels(vocabulary, "replay", reference_m, ep_raw_m=raw_m, **scores)

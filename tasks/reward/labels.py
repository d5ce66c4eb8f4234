"""Reward labels of a sample: a whole vocabulary driven from its scene and scored (docs/reward.md 1 and 2)."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from tasks.reward.epdms import Scores, rows, score
from tasks.reward.label_bytes import ARRAYS, VocabularyLabels
from tasks.reward.prepare import PreparedScene
from tasks.reward.reactive import reactive_scores
from tasks.rollout.lqr import track_local
from tasks.rollout.simulate import TrafficSettings
from tasks.world.arrays import Array
from tasks.world.clip import Scene
from tasks.world.vocabulary import Vocabulary

TRAJECTORIES_AT_ONCE = 4096  # 15 MB of states


@dataclass(frozen=True)
class Labelling:
    """Which trajectories samples are labelled with, and among which traffic."""

    vocabulary: Vocabulary
    traffic: TrafficSettings  # replay: the traffic that the sample was judged in; idm: traffic that answers to each


def vocabulary_labels(labelling: Labelling, scene: Scene, prepared: PreparedScene, rival: Array) -> VocabularyLabels:
    """The scores of the whole vocabulary, driven by the tracker from the scene's ego state.

    Args:
        labelling: vocabulary of K trajectories, and the traffic.
        scene: where the sample's now is.
        prepared: the scene with the objects that the sample was judged among; asked only where traffic is replayed.
        rival: (41, 11) PDM-Closed as the tracker drives it, the reference of every trajectory's progress. Where traffic
            reacts it is scored among the traffic that answers to it.
    """
    trajectories, traffic = labelling.vocabulary.trajectories, labelling.traffic
    scored = (
        partial(score, prepared, normalise="pairs")
        if traffic.mode == "replay"
        else partial(reactive_scores, scene, traffic=traffic)
    )
    parts: list[Scores] = []
    reference_m = 0.0
    for start in range(0, len(trajectories), TRAJECTORIES_AT_ONCE):
        driven = track_local(scene.ego_state, trajectories[start : start + TRAJECTORIES_AT_ONCE])
        scores = scored(np.concatenate([rival[None], driven]))
        reference_m = float(scores.ep_raw_m[0] * scores.multiplier[0])
        parts.append(rows(scores, slice(1, None)))
    kept = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
    return VocabularyLabels(labelling.vocabulary.digest, traffic.mode, reference_m, **kept)

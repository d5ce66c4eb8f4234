"""Reward labels of a sample: a whole vocabulary driven from its scene and scored (docs/reward.md 1 and 2)."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from tasks.reward.epdms import Scores, joined, rows, score, score_among
from tasks.reward.label_bytes import ARRAYS, VocabularyLabels
from tasks.reward.prepare import PreparedScene, collision_scores, prepare_scene
from tasks.reward.rules.ego import checked
from tasks.reward.rules.obstacles import STOPPED_SPEED_MPS
from tasks.rollout.lqr import track
from tasks.rollout.simulate import Rollouts, TrafficSettings, prepare_traffic, roll_out_many
from tasks.world.arrays import Array, Bools
from tasks.world.clip import HORIZON_STEPS, Scene
from tasks.world.frames import PACIFICA
from tasks.world.geometry import ego_boxes, touching
from tasks.world.vocabulary import Vocabulary

TRAJECTORIES_AT_ONCE = 4096  # 15 MB of states
EGOS_AT_ONCE = 256  # 0.6 MB per agent of traffic


@dataclass(frozen=True)
class Labelling:
    """Which trajectories samples are labelled with, and among which traffic."""

    vocabulary: Vocabulary
    traffic: TrafficSettings  # replay: the traffic that the sample was judged in; else traffic that answers to each


def vocabulary_labels(
    labelling: Labelling, scene: Scene, prepared: PreparedScene, reference: Array
) -> VocabularyLabels:
    """The scores of the whole vocabulary, driven by the tracker from the scene's ego state at the sample's now.

    prepared: the scene with the objects that the sample was judged among; asked only where traffic is replayed.
    reference: (41, 11) PDM-Closed as the tracker drives it, to which every trajectory's progress is related. Where
    traffic reacts it is scored among the traffic that answers to it.
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
        driven = track(scene.ego_state, trajectories[start : start + TRAJECTORIES_AT_ONCE], local=True)
        scores = scored(np.concatenate([reference[None], driven]))
        reference_m = float(scores.ep_raw_m[0] * scores.multiplier[0])
        parts.append(rows(scores, slice(1, None)))
    kept = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
    return VocabularyLabels(labelling.vocabulary.digest, traffic.mode, reference_m, **kept)


def reactive_scores(scene: Scene, states: Array, traffic: TrafficSettings) -> Scores:
    """Score simulated ego states (K, 41, 11); progress is related in pairs with row 0, as `score` does.

    A row does not depend on the others but for that: row 0, too, drives among the traffic that answers to it. An agent
    that touches the ego at the start is left out for good, but in the public reactive traffic.
    Raises ValueError for other shapes or non-finite states.
    """
    ready = prepare_traffic(scene, traffic)
    states = checked("states", states)
    now = scene.agents.window(scene.step, scene.step + HORIZON_STEPS + 1)
    prepared = prepare_scene(scene, now)
    collision_score = collision_scores(now.kinds)
    is_agent = collision_score == 0.0
    touches = now.valid[0] & touching(ego_boxes(scene.ego_state, PACIFICA), now.boxes[0])
    keep = ~(touches & traffic.leaves_out_touching)
    parts = []
    for start in range(0, len(states), EGOS_AT_ONCE):
        egos = states[start : start + EGOS_AT_ONCE]
        rollouts = roll_out_many(ready, egos)
        stopped = _stopped_when_first_seen(rollouts) | ~is_agent
        parts.append(score_among(prepared, rollouts.boxes[:, :, keep], stopped[:, keep], collision_score[keep], egos))
    return joined(parts, "pairs")


def _stopped_when_first_seen(rollouts: Rollouts) -> Bools:
    """(B, N) whether each agent's speed is next to nothing at its first appearance (docs/reward.md 2)."""
    first = rollouts.valid.argmax(axis=1)[:, None, :, None]
    velocity = np.take_along_axis(rollouts.velocities, first, axis=1)[:, 0]
    return np.hypot(velocity[..., 0], velocity[..., 1]) <= STOPPED_SPEED_MPS

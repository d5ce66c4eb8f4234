"""Scores of many ego trajectories, each among the traffic that answers to it."""

import numpy as np

from tasks.reward.epdms import Scores, joined, score_among
from tasks.reward.prepare import collision_scores, prepare_scene
from tasks.reward.rules.obstacles import STOPPED_SPEED_MPS
from tasks.reward.verdicts import checked_states
from tasks.rollout.simulate import Rollouts, TrafficSettings, prepare_traffic, roll_out_many
from tasks.world.arrays import Array, Bools
from tasks.world.boxes import ego_boxes, touching
from tasks.world.clip import HORIZON_STEPS, Scene
from tasks.world.vehicle import PACIFICA

EGOS_AT_ONCE = 256  # 0.6 MB per agent of traffic


def reactive_scores(scene: Scene, states: Array, traffic: TrafficSettings) -> Scores:
    """Score simulated ego states (K, 41, 11); progress is related in pairs with row 0, as `score` does.

    A row does not depend on the others but for that: row 0, too, drives among the traffic that answers to it. As in
    every prepared scene, an agent that touches the ego at the start is left out for good.
    Raises ValueError for other shapes or non-finite states.
    """
    states = checked_states(states)
    ready = prepare_traffic(scene, traffic)
    now = scene.agents.window(scene.step, scene.step + HORIZON_STEPS + 1)
    prepared = prepare_scene(scene, now)
    collision_score = collision_scores(now.kinds)
    is_agent = collision_score == 0.0
    keep = ~(now.valid[0] & touching(ego_boxes(scene.ego_state, PACIFICA), now.boxes[0]))
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

"""navhard's two-stage aggregation: a planner's score times what happens where its plan ends (docs/reward.md 3).

Stage one scores the logged frame, stage two the synthetic frames that start near where a plan may end. Every group of
follow-up frames exists for the frame now and for the one 0.5 s before. All columns (each sub-score, the score) are
aggregated alike; extended comfort belongs to a now/previous pair and stands in both rows.

The published stage two is the mean over groups of the group's WEIGHTED mean, with the weights that the final score has
(navsim/planning/script/run_pdm_score.py:242-290 at 0a380a9). The plain mean of the follow-up rows is another quantity;
it is `follow_ups` here, and no published table holds it.

The human-penalty filter is for logged frames, so stage one and the final score come both ways and stage two has one.
The paper's tables hold unfiltered scores; the public code filters since September 2025 (navsim 359c7f7).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tasks.reward.one_stage import FrameScores, means_of, means_over
from tasks.world.arrays import Array

WEIGHT_VARIANCE_M2 = 0.1


@dataclass(frozen=True)
class Group:
    """One stage-one frame and its M follow-up frames, C columns."""

    stage_one: FrameScores  # C columns
    endpoint_xy: Array  # (2,) last pose of the plan made in stage one, as predicted, world [m]
    stage_two: Array  # (M, C)
    starts_xy: Array  # (M, 2) rear axle at the start of each follow-up frame, world [m]


@dataclass(frozen=True)
class TwoStageScores:
    """Means over all scenarios, per column."""

    stage_one: FrameScores  # mean over groups of the logged frame's row
    stage_two: Array  # (C,) mean over groups of the weighted mean of their follow-up rows
    follow_ups: Array  # (C,) plain mean of all follow-up rows, whatever their groups and weights
    final: FrameScores  # mean of stage one times weighted stage two


def follow_up_weights(endpoint_xy: Array, starts_xy: Array) -> Array:
    """Weights (M,), sum 1, of follow-up frames that start at (M, 2) for a plan that ends at (2,).

    Gaussian in the distance, variance 0.1 m^2; uniform where `is_uniform`.
    """
    weights = _gaussian(endpoint_xy, starts_xy)
    if is_uniform(endpoint_xy, starts_xy):
        return np.full(len(weights), 1.0 / len(weights))
    return weights / weights.sum()


def is_uniform(endpoint_xy: Array, starts_xy: Array) -> bool:
    """Whether all frames are too far (beyond 1.92 m) for a weight, or a distance is NaN."""
    total = float(_gaussian(endpoint_xy, starts_xy).sum())
    return bool(np.isnan(total) or np.isclose(total, 0.0))


def _gaussian(endpoint_xy: Array, starts_xy: Array) -> Array:
    weights: Array = np.exp(-((starts_xy - endpoint_xy) ** 2).sum(axis=-1) / (2.0 * WEIGHT_VARIANCE_M2))
    return weights


def weighted_stage_two(group: Group) -> Array:
    """Columns (C,) of one group's follow-up frames, weighted by how near they start to where the plan ended.

    Raises ValueError when the group has no follow-up frame.
    """
    if len(group.stage_two) == 0:
        raise ValueError("a group needs at least one follow-up frame")
    after: Array = follow_up_weights(group.endpoint_xy, group.starts_xy) @ group.stage_two
    return after


def group_scores(group: Group) -> FrameScores:
    """Columns of one group: stage one times `weighted_stage_two`, and what that raises."""
    after = weighted_stage_two(group)
    return FrameScores(group.stage_one.unfiltered * after, group.stage_one.filtered * after)


def aggregate(scenarios: Sequence[tuple[Group, Group]]) -> TwoStageScores:
    """Aggregate (now, previous) groups, one pair per scenario.

    A mean over groups is over those that have the column, NaN where none does. Raises ValueError when there is no
    scenario, or a group has no follow-up frame.
    """
    if not scenarios:
        raise ValueError("nothing to aggregate")
    groups = [group for pair in scenarios for group in pair]
    return TwoStageScores(
        stage_one=means_of([group.stage_one for group in groups]),
        stage_two=means_over(np.stack([weighted_stage_two(group) for group in groups])),
        follow_ups=np.mean(np.concatenate([group.stage_two for group in groups]), axis=0),
        final=means_of([means_of([group_scores(now), group_scores(before)]) for now, before in scenarios]),
    )

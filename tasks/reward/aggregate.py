"""A frame's final score, and the means of a one-stage and of a two-stage evaluation (docs/reward.md 2k, 2l, 3).

The paper's tables hold the UNFILTERED score beside FILTERED sub-scores, in one stage and in two: its copy of the public
code filtered the columns after the score's terms were taken (fixed in navsim 359c7f7, September 2025). With the public
code of today the score is filtered as well. So every number here comes both ways and is named: the unfiltered score is
held against the paper's tables, the filtered one against today's leaderboard.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tasks.reward.epdms import Scores, human_filtered, score_with_ec
from tasks.subscores import MULTIPLIERS, WEIGHTS
from tasks.world.arrays import Array

COLUMNS = (*MULTIPLIERS, *WEIGHTS, "ec", "score")


@dataclass(frozen=True)
class FrameScores:
    """C columns of a frame, or means over frames, without and with the human-penalty filter."""

    unfiltered: Array  # (C,)
    filtered: Array  # (C,)

    @property
    def published(self) -> Array:
        """Columns (C,) as the paper's tables show them: the filtered sub-scores, the last column's score unfiltered."""
        return np.append(self.filtered[:-1], self.unfiltered[-1])


def final_score(scores: Scores, ec: Array) -> Array:
    """The final score (K,): weighted over 16 with extended comfort (K,), over 14 where that is NaN.

    It is NaN where there is no frame up to 0.55 s before.
    """
    return np.where(np.isnan(ec), scores.pdm_score, score_with_ec(scores, ec))


def columns_of(scores: Scores, ec: Array) -> Array:
    """COLUMNS (K, 10) of K scored rows with their extended comfort (K,), NaN where there is none."""
    sub_scores = [getattr(scores, name) for name in (*MULTIPLIERS, *WEIGHTS)]
    return np.stack([*sub_scores, ec, final_score(scores, ec)], axis=-1)


def frame_scores(scores: Scores, human: Scores | None, ec: float = np.nan) -> FrameScores:
    """COLUMNS of one frame's plan: `scores` of one row, before the filter; ec: NaN where no frame came before.

    human: one row, the logged human in the same frame, see `human_filtered`; None in synthetic frames, which are never
    filtered. Raises ValueError unless both have one row.
    """
    if len(scores) != 1:
        raise ValueError(f"scores must be one row, the plan's, got {len(scores)}")
    unfiltered = columns_of(scores, np.array([ec]))[0]
    if human is None:
        return FrameScores(unfiltered, unfiltered)
    return FrameScores(unfiltered, columns_of(human_filtered(scores, human), np.array([ec]))[0])


def means_of(frames: Sequence[FrameScores]) -> FrameScores:
    """Means over frames: a one-stage evaluation.

    Extended comfort's is over the frames that have it, NaN where none does. Raises ValueError when there is no frame.
    """
    if not frames:
        raise ValueError("frames must hold at least one frame, got none")
    return FrameScores(
        unfiltered=means_over(np.stack([frame.unfiltered for frame in frames])),
        filtered=means_over(np.stack([frame.filtered for frame in frames])),
    )


def means_over(columns: Array) -> Array:
    """Means (C,) of rows (N, C), each over the rows that have the column; NaN where none does.

    Each column is summed by itself, in pairs as pandas sums it: the published means come back to the last digit.
    """
    known = ~np.isnan(columns)
    total = np.ascontiguousarray(np.where(known, columns, 0.0).T).sum(axis=1)
    return np.divide(total, known.sum(axis=0), out=np.full(len(total), np.nan), where=known.any(axis=0))


# navhard's two-stage aggregation: a planner's score times what happens where its plan ends (docs/reward.md 3).
#
# Stage one scores the logged frame, stage two the synthetic frames that start near where a plan may end. Every group
# of follow-up frames exists for the frame now and for the one 0.5 s before. All columns (each sub-score, the score)
# are aggregated alike; extended comfort belongs to a now/previous pair and stands in both rows.
#
# The published stage two is the mean over groups of the group's WEIGHTED mean, with the weights that the final score
# has (navsim/planning/script/run_pdm_score.py:242-290 at 0a380a9). The plain mean of the follow-up rows is another
# quantity; it is `follow_ups` here, and no published table holds it.
#
# The human-penalty filter is for logged frames, so stage one and the final score come both ways and stage two has one.

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

    Gaussian in the distance, variance 0.1 m^2; uniform where `has_uniform_weights`.
    """
    weights = _gaussian(endpoint_xy, starts_xy)
    if has_uniform_weights(endpoint_xy, starts_xy):
        return np.full(len(weights), 1.0 / len(weights))
    return weights / weights.sum()


def has_uniform_weights(endpoint_xy: Array, starts_xy: Array) -> bool:
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

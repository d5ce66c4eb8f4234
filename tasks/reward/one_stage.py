"""A frame's final score, and the means of a one-stage evaluation (docs/reward.md 2k, 2l).

The paper's tables hold the UNFILTERED score beside FILTERED sub-scores, in one stage and in two: its copy of the public
code filtered the columns after the score's terms were taken (fixed in navsim 359c7f7, September 2025). With the public
code of today the score is filtered as well. So every number here comes both ways and is named: the unfiltered score is
held against the paper's tables, the filtered one against today's leaderboard.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tasks.reward.epdms import Scores, human_filtered, score_with_ec
from tasks.reward.formula import MULTIPLIERS, WEIGHTS
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

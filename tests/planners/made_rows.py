"""Rows as scoring makes them, with scores chosen by hand."""

from dataclasses import replace

import numpy as np

from planners.evaluation.frames import FrameKey
from planners.evaluation.score_rows import FrameRow, ScoreStage
from tasks.reward.aggregate import COLUMNS, FrameScores


def row(
    stage: ScoreStage,
    key: FrameKey,
    score: float,
    filtered: float | None = None,
    start: tuple[float, float] = (0.0, 0.0),
    end: tuple[float, float] = (np.nan, np.nan),
    tags: tuple[str, ...] = (),
) -> FrameRow:
    """Every column holds the score."""
    unfiltered = np.full(len(COLUMNS), score)
    scores = FrameScores(unfiltered, unfiltered if filtered is None else np.full(len(COLUMNS), filtered))
    return FrameRow(stage, key, scores, 0.0, np.array([*start, 0.0]), np.array([*end, 0.0]), tags)


def clip_rows(
    clip_id: str,
    one_stage: float,
    stage_one: tuple[float, float],
    ends: tuple[tuple[float, float], tuple[float, float]],
    follow_ups: list[tuple[tuple[float, float], tuple[float, float], tuple[float, float]]],
    log_id: str = "",
) -> list[FrameRow]:
    """follow_ups: (score now, before), start now, start before."""
    now, before = FrameKey.logged(clip_id)
    rows = [
        row("one_stage", now, one_stage, end=ends[0]),
        row("stage_one", now, stage_one[0], end=ends[0]),
        row("stage_one", before, stage_one[1], end=ends[1]),
    ]
    for i, (scores, *starts) in enumerate(follow_ups):
        for key, score, start in zip(FrameKey.follow_up(clip_id, i), scores, starts):
            rows.append(row("stage_two", key, score, start=start))
    return [replace(one, log_id=log_id) for one in rows]

"""What runs scored on each clip, as arrays to draw from."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planners.aggregation import MEASURES, ClipResult, columns_at
from tasks.reward.one_stage import COLUMNS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """One column of S runs on C clips."""

    clips: tuple[str, ...]
    logs: tuple[str, ...]  # of each clip; empty: unknown
    scores: Array  # (S, C)
    weights: Array  # (S, C) how much a clip's score counts in a mean: rows or groups that it is the mean of


def measured(runs: Sequence[Sequence[ClipResult]], column: str) -> dict[tuple[str, str], Measured]:
    """(stage, filter) -> scores of the runs; stages that a run lacks, or that are not numbers, are left out.

    Raises ValueError where the runs are not over the same clips, naming what differs.
    """
    check_same_clips(runs)
    found = {}
    for stage, human_filter in MEASURES:
        mine = [[clip for clip in run if stage == "one_stage" or clip.groups is not None] for run in runs]
        if mine[0]:
            found[stage, human_filter] = _of_stage(mine, stage, human_filter, column)
    return {name: values for name, values in found.items() if np.isfinite(values.scores).all()}


def _of_stage(runs: Sequence[Sequence[ClipResult]], stage: str, human_filter: str, column: str) -> Measured:
    place = COLUMNS.index(column)

    def score(clip: ClipResult) -> float:
        two_stage = None if stage == "one_stage" else clip.two_stage
        return float(columns_at(clip.one_stage, two_stage, stage, human_filter)[place])

    return Measured(
        clips=tuple(clip.clip_id for clip in runs[0]),
        logs=tuple(clip.log_id for clip in runs[0]),
        scores=np.array([[score(clip) for clip in run] for run in runs]),
        weights=np.array([[float(_count(clip, stage)) for clip in run] for run in runs]),
    )


def _count(clip: ClipResult, stage: str) -> int:
    """Rows of stage one, groups of stage two and follow-up rows: what a clip's score is the mean of."""
    return {"stage_one": 2, "stage_two": 2, "follow_ups": 2 * clip.n_follow_ups}.get(stage, 1)


def check_same_clips(runs: Sequence[Sequence[ClipResult]]) -> None:
    """Raises ValueError naming a clip that not all runs have with as many follow-ups."""
    shapes = [{clip.clip_id: clip.n_follow_ups for clip in run} for run in runs]
    for n, shape in enumerate(shapes[1:], start=1):
        other = sorted(set(shape.items()) ^ set(shapes[0].items()))
        if other:
            raise ValueError(f"runs 0 and {n} are not over the same frames: clip {other[0][0]} is not in both alike")

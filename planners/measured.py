"""What runs scored on each clip, as arrays to draw from."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planners.aggregation import ClipResult
from tasks.reward.one_stage import COLUMNS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """One column of S runs on C clips."""

    clips: tuple[str, ...]
    scores: Array  # (S, C)
    weights: Array  # (S, C) frames that a clip's score is the mean of


def measured(runs: Sequence[Sequence[ClipResult]], column: str) -> dict[tuple[str, str], Measured]:
    """(stage, filter) -> scores of the runs; stages that a run lacks, or that are not numbers, are left out.

    Raises ValueError where the runs are not over the same clips, naming what differs.
    """
    check_same_clips(runs)
    found = {}
    for name in (("one_stage", f) for f in ("unfiltered", "filtered")):
        found[name] = _of_stage(runs, *name, column)
    for stage in ("stage_one", "stage_two", "final"):
        two_stage = [[clip for clip in run if clip.groups is not None] for run in runs]
        for human_filter in ("none",) if stage == "stage_two" else ("unfiltered", "filtered"):
            if two_stage[0]:
                found[stage, human_filter] = _of_stage(two_stage, stage, human_filter, column)
    return {name: values for name, values in found.items() if np.isfinite(values.scores).all()}


def _of_stage(runs: Sequence[Sequence[ClipResult]], stage: str, human_filter: str, column: str) -> Measured:
    both = np.array([[_one(clip, stage, human_filter, column) for clip in run] for run in runs], dtype=np.float64)
    return Measured(tuple(clip.clip_id for clip in runs[0]), both[..., 0], both[..., 1])


def _one(clip: ClipResult, stage: str, human_filter: str, column: str) -> tuple[float, float]:
    """Score and number of frames."""
    place = COLUMNS.index(column)
    if stage == "one_stage":
        scores, count = clip.one_stage, 1
    else:
        two = clip.two_stage
        assert two is not None
        if stage == "stage_two":
            return float(two.stage_two[place]), 2.0 * clip.n_follow_ups
        scores, count = (two.stage_one, 2) if stage == "stage_one" else (two.final, 1)
    return float((scores.filtered if human_filter == "filtered" else scores.unfiltered)[place]), float(count)


def check_same_clips(runs: Sequence[Sequence[ClipResult]]) -> None:
    """Raises ValueError naming a clip that not all runs have with as many follow-ups."""
    shapes = [{clip.clip_id: clip.n_follow_ups for clip in run} for run in runs]
    for n, shape in enumerate(shapes[1:], start=1):
        other = sorted(set(shape.items()) ^ set(shapes[0].items()))
        if other:
            raise ValueError(f"runs 0 and {n} are not over the same frames: clip {other[0][0]} is not in both alike")

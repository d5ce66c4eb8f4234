"""What runs scored on each clip, as arrays to draw from, and clips.csv, which holds that of a whole study.

A row of clips.csv for each stage and clip, a column for each training, EPDMS in percent: all that a study's intervals
are drawn from. Trainings that were made elsewhere, on the same benchmark, can be held against these
(`python -m planners compare table=...`).
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from planners.evaluation.aggregation import MEASURES, ClipResult, columns_at, write_csv
from tasks.reward.one_stage import COLUMNS
from tasks.world.arrays import Array

FACTS = ("stage", "human_filter", "log", "clip", "frames")  # frames: what the clip counts in a mean


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


def write_clips(path: Path, runs: Mapping[str, Sequence[ClipResult]]) -> None:
    """One column for each run, by its label. Raises ValueError where they are not over the same clips."""
    found = measured(list(runs.values()), "score")
    rows = []
    for name in MEASURES:
        for k, clip in enumerate(found[name].clips if name in found else ()):
            facts = dict(zip(FACTS, (*name, found[name].logs[k], clip, int(found[name].weights[0, k]))))
            rows.append(facts | dict(zip(runs, (100.0 * found[name].scores[:, k]).tolist())))
    write_csv(path, rows)


def read_clips(path: Path, labels: Sequence[str]) -> dict[tuple[str, str], Measured]:
    """(stage, filter) -> scores of the runs `labels`. ValueError for a run it lacks, or no such table."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if not rows or not set(FACTS) <= set(rows[0]):
        raise ValueError(f"{path}: no table of clips' scores: its columns must begin with {', '.join(FACTS)}")
    known = [column for column in rows[0] if column not in FACTS]
    unknown = [label for label in labels if label not in known]
    if unknown:
        raise ValueError(f"{path}: no run {', '.join(unknown)}; it has {', '.join(known) or 'none'}")
    found = {}
    for name in dict.fromkeys((row["stage"], row["human_filter"]) for row in rows):
        mine = [row for row in rows if (row["stage"], row["human_filter"]) == name]
        try:
            scores = np.array([[float(row[label]) for row in mine] for label in labels]) / 100.0
            frames = np.array([float(row["frames"]) for row in mine])
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}, {' '.join(name)}: {error}") from error
        clips, logs = (tuple(row[what] for row in mine) for what in ("clip", "log"))
        found[name] = Measured(clips, logs, scores, np.tile(frames, (len(labels), 1)))
    return found

"""clips.csv of a study: what each training scored on each clip, which is all that its intervals are drawn from.

A row for each stage and clip, a column for each training, EPDMS in percent. Trainings that were made elsewhere, on the
same benchmark, can be held against these (`python -m planners.compare table=...`).
"""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from planners.aggregation import MEASURES, ClipResult
from planners.measured import Measured, measured
from planners.scores import write_csv

FACTS = ("stage", "human_filter", "log", "clip", "frames")  # frames: what the clip counts in a mean


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
    with path.open(newline="") as file:
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

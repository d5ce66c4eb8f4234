"""A study's or sweep's per-frame rows in one file, small enough to be committed: what all of its tables are made of.

A row for each frame and planner: EPDMS (float32), where the frame starts and where the plan from a logged frame ends,
which is what follow-ups are weighted by. Frames are the same for all planners, so that their columns take next to
nothing. What was trained and what is compared with what stands in the file's metadata.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from planners.evaluation.aggregation import ClipResult, by_clip
from planners.evaluation.benchmark_folder import logs_of
from planners.evaluation.frames import FrameKey
from planners.evaluation.score_rows import FrameRow, read_rows
from planners.study.setups import Comparison, Setup
from tasks.reward.one_stage import COLUMNS, FrameScores

Clips = Mapping[str, Sequence[ClipResult]]  # by label

FRAMES = "frames.parquet"
META = b"study"
SCORE = COLUMNS.index("score")
NAMES = ("training", "stage", "log_id", "clip_id", "kind")
SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in NAMES),
        ("candidate_index", pa.int32()),
        ("score", pa.float32()),  # EPDMS, 0 .. 1
        ("score_filtered", pa.float32()),  # null: the same
        *((name, pa.float64()) for name in ("start_x", "start_y")),  # rear axle of the frame, world [m]
        *((name, pa.float64()) for name in ("end_x", "end_y")),  # of the plan, world [m]; null for follow-ups
    ]
)


@dataclass(frozen=True)
class StudyFrames:
    """What a file holds."""

    trainings: tuple[Mapping[str, Any], ...]  # facts of each, with its label under "training"
    comparisons: tuple[Comparison, ...]  # of a study; none of a sweep
    clips: Clips  # by label, also of ensembles and bounds; scores alone, no sub-scores


def rows_of(labels: Iterable[str], evaluations: Path, benchmark: str) -> Iterator[tuple[str, list[FrameRow]]]:
    """The scored frames of each evaluated planner, with the logs of their clips as the benchmark has them."""
    logs = logs_of(benchmark)
    for label in labels:
        yield label, [replace(row, log_id=logs[row.key.clip_id]) for row in read_rows(evaluations / label)]


def write_frames(
    path: Path,
    rows: Iterator[tuple[str, Sequence[FrameRow]]],
    trainings: Sequence[Mapping[str, Any]],
    comparisons: Sequence[Comparison] = (),
) -> None:
    """Write the rows of each planner, by its label. Whole or not at all."""
    meta = {"trainings": [dict(one) for one in trainings], "comparisons": [asdict(one) for one in comparisons]}
    schema = SCHEMA.with_metadata({META: json.dumps(meta).encode()})
    table = pa.concat_tables([_table(label, of_one) for label, of_one in rows]).cast(schema)
    unfinished = path.with_name(f".{path.name}.unfinished")
    pq.write_table(
        table,
        unfinished,
        compression="zstd",
        compression_level=9,
        use_dictionary=[*NAMES, "candidate_index", "start_x", "start_y"],
        write_statistics=False,
    )
    unfinished.replace(path)


def read_frames(path: Path) -> StudyFrames:
    """What `write_frames` wrote. Raises FileNotFoundError, or ValueError for a file that is none."""
    table = pq.read_table(path)
    meta = (table.schema.metadata or {}).get(META)
    if meta is None or table.column_names != SCHEMA.names:
        raise ValueError(f"{path}: no rows of a study: it must have the columns {', '.join(SCHEMA.names)}")
    told = json.loads(meta)
    columns = {name: table[name].to_numpy(zero_copy_only=False) for name in SCHEMA.names}
    labels = columns["training"]
    begins = [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1).tolist(), len(labels)]
    clips = {}
    for first, last in pairwise(begins):
        clips[str(labels[first])] = by_clip([_row(columns, i) for i in range(first, last)])
    return StudyFrames(tuple(told["trainings"]), tuple(map(_comparison, told["comparisons"])), clips)


def _table(label: str, rows: Sequence[FrameRow]) -> pa.Table:
    ordered = sorted(rows, key=lambda row: (row.key.clip_id, row.stage, row.key.candidate_index, row.key.kind))
    scores = np.array([(row.scores.unfiltered[SCORE], row.scores.filtered[SCORE]) for row in ordered], np.float32)
    starts = np.array([row.start[:2] for row in ordered])
    ends = np.array([row.end[:2] for row in ordered])
    same = (scores[:, 0] == scores[:, 1]) | np.isnan(scores[:, 1])
    follow_up = np.array([row.stage == "stage_two" for row in ordered])
    columns = [
        pa.array([label] * len(ordered)),
        *(pa.array([getattr(row, name) for row in ordered]) for name in ("stage", "log_id")),
        *(pa.array([getattr(row.key, name) for row in ordered]) for name in ("clip_id", "kind", "candidate_index")),
        pa.array(scores[:, 0]),
        pa.array(scores[:, 1], mask=same),
        *(pa.array(np.ascontiguousarray(column)) for column in starts.T),
        *(pa.array(np.ascontiguousarray(column), mask=follow_up) for column in ends.T),
    ]
    return pa.table(columns, names=SCHEMA.names).cast(SCHEMA)


def _row(columns: Mapping[str, NDArray[Any]], i: int) -> FrameRow:
    """As it was scored, with NaN for what the file does not hold."""
    score, filtered = float(columns["score"][i]), float(columns["score_filtered"][i])
    unfiltered, forgiven = np.full((2, len(COLUMNS)), np.nan)
    unfiltered[SCORE], forgiven[SCORE] = score, score if np.isnan(filtered) else filtered
    return FrameRow(
        stage=columns["stage"][i],
        key=FrameKey(columns["clip_id"][i], columns["kind"][i], int(columns["candidate_index"][i])),
        scores=FrameScores(unfiltered, forgiven),
        progress_m=np.nan,
        start=np.array([columns["start_x"][i], columns["start_y"][i], np.nan]),
        end=np.array([columns["end_x"][i], columns["end_y"][i], np.nan]),
        log_id=columns["log_id"][i],
    )


def _comparison(told: Mapping[str, Any]) -> Comparison:
    reference = None if told["reference"] is None else Setup(**told["reference"])
    return Comparison(**{**told, "setup": Setup(**told["setup"]), "reference": reference})

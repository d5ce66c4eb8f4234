"""Per-frame rows of many planners in one file, small enough to be committed: what all tables of them are made of.

A row for each frame and planner: EPDMS (float32), where the frame starts and where the plan from a logged frame ends,
which is what follow-ups are weighted by. Frames are the same for all planners, so that their columns take next to
nothing. Whatever else is to be known of the planners stands in the file's metadata.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from planners.evaluation.aggregation import ClipResult, by_clip
from planners.evaluation.benchmark_folder import logs_of
from planners.evaluation.frames import FrameKey
from planners.evaluation.score_rows import FrameRow, read_rows
from tasks.reward.one_stage import COLUMNS, FrameScores

Clips = Mapping[str, Sequence[ClipResult]]  # by label of the planner; scores alone, no sub-scores

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


def rows_of(labels: Iterable[str], evaluations: Path, benchmark: str) -> Iterator[tuple[str, list[FrameRow]]]:
    """The scored frames of each evaluated planner, with the logs of their clips as the benchmark has them."""
    logs = logs_of(benchmark)
    for label in labels:
        yield label, [replace(row, log_id=logs[row.key.clip_id]) for row in read_rows(evaluations / label)]


def write_frames(path: Path, rows: Iterator[tuple[str, Sequence[FrameRow]]], meta: Mapping[str, Any]) -> None:
    """Write the rows of each planner, by its label, and what else is to be known. Whole or not at all."""
    schema = SCHEMA.with_metadata({META: json.dumps(meta).encode()})
    table = pa.concat_tables(_table(label, of_one) for label, of_one in rows).cast(schema)
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


def read_frames(path: Path) -> tuple[Mapping[str, Any], Clips]:
    """`meta` and rows of `write_frames`. Raises FileNotFoundError, or ValueError for a file that is none."""
    table = pq.read_table(path)
    meta = (table.schema.metadata or {}).get(META)
    if meta is None or table.column_names != SCHEMA.names:
        raise ValueError(f"{path}: no rows of a study: it must have the columns {', '.join(SCHEMA.names)}")
    columns = (table[name].to_numpy(zero_copy_only=False) for name in SCHEMA.names)
    clips = {
        str(label): by_clip([_row(*values) for _, *values in rows])
        for label, rows in groupby(zip(*columns), key=itemgetter(0))
    }
    return json.loads(meta), clips


def _table(label: str, rows: Sequence[FrameRow]) -> pa.Table:
    ordered = sorted(rows, key=lambda row: (row.key.clip_id, row.stage, row.key.candidate_index, row.key.kind))
    return pa.Table.from_pylist([_flat(label, row) for row in ordered], SCHEMA)


def _flat(label: str, row: FrameRow) -> dict[str, Any]:
    score, filtered = (np.float32(values[SCORE]) for values in (row.scores.unfiltered, row.scores.filtered))
    same = score == filtered or np.isnan(filtered)
    ends = (None, None) if row.stage == "stage_two" else row.end
    facts = (row.log_id, row.key.clip_id, row.key.kind, row.key.candidate_index)
    return dict(
        zip(SCHEMA.names, (label, row.stage, *facts, score, None if same else filtered, *row.start[:2], *ends[:2]))
    )


def _row(
    stage: Any, log_id: str, clip_id: str, kind: str, candidate: int, score: float, filtered: float, *places: float
) -> FrameRow:
    """As it was scored, with NaN for what the file does not hold."""
    scores = np.full((2, len(COLUMNS)), np.nan)
    scores[:, SCORE] = score, score if np.isnan(filtered) else filtered
    start, end = (np.array([*places[i : i + 2], np.nan]) for i in (0, 2))
    key = FrameKey(clip_id, kind, int(candidate))
    return FrameRow(stage, key, FrameScores(*scores), np.nan, start, end, log_id=log_id)

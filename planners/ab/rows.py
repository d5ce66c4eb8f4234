"""The rows that an experiment's report is made of, and of nothing else: a file of frames and one of drives.

frames.parquet has a row for each frame and planner: EPDMS, where it starts and where the plan from it ends, by which
follow-ups are weighted. drives.parquet has a row for each drive. Who is who stands in the metadata of both.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from planners.evaluation.aggregation import ClipResult, group_by_clip
from planners.evaluation.bootstrap import town_of
from planners.evaluation.frames import FrameKey
from planners.evaluation.score_rows import FrameRow
from tasks.reward.aggregate import COLUMNS, FrameScores

FRAMES, DRIVES = "frames.parquet", "drives.parquet"
META = b"ab"
Row = Mapping[str, Any]  # of drives
SCORE = COLUMNS.index("score")
NAMES = ("training", "stage", "log_id", "clip_id", "kind")
FRAME_SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in NAMES),
        ("candidate_index", pa.int32()),
        ("score", pa.float32()),  # EPDMS, 0 .. 1
        ("score_filtered", pa.float32()),  # null or NaN: the same
        *((name, pa.float64()) for name in ("start_x", "start_y")),  # rear axle of the frame, world [m]
        *((name, pa.float64()) for name in ("end_x", "end_y")),  # of the plan, world [m]
    ]
)
DRIVE_SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in ("training", "log_id", "clip_id", "pictures")),
        ("start", pa.int32()),  # number of the perturbed start; -1: the log's own
        ("score", pa.float64()),  # scene score, 0 .. 1
        ("dist_traveled_m", pa.float64()),
        ("offroad_or_collision_at_fault", pa.float64()),  # 0 or 1
    ]
)


@dataclass(frozen=True)
class Trained:
    """One training of an arm, under whose label rows stand."""

    planner: str
    arm: str
    seed: int
    real: int = 0  # samples
    simulated: int = 0

    @property
    def label(self) -> str:
        """Names it."""
        return f"{self.planner}-{self.arm}-{self.seed}"


@dataclass(frozen=True)
class AbRows:
    """What an experiment kept."""

    trained: tuple[Trained, ...]
    asked: Mapping[str, Any]  # reference, claim, confidence, steps
    frames: Mapping[str, Sequence[ClipResult]]  # by label, also of bounds; scores alone, no sub-scores
    drives: Mapping[str, Sequence[Row]]


def frames_of(folder: Path, label: str) -> pa.Table:
    """The frames of one evaluated planner, under another label, without what decides nothing.

    That is where plans from follow-ups end, most of the file's bytes, and filtered scores that are the score.
    """
    table = pq.read_table(folder / FRAMES)
    follow_up = pc.equal(table["stage"], "stage_two")
    same = pc.equal(table["score"], table["score_filtered"])
    for name, unneeded in {"end_x": follow_up, "end_y": follow_up, "score_filtered": same}.items():
        kept = pc.if_else(unneeded, None, table[name])
        table = table.set_column(table.column_names.index(name), name, kept)
    named = table.append_column("training", pa.array([label] * len(table), pa.string()))
    return named.select(FRAME_SCHEMA.names).cast(FRAME_SCHEMA)


def cluster_of(log: str) -> str:
    """What is held out as a whole: the town of a log, else the log."""
    return town_of(log) or log


def write_ab_rows(
    folder: Path,
    trained: Sequence[Trained],
    asked: Mapping[str, Any],
    frames: Sequence[pa.Table],
    drives: Sequence[Row],
) -> None:
    """Both files of an AbRows; frames: of `frames_of`, one label behind the other; drives: of DRIVE_SCHEMA."""
    folder.mkdir(parents=True, exist_ok=True)
    meta = {META: json.dumps({"trained": [asdict(one) for one in trained], "asked": dict(asked)}).encode()}
    tables = {FRAMES: pa.concat_tables(frames), DRIVES: pa.Table.from_pylist(list(drives), DRIVE_SCHEMA)}
    for name, table in tables.items():
        unfinished = folder / f".{name}.unfinished"
        pq.write_table(table.replace_schema_metadata(meta), unfinished, compression="zstd", write_statistics=False)
        unfinished.replace(folder / name)


def read_ab_rows(folder: Path) -> AbRows:
    """What `write_ab_rows` wrote. Raises FileNotFoundError, or ValueError for files that are none."""
    kept = (pq.read_schema(folder / FRAMES).metadata or {}).get(META)
    if kept is None:
        raise ValueError(f"{folder / FRAMES}: no rows of `python -m planners ab`")
    meta = json.loads(kept)
    by_label: dict[str, list[Row]] = {}
    for row in pq.read_table(folder / DRIVES).to_pylist():
        by_label.setdefault(row["training"], []).append(row)
    trained = tuple(Trained(**one) for one in meta["trained"])
    return AbRows(trained, meta["asked"], read_frames(folder / FRAMES), by_label)


def read_frames(path: Path) -> dict[str, list[ClipResult]]:
    """Clips by label of such a file of frames. Raises FileNotFoundError, or ValueError for other columns."""
    table = pq.read_table(path)
    if table.column_names != FRAME_SCHEMA.names:
        raise ValueError(f"{path}: no rows of frames: it must have the columns {', '.join(FRAME_SCHEMA.names)}")
    columns = (table[name].to_numpy(zero_copy_only=False) for name in FRAME_SCHEMA.names)
    return {
        str(label): group_by_clip([_frame(*values) for _, *values in rows])
        for label, rows in groupby(zip(*columns), key=itemgetter(0))
    }


def _frame(
    stage: Any, log_id: str, clip_id: str, kind: str, candidate: int, score: float, filtered: float, *places: float
) -> FrameRow:
    """As it was scored, with NaN for what the file does not hold."""
    scores = np.full((2, len(COLUMNS)), np.nan)
    scores[:, SCORE] = score, score if np.isnan(filtered) else filtered
    start, end = (np.array([*places[i : i + 2], np.nan]) for i in (0, 2))
    key = FrameKey(clip_id, kind, int(candidate))
    return FrameRow(stage, key, FrameScores(*scores), np.nan, start, end, log_id=log_id)

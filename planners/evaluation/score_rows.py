"""What is kept of an evaluated planner: all sub-scores of every frame, as Parquet and CSV, and what the folder is.

record.json is written last, so that a folder without it is not done.
"""

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from factory.config.compose import ConfigError
from planners.evaluation.frames import FrameKey
from tasks.reward.aggregate import COLUMNS, FrameScores
from tasks.world.arrays import Array

ScoreStage = Literal["one_stage", "stage_one", "stage_two"]
STAGES: tuple[ScoreStage, ...] = get_args(ScoreStage)
FILTERED = "_filtered"  # suffix of a column with the filter
POSE = ("x", "y", "heading")


@dataclass(frozen=True)
class FrameRow:
    """One frame and one planner."""

    stage: ScoreStage
    key: FrameKey
    scores: FrameScores  # tasks.reward.aggregate.COLUMNS; NaN: not defined
    progress_m: float  # along the route, of the drive
    start: Array  # (3,) rear axle of the frame, world
    end: Array  # (3,) last pose of the plan as predicted, world; NaN: no plan
    tags: tuple[str, ...] = ()
    weight: float = np.nan  # of a follow-up frame in its group; NaN elsewhere
    log_id: str = ""  # of the clip; empty: unknown

    def __post_init__(self) -> None:
        if self.stage not in STAGES:
            raise ValueError(f"stage must be one of {', '.join(STAGES)}, not {self.stage!r}")


SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in ("stage", "log_id", "clip_id", "kind")),
        ("candidate_index", pa.int32()),
        *((name, pa.float64()) for name in COLUMNS),
        *((name + FILTERED, pa.float64()) for name in COLUMNS),
        ("progress_m", pa.float64()),
        *((f"start_{name}", pa.float64()) for name in POSE),
        *((f"end_{name}", pa.float64()) for name in POSE),
        ("weight", pa.float64()),
        ("tags", pa.string()),  # joined by spaces
    ]
)


def write_rows(folder: Path, rows: Sequence[FrameRow]) -> None:
    """`frames.parquet` and `frames.csv` in the folder."""
    table = pa.Table.from_pylist([_flat(row) for row in rows], schema=SCHEMA)
    pq.write_table(table, folder / "frames.parquet")
    pa_csv.write_csv(table, folder / "frames.csv")


def read_rows(folder: Path) -> list[FrameRow]:
    """What `write_rows` wrote. Raises FileNotFoundError, or ValueError for a file of other columns.

    Files from before log_id was written are read as of unknown logs.
    """
    path = folder / "frames.parquet"
    table = pq.read_table(path)
    if "log_id" not in table.column_names:
        table = table.append_column("log_id", pa.array([""] * len(table)))
    missing = [name for name in SCHEMA.names if name not in table.column_names]
    if missing:
        raise ValueError(f"{path}: no columns {', '.join(missing)}: evaluate the planner again")
    return [_row(values) for values in table.to_pylist()]


def _flat(row: FrameRow) -> dict[str, object]:
    key, scores = row.key, [*row.scores.unfiltered.tolist(), *row.scores.filtered.tolist()]
    facts = (row.stage, row.log_id, key.clip_id, key.kind, key.candidate_index)
    values = (*facts, *scores, row.progress_m, *row.start.tolist(), *row.end.tolist(), row.weight, " ".join(row.tags))
    return dict(zip(SCHEMA.names, values, strict=True))


def _row(values: dict[str, Any]) -> FrameRow:
    def numbers(names: Iterable[str]) -> Array:
        return np.array([values[name] for name in names], dtype=np.float64)

    return FrameRow(
        stage=values["stage"],
        key=FrameKey(values["clip_id"], values["kind"], values["candidate_index"]),
        scores=FrameScores(numbers(COLUMNS), numbers(name + FILTERED for name in COLUMNS)),
        progress_m=float(values["progress_m"]),
        start=numbers(f"start_{name}" for name in POSE),
        end=numbers(f"end_{name}" for name in POSE),
        tags=tuple(values["tags"].split()),
        weight=float(values["weight"]),
        log_id=values["log_id"],
    )


RECORD = "record.json"


def write_record(folder: Path, record: Mapping[str, Any]) -> None:
    """Whole or not at all."""
    unfinished = folder / f".{RECORD}.{os.getpid()}"
    unfinished.write_text(json.dumps(record, indent=1, sort_keys=True))
    os.replace(unfinished, folder / RECORD)


def read_record(folder: Path) -> dict[str, Any]:
    """Raises ConfigError where there is none or it is damaged."""
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(f"{folder}: no {RECORD}: no planner was evaluated here, or not to the end") from error
    except ValueError as error:
        raise ConfigError(f"{folder / RECORD}: {error}: remove it and evaluate again") from error
    assert isinstance(record, dict)
    return record


def is_done(folder: Path, identity: Mapping[str, Any]) -> bool:
    """Whether the folder holds what `identity` (planner, benchmark, rules) describes, whole."""
    if not (folder / RECORD).is_file():
        return False
    record = read_record(folder)
    return all(record.get(name) == value for name, value in identity.items())

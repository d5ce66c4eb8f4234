"""The table `explored` under the `out` of `python -m planners explore`: one row a clip, with a planner's drifts.

All rows of a table are of one planner and one set of settings, so that a run which takes it can name them.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import pyarrow as pa

from factory.store.location import Location
from factory.store.parquet_file import TableSpec, write_shard
from factory.store.schema import canonical_json, schema_of
from factory.store.table import KeyedTable
from tasks.drifts import Drift

TABLE = "explored"


@dataclass(frozen=True)
class DriftRow:
    """One drift of a clip."""

    number: int  # 0 ... in the order of the ways; those of ways that led nowhere are left out
    way: str  # how the planner was let drive, such as "closed loop from 1.0 s"
    end_x: float  # [m] at T+H, frame of the logged pose at T+H
    end_y: float  # [m]
    end_heading: float  # [rad]
    end_speed: float  # [m/s]
    score: float  # EPDMS (/14) of the planner's own drive from T+H on
    fails: str  # the first sub-score for which the reward would reject that drive; "": none
    subscores: dict[str, float]  # of that drive
    ego_states: tuple[tuple[float, ...], ...]  # (41, 11) at 10 Hz from T on, world

    def as_drift(self) -> Drift:
        """As a clip is perturbed by it."""
        return Drift(self.number, np.array(self.ego_states), self.score, self.fails)


@dataclass(frozen=True)
class ExploredClip:
    """One row of the table."""

    clip_id: str
    dataset: str
    log_id: str
    content_digest: str
    licence: str
    tags: tuple[str, ...]  # what is in the scene at T
    planner: str
    planner_digest: str
    settings: str  # all that the drifts depend on beside clip and planner, canonical JSON
    score: float  # EPDMS (/14) of the planner's closed loop from the log at T to T+H
    fails: str  # as of a drift, of that drive; or why there is none
    dropped: dict[str, int]  # why ways led to no drift -> ways
    drifts: tuple[DriftRow, ...]

    @property
    def digest(self) -> str:
        """16 hex digits of all of it."""
        return hashlib.sha256(canonical_json(asdict(self)).encode()).hexdigest()[:16]


COUNTED = {  # beside what a clip holds
    "digest": pa.string(),
    "n_drifts": pa.int32(),
    "n_failing": pa.int32(),
    "ends": pa.list_(pa.list_(pa.float64())),  # x, y [m], heading [rad] of each drift
    "fails_from": pa.list_(pa.string()),
}
FACTS = (
    "clip_id",
    "planner",
    "planner_digest",
    "settings",
    "digest",
    "n_drifts",
    "n_failing",
)  # what is not as long as a drive
SCHEMA = pa.schema([*schema_of(ExploredClip), *(pa.field(name, kind) for name, kind in COUNTED.items())])
EXPLORED = TableSpec(TABLE, SCHEMA, "clip_id")


def open_explored(folder: Location) -> KeyedTable:
    """The table, which need not be there yet."""
    return KeyedTable(folder.child(TABLE), EXPLORED)


def write_explored(table: KeyedTable, clips: Sequence[ExploredClip]) -> None:
    """One commit. Raises DuplicateKey, and AnotherWriter where a later command has taken the table over."""
    rows = pa.Table.from_pylist([asdict(clip) | _counted(clip) for clip in clips], schema=SCHEMA)
    table.commit([write_shard(table.location, EXPLORED, rows)])


def _counted(clip: ExploredClip) -> dict[str, object]:
    fails_from = [one.fails for one in clip.drifts]
    return {
        "digest": clip.digest,
        "n_drifts": len(fails_from),
        "n_failing": sum(map(bool, fails_from)),
        "ends": [[one.end_x, one.end_y, one.end_heading] for one in clip.drifts],
        "fails_from": fails_from,
    }


def explored_clips(rows: pa.Table) -> list[ExploredClip]:
    """Rows of the table."""
    found = []
    for row in rows.drop_columns(list(COUNTED)).to_pylist(maps_as_pydicts="strict"):
        drifts = tuple(DriftRow(**one) for one in row.pop("drifts"))
        found.append(ExploredClip(**row, drifts=drifts))
    return found

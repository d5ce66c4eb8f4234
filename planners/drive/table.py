"""The table `drives` under `out`: one row a drive, committed as they end, so that no drive is made twice."""

import hashlib
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Generic, TypeVar

import pyarrow as pa

from factory.store.location import Location, write_shard
from factory.store.schema import TableSpec, canonical_json, schema_of
from factory.store.table import KeyedTable
from planners.drive.measures import DriveMeasures

COMMIT_EVERY_S = 10.0  # a killed command drives as much again
Row = TypeVar("Row")


@dataclass(frozen=True)
class DriveKey:
    """What a drive is: the same key, the same drive."""

    clip_id: str
    content_digest: str  # of the log, "" where its reader does not say
    start: int  # number of the clip's perturbed start; -1: from the log at T
    planner_digest: str
    pictures: str  # truth, engine, none
    settings: str  # all that it depends on beside, canonical JSON

    @property
    def drive_id(self) -> str:
        """16 hex digits."""
        return hashlib.sha256(canonical_json(asdict(self)).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class DriveRow(DriveMeasures):
    """One drive in the table."""

    drive_id: str
    clip_id: str
    dataset: str
    log_id: str
    content_digest: str
    licence: str
    start: int  # number of the clip's perturbed start; -1: from the log at T
    candidate_index: int  # that led there; -1: from the log at T
    start_step: int  # of the clip, 0.1 s
    planner: str
    planner_digest: str
    pictures: str
    psnr_db: float  # of the scene's held-out photos; NaN: no scene, or none was held out
    ended: str  # planners.drive.drivers.DriveEnd
    hit_track: str  # what was hit, "": nothing
    hit_kind: str
    hit_speed_mps: float  # of the ego; NaN: nothing was hit
    film: str  # file under `out`, "": none
    settings: str
    ego_states: tuple[tuple[float, ...], ...]  # (S + 1, 11) at 10 Hz, world
    plans: tuple[tuple[float, ...], ...]  # (P, 120) x, y, heading at 0.1 .. 4.0 s of the plans at 2 Hz, world


SCHEMA = schema_of(DriveRow)
DRIVES = TableSpec("drives", SCHEMA, "drive_id")
FACTS = [field.name for field in fields(DriveRow) if field.name not in ("ego_states", "plans")]


def open_drives(out: Location) -> KeyedTable:
    """The table, which need not be there yet."""
    return KeyedTable(out.child("drives"), DRIVES)


def write_rows(table: KeyedTable, rows: Sequence[DriveRow]) -> None:
    """One commit. Raises DuplicateKey, and AnotherWriter where a later command has taken the table over."""
    columns = [pa.array([getattr(row, field.name) for row in rows], field.type) for field in SCHEMA]
    table.commit([write_shard(table.location, DRIVES, pa.Table.from_arrays(columns, schema=SCHEMA))])


class Committer(Generic[Row]):
    """Gathers rows and writes them, a commit each time, every COMMIT_EVERY_S and when it is closed."""

    def __init__(self, write: Callable[[Sequence[Row]], None]) -> None:
        self._write, self._rows, self._last = write, list[Row](), time.monotonic()

    def add(self, rows: Iterable[Row]) -> None:
        """Rows to be committed."""
        self._rows += rows
        if time.monotonic() - self._last > COMMIT_EVERY_S:
            self.close()

    def close(self) -> None:
        """Commit what is gathered."""
        if self._rows:
            self._write(self._rows)
        self._rows, self._last = [], time.monotonic()

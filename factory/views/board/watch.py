"""The tables of a run, read anew as they grow: only what was committed since, and only the columns the page needs.

Files of a table are immutable and named by their content, so each is read once; a commit costs its own files. What is
kept of a sample is some 300 bytes: its scores and lineage, and the file and row that its pictures stand in.

Tables are looked at in the order outcomes, samples, candidates, the opposite of the order of a commit. In between an
attempt of the newest group may be missing, and one that failed and then succeeded may stand in both, which the funnel
knows to count once; the next look sees the whole group.
"""

import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from factory.store import funnel
from factory.store.samples import CURRENT_RUN, LAST_RUN, PLANS, RUN_FILE, NewestRun, Store
from factory.store.table import KeyedTable, LiveFile, pack_small, packed_tables
from tasks.world.arrays import Ints

SAMPLE_COLUMNS = (
    "attempt_id",
    *funnel.SAMPLE_COLUMNS,
    "dataset",
    "log_id",
    "split",
    "licence",
    "round",
    "command",
    "image_source",
)
SAMPLE_COLUMNS += ("stage1_score", "stage2_score", "candidate_end")
OUTCOME_COLUMNS = ("attempt_id", *funnel.OUTCOME_COLUMNS, "log_id", "detail", "error", "tries", "seconds")
CANDIDATE_COLUMNS = (*funnel.LIST_COLUMNS, "candidates")
LOOK_EVERY_S = 2.0
UNPACKED = ("seconds", "candidates", "candidate_end")  # columns of which only sums and end points are kept
Points = NDArray[np.floating]
MOST_PARTS = 256  # of a table


@dataclass(frozen=True)
class WatchedFiles:
    """What is kept of some files; `rows` has the columns _file, _row and _written_ms beside those of the table."""

    rows: pa.Table
    seconds: Mapping[str, tuple[int, float]] = field(default_factory=dict)  # outcomes: stage -> attempts, seconds
    # (N, 2) x, y [m] of candidates, or of samples where they began, frame of the logged pose at T+H
    end_points: Points = field(default_factory=lambda: np.zeros((0, 2), np.float32))


class WatchedTable:
    """One table and the parts of it that were read."""

    def __init__(self, table: KeyedTable, columns: Sequence[str]) -> None:
        self.table, self._columns = table, list(columns)
        self.files: Mapping[str, LiveFile] = {}
        self.parts: dict[tuple[str, ...], WatchedFiles] = {}
        self.paths: list[str] = []  # by the number in _file
        self._seen: int | None = None

    def refresh(self) -> bool:
        """Read what was committed since; whether anything was."""
        self.table.refresh()
        if self.table.version == self._seen:
            return False
        self.files, self._seen = self.table.file_facts(), self.table.version
        self.parts = {paths: part for paths, part in self.parts.items() if self.files.keys() >= set(paths)}
        if len(self.parts) > MOST_PARTS:  # of a run that is watched, a few files each
            parts = list(self.parts.values())
            rows = pa.concat_tables(part.rows for part in parts).unify_dictionaries().combine_chunks()
            whole = WatchedFiles(rows, _summed([part.seconds for part in parts]), _joined(parts))
            self.parts = {sum(self.parts, ()): whole}
        known = {path for paths in self.parts for path in paths}
        for pack in pack_small(sorted(self.files.keys() - known), lambda path: self.files[path].n_rows):
            self.parts[tuple(pack)] = self._read(pack)
        return True

    def rows(self) -> pa.Table:
        """All of them."""
        names = [name for name in self._columns if name not in UNPACKED]
        empty = self.table.schema_of(names, encoded=True).empty_table()
        return pa.concat_tables(
            [_with_file_and_row(empty, 0, LiveFile({}, 0, 0, 0)), *(part.rows for part in self.parts.values())]
        )

    def _read(self, paths: Sequence[str]) -> WatchedFiles:
        read = [self._read_file(path) for path in paths]
        (rows,) = packed_tables([pa.concat_tables(file.rows for file in read)], self.table.spec.key)
        return WatchedFiles(rows, _summed([file.seconds for file in read]), _joined(read))

    def _read_file(self, path: str) -> WatchedFiles:
        file = self.files[path]
        rows = self.table.read_file(path, file.partition, self._columns)
        self.paths.append(path)
        kept = _with_file_and_row(
            rows.drop_columns([n for n in UNPACKED if n in rows.column_names]), len(self.paths) - 1, file
        )
        if "seconds" in self._columns:
            return WatchedFiles(kept, seconds=seconds_of(rows["seconds"]))
        if "candidates" in self._columns:
            flat = pc.list_flatten(rows["candidates"])
            x, y = (pc.struct_field(flat, name).to_numpy().astype(np.float32) for name in ("end_x", "end_y"))
            return WatchedFiles(kept, end_points=np.stack([x, y], axis=1))
        if "candidate_end" in self._columns:
            return WatchedFiles(
                kept, end_points=pc.list_flatten(rows["candidate_end"]).to_numpy().reshape(-1, 4)[:, :2]
            )
        return WatchedFiles(kept)


def _joined(parts: Iterable[WatchedFiles]) -> Points:
    return np.concatenate([np.zeros((0, 2), np.float32), *(part.end_points for part in parts)])


def _with_file_and_row(rows: pa.Table, number: int, file: LiveFile) -> pa.Table:
    n = rows.num_rows
    rows = rows.append_column("_file", pa.repeat(pa.scalar(number, pa.int32()), n))
    rows = rows.append_column("_row", pa.array(np.arange(n), pa.int32()))
    return rows.append_column("_written_ms", pa.repeat(pa.scalar(file.written_ms, pa.int64()), n))


def seconds_of(column: pa.ChunkedArray) -> dict[str, tuple[int, float]]:
    """Stage -> (attempts, seconds) of a column of maps."""
    flat = [pa.table([chunk.keys, chunk.items], names=["stage", "s"]) for chunk in column.chunks if len(chunk.keys)]
    if not flat:
        return {}
    sums = pa.concat_tables(flat).group_by("stage").aggregate([("s", "count"), ("s", "sum")])
    rows = zip(*(sums[name].to_pylist() for name in ("stage", "s_count", "s_sum")))
    return {stage: (n, seconds) for stage, n, seconds in rows}


@dataclass(frozen=True)
class Snapshot:
    """The run at one instant. Row tables have the columns named above, texts but keys as numbers into a dictionary (see
    `plain`), and _file, _row, _written_ms."""

    version: str  # of samples, outcomes and candidates, "-" for one that is not there yet
    samples: pa.Table
    outcomes: pa.Table
    candidates: pa.Table
    plans: pa.Table
    sample_paths: Sequence[str]  # by _file
    candidate_paths: Sequence[str]
    sample_bytes: int
    last_commit_ms: int  # of these three, since 1970; 0: none
    seconds: Mapping[str, tuple[int, float]]  # stage -> attempts, seconds: of rejected attempts
    end_points: Sequence[Points]  # each (N, 2) x, y [m], of all candidates, frame of the logged pose at T+H
    accepted_points: Sequence[Points]  # likewise, of those that became samples
    runs: Sequence[Mapping[str, Any]]  # records of run.json, oldest first
    run: NewestRun

    @cached_property
    def funnel(self) -> funnel.Funnel:
        return funnel.funnel_of_tables(self.samples, self.outcomes, self.candidates, self.plans, self.runs)

    @cached_property
    def newest_first(self) -> Ints:
        """Places of samples: those committed last first, and by attempt_id within a file's time."""
        keys = [("_written_ms", "descending"), ("attempt_id", "ascending")]
        return np.asarray(pc.sort_indices(self.samples, sort_keys=keys)).astype(np.int64)

    def newest(self, place: int) -> Mapping[str, Any]:
        """The sample at a place of `newest_first`."""
        (row,) = self.samples.slice(self.newest_first[place], 1).to_pylist()
        return dict(row)


class Watch:
    """Takes snapshots of one store; safe to ask from many threads."""

    def __init__(self, store: Store, look_every_s: float = LOOK_EVERY_S) -> None:
        self.store = store
        self._every_s = look_every_s
        self._outcomes = WatchedTable(store.outcomes, OUTCOME_COLUMNS)
        self._samples = WatchedTable(store.samples, SAMPLE_COLUMNS)
        self._candidates = WatchedTable(store.candidates, CANDIDATE_COLUMNS)
        self._plans = PLANS.schema.empty_table()
        self._lock = threading.Lock()
        self._snapshot: Snapshot | None = None
        self._due_s = 0.0
        self._run_files: tuple[bytes | None, ...] = ()

    def snapshot(self) -> Snapshot:
        """The newest snapshot; the tables are looked at again where the last look is some seconds old."""
        with self._lock:
            if self._snapshot is None or time.monotonic() >= self._due_s:
                began = time.monotonic()
                self._snapshot = self._new_snapshot(self._snapshot)
                cost = time.monotonic() - began
                self._due_s = time.monotonic() + max(self._every_s, 4.0 * cost if self._every_s else 0.0)
            return self._snapshot

    def _new_snapshot(self, known: Snapshot | None) -> Snapshot:
        tables = (self._outcomes, self._samples, self._candidates)
        changed = [table.refresh() for table in tables]
        run_files = tuple(self.store.location.read(name) for name in (RUN_FILE, CURRENT_RUN, LAST_RUN))
        if known is not None and not any(changed) and run_files == self._run_files:
            return known
        self._run_files = run_files
        self.store.plans.refresh()
        self._plans = self.store.plans.read()
        return Snapshot(
            version=".".join("-" if t.table.version is None else str(t.table.version) for t in tables),
            samples=self._samples.rows(),
            outcomes=self._outcomes.rows(),
            candidates=self._candidates.rows(),
            plans=self._plans,
            sample_paths=tuple(self._samples.paths),
            candidate_paths=tuple(self._candidates.paths),
            sample_bytes=sum(file.n_bytes for file in self._samples.files.values()),
            last_commit_ms=max((file.written_ms for t in tables for file in t.files.values()), default=0),
            seconds=_summed([part.seconds for part in self._outcomes.parts.values()]),
            end_points=[part.end_points for part in self._candidates.parts.values()],
            accepted_points=[part.end_points for part in self._samples.parts.values()],
            runs=self.store.runs(),
            run=NewestRun(*run_files[1:]),
        )


def _summed(parts: Sequence[Mapping[str, tuple[int, float]]]) -> dict[str, tuple[int, float]]:
    total: dict[str, tuple[int, float]] = {}
    for part in parts:
        for stage, (n, seconds) in part.items():
            had, spent = total.get(stage, (0, 0.0))
            total[stage] = had + n, spent + seconds
    return dict(sorted(total.items()))

"""A compact copy, on a local disk, of what one planner reads of the tables (`data.copy`).

    <folder>/<digest>.arrow    one for every file of a table that was read, a record batch for each of its row groups

It holds all rows with the needed columns alone, of the images those at now of the chosen cameras, uncompressed, and is
read by mapping it: pictures are decoded from where they lie. A file of a table never changes, and the digest is of its
name, the columns, the cameras and the format, so that trainings with other rows share the copies and those with other
columns or cameras have their own. Nothing is ever removed; the folder can be deleted while no training runs.

Each record batch is a stream of Arrow's of its own. Behind them stands where each lies and its checksum, as sealed
JSON, and in the last 8 bytes the length of that. A copy that is found damaged is made again, with a line in the log.
"""

import hashlib
import json
import logging
import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from factory.locks import locked
from factory.store.reader import TIME_TOLERANCE_S, group_rows
from planners.data.feed import Feed
from planners.data.files import SampleFile, leaves, read_group
from tasks.sealed import Damaged, sealed, unsealed

FORMAT = 3
ALIGNED_BYTES = 64  # Arrow's own
LENGTH_BYTES = 8
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class LocalCopy:
    """The copy of one file of a table, which need not be there yet."""

    path: Path
    file: SampleFile
    columns: tuple[str, ...]
    cameras: tuple[str, ...]  # whose images are held

    def open(self) -> "CopyReader":
        """Made first where it is not there. Raises OSError naming it where it cannot be made."""
        if not self.path.exists():
            self.make(None)
        return CopyReader(self)

    def make(self, damaged: int | None) -> None:
        """Whole or not at all, by one of those who want it at a time, in whatever thread or process.

        damaged: inode of a copy to be replaced. A draft that a killed process left is written anew: its lock is gone
        with it. Raises OSError naming the copy.
        """
        try:
            self._make(damaged)
        except OSError as error:
            raise OSError(f"while it was copied to {self.path}: {error}") from error

    def _make(self, damaged: int | None) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        draft = self.path.with_suffix(".draft")
        with draft.open("ab") as sink, locked(sink):
            if self.path.exists() and self.path.stat().st_ino != damaged:  # another made it meanwhile
                draft.unlink(missing_ok=True)
                return
            sink.seek(0)
            sink.truncate()
            self._write(sink)
            sink.flush()
            os.fsync(sink.fileno())
            draft.replace(self.path)

    def _write(self, sink: IO[bytes]) -> None:
        parquet, places, end = self.file.open(), [], 0
        paths = leaves(parquet, self.columns)
        for group in range(len(group_rows(parquet))):
            table = read_group(parquet, group, paths).combine_chunks()
            if "images" in table.column_names:
                images = _chosen(table["images"].combine_chunks(), self.cameras)
                table = table.set_column(table.column_names.index("images"), "images", images)
            stream = pa.BufferOutputStream()
            with pa.ipc.new_stream(stream, table.schema) as writer:
                writer.write_table(table)
            data = stream.getvalue()
            places.append([end, data.size, zlib.crc32(data)])
            sink.write(data)
            sink.write(bytes(-data.size % ALIGNED_BYTES))
            end += data.size + -data.size % ALIGNED_BYTES
        index = sealed(json.dumps(places).encode(), self.path.name)
        sink.write(index + len(index).to_bytes(LENGTH_BYTES, "little"))


class CopyReader:
    """Row groups of a copy, mapped into memory."""

    def __init__(self, copy: LocalCopy) -> None:
        self._copy = copy
        self._mapped: tuple[int, pa.Buffer] | None = None  # its inode and what it holds

    def read_row_group(self, group: int) -> pa.Table:
        """All rows of it; nothing is copied. Checked each time, which also brings it from the disk in this thread.

        A damaged copy is made again. Raises OSError naming it where that cannot be done, or is of no use.
        """
        inode, data = self._mapped or self._map()
        try:
            return _group_of(data, group, self._copy.path.name)
        except Damaged as error:
            log.warning("%s: %s; it is made again", self._copy.path, error)
        self._copy.make(inode)
        try:
            return _group_of(self._map()[1], group, self._copy.path.name)
        except Damaged as error:
            raise OSError(f"its copy {self._copy.path}, just made again, is damaged: {error}") from error

    def _map(self) -> tuple[int, pa.Buffer]:
        path = self._copy.path
        if path.stat().st_size:
            with pa.memory_map(str(path)) as file:
                self._mapped = path.stat().st_ino, file.read_buffer()
        else:  # which cannot be mapped
            self._mapped = path.stat().st_ino, pa.py_buffer(b"")
        return self._mapped


def _group_of(data: pa.Buffer, group: int, key: str) -> pa.Table:
    """One row group of what a copy holds, nothing of which is parsed before its checksum is right. Raises Damaged.

    key: the name that the copy has.
    """
    end = max(0, data.size - LENGTH_BYTES)
    n_bytes = int.from_bytes(data[end:], "little")
    index = data[max(0, end - n_bytes) : end].to_pybytes()
    offset, length, checksum = json.loads(unsealed(index, key))[group]
    block = data.slice(min(offset, data.size), length)
    if zlib.crc32(block) != checksum:
        raise Damaged(f"checksum of row group {group}")
    return pa.ipc.open_stream(block).read_all()


def copies_of(feed: Feed) -> dict[int, LocalCopy]:
    """File -> its copy, for every file that the samples stand in; empty without `data.copy`."""
    settings, rows = feed.dataset.settings, feed.dataset.rows
    if settings.copy is None:
        return {}
    folder = Path(settings.copy).expanduser()
    copies = {}
    for number in np.unique(rows.file).tolist():
        file = feed.dataset.files[number]
        cameras = sorted({name for i in np.flatnonzero(rows.file == number) for name in feed.cameras[i]})
        words = (str(FORMAT), Path(file.path).name, *feed.columns, "", *cameras)
        digest = hashlib.sha256("\x1f".join(words).encode()).hexdigest()[:32]
        copies[number] = LocalCopy(folder / f"{digest}.arrow", file, feed.columns, tuple(cameras))
    return copies


def _chosen(images: pa.ListArray, cameras: tuple[str, ...]) -> pa.ListArray:
    """The images at now of these cameras."""
    entries = images.values
    at_now = np.abs(entries.field("time_s").to_numpy()) <= TIME_TOLERANCE_S
    of_them = pc.is_in(entries.field("camera"), value_set=pa.array(cameras, pa.string()))
    kept = np.flatnonzero(at_now & of_them.to_numpy(zero_copy_only=False))
    offsets = np.searchsorted(kept, images.offsets.to_numpy())
    return pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), entries.take(pa.array(kept)))

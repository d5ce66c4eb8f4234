"""The files of sample tables as the loader reads them: row group by row group, single columns, single leaves.

A column is read with all that is nested in it; of a column of structs single members can be named, such as
`images.jpeg`, and the others stay on disk.

With `data.copy` they are read from a compact copy, on a local disk, of what one planner reads of the tables:

    <folder>/<digest>.arrow    one for every file of a table that was read, a record batch for each of its row groups

It holds all rows with the needed columns alone, of the images those at now of the chosen cameras, uncompressed, and is
read by mapping it: pictures are decoded from where they lie. A file of a table never changes, and the digest is of its
name, the columns and the cameras, so that trainings with other rows share the copies and those with other
columns or cameras have their own. Nothing is ever removed; the folder can be deleted while no training runs.

Each record batch is a stream of Arrow's of its own. Behind them stands where each lies and its checksum, as sealed
JSON, and in the last 8 bytes the length of that. A copy that is found damaged is made again, with a line in the log.
"""

import json
import logging
import os
import re
import zlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pyarrow import fs

from factory.files import locked
from factory.store.location import raising_damaged_file
from factory.store.reader import TIME_TOLERANCE_S, group_rows, sample_table
from tasks.caches import Damaged, sealed, unsealed
from tasks.world.arrays import Ints

FOOTER_BYTES = 2**25  # as they are stored; parsed they take eight times that


class Footers:
    """The parsed footers of the files that were opened last; parsing one of 40 row groups takes 6 ms.

    The files are immutable and named by their contents' digests, so that a footer never grows old.
    """

    def __init__(self, limit: int) -> None:
        """limit: bytes of footers that are kept."""
        self._limit, self._held = limit, 0
        self._footers: OrderedDict[str, pq.FileMetaData] = OrderedDict()
        self._lock = Lock()

    def of(self, path: str) -> pq.FileMetaData | None:
        """The footer of a file; None where it must be read."""
        with self._lock:
            if path in self._footers:
                self._footers.move_to_end(path)
            return self._footers.get(path)

    def keep(self, path: str, footer: pq.FileMetaData) -> None:
        """Keep one footer more, and drop those that were not asked for the longest as far as need be."""
        with self._lock:
            if path not in self._footers:
                self._footers[path] = footer
                self._held += footer.serialized_size
            while self._held > self._limit:
                self._held -= self._footers.popitem(last=False)[1].serialized_size


_FOOTERS = Footers(FOOTER_BYTES)


@dataclass(frozen=True, eq=False)
class SampleFile:
    """One live file of a table; every row has its partition's round and expert."""

    table: str  # as it was asked for, for messages
    filesystem: fs.FileSystem
    path: str  # in the filesystem
    round: int
    expert: str

    def open(self, check_pages: bool = True) -> pq.ParquetFile:
        """check_pages: whether reading a damaged page raises OSError.

        Raises OSError with the file's name.
        """
        with raising_damaged_file(self.where):
            return self._open(check_pages)

    @property
    def where(self) -> str:
        """For messages."""
        return f"{self.table}: {self.path}"

    def _open(self, check_pages: bool) -> pq.ParquetFile:
        local = isinstance(self.filesystem, fs.LocalFileSystem)
        filesystem = fs.LocalFileSystem(use_mmap=True) if local else self.filesystem
        footer = _FOOTERS.of(self.path)
        parquet = pq.ParquetFile(
            self.path,
            metadata=footer,
            filesystem=filesystem,
            page_checksum_verification=check_pages,
            pre_buffer=not local,
        )
        _FOOTERS.keep(self.path, parquet.metadata)
        return parquet


def files_of(table: str | os.PathLike[str], storage_options: Mapping[str, str] | None = None) -> list[SampleFile]:
    """The files of a table of samples in the order of their names, which are their contents' digests.

    Raises FileNotFoundError where there is no table, ValueError where its columns are those of another version.
    """
    found = sample_table(table, storage_options)
    filesystem, base = found.location.filesystem()
    return [
        SampleFile(os.fspath(table), filesystem, f"{base}/{path}", int(partition["round"]), partition["expert"])
        for path, partition in sorted(found.live_files().items(), key=lambda item: item[0].rpartition("/")[2])
    ]


def leaves(file: pq.ParquetFile, columns: Sequence[str]) -> list[str]:
    """The paths of the leaves under columns and members (`label_2hz`, `images.jpeg`) of a file, for reading.

    Raises ValueError naming those it has not.
    """
    paths = _paths(file)
    missing = [c for c in columns if not any(_under(plain, c) for _, plain in paths)]
    if missing:
        raise ValueError(f"columns {', '.join(missing)} are missing")
    return [path for path, plain in paths if any(_under(plain, c) for c in columns)]


def read_group(file: pq.ParquetFile, group: int, paths: Sequence[str]) -> pa.Table:
    """Leaves of one row group, in this thread."""
    return file.read_row_group(group, columns=paths, use_threads=False)


def read_all(file: pq.ParquetFile, paths: Sequence[str]) -> pa.Table:
    """Leaves of all row groups, in this thread."""
    return file.read(columns=paths, use_threads=False)


def group_bytes(file: pq.ParquetFile, columns: Sequence[str]) -> Ints:
    """(groups, columns) uncompressed bytes of columns and members in Parquet, as the footer says."""
    paths = _paths(file)
    numbers = [[i for i, (_, plain) in enumerate(paths) if _under(plain, column)] for column in columns]
    groups = (file.metadata.row_group(g) for g in range(file.metadata.num_row_groups))
    sizes = [[sum(group.column(i).total_uncompressed_size for i in under) for under in numbers] for group in groups]
    return np.array(sizes, np.int64).reshape(-1, len(columns))


def _paths(file: pq.ParquetFile) -> list[tuple[str, str]]:
    """Of every leaf its path, and that without what engines put, under several names, between a list and its items."""
    schema = file.metadata.schema
    paths = [schema.column(i).path for i in range(len(schema))]
    return [(path, re.sub(r"\.(list\.(element|item)|bag\.array_element)", "", path)) for path in paths]


def _under(path: str, column: str) -> bool:
    return path == column or path.startswith(f"{column}.")


COPY_FORMAT = 3
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


def _chosen(images: pa.ListArray, cameras: tuple[str, ...]) -> pa.ListArray:
    """The images at now of these cameras."""
    entries = images.values
    at_now = np.abs(entries.field("time_s").to_numpy()) <= TIME_TOLERANCE_S
    of_them = pc.is_in(entries.field("camera"), value_set=pa.array(cameras, pa.string()))
    kept = np.flatnonzero(at_now & of_them.to_numpy(zero_copy_only=False))
    offsets = np.searchsorted(kept, images.offsets.to_numpy())
    return pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), entries.take(pa.array(kept)))

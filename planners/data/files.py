"""The files of sample tables as the loader reads them: row group by row group, single columns, single leaves.

A column is read with all that is nested in it; of a column of structs single members can be named, such as
`images.jpeg`, and the others stay on disk.
"""

import os
import re
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import fs

from factory.store.location import raising_damaged_file
from factory.store.reader import sample_table
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

    def get(self, path: str) -> pq.FileMetaData | None:
        """The footer of a file; None where it must be read."""
        with self._lock:
            if path in self._footers:
                self._footers.move_to_end(path)
            return self._footers.get(path)

    def put(self, path: str, footer: pq.FileMetaData) -> None:
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
        footer = _FOOTERS.get(self.path)
        parquet = pq.ParquetFile(
            self.path,
            metadata=footer,
            filesystem=filesystem,
            page_checksum_verification=check_pages,
            pre_buffer=not local,
        )
        _FOOTERS.put(self.path, parquet.metadata)
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


def leaf_paths(file: pq.ParquetFile, columns: Sequence[str]) -> list[str]:
    """The paths of the leaves under columns and members (`label_2hz`, `images.jpeg`) of a file, for reading.

    Raises ValueError naming those it has not.
    """
    paths = _paths(file)
    missing = [c for c in columns if not any(_under(plain, c) for _, plain in paths)]
    if missing:
        raise ValueError(f"columns {', '.join(missing)} are missing")
    return [path for path, plain in paths if any(_under(plain, c) for c in columns)]


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

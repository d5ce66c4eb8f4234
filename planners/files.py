"""The Parquet files of sample tables as the loader reads them: row group by row group, single columns, single leaves.

A column is read with all that is nested in it; of a column of structs single members can be named, such as
`images.jpeg`, and the others stay on disk.
"""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pyarrow import fs

from factory.store.reader import sample_table


@dataclass(frozen=True, eq=False)
class SampleFile:
    """One live file of a table; every row has its partition's round and expert."""

    table: str  # as it was asked for, for messages
    filesystem: fs.FileSystem
    path: str  # in the filesystem
    round: int
    expert: str

    def open(self, check_pages: bool = True) -> pq.ParquetFile:
        """check_pages: whether reading a damaged page raises OSError."""
        remote = not isinstance(self.filesystem, fs.LocalFileSystem)
        return pq.ParquetFile(
            self.path, filesystem=self.filesystem, page_checksum_verification=check_pages, pre_buffer=remote
        )


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


def group_rows(file: pq.ParquetFile) -> NDArray[np.int64]:
    """(groups,) rows of each row group."""
    metadata = file.metadata
    return np.array([metadata.row_group(g).num_rows for g in range(metadata.num_row_groups)], np.int64)


def group_bytes(file: pq.ParquetFile, columns: Sequence[str]) -> NDArray[np.int64]:
    """(groups, columns) uncompressed bytes of columns and members, as the footer says."""
    paths = _paths(file)
    numbers = [[i for i, (_, plain) in enumerate(paths) if _under(plain, column)] for column in columns]
    groups = (file.metadata.row_group(g) for g in range(file.metadata.num_row_groups))
    sizes = [[sum(group.column(i).total_uncompressed_size for i in under) for under in numbers] for group in groups]
    return np.array(sizes, np.int64).reshape(-1, len(columns))


def _paths(file: pq.ParquetFile) -> list[tuple[str, str]]:
    """Of every leaf its path, and that without what engines put, under several names, between a list and its items."""
    schema = file.metadata.schema
    paths = (schema.column(i).path for i in range(len(schema)))
    return [(path, re.sub(r"\.(list\.(element|item)|bag\.array_element)", "", path)) for path in paths]


def _under(path: str, column: str) -> bool:
    return path == column or path.startswith(f"{column}.")

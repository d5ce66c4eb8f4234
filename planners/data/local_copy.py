"""A compact copy, on a local disk, of what one planner reads of the tables (`data.copy`).

    <folder>/<digest>.arrow    one for every file of a table that was read, a record batch for each of its row groups

It holds all rows with the needed columns alone, of the images those at now of the chosen cameras, uncompressed, and is
read by mapping it: pictures are decoded from where they lie. A file of a table never changes, and the digest is of its
name, the columns, the cameras and the format, so that trainings with other rows share the copies and those with other
columns or cameras have their own. A damaged copy is an error that names it. Nothing is ever removed; the folder can
be deleted while no training runs.
"""

import fcntl
import hashlib
import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from factory.store.reader import TIME_TOLERANCE_S
from planners.data.feed import Feed
from planners.data.files import SampleFile, leaves

FORMAT = 1
CHECKSUM = b"crc32"


@dataclass(frozen=True, eq=False)
class LocalCopy:
    """The copy of one file of a table, which need not be there yet."""

    path: Path
    file: SampleFile
    columns: tuple[str, ...]
    cameras: tuple[str, ...]  # whose images are held

    def open(self) -> "CopyReader":
        """Made first where it is not there. Raises OSError naming it where it cannot be made or is damaged."""
        if not self.path.exists():
            try:
                self._make()
            except OSError as error:
                raise OSError(f"while it was copied to {self.path}: {error}") from error
        return CopyReader(self.path)

    def _make(self) -> None:
        """Whole or not at all, by one of those who want it at a time, in whatever thread or process.

        A draft that a killed process left is written anew: its lock is gone with it.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        draft = self.path.with_suffix(".draft")
        with draft.open("ab") as sink:
            fcntl.flock(sink, fcntl.LOCK_EX)
            if self.path.exists():  # another made it meanwhile
                draft.unlink(missing_ok=True)
                return
            sink.seek(0)
            sink.truncate()
            self._write(sink)
            sink.flush()
            os.fsync(sink.fileno())
            draft.replace(self.path)

    def _write(self, sink: IO[bytes]) -> None:
        parquet = self.file.open()
        paths = leaves(parquet, self.columns)
        writer: pa.RecordBatchFileWriter | None = None
        for group in range(parquet.metadata.num_row_groups):
            table = parquet.read_row_group(group, columns=paths, use_threads=False).combine_chunks()
            if "images" in table.column_names:
                images = _chosen(table["images"].combine_chunks(), self.cameras)
                table = table.set_column(table.column_names.index("images"), "images", images)
            (batch,) = table.to_batches()
            batch = pa.ipc.read_record_batch(batch.serialize(), batch.schema)  # the buffers that a reader will see
            if writer is None:
                writer = pa.ipc.new_file(sink, batch.schema)
            writer.write_batch(batch, custom_metadata={CHECKSUM: _checksum(batch)})
        if writer is not None:
            writer.close()


class CopyReader:
    """Row groups of a copy, mapped into memory."""

    def __init__(self, path: Path) -> None:
        """Raises OSError for a damaged file."""
        self._path = path
        try:
            self._reader = pa.ipc.open_file(pa.memory_map(str(path)))
        except pa.ArrowInvalid as error:
            raise self._damaged(str(error)) from error

    def read_row_group(self, group: int) -> pa.Table:
        """All rows of it; nothing is copied. Checked each time, which also brings it from the disk in this thread.

        Raises OSError naming the copy and what to do where it is damaged.
        """
        try:
            batch, metadata = self._reader.get_batch_with_custom_metadata(group)
        except (pa.ArrowException, OSError, ValueError) as error:
            raise self._damaged(str(error)) from error
        if metadata is None or metadata.get(CHECKSUM) != _checksum(batch):
            raise self._damaged(f"checksum of row group {group}")
        return pa.Table.from_batches([batch])

    def _damaged(self, what: str) -> OSError:
        return OSError(f"its copy {self._path} is damaged ({what}): delete the copy, and it is made again")


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


def _checksum(batch: pa.RecordBatch) -> bytes:
    value = batch.num_rows
    for column in batch.columns:
        for buffer in column.buffers():
            if buffer is not None:
                value = zlib.crc32(buffer, value)
    return f"{value:08x}".encode()

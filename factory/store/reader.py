"""Reads samples without Ray or Hydra: `SampleTable(path)`.

A table is a snapshot: what is committed after it was opened is not in it. Samples are ordered by attempt_id, whatever
files they stand in; `iterate` goes file by file instead, which is what a pass over everything wants.

    samples = SampleTable("runs/demo")
    print(len(samples), samples.schema)
    sample = samples[0]                       # dict: column -> array, text, number or None
    front = image_of(sample, "front", 0.0)    # (height, width, 3) uint8 RGB
    labels = labels_of(sample)                # the scores of a whole vocabulary from this sample's scene
"""

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from factory.readers.pictures import BadPicture, decode_rgb
from factory.store.location import Location, open_parquet, raising_damaged_file, with_partition_columns
from factory.store.schema import SAMPLES, SCHEMA, VERSION_PROPERTY, table_to_rows, why_other_schema
from factory.store.table import KeyedTable, fixed_bytes, keys_with_prefix
from tasks.reward.label_bytes import VocabularyLabels, decode
from tasks.world.arrays import Bytes, Ints

Sample = dict[str, Any]
TIME_TOLERANCE_S = 0.05


def sample_table(path: str | os.PathLike[str], storage_options: Mapping[str, str] | None = None) -> KeyedTable:
    """The table of samples at a run's `out`, or at its folder `samples`.

    Raises FileNotFoundError where there is none, ValueError where its columns are those of another version.
    """
    location = Location.parse(path, storage_options)
    here = KeyedTable(location, SAMPLES)
    table = here if here.version is not None else KeyedTable(location.child("samples"), SAMPLES)
    if table.version is None:
        raise FileNotFoundError(f"{location.uri}: no table of samples here or in its folder samples")
    if other := why_other_schema(location.uri, table.properties.get(VERSION_PROPERTY)):
        raise ValueError(other)
    return table


class SampleTable:
    """The samples of one store, read-only."""

    def __init__(
        self,
        path: str | os.PathLike[str],
        storage_options: Mapping[str, str] | None = None,
        version: int | None = None,
    ) -> None:
        """path: the run's `out`, or its folder `samples`; version: of the table, None the newest.

        Raises what `sample_table` does, and DamagedLog where the log has no such version.
        """
        newest = sample_table(path, storage_options)
        self._table = newest if version is None else newest.at(version)
        self._partitions = self._table.live_files()
        files = [(path, fixed_bytes(rows["attempt_id"])) for path, rows in self._table.files(["attempt_id"])]
        counts = [len(keys) for _, keys in files]
        keys = np.concatenate([np.zeros(0, "S1"), *(keys for _, keys in files)])
        rows = np.concatenate([np.zeros(0, np.int32), *(np.arange(n, dtype=np.int32) for n in counts)])
        order = np.argsort(keys, kind="stable")
        self._keys, self._rows = keys[order], rows[order]  # (N,) sorted, and of each its row in its file,
        self._files = np.repeat(np.arange(len(files), dtype=np.int32), counts)[order]  # which is of this number
        self._paths = [path for path, _ in files]
        self._file = self._kept_open()

    def _kept_open(self) -> Callable[[str], pq.ParquetFile]:
        """Path -> file, of those that were read last."""
        return lru_cache(maxsize=32)(partial(open_parquet, self._table.location))

    def __getstate__(self) -> dict[str, Any]:
        """For another process, such as a DataLoader's worker: the same snapshot; it opens the files itself."""
        return {name: value for name, value in self.__dict__.items() if name != "_file"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._file = self._kept_open()

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def schema(self) -> pa.Schema:
        """Arrow schema with unit, frame and shape in each field's metadata."""
        return self._table.spec.schema

    @property
    def attempt_ids(self) -> tuple[str, ...]:
        """In the table's order."""
        return tuple(key.decode() for key in self._keys.tolist())

    def keys_with_prefix(self, prefix: str) -> list[str]:
        """Those attempt_ids that begin so, in the table's order."""
        return keys_with_prefix(self._keys, prefix)

    def table(self, columns: Sequence[str] | None = None) -> pa.Table:
        """Some columns of all samples, ordered by attempt_id; reads nothing but these columns."""
        wanted = list(self.schema.names if columns is None else columns)
        rows = self._table.read(wanted if "attempt_id" in wanted else [*wanted, "attempt_id"])
        return rows.sort_by("attempt_id").select(wanted)

    def __getitem__(self, which: int | str) -> Sample:
        """One sample by place or attempt_id. Raises IndexError or KeyError."""
        return self.sample(which)

    def sample(self, which: int | str, columns: Sequence[str] | None = None) -> Sample:
        """One sample, or some of its columns; reads the row group it stands in."""
        at = which if isinstance(which, int) else int(np.searchsorted(self._keys, which.encode()))
        if isinstance(which, str) and (at == len(self._keys) or self._keys[at].decode() != which):
            raise KeyError(which)
        path = self._paths[self._files[at]]
        with raising_damaged_file(f"{self._table.location.uri}/{path}"):
            group, row = find_row_group(self._file(path), int(self._rows[at]))
        (sample,) = self.rows(path, group, columns, slice(row, row + 1))
        return sample

    def __iter__(self) -> Iterator[Sample]:
        return self.iterate()

    def iterate(self, columns: Sequence[str] | None = None) -> Iterator[Sample]:
        """Every sample once, file by file, one row group in memory."""
        for path, group, _ in self.row_groups():
            yield from self.rows(path, group, columns)

    def row_groups(self) -> Iterator[tuple[str, int, int]]:
        """Of every row group its file, its number there and its rows, file by file."""
        for path in sorted(self._partitions):
            with raising_damaged_file(f"{self._table.location.uri}/{path}"):
                sizes = row_group_sizes(self._file(path))
            yield from ((path, group, n_rows) for group, n_rows in enumerate(sizes.tolist()))

    def rows(self, path: str, group: int, columns: Sequence[str] | None, rows: slice = slice(None)) -> list[Sample]:
        """Samples of one row group. Raises KeyError for unknown columns, OSError for a damaged file, by name."""
        _check_columns(columns)
        with raising_damaged_file(f"{self._table.location.uri}/{path}"):
            return read_rows(self._file(path), group, self._partitions[path], columns, rows)


def read_samples(
    table: Location, path: str, partition: Mapping[str, str], attempt_ids: Collection[str]
) -> Iterator[Sample]:
    """Some whole rows of one file of a table of samples; reads the row groups they stand in, one at a time."""
    file = open_parquet(table, path)
    for group in range(file.metadata.num_row_groups):
        keys = file.read_row_group(group, columns=["attempt_id"])["attempt_id"].to_pylist()
        for i in (i for i, key in enumerate(keys) if key in attempt_ids):
            yield from read_rows(file, group, partition, None, slice(i, i + 1))


def row_group_sizes(file: pq.ParquetFile) -> Ints:
    """(groups,) rows of each row group of a file."""
    metadata = file.metadata
    return np.array([metadata.row_group(g).num_rows for g in range(metadata.num_row_groups)], np.int64)


def find_row_group(file: pq.ParquetFile, row: int) -> tuple[int, int]:
    """The row group that a file's row stands in, and its place there."""
    group = 0
    for n in row_group_sizes(file).tolist():
        if row < n:
            break
        group, row = group + 1, row - n
    return group, row


def read_rows(
    file: pq.ParquetFile,
    group: int,
    partition: Mapping[str, str],
    columns: Sequence[str] | None,
    rows: slice = slice(None),
) -> list[Sample]:
    """Rows of one row group of a file of a table of samples; columns None: all. Raises KeyError for unknown ones."""
    _check_columns(columns)
    names = list(SCHEMA.names if columns is None else columns)
    stored = file.read_row_group(group, columns=[n for n in names if n not in partition])[rows]
    return table_to_rows(with_partition_columns(stored, pa.schema([SCHEMA.field(n) for n in names]), partition))


def _check_columns(columns: Sequence[str] | None) -> None:
    if unknown := sorted(set(columns or ()) - set(SCHEMA.names)):
        raise KeyError(f"no columns {unknown}")


def image_of(sample: Mapping[str, Any], camera: str, time_s: float) -> Bytes:
    """One image (height, width, 3) uint8 RGB; time_s relative to the sample's now, within 0.05 s.

    Raises KeyError where the sample has no such image, ValueError where it cannot be decoded.
    """
    return decode_stored_image(stored_image(sample, camera, time_s))


def stored_image(sample: Mapping[str, Any], camera: str, time_s: float) -> Mapping[str, Any]:
    """As `image_of`, not decoded: one of the column `images`. Raises KeyError as it does."""
    for image in sample["images"] or ():
        if image["camera"] == camera and abs(image["time_s"] - time_s) <= TIME_TOLERANCE_S:
            return cast(Mapping[str, Any], image)
    have = sorted({(i["camera"], round(float(i["time_s"]), 3)) for i in sample["images"] or ()})
    raise KeyError(f"no image of camera {camera!r} at {time_s} s; there are {have}, source {sample['image_source']}")


def decode_stored_image(image: Mapping[str, Any]) -> Bytes:
    """The pixels of one of a row's images (height, width, 3) uint8 RGB. Raises ValueError where it is no picture."""
    try:
        return decode_rgb(image["jpeg"])
    except BadPicture as error:
        raise ValueError(f"image of camera {image['camera']} at {image['time_s']:.1f} s: {error}") from error


def labels_of(sample: Mapping[str, Any], vocabulary: str | None = None) -> VocabularyLabels:
    """Sub-scores and progress of every vocabulary trajectory from the sample's scene, from the columns LABEL_COLUMNS.

    vocabulary: digest of the trajectories that they are meant for. Raises ValueError where the sample has no labels,
    has those of another vocabulary, or its bytes are damaged.
    """
    name = f"sample {sample.get('attempt_id', '')}".strip()
    if sample["label_subscores"] is None:
        raise ValueError(f"{name} has no vocabulary labels: its run had reward.labels=none")
    digest = sample["label_vocabulary"]
    if vocabulary not in (None, digest):
        raise ValueError(f"{name} has labels of vocabulary {digest}, not of {vocabulary}: load the file of that digest")
    try:
        return decode(
            sample["label_subscores"],
            sample["label_progress"],
            vocabulary=digest,
            reference_progress_m=sample["label_reference_progress_m"],
        )
    except ValueError as error:
        raise ValueError(f"{name}: label_{error}") from error

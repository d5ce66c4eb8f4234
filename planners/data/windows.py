"""Rows in memory: windows are read ahead in the order in which an epoch needs them, two of a side at a time.

A row group is read once per window, file by file, and of it only the rows that are wanted. A side that fits into one
window is read once and stays. Rows of a local copy are mapped: they are pages that the system may take back and read
again, and count as the window's memory all the same.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa

from factory.store.parquet_file import naming
from planners.data.decode import StoredRows
from planners.data.feed import Feed
from planners.data.files import leaves, read_group
from planners.data.images import stitch
from planners.data.local_copy import copies_of
from planners.data.mix import WindowKey
from planners.data.pictures import pictures_of
from tasks.world.arrays import Ints

AHEAD = 2  # windows of a side that are in memory, the one in use among them

Place = tuple[StoredRows, int]  # a row group in memory, a row of it


@dataclass(frozen=True, eq=False)
class Window:
    """What is wanted of one window."""

    key: WindowKey
    samples: Ints  # places in the data set, rising
    last: int  # batch after which it can go


class Inline(Executor):
    """Does at once what it is given, in the caller's thread."""

    def submit(self, call: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(call(*args, **kwargs))
        except BaseException as error:
            future.set_exception(error)
        return future


class _Reading:
    """Samples that are being read, a future a file."""

    def __init__(self, futures: list[Future[dict[int, Place]]], last: int) -> None:
        self.futures, self.last = futures, last

    @property
    def is_done(self) -> bool:
        return all(future.done() for future in self.futures)

    @property
    def is_cancelled(self) -> bool:
        return any(future.cancelled() for future in self.futures)

    @cached_property
    def rows(self) -> dict[int, Place]:
        return {sample: place for future in self.futures for sample, place in future.result().items()}


class Memory:
    """The rows of windows that are in use or about to be, and of sides that stay."""

    def __init__(self, feed: Feed, staying: Mapping[int, Ints]) -> None:
        """staying: side -> its samples, for those that fit into one window."""
        self._feed, self._staying = feed, staying
        self.copies = copies_of(feed)
        self.pictures = pictures_of(feed)
        self._stay: dict[int, _Reading] = {}
        self._checked: set[tuple[int, int]] = set()  # row groups whose pages were found undamaged

    def __getstate__(self) -> dict[str, Any]:
        """For another process, which reads for itself."""
        lasting = ("_feed", "_staying", "copies", "pictures", "_checked")
        return {name: self.__dict__[name] for name in lasting} | {"_stay": {}}

    def begin(self, windows: Sequence[Window], executor: Executor) -> None:
        """Start to read for an epoch; what an earlier one left is dropped, but what stays."""
        self._executor = executor
        self._to_come = [window for window in windows if window.key[0] not in self._staying]
        self._read: dict[WindowKey, _Reading] = {}
        for side in sorted({window.key[0] for window in windows} & set(self._staying)):
            if side not in self._stay or self._stay[side].is_cancelled:
                self._stay[side] = self._submit(self._staying[side], 0)
        self._advance()

    def ready(self, key: WindowKey) -> bool:
        """Whether the rows of a window are there."""
        return self._reading(key).is_done

    def rows(self, key: WindowKey) -> Mapping[int, Place]:
        """Sample -> its row, once they are read. Raises OSError for a damaged file."""
        return self._reading(key).rows

    def done(self, batch: int) -> None:
        """No batch up to this one will ask again: windows that only they need are dropped, the next ones read."""
        for key in [key for key, reading in self._read.items() if reading.last <= batch]:
            del self._read[key]
        self._advance()

    def _reading(self, key: WindowKey) -> _Reading:
        if key[0] in self._staying:
            return self._stay[key[0]]
        if key not in self._read:  # a batch that is larger than two windows
            (window,) = (window for window in self._to_come if window.key == key)
            self._to_come.remove(window)
            self._read[key] = self._submit(window.samples, window.last)
        return self._read[key]

    def _advance(self) -> None:
        """Submit the next windows of every side that has fewer than AHEAD."""
        waiting = []
        for window in self._to_come:
            if sum(key[0] == window.key[0] for key in self._read) < AHEAD:
                self._read[window.key] = self._submit(window.samples, window.last)
            else:
                waiting.append(window)
        self._to_come = waiting

    def _submit(self, samples: Ints, last: int) -> _Reading:
        files = self._feed.dataset.rows.file[samples]
        tasks = [self._executor.submit(self._load, int(n), samples[files == n]) for n in np.unique(files)]
        return _Reading(tasks, last)

    def _load(self, number: int, samples: Ints) -> dict[int, Place]:
        """Rows of one file."""
        file = self._feed.dataset.files[number]
        groups = self._feed.dataset.rows.group[samples]
        found: dict[int, Place] = {}
        with naming(file.where):
            read = self._reader(number, np.unique(groups))
            for group in np.unique(groups).tolist():
                found |= self._rows(read(group), samples[groups == group], number in self.copies)
                self._checked.add((number, group))
        return found

    def _reader(self, number: int, groups: Ints) -> Callable[[int], pa.Table]:
        """Row group -> its rows, from the file's copy where there is to be one."""
        if number in self.copies:
            return self.copies[number].open().read_row_group
        checked = all((number, group) in self._checked for group in groups.tolist())
        parquet = self._feed.dataset.files[number].open(check_pages=not checked)
        paths = leaves(parquet, self._feed.columns)
        return lambda group: read_group(parquet, group, paths)

    def _rows(self, table: pa.Table, samples: Ints, mapped: bool) -> dict[int, Place]:
        """Those of a row group that are wanted. Of one that is mapped nothing needs to be cut: it takes no memory."""
        places = self._feed.dataset.rows.place[samples]
        if len(samples) < table.num_rows and not mapped:
            table, places = table.take(places), np.arange(len(samples))
        cameras: list[tuple[str, ...]] = [()] * table.num_rows
        for sample, place in zip(samples.tolist(), places.tolist()):
            cameras[place] = self._feed.cameras[sample]
        stitched = stitch if self.pictures is None else self.pictures.stitch
        stored = StoredRows(table, cameras, in_place=mapped, stitched=stitched)
        return {sample: (stored, place) for sample, place in zip(samples.tolist(), places.tolist())}

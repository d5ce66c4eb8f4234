"""In which file each key of a table stands: sorted arrays, some 20 bytes a key, and what changed since beside them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
import pyarrow as pa

from factory.store.counts.codes import Bytes, fixed_bytes

MERGED_AT = 20_000  # changes, or an eighth of all keys where that is more: then they are sorted in


class KeyIndex:
    """Keys that are not there any more stand in `_changed` as None until they are sorted in."""

    def __init__(self, files: Iterable[tuple[str, pa.ChunkedArray]] = ()) -> None:
        self._paths: list[str] = []
        keys, numbers = [np.zeros(0, "S1")], [np.zeros(0, np.int32)]
        for path, column in files:
            keys.append(fixed_bytes(column))
            numbers.append(np.full(len(column), len(self._paths), np.int32))
            self._paths.append(path)
        self._number_of = {path: number for number, path in enumerate(self._paths)}
        self._changed: dict[str, int | None] = {}
        self._sort(np.concatenate(keys), np.concatenate(numbers))

    def __len__(self) -> int:
        return len(self.keys())

    def __iter__(self) -> Iterator[str]:
        return (key.decode() for key in self.keys().tolist())

    def keys(self) -> Bytes:
        """(N,) sorted."""
        if self._changed:
            self._merge()
        return self._keys

    def files_of(self, keys: Iterable[str]) -> dict[str, str]:
        """Those of the keys that are there, and the file each stands in."""
        asked = list(dict.fromkeys(keys))
        numbers = dict(zip(asked, self._numbers_of(asked)))
        numbers |= {key: self._changed[key] for key in asked if key in self._changed}
        return {key: self._paths[number] for key, number in numbers.items() if number is not None}

    def change(self, drop: Iterable[str], add: Mapping[str, str]) -> None:
        """Keys out, and keys with their files in."""
        self._changed.update(dict.fromkeys(drop))
        for key, path in add.items():
            if path not in self._number_of:
                self._number_of[path] = len(self._paths)
                self._paths.append(path)
            self._changed[key] = self._number_of[path]
        if len(self._changed) > max(MERGED_AT, len(self._keys) // 8):
            self._merge()

    def _numbers_of(self, asked: Sequence[str]) -> list[int | None]:
        if not len(self._keys) or not asked:
            return [None] * len(asked)
        encoded = [key.encode() for key in asked]
        wanted = np.array(encoded, self._keys.dtype)  # of longer ones the beginning
        at = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        there = (self._keys[at] == wanted) & (np.fromiter(map(len, encoded), int) <= self._keys.itemsize)
        return [number if found else None for number, found in zip(self._file[at].tolist(), there.tolist())]

    def _merge(self) -> None:
        stays = np.ones(len(self._keys), bool)
        changed = [encoded for key in self._changed if len(encoded := key.encode()) <= self._keys.itemsize]
        if len(self._keys) and changed:
            stays = ~np.isin(self._keys, np.array(changed, self._keys.dtype), kind="sort")
        added = [(key.encode(), number) for key, number in self._changed.items() if number is not None]
        self._changed = {}
        keys = np.concatenate([self._keys[stays], np.array([key for key, _ in added], np.bytes_)])
        self._sort(keys, np.concatenate([self._file[stays], np.array([number for _, number in added], np.int32)]))

    def _sort(self, keys: Bytes, numbers: np.ndarray) -> None:
        order = np.argsort(keys, kind="stable")
        self._keys, self._file = keys[order], numbers[order]

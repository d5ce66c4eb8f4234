"""A Delta table whose rows have a unique key, written in two steps: files first, then one commit that names them.

Files are content-addressed (`part-<sha256>.parquet`): a task that runs twice writes the same file twice, and a
file that no commit names is an orphan that every reader ignores. A commit may drop rows by key at the same time: the
files they stand in are rewritten without them, in the same transaction, so that a reader sees old or new, never both.

Every commit carries an application transaction. A run claims the table when it starts; from then on the commit of any
older run fails with AnotherWriter. A claim carries an epoch. A run takes one by its commit to one table's log, above
all that were seen, and claims its other tables by it; none takes a claim of an epoch that is not above its own. So of
runs that begin at once the last in that one log is the newest everywhere, and none waits for another, alive or dead.
Measured here: 5-12 ms per commit on local disk.
"""

import json
import re
import secrets
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from deltalake import CommitProperties, DeltaTable, Transaction
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError
from deltalake.transaction import AddAction, RemoveAction
from numpy.typing import NDArray

from factory.files import DamagedFile, machine_fault_of, naming_disk_errors
from factory.store.commit_copies import COPIES, LOG, CommitCopies
from factory.store.location import (
    Location,
    Shard,
    raising_damaged_file,
    read_parquet,
    with_partition_columns,
    write_shard,
)
from factory.store.schema import TableSpec
from factory.wording import one_line, shown

# Texts of millions of rows as integers: a number for each different text.

Ints = NDArray[np.int64]
Codes = NDArray[np.int32]
Bytes = NDArray[np.bytes_]
T = TypeVar("T")
PACKED_ROWS = 2**16


def text_codes(column: pa.ChunkedArray) -> tuple[Codes, tuple[str, ...]]:
    """A number for each text, in the order of the texts, and the texts."""
    if not pa.types.is_dictionary(column.type):
        column = column.dictionary_encode()
    whole = column.unify_dictionaries().combine_chunks()
    if isinstance(whole, pa.ChunkedArray):  # of no chunk
        return np.zeros(0, np.int32), ()
    texts, at = np.array(whole.dictionary.to_pylist(), object), whole.indices.to_numpy()
    used = np.flatnonzero(np.bincount(at, minlength=len(texts)))
    used = used[np.argsort(texts[used])]
    number = np.empty(len(texts), np.int32)
    number[used] = np.arange(len(used))
    return number[at], tuple(texts[used])


def text_equals(column: pa.ChunkedArray, text: str) -> NDArray[np.bool_]:
    """(N,) where a column of texts, numbers into dictionaries or not, has this one; without writing the texts out."""
    if not pa.types.is_dictionary(column.type):
        return np.asarray(pc.equal(column, text), bool)
    parts = [chunk.indices.to_numpy() == chunk.dictionary.index(text).as_py() for chunk in column.chunks]
    return np.concatenate([np.zeros(0, bool), *parts])


def packed_tables(parts: Iterable[pa.Table], key: str) -> Iterator[pa.Table]:
    """The rows in tables of at least PACKED_ROWS, the last one aside; texts but the key as numbers into a dictionary.

    Dictionaries of many small files would cost more than their texts.
    """
    return (_encoded(pack, key) for pack in pack_small(parts, lambda rows: int(rows.num_rows)))


def pack_small(parts: Iterable[T], rows_of: Callable[[T], int]) -> Iterator[list[T]]:
    """In order, as many together as have PACKED_ROWS rows or more; the last ones may have fewer."""
    pack: list[T] = []
    n_rows = 0
    for part in parts:
        pack.append(part)
        n_rows += rows_of(part)
        if n_rows >= PACKED_ROWS:
            yield pack
            pack, n_rows = [], 0
    if pack:
        yield pack


def _encoded(parts: Sequence[pa.Table], key: str) -> pa.Table:
    rows = pa.concat_tables(parts)
    for at, field in enumerate(rows.schema):
        if field.type == pa.string() and field.name != key:
            rows = rows.set_column(at, field.name, rows[field.name].dictionary_encode())
    return rows.combine_chunks()


def distinct_texts(rows: pa.Table, names: Sequence[str]) -> tuple[list[tuple[str, ...]], Codes]:
    """The different combinations of texts that some columns have, and which of them each row has."""
    texts: list[tuple[str, ...]] = []

    def one_by_one() -> Iterator[Codes]:  # of millions of rows a column's numbers take their place in memory
        for name in names:
            numbers, different = text_codes(rows[name])
            texts.append(different)
            yield numbers

    found, at = distinct_rows(one_by_one())
    return [tuple(words[i] for i, words in zip(row, texts)) for row in found.tolist()], at


def distinct_rows(columns: Iterable[Ints | Codes]) -> tuple[Ints, Codes]:
    """The different rows (D, columns) in order, and which of them each row is; of columns of few different numbers."""
    rows, at = np.zeros((1, 0), np.int64), np.zeros(1, np.int32)
    for numbers in columns:
        width = int(numbers.max(initial=0)) + 1
        at = at * np.int32(width) + numbers.astype(np.int32, copy=False)
        used = np.flatnonzero(np.bincount(at, minlength=len(rows) * width))
        number = np.empty(len(rows) * width, np.int32)
        number[used] = np.arange(len(used))
        rows, at = np.column_stack([rows[used // width], used % width]), number[at]
    return rows, at


def fixed_bytes(column: pa.ChunkedArray | pa.Array) -> Bytes:
    """(N,) texts as bytes of one width, that of the longest."""
    chunks = column.chunks if isinstance(column, pa.ChunkedArray) else [column]
    parts = [_fixed(chunk) for chunk in chunks if len(chunk)]
    return np.concatenate(parts) if parts else np.zeros(0, "S1")


def _fixed(texts: pa.Array) -> Bytes:
    lengths = pc.min_max(pc.binary_length(texts)).as_py()
    width = lengths["max"]
    if not 0 < width == lengths["min"]:
        return np.array([text.encode() for text in texts.to_pylist()], np.bytes_)
    start = int.from_bytes(texts.buffers()[1][4 * texts.offset : 4 * texts.offset + 4], "little")
    return np.frombuffer(texts.buffers()[2], f"S{width}", len(texts), start)


def keys_with_prefix(keys: Bytes, prefix: str) -> list[str]:
    """Those of sorted keys that begin so, in order."""
    first, behind = prefix.encode(), prefix.encode() + b"\xff"  # a byte that is in no text
    return [key.decode() for key in keys[np.searchsorted(keys, first) : np.searchsorted(keys, behind)].tolist()]


# Listings of an object store that are behind what was written, or break off. Amazon's list a key as soon as it is
# there, others may be seconds late; who asks for a key by its name gets it at once. delta-rs's client asks again where
# a file breaks off, but not where a listing does, or the words by which a store says that there is no such file;
# Arrow's does for all of them.

PAUSES_S = (0.0, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0)  # a minute in all
BROKE_OFF = re.compile(  # in what delta-rs says; where it asked again by itself the time is followed by how often
    r"Error getting list response body|Error performing GET \S+ in \S+ - .*error reading a body", re.DOTALL
)
BROKEN_PAUSES_S = (0.1, 0.2, 0.5, 1.0, 2.0)  # each before asking once more


class ListingBehind(TimeoutError):
    """What was written is still not listed."""


def wait_until_listed(is_seen: Callable[[], bool], name: str) -> None:
    """Look until it is seen. Raises ListingBehind after a minute."""
    for pause_s in PAUSES_S:
        time.sleep(pause_s)
        if is_seen():
            return
    raise ListingBehind(f"{name} is there, and its store does not list it after {sum(PAUSES_S):.0f} s")


def is_broken_listing(error: BaseException) -> bool:
    """What delta-rs raised is of an answer that ended before its end, and was not asked for again."""
    return isinstance(error, DeltaError | OSError) and BROKE_OFF.search(str(error)) is not None


def retry_broken_listing(ask: Callable[[], T]) -> T:
    """What delta-rs, which lists meanwhile, answers; asked again, five times at most, where an answer broke off."""
    for pause_s in BROKEN_PAUSES_S:
        try:
            return ask()
        except (DeltaError, OSError) as error:
            if not is_broken_listing(error):
                raise
        time.sleep(pause_s)
    return ask()


# In which file each key of a table stands: sorted arrays, some 20 bytes a key, and what changed since beside them.

MERGED_AT = 20_000  # changes, or 1/32 of all keys where that is more: then they are sorted in


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
        every = np.concatenate(keys)
        order = np.argsort(every, kind="stable")
        self._keys, self._file = every[order], np.concatenate(numbers)[order]

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

    def update(self, drop: Iterable[str], add: Mapping[str, str]) -> None:
        """Keys out, and keys with their files in."""
        self._changed.update(dict.fromkeys(drop))
        for key, path in add.items():
            if path not in self._number_of:
                self._number_of[path] = len(self._paths)
                self._paths.append(path)
            self._changed[key] = self._number_of[path]
        if len(self._changed) > max(MERGED_AT, len(self._keys) // 32):
            self._merge()

    def _numbers_of(self, asked: Sequence[str]) -> list[int | None]:
        if not len(self._keys) or not asked:
            return [None] * len(asked)
        at, there = self._places([key.encode() for key in asked])
        return [number if found else None for number, found in zip(self._file[at].tolist(), there.tolist())]

    def _places(self, encoded: Sequence[bytes]) -> tuple[Ints, NDArray[np.bool_]]:
        """Where keys stand among the sorted ones, of which there are some, and whether they do."""
        wanted = np.array(encoded, self._keys.dtype)  # of longer ones the beginning
        at = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        there = (self._keys[at] == wanted) & (np.fromiter(map(len, encoded), int) <= self._keys.itemsize)
        return at, there

    def _merge(self) -> None:
        """By inserting: sorting them all anew would take their memory three times more."""
        changed = sorted((key.encode(), -1 if number is None else number) for key, number in self._changed.items())
        self._changed = {}
        keys, numbers = np.array([key for key, _ in changed]), np.array([number for _, number in changed], np.int32)
        if len(self._keys):
            at, there = self._places([key for key, _ in changed])
            if there.any():
                self._keys, self._file = np.delete(self._keys, at[there]), np.delete(self._file, at[there])
        keys, numbers = keys[numbers >= 0], numbers[numbers >= 0]
        self._keys = self._keys.astype(np.promote_types(self._keys.dtype, keys.dtype), copy=False)
        at = np.searchsorted(self._keys, keys)
        self._keys, self._file = np.insert(self._keys, at, keys), np.insert(self._file, at, numbers)


APP_ID = "driving-data-factory"
EPOCH_ID = f"{APP_ID}.epoch"
ACTION_BYTES = 1024  # of the log, about, that a file added or removed takes
SCHEMA_BYTES = 16 * 1024  # of the log, about, that a new table takes
CLAIMS = 20  # of one table, by a run that begins while another commits
CLAIM_PAUSE_S = 0.1  # on an object store after the first, and half as long again after each: 50 s in all
AHEAD = 16  # files of an object store that are read at once


class DuplicateKey(RuntimeError):
    """A commit would store a key twice. Nothing was written."""


class DamagedLog(DamagedFile):
    """A file of the table's log is damaged."""


DEEPEST = 10_000  # brackets open at once; delta-rs follows them with its stack, which ends behind 20,000
_TEXT = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+"?', re.DOTALL)


def refuse_deep_commits(table: Path) -> None:
    """Raises DamagedLog where a commit's JSON would end this process while delta-rs reads it."""
    for path in (table / LOG).glob("*.json"):
        if path.stat().st_size > DEEPEST:
            signs = np.frombuffer(re.sub(rb"[^][{}]+", b"", _TEXT.sub(b"", path.read_bytes())), np.uint8)
            if np.where(np.isin(signs, list(b"[{")), 1, -1).cumsum().max(initial=0) > DEEPEST:
                raise DamagedLog(f"{path}: more than {DEEPEST:,} brackets in one another, which no writer makes")


class AnotherWriter(RuntimeError):
    """Another run claimed the table since this one did; what this one has not committed by now, it never will."""


@dataclass(frozen=True)
class LiveFile:
    """One file that the log names."""

    partition: Mapping[str, str]
    n_bytes: int
    n_rows: int
    written_ms: int  # since 1970: when its rows came into the table, or were rewritten without others


class KeyedTable:
    """One writer's view of the table, which need not exist before its first commit."""

    def __init__(self, location: Location, spec: TableSpec) -> None:
        self.location, self.spec = location, spec
        self.copies = CommitCopies(location)
        self._token = secrets.token_hex(16)  # stands in every commit of this writer
        self._delta: DeltaTable | None = None
        self._facts: tuple[int, dict[str, LiveFile]] = (-1, {})  # of a version
        with self._log_naming():
            self._delta = retry_broken_listing(self._opened)

    def __getstate__(self) -> dict[str, Any]:
        """For another process: the version that is seen here, whatever is committed in the meantime."""
        return {**self.__dict__, "_delta": self.version}

    def __setstate__(self, state: dict[str, Any]) -> None:
        version = state["_delta"]
        self.__dict__.update(state)
        self._token = secrets.token_hex(16)
        with self._log_naming():
            self._delta = None if version is None else retry_broken_listing(partial(self._opened, version))

    def at(self, version: int) -> "KeyedTable":
        """The table as it was at one of its versions, to be read. Raises DamagedLog where its log has that no more."""
        then = KeyedTable.__new__(KeyedTable)
        then.__setstate__({**self.__dict__, "_facts": (-1, {}), "_delta": version})
        then.__dict__.pop("_index", None)
        return then

    def _opened(self, version: int | None = None) -> DeltaTable | None:
        """version: None: the newest."""
        options = dict(self.location.options)
        is_there = DeltaTable.is_deltatable(self.location.uri, storage_options=options)
        if self.location.is_local:
            refuse_deep_commits(Path(self.location.uri))
        return DeltaTable(self.location.uri, version, storage_options=options) if is_there else None

    @contextmanager
    def _log_naming(self) -> Iterator[None]:
        """What a damaged log raises while it is read, a panic of delta-rs among it, is a DamagedLog."""
        try:
            yield
        except BaseException as error:
            panic = type(error).__name__ == "PanicException"  # no Exception, and importable from nowhere
            if not panic and not isinstance(error, Exception):
                raise
            found = [f"{damage.name} {damage.problem}" for damage in self.copies.damage()]
            if panic or found or (isinstance(error, DeltaError) and not machine_fault_of(error)):
                said = "; ".join(found) or f"its log cannot be read: {one_line(error)}"
                raise DamagedLog(f"{self.location.uri}: {said}") from error
            raise

    @cached_property
    def _index(self) -> KeyIndex:
        """In which file each key stands."""
        key = self.spec.key
        return KeyIndex((path, rows[key]) for path, rows in self.files([key]))

    def keys(self) -> Bytes:
        """(N,) sorted."""
        return self._index.keys()

    @property
    def version(self) -> int | None:
        return None if self._delta is None else self._delta.version()

    def __len__(self) -> int:
        counts = [file.n_rows for file in self.file_facts().values()]
        return sum(counts) if all(counts) else len(self._index)  # the log tells, but of files of others perhaps

    def __iter__(self) -> Iterator[str]:
        return iter(self._index)

    def __contains__(self, key: str) -> bool:
        return bool(self._index.files_of([key]))

    def path_of(self, key: str) -> str:
        """The file that a key stands in. Raises KeyError."""
        return self._index.files_of([key])[key]

    def live_files(self) -> dict[str, Mapping[str, str]]:
        """Path -> partition values of every file that the log names."""
        return {path: file.partition for path, file in self.file_facts().items()}

    def file_facts(self) -> dict[str, LiveFile]:
        """Path -> what the log says of every file that it names; reads no file."""
        if self._delta is None:
            return {}
        if self._facts[0] != self._delta.version():
            self._facts = (self._delta.version(), self._read_facts(self._delta))
        return dict(self._facts[1])

    def _read_facts(self, delta: DeltaTable) -> dict[str, LiveFile]:
        parts = {name: f"partition.{name}" for name in self.spec.partition_by}
        facts = ["path", "size_bytes", "num_records", "modification_time"]
        with self._log_naming():
            actions = pa.table(delta.get_add_actions(flatten=True)).select([*facts, *parts.values()])
        for path in actions["path"].to_pylist():
            if not {"", ".", ".."}.isdisjoint(path.split("/")):  # verify removes files by these names
                raise DamagedLog(f"{self.location.uri}: names a file that is not in its folder: {shown(path)}")
        return {
            a["path"]: LiveFile(
                {name: str(a[part]) for name, part in parts.items()},
                a["size_bytes"],
                a["num_records"] or 0,
                a["modification_time"],
            )
            for a in actions.to_pylist()
        }

    def refresh(self) -> None:
        """For a reader: see what was committed since the table was opened or last refreshed."""
        if self._delta is not None:
            retry_broken_listing(self._delta.update_incremental)
        else:
            self._delta = retry_broken_listing(self._opened)
        self.__dict__.pop("_index", None)

    def files(self, columns: Sequence[str] | None = None) -> Iterable[tuple[str, pa.Table]]:
        """(path, its rows) for every live file, in path order; columns None: all, partition columns included.

        On an object store, where a file costs round trips and little else, AHEAD more are being read meanwhile.
        """
        live = sorted(self.live_files().items())
        if self.location.is_local:
            yield from ((path, self.read_file(path, partition, columns)) for path, partition in live)
            return
        with ThreadPoolExecutor(AHEAD) as pool:
            reading: deque[tuple[str, Future[pa.Table]]] = deque()
            for path, partition in live:
                reading.append((path, pool.submit(self.read_file, path, partition, columns)))
                if len(reading) > AHEAD:
                    first, rows = reading.popleft()
                    yield first, rows.result()
            yield from ((path, rows.result()) for path, rows in reading)

    def read_file(self, path: str, partition: Mapping[str, str], columns: Sequence[str] | None = None) -> pa.Table:
        """One file's rows in the table's schema, page checksums verified."""
        schema = self.schema_of(columns)
        with raising_damaged_file(f"{self.location.uri}/{path}"):
            return with_partition_columns(read_parquet(self.location, path, schema, partition), schema, partition)

    def read(self, columns: Sequence[str] | None = None, encoded: bool = False) -> pa.Table:
        """All rows.

        encoded: texts but the key as numbers into dictionaries, for what counts over many rows of few different ones.
        """
        parts = (rows for _, rows in self.files(columns))
        found = packed_tables(parts, self.spec.key) if encoded else parts
        return pa.concat_tables([self.schema_of(columns, encoded).empty_table(), *found])

    def schema_of(self, columns: Sequence[str] | None = None, encoded: bool = False) -> pa.Schema:
        """Of some columns, None: all; encoded: as of `read`."""
        names = self.spec.schema.names if columns is None else columns
        fields = [self.spec.schema.field(name) for name in names]
        numbers = pa.dictionary(pa.int32(), pa.string())  # texts as numbers into a dictionary
        encodes = [encoded and f.name != self.spec.key and f.type == pa.string() for f in fields]
        return pa.schema([f.with_type(numbers) if to_number else f for f, to_number in zip(fields, encodes)])

    def lost_commit(self) -> int | None:
        """The number of a commit that was made and that the log does not have any more; None where it has all."""
        lost: int | None = None

        def is_sure() -> bool:
            nonlocal lost
            self.refresh()
            lost = self.copies.lost_commit(-1 if self.version is None else self.version)
            return lost is None or not self.copies.log_has(lost)

        wait_until_listed(is_sure, f"a commit of {self.location.uri}")
        return lost

    @property
    def epoch(self) -> int:
        """Of the newest claim that was seen; 0 where there is none."""
        return 0 if self._delta is None else self._delta.transaction_version(EPOCH_ID) or 0

    def claim(self, epoch: int | None = None, above: int = 0) -> int:
        """Create the table if need be, and make commits and claims of every earlier epoch fail from here on.

        epoch: that another table was claimed in; None: the next one of this table, higher than `above`. Returns it.
        What was committed since the table was opened is seen from here on. An older run may commit at the same moment:
        then once more, as the newest claim is to stand. Raises AnotherWriter where a run of the same or a later epoch
        has claimed the table.
        """
        if self._delta is None:
            self._create()
        self.refresh()
        for left in reversed(range(CLAIMS)):
            mine = max(self.epoch, above) + 1 if epoch is None else epoch
            if mine <= self.epoch:
                raise self._another_writer_error()
            try:
                self._transact([], mine)
                break
            except AnotherWriter:
                if left and not self.location.is_local:  # perhaps a commit that is not listed yet
                    time.sleep(min(CLAIM_PAUSE_S * 1.5 ** (CLAIMS - left), 5.0))
                self.refresh()
                if not left or self.epoch > mine:  # a later claim followed at once
                    raise
        return mine

    def commit(self, add: Sequence[Shard], drop: Iterable[str] = ()) -> None:
        """Add files and drop rows by key, in one transaction; a dropped key that is not there is no error.

        Raises DuplicateKey and AnotherWriter; in both cases the table stays as it was.
        """
        index = self._index  # as it was before the transaction
        path_of = index.files_of(drop)
        dropped, touched = set(path_of), set(path_of.values())
        new = [key for shard in add for key in shard.keys]
        twice = [key for key in index.files_of(new) if key not in dropped]
        if twice or len(set(new)) < len(new):
            key = twice[0] if twice else next(key for key, n in Counter(new).items() if n > 1)
            raise DuplicateKey(f"{self.spec.name}: {self.spec.key} {key} would be stored twice")
        if not add and not dropped:
            return
        live = self.live_files() if touched else {}
        kept = [rest for path in sorted(touched) if (rest := self._rewritten(path, live[path], dropped)) is not None]
        adds = {shard.path: shard for shard in (*add, *kept)}
        unchanged = touched & set(adds)  # content-addressed: the same name is the same bytes
        now_ms = int(time.time() * 1000)
        actions: list[AddAction | RemoveAction] = [
            RemoveAction(path, True, now_ms, None, dict(live[path])) for path in sorted(touched - unchanged)
        ]
        for path, shard in sorted(adds.items()):
            if path not in unchanged:
                stats = json.dumps({"numRecords": len(shard.keys)})
                actions.append(AddAction(path, shard.size, shard.partition, now_ms, True, stats))
        self._transact(actions)
        index.update(dropped, {key: written.path for written in (*kept, *add) for key in written.keys})

    def replace_files(self, drop: Collection[str], add: Sequence[tuple[Shard, int]] = ()) -> None:
        """Files out of the table and others, with the time [ms] of their rows, into it, in one transaction.

        What samples there are does not change by those that are added. Raises AnotherWriter.
        """
        live, now_ms, names = self.live_files(), int(time.time() * 1000), {shard.path for shard, _ in add}
        actions: list[AddAction | RemoveAction] = [
            RemoveAction(path, not add, now_ms, None, dict(live[path])) for path in sorted(set(drop) - names)
        ]
        for shard, written_ms in add:
            stats = json.dumps({"numRecords": len(shard.keys)})
            actions.append(AddAction(shard.path, shard.size, shard.partition, written_ms, False, stats))
        self._transact(actions)
        self.__dict__.pop("_index", None)

    @property
    def properties(self) -> Mapping[str, str]:
        """The table's own metadata; empty before its first commit."""
        if self._delta is None:
            return {}
        return {name: value for name, value in self._delta.metadata().configuration.items() if value is not None}

    def set_property(self, name: str, value: str) -> None:
        """One more commit, of metadata. Raises AnotherWriter."""
        table = self._delta if self._delta is not None else self._create()
        change = partial(table.alter.set_table_properties, {name: value}, raise_if_not_exists=False)
        self._commit(table, 1, lambda: change(commit_properties=self._properties()))

    def _rewritten(self, path: str, partition: Mapping[str, str], dropped: set[str]) -> Shard | None:
        rows = self.read_file(path, partition)
        rows = rows.filter(pc.invert(pc.is_in(rows[self.spec.key], value_set=pa.array(sorted(dropped), pa.string()))))
        return write_shard(self.location, self.spec, rows) if rows.num_rows else None

    def _transact(self, actions: list[AddAction | RemoveAction], epoch: int | None = None) -> None:
        """Put one commit, with a claim's epoch, at the end of the log that was seen. Raises AnotherWriter."""
        table = self._delta if self._delta is not None else self._create()
        said = [Transaction(APP_ID, (table.transaction_version(APP_ID) or 0) + 1)]
        if epoch is not None:
            said.append(Transaction(EPOCH_ID, epoch))
        self._commit(
            table,
            1 + len(actions),
            lambda: table.create_write_transaction(
                actions,
                mode="append",
                schema=self.spec.schema,
                partition_by=list(self.spec.partition_by),
                commit_properties=self._properties(*said),
            ),
        )

    def _another_writer_error(self) -> AnotherWriter:
        taken = f"{self.spec.name}: another run has taken over {self.location.uri}"
        return AnotherWriter(f"{taken}; once that has ended, run the same command again")

    def _properties(self, *transactions: Transaction) -> CommitProperties:
        return CommitProperties({"writer": self._token}, max_commit_retries=0, app_transactions=list(transactions))

    def _commit(self, table: DeltaTable, n_actions: int, commit: Callable[[], object]) -> None:
        """Make one commit: it is ours and the newest, and has its copy. Raises AnotherWriter.

        A client whose answer got lost asks again, and is told that somebody was faster: the log says who it was. It
        does so too where a listing broke off, which may have been before the commit or after it.
        """
        version = table.version() + 1

        def once() -> None:
            try:
                with naming_disk_errors(f"{self.location.uri}/_delta_log", ACTION_BYTES * n_actions):
                    commit()
            except (DeltaError, OSError) as error:
                may_be_made = isinstance(error, DeltaError) or is_broken_listing(error)
                if may_be_made and self.copies.log_has(version, self._token):
                    return
                if isinstance(error, CommitFailedError):
                    raise self._another_writer_error() from error
                raise

        retry_broken_listing(once)
        self._wait_until_seen(table, version)
        if self.version != version:
            raise self._another_writer_error()
        with naming_disk_errors(f"{self.location.uri}/{COPIES}", SCHEMA_BYTES):
            self.copies.copy_commit(version)

    def _wait_until_seen(self, table: DeltaTable, version: int) -> None:
        def is_seen() -> bool:
            with suppress(TableNotFoundError):
                retry_broken_listing(table.update_incremental)
            return table.version() >= version

        wait_until_listed(is_seen, f"commit {version} of {self.location.uri}")

    def _create(self) -> DeltaTable:
        with naming_disk_errors(f"{self.location.uri}/_delta_log", SCHEMA_BYTES):
            if self.location.is_local:
                Path(self.location.uri).mkdir(parents=True, exist_ok=True)
            try:
                retry_broken_listing(self._create_once)
            except DeltaError:
                if not self.copies.log_has(0):
                    raise

        def is_seen() -> bool:
            self.refresh()
            return self._delta is not None

        wait_until_listed(is_seen, f"the first commit of {self.location.uri}")
        assert self._delta is not None
        return self._delta

    def _create_once(self) -> None:
        """Where it is there already, by another run or by ourselves, it stays as it is."""
        DeltaTable.create(
            self.location.uri,
            self.spec.schema,
            mode="ignore",
            partition_by=list(self.spec.partition_by),
            name=self.spec.name,
            configuration=self.spec.properties,
            raise_if_key_not_exists=False,
            commit_properties=CommitProperties(max_commit_retries=0),  # else it is made a second time
            storage_options=dict(self.location.options),
        )


def main(arguments: list[str]) -> int:
    """The trial of a URL that `why_unusable` runs: both clients, a small object written and removed.

    0, or 1 and why not on standard output.
    """
    try:
        location = Location.parse(arguments[0])
        name = f".trial-{secrets.token_hex(8)}"
        retry_broken_listing(lambda: DeltaTable.is_deltatable(location.child("samples").uri))
        location.write(name, b"")
        location.remove(name)
    except (OSError, ValueError, pa.ArrowException, DeltaError) as error:  # BadLocation among them
        print(one_line(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Where a store lives, a folder or an object-store URL, and its files: read and written whole; Parquet, under its
content's name and with its checksums verified; prepared clips and scenes, with_checksum.
"""

import dataclasses
import enum
import hashlib
import importlib
import json
import math
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pyarrow import fs

from factory.files import DamagedFile, atomic_file, in_submitted_job, is_data
from factory.store.schema import TableSpec
from factory.wording import one_line, printable
from tasks.caches import Damaged, with_checksum, without_checksum

if TYPE_CHECKING:
    from tasks.hard_scenes import BenchmarkClip, GivenScenes, OneStageClip

REMOTE = ("s3", "gs", "abfs", "abfss", "file")  # what both Arrow and Delta write to


class BadLocation(ValueError):
    """The output path cannot be used as it stands."""


@dataclass(frozen=True)
class Location:
    """A folder: an absolute local path or a URL such as s3://bucket/prefix.

    `options` are deltalake's `storage_options` (AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID, ...); empty on local disk.
    """

    uri: str
    options: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def parse(
        out: str | os.PathLike[str], options: Mapping[str, str] | None = None, setting: str = "out"
    ) -> "Location":
        """Raises BadLocation for an unknown kind of URL, and for a relative path in a submitted Ray job's own copy.

        setting: what errors call it.
        """
        text = os.fspath(out)
        if "://" in text:
            if text.partition("://")[0] not in REMOTE:
                raise BadLocation(f"{setting}={text}: name a folder, or a URL of {', '.join(REMOTE)}://")
            return Location(text.rstrip("/"), dict(options or {}))
        path = Path(text).expanduser()
        if not path.is_absolute() and in_submitted_job():
            raise BadLocation(
                f"{setting}={text} is relative, and a submitted job runs in a copy: name an absolute path or a URL"
            )
        return Location(str(path.resolve()), dict(options or {}))

    @property
    def is_local(self) -> bool:
        return "://" not in self.uri

    @property
    def folder(self) -> Path | None:
        """On this machine's file systems; None where it is on an object store."""
        filesystem, base = self.filesystem()
        return Path(base) if isinstance(filesystem, fs.LocalFileSystem) else None

    def child(self, name: str) -> "Location":
        return Location(f"{self.uri}/{name}", self.options)

    def read(self, name: str) -> bytes | None:
        """The file's bytes; None where there is no such file."""
        filesystem, base = self.filesystem()
        try:
            with filesystem.open_input_stream(f"{base}/{name}", compression=None) as stream:
                return bytes(stream.read())
        except (FileNotFoundError, NotADirectoryError):  # the latter: below a file
            return None

    def has(self, name: str) -> bool:
        """There is such a file."""
        filesystem, base = self.filesystem()
        return bool(filesystem.get_file_info(f"{base}/{name}").type == fs.FileType.File)

    def write(self, name: str, data: bytes) -> None:
        """Whole file or no file: rename on local disk (flushed first), on an object store an upload that is completed.

        Raises DiskFull where the disk is full.
        """
        if not self.is_local:
            filesystem, base = self.filesystem()
            with filesystem.open_output_stream(f"{base}/{name}", compression=None) as stream:
                stream.write(data)
            return
        with atomic_file(Path(self.uri, name), len(data)) as draft, draft.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())

    def remove(self, name: str) -> None:
        filesystem, base = self.filesystem()
        filesystem.delete_file(f"{base}/{name}")

    def names(self) -> list[str]:
        """Paths of all files below, relative to this folder, sorted."""
        return sorted(self._files())

    def ages_s(self, now_s: float) -> dict[str, float]:
        """Seconds since each file below, by its path relative to this folder, was last written."""
        return {name: now_s - (info.mtime_ns or 0) / 1e9 for name, info in self._files().items()}

    def _files(self) -> dict[str, fs.FileInfo]:
        """All files below."""
        filesystem, base = self.filesystem()
        if self.folder is not None:
            found = filesystem.get_file_info([os.fspath(path) for path in _local_files(self.folder)])
        else:
            found = filesystem.get_file_info(fs.FileSelector(base, recursive=True, allow_not_found=True))
        return {info.path[len(base) + 1 :]: info for info in found if info.type == fs.FileType.File}

    def filesystem(self) -> tuple[fs.FileSystem, str]:
        if self.is_local:
            return fs.LocalFileSystem(), self.uri
        return _remote(os.getpid(), self.uri, tuple(sorted(self.options.items())))


OWN_DRAFT = re.compile(r"\..*\.tmp|\.trial-[0-9a-f]+")  # hidden files that runs leave; others are somebody else's


def _local_files(folder: Path) -> Iterator[Path]:
    """What is in a folder and is none. No link to a folder is followed, as what is listed may be removed.

    Other processes make and remove folders there: one that is gone before it is opened has no files.
    """
    try:
        entries = [entry for entry in os.scandir(folder) if is_data(entry.name) or OWN_DRAFT.fullmatch(entry.name)]
    except FileNotFoundError:
        return
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            yield from _local_files(folder / entry.name)
        else:
            yield folder / entry.name


@lru_cache(maxsize=64)
def _remote(process: int, uri: str, options: tuple[tuple[str, str], ...]) -> tuple[fs.FileSystem, str]:
    """A client that keeps its connections, which a forked `process` must not share, and the folder's path there."""
    if uri.startswith("s3://") and options:
        given = dict(options)
        scheme, _, host = given.get("AWS_ENDPOINT_URL", "").rpartition("://")
        client = fs.S3FileSystem(
            access_key=given.get("AWS_ACCESS_KEY_ID"),
            secret_key=given.get("AWS_SECRET_ACCESS_KEY"),
            session_token=given.get("AWS_SESSION_TOKEN"),
            region=given.get("AWS_REGION"),
            scheme=scheme or "https",
            endpoint_override=host or None,
        )
        return client, uri.removeprefix("s3://")
    client, base = fs.FileSystem.from_uri(uri)
    return client, base


# One Parquet file of a table: written under its content's name, opened with its checksums verified, and what damage
# is called.

LONGEST_PATH = 4096  # characters, of Linux
ROW_GROUP_BYTES = 4 * 2**20  # uncompressed; one sample costs one group, and a group 13 kB of the file's footer


@dataclass(frozen=True)
class Shard:
    """One written, not yet committed file."""

    path: str  # relative to the table
    size: int  # bytes
    partition: Mapping[str, str]
    keys: tuple[str, ...]


def write_shard(location: Location, spec: TableSpec, rows: pa.Table) -> Shard:
    """Write rows of ONE partition, sorted by key, as one file under the table's folder. Idempotent.

    The partition's columns stand in the file too, where Delta does not need them: a file alone says what it holds.
    Row groups hold at most 4 MB, or one row. Without Arrow's own schema every engine reads plain lists as the Delta log
    says. Only text gets a dictionary, which numbers that differ make larger than they are (samples of logs take 0.6 of
    that). Packed leaves are stored as they are: zstd makes no JPEG smaller.
    """
    rows = rows.select(spec.schema.names).cast(spec.schema).sort_by(spec.key)
    partition = {}
    for name in spec.partition_by:
        (value,) = pc.unique(rows[name]).to_pylist()
        partition[name] = str(value)
    keys = tuple(rows[spec.key].to_pylist())
    group_rows = max(1, int(ROW_GROUP_BYTES // max(1, rows.nbytes // max(1, rows.num_rows))))
    sink = pa.BufferOutputStream()
    leaves = {path: kind for field in rows.schema for path, kind in _leaves(field.name, field.type)}
    pq.write_table(
        rows,
        sink,
        row_group_size=group_rows,
        compression={path: "none" if path in spec.packed else "zstd" for path in leaves},
        use_dictionary=[path for path, kind in leaves.items() if pa.types.is_string(kind)],
        write_page_checksum=True,
        write_page_index=True,
        store_schema=False,
    )
    data = sink.getvalue().to_pybytes()
    folder = "".join(f"{name}={value}/" for name, value in partition.items())
    path = f"{folder}part-{hashlib.sha256(data).hexdigest()[:32]}.parquet"
    location.write(path, data)
    return Shard(path, len(data), partition, keys)


def _leaves(path: str, kind: pa.DataType) -> list[tuple[str, pa.DataType]]:
    """The paths in a file of the leaves under a column or member, and their types."""
    if pa.types.is_struct(kind):
        return [leaf for member in kind for leaf in _leaves(f"{path}.{member.name}", member.type)]
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        return _leaves(f"{path}.list.element", kind.value_type)
    return [(path, kind)]


def with_partition_columns(stored: pa.Table, schema: pa.Schema, partition: Mapping[str, object]) -> pa.Table:
    """The columns of `schema` from what a file holds and what the log says of it. Raises ValueError for a column whose
    members have other names: a cast would take them for absent, and make null of what they hold."""
    n = stored.num_rows
    for name, kind in zip(schema.names, schema.types):
        if name not in partition and _members(stored[name].type) != _members(kind):
            raise ValueError(f"column {name} is {stored[name].type}, expected {kind}")
    arrays = [pa.repeat(pa.scalar(partition[f.name]), n) if f.name in partition else stored[f.name] for f in schema]
    same = [array if array.type == f.type else array.cast(f.type) for array, f in zip(arrays, schema)]
    return pa.table(same, schema=schema)


def _members(kind: pa.DataType) -> Any:
    """The names within a type, as they nest."""
    if pa.types.is_struct(kind):
        return {member.name: _members(member.type) for member in kind}
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        return _members(kind.value_type)
    return None


def open_parquet(location: Location, path: str) -> pq.ParquetFile:
    """One file. Only where reading costs round trips are a read's columns fetched together, before they are decoded."""
    return _open_parquet(location, path)[0]


def _open_parquet(location: Location, path: str) -> tuple[pq.ParquetFile, int]:
    """The same, and its size in bytes. What the footer says of a column is not asked: Arrow ends the process where that
    is damaged (ColumnChunkMetaData of pyarrow 26 is made outside of any `except`)."""
    filesystem, base = location.filesystem()
    source = filesystem.open_input_file(f"{base}/{path}")
    options: dict[str, Any] = {"page_checksum_verification": True, "pre_buffer": not location.is_local}
    return pq.ParquetFile(source, **options), source.size()


def read_parquet(location: Location, path: str, schema: pa.Schema, without: Collection[str] = ()) -> pa.Table:
    """The columns of `schema` that stand in a file. Raises DamagedFile for a damaged page."""
    names = [name for name in schema.names if name not in without]
    with raising_damaged_file(f"{location.uri}/{path}"):
        file, n_bytes = _open_parquet(location, path)
        if file.metadata.num_rows > n_bytes:  # keys that are all different take more
            raise OSError(f"{file.metadata.num_rows:,} rows in {n_bytes:,} bytes")
        return file.read(columns=names, use_threads=not location.is_local)  # threads cost more than small columns do


@contextmanager
def raising_damaged_file(path: str) -> Iterator[None]:
    """What is raised while a Parquet file is read, by a damaged page, footer or schema, is a DamagedFile."""
    path = printable(path[:LONGEST_PATH])  # a log may name any
    try:
        yield
    except DamagedFile:
        raise
    except FileNotFoundError as error:  # Arrow says so in three clauses
        raise DamagedFile(f"{path}: is missing") from error
    except (OSError, pa.ArrowException, ValueError, LookupError, RuntimeError, MemoryError, OverflowError) as error:
        raise DamagedFile(f"{path}: cannot be read: {one_line(error)}") from error


# Prepared clips on disk, so that a later run goes on without a perturb task, and the scenes of a benchmark.
#
# A file is a JSON tree that says how frozen dataclasses, tuples, dicts and arrays nest, and all arrays of a type one
# behind the other: a clip has some 1,200, and its candidates name the same agents twenty times. Reading it builds only
# dataclasses and enums of this distribution, by their fields, and nothing else. All of it is compressed by zstd; its
# size stands before it, a seal (tasks.caches) behind; a damaged or foreign file counts as missing, with the reason.

FORMAT = 4
ALIGNED = 16  # where arrays begin [bytes]
MOST_BYTES = 2**30  # of a file before it is compressed
CLIP_SUFFIX = ".clip"
PACKAGES = ("tasks.", "factory.")  # whose dataclasses and enums a file may name
_AGAIN = "the command that made it writes it again"
_PLAIN = (str, int, float, bool, type(None))


class BadCacheFile(ValueError):
    """A cache file is damaged or not one of ours."""


def encode_tree(value: object) -> bytes:
    """A tree of dataclasses, enums, dicts, tuples, lists, frozensets, numpy arrays and plain scalars as bytes.

    Raises TypeError naming the type of anything else.
    """
    parts = _Parts()
    root = _encode(value, parts)
    arrays = parts.by_type()
    sizes = {kind: array.size for kind, array in arrays.items()}
    tree = json.dumps({"sizes": sizes, "tuples": parts.tuples, "root": root}).encode()
    plain = bytearray(FORMAT.to_bytes(8, "little") + len(tree).to_bytes(8, "little") + tree)
    for array in arrays.values():
        plain += bytes(-len(plain) % ALIGNED)
        plain += array.view(np.uint8).data
    return len(plain).to_bytes(8, "little") + pa.compress(plain, codec="zstd", asbytes=True)


def decode_tree(data: bytes, within: Sequence[str] = ()) -> Any:
    """The opposite; within: fields that lead to the part that is wanted, None where there is none. Raises BadCacheFile.

    Nothing else of the tree is built: one drive of a clip with its candidates takes a third of the time.
    """
    try:
        size = int.from_bytes(data[:8], "little")
        if size > MOST_BYTES:
            raise BadCacheFile(f"{size:,} bytes in {len(data):,}: no clip is that large")
        plain = bytearray(pa.decompress(data[8:], decompressed_size=size, codec="zstd"))  # arrays in it can be written
        if (found := int.from_bytes(plain[:8], "little")) != FORMAT:
            raise BadCacheFile(f"another format ({found}), this version reads {FORMAT}")
        at = 16 + int.from_bytes(plain[8:16], "little")
        tree, arrays = json.loads(plain[16:at]), dict[str, NDArray[np.generic]]()
        for kind, count in tree["sizes"].items():
            at += -at % ALIGNED
            arrays[kind] = np.frombuffer(plain, kind, count, at) if count else np.empty(0, kind)
            at += arrays[kind].nbytes
        node = tree["root"]
        for name in within:
            node = node.get("members", {}).get(name) if isinstance(node, dict) else None
        return _Stored(arrays, tree["tuples"]).decode(node)
    except Exception as error:  # whatever a type's name, a size or a class makes of bytes that are none of ours
        raise BadCacheFile(str(error) or type(error).__name__) from error


class ClipCache:
    """Prepared clips by key, under the store."""

    def __init__(self, location: Location) -> None:
        self.location = location

    def load(self, key: str, within: Sequence[str] = ()) -> object | None:
        """The stored value, or a part of it (see decode_tree); None where there is none. Raises BadCacheFile."""
        data = self.location.read(f"{key}{CLIP_SUFFIX}")
        return None if data is None else decode_tree(_unsealed(data, key), within)

    def store(self, key: str, value: object) -> None:
        """Whole or not at all."""
        self.location.write(f"{key}{CLIP_SUFFIX}", with_checksum(encode_tree(value), key))


@dataclasses.dataclass(frozen=True)
class SceneFiles:
    """The folder `scenes` of a store: one file a clip, from which planners are driven without the raw logs."""

    location: Location

    def store(self, scenes: "BenchmarkClip | GivenScenes | OneStageClip") -> None:
        """Whole or not at all; in place of an older one."""
        self.location.write(f"{scenes.clip.clip_id}{CLIP_SUFFIX}", with_checksum(encode_tree(scenes)))

    def load(self, clip_id: str) -> "BenchmarkClip | GivenScenes | OneStageClip":
        """Raises FileNotFoundError where the clip has none, BadCacheFile, naming it, for a damaged or foreign file."""
        from tasks.hard_scenes import BenchmarkClip, GivenScenes, OneStageClip

        data, path = self.location.read(f"{clip_id}{CLIP_SUFFIX}"), f"{self.location.uri}/{clip_id}{CLIP_SUFFIX}"
        if data is None:
            raise FileNotFoundError(f"{path}: no scenes of this clip; run the factory again")
        try:
            scenes = decode_tree(_unsealed(data))
        except BadCacheFile as error:
            raise BadCacheFile(f"{path}: {error}; remove it, {_AGAIN}") from error
        if not isinstance(scenes, BenchmarkClip | GivenScenes | OneStageClip):
            raise BadCacheFile(f"{path} holds {type(scenes).__name__}, not a clip's scenes")
        if scenes.clip.clip_id != clip_id:
            raise BadCacheFile(f"{path} holds clip {scenes.clip.clip_id}; remove it, {_AGAIN}")
        return scenes

    def clip_ids(self) -> list[str]:
        """Of all clips that have scenes, sorted."""
        return [name.removesuffix(CLIP_SUFFIX) for name in self.location.names() if name.endswith(CLIP_SUFFIX)]


def check_prepared_clip(data: bytes, key: str) -> None:
    """Hold the file of a prepared clip against its seal. Raises BadCacheFile."""
    try:
        without_checksum(data, key)
    except Damaged as error:
        raise BadCacheFile(f"{error}; the next run makes it again") from error


def _unsealed(data: bytes, key: str = "") -> bytes:
    try:
        return without_checksum(data, key)
    except Damaged as error:
        raise BadCacheFile(str(error)) from error


class _Parts:
    """Arrays and tuples of a tree; one that stands in it twice is stored once."""

    def __init__(self) -> None:
        self.tuples: list[Any] = []
        self._flat: dict[str, list[NDArray[np.generic]]] = {}
        self._ends: dict[str, int] = {}
        self._known: dict[int, tuple[Any, Any]] = {}  # by id, which is taken while the value is here

    def place(self, array: NDArray[np.generic]) -> Any:
        """Where an array lies: type, first element, shape."""
        if id(array) not in self._known:
            kind = _type_name(array.dtype)
            first = self._ends.get(kind, 0)
            own = array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))
            self._flat.setdefault(kind, []).append(own.ravel())
            self._ends[kind] = first + array.size
            self._known[id(array)] = array, [kind, first, list(array.shape)]
        return self._known[id(array)][1]

    def number(self, value: tuple[Any, ...]) -> int:
        """Which of the tuples it is."""
        if id(value) not in self._known:
            members = [_encode(v, self) for v in value]
            self._known[id(value)] = value, len(self.tuples)
            self.tuples.append(members)
        return int(self._known[id(value)][1])

    def by_type(self) -> dict[str, NDArray[np.generic]]:
        """All arrays of a type as one (N,)."""
        return {kind: np.concatenate(parts) for kind, parts in self._flat.items()}


@cache
def _type_name(dtype: Any) -> str:
    return str(dtype.str[1:])


def _encode(value: Any, parts: _Parts) -> Any:
    kind: Any = type(value)
    if kind in _PLAIN:
        return value
    if kind is tuple:
        return {"tuple": parts.number(value)}
    if kind is list:
        return {"list": [_encode(v, parts) for v in value]}
    if isinstance(value, enum.Enum):
        return {"enum": _name(kind), "value": value.value}
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError("an array of objects cannot be cached")
        return {"array": parts.place(value)}
    if isinstance(value, np.generic):
        return {"scalar": parts.place(np.asarray(value))}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {"class": _name(kind), "members": {name: _encode(getattr(value, name), parts) for name in _given(kind)}}
    if isinstance(value, Mapping):
        return {"dict": [[_encode(k, parts), _encode(v, parts)] for k, v in value.items()]}
    if isinstance(value, frozenset):
        return {"frozenset": [_encode(v, parts) for v in sorted(value)]}
    raise TypeError(f"{_name(kind)} cannot be cached; allowed: dataclasses of {PACKAGES}, arrays, containers")


@cache
def _given(kind: Any) -> tuple[str, ...]:
    """The fields that a dataclass is made of."""
    return tuple(member.name for member in dataclasses.fields(kind) if member.init)


class _Stored:
    """The arrays and tuples of a file; one that stands twice in the tree is one."""

    def __init__(self, by_type: Mapping[str, NDArray[np.generic]], tuples: Sequence[Any]) -> None:
        self._by_type, self._tuples = by_type, tuples
        self._known: dict[Any, Any] = {}

    def decode(self, node: Any) -> Any:
        """What a node of the tree says."""
        if not isinstance(node, dict):
            return node
        if "array" in node:
            return self._array(node["array"])
        if "scalar" in node:
            return self._array(node["scalar"])[()]
        if "class" in node:
            kind = _class(node["class"])
            if not dataclasses.is_dataclass(kind):
                raise BadCacheFile(f"{node['class']} is no dataclass")
            build: Any = kind
            return build(**{name: self.decode(child) for name, child in node["members"].items()})
        if "enum" in node:
            return _member(node["enum"], node["value"])
        if "dict" in node:
            return {self.decode(k): self.decode(v) for k, v in node["dict"]}
        if "tuple" in node:
            return self._tuple(node["tuple"])
        if "frozenset" in node:
            return frozenset(self.decode(child) for child in node["frozenset"])
        return [self.decode(child) for child in node["list"]]

    def _array(self, place: Any) -> NDArray[np.generic]:
        kind, first, shape = key = place[0], place[1], tuple(place[2])
        if key not in self._known:
            self._known[key] = self._by_type[kind][first : first + math.prod(shape)].reshape(shape)
        found: NDArray[np.generic] = self._known[key]
        return found

    def _tuple(self, number: int) -> tuple[Any, ...]:
        if number not in self._known:
            self._known[number] = tuple(self.decode(child) for child in self._tuples[number])
        found: tuple[Any, ...] = self._known[number]
        return found


@cache
def _member(name: str, value: Any) -> enum.Enum:
    kind = _class(name)
    if not issubclass(kind, enum.Enum):
        raise BadCacheFile(f"{name} is no enum")
    return kind(value)


@cache
def _name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


@cache
def _class(name: str) -> Any:
    module, _, qualname = name.partition(":")
    if not module.startswith(PACKAGES) or "." in qualname:
        raise BadCacheFile(f"{name} is not a class a cache file may name")
    found = getattr(importlib.import_module(module), qualname)
    if not isinstance(found, type) or found.__module__ != module:
        raise BadCacheFile(f"{name} is not a class of {module}")
    return found

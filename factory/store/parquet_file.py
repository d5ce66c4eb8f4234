"""One Parquet file of a table: written under its content's name, opened with its checksums verified, and what damage is
called."""

import hashlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from factory.store.location import Location
from factory.wording import one_line

ROW_GROUP_BYTES = 4 * 2**20  # uncompressed; one sample costs one group, and a group 13 kB of the file's footer


class DamagedFile(OSError):
    """A file of the table cannot be read; the message names it."""


@dataclass(frozen=True)
class TableSpec:
    """What a table is; `key` is its unique column."""

    name: str
    schema: pa.Schema
    key: str
    partition_by: tuple[str, ...] = ()
    properties: Mapping[str, str] | None = None
    packed: tuple[str, ...] = ()  # leaves whose values are compressed already, as their paths in a file


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
    says. Packed leaves are stored as they are: neither zstd nor a dictionary makes a JPEG smaller.
    """
    rows = rows.select(spec.schema.names).cast(spec.schema).sort_by(spec.key)
    partition = {}
    for name in spec.partition_by:
        (value,) = pc.unique(rows[name]).to_pylist()
        partition[name] = str(value)
    keys = tuple(rows[spec.key].to_pylist())
    group_rows = max(1, int(ROW_GROUP_BYTES // max(1, rows.nbytes // max(1, rows.num_rows))))
    sink = pa.BufferOutputStream()
    leaves = [path for field in rows.schema for path in _leaf_paths(field.name, field.type)]
    pq.write_table(
        rows,
        sink,
        row_group_size=group_rows,
        compression={path: "none" if path in spec.packed else "zstd" for path in leaves},
        use_dictionary=[path for path in leaves if path not in spec.packed],
        write_page_checksum=True,
        write_page_index=True,
        store_schema=False,
    )
    data = sink.getvalue().to_pybytes()
    folder = "".join(f"{name}={value}/" for name, value in partition.items())
    path = f"{folder}part-{hashlib.sha256(data).hexdigest()[:32]}.parquet"
    location.write(path, data)
    return Shard(path, len(data), partition, keys)


def _leaf_paths(path: str, kind: pa.DataType) -> list[str]:
    """The paths in a file of the leaves under a column or member."""
    if pa.types.is_struct(kind):
        return [leaf for member in kind for leaf in _leaf_paths(f"{path}.{member.name}", member.type)]
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        return _leaf_paths(f"{path}.list.element", kind.value_type)
    return [path]


def with_partition(stored: pa.Table, schema: pa.Schema, partition: Mapping[str, object]) -> pa.Table:
    """The columns of `schema` from what a file holds and what the log says of it."""
    n = stored.num_rows
    arrays = [_repeated(partition[f.name], f.type, n) if f.name in partition else stored[f.name] for f in schema]
    same = (array if array.type == f.type else array.cast(f.type) for array, f in zip(arrays, schema))
    return pa.table(list(same), schema=schema)


def _repeated(value: object, kind: pa.DataType, n: int) -> pa.Array:
    return pa.repeat(pa.scalar(value).cast(kind), n)


def encoded_text(field: pa.Field) -> pa.Field:
    """The column with its texts as numbers into a dictionary."""
    return field.with_type(pa.dictionary(pa.int32(), pa.string())) if field.type == pa.string() else field


def open_parquet(location: Location, path: str) -> pq.ParquetFile:
    """One file. Only where reading costs round trips are a read's columns fetched together, before they are decoded."""
    filesystem, base = location.filesystem()
    options: dict[str, Any] = {"filesystem": filesystem, "page_checksum_verification": True}
    return pq.ParquetFile(f"{base}/{path}", pre_buffer=not location.is_local, **options)


def read_parquet(location: Location, path: str, schema: pa.Schema, without: Collection[str] = ()) -> pa.Table:
    """The columns of `schema` that stand in a file. Raises DamagedFile for a damaged page."""
    names = [name for name in schema.names if name not in without]
    with naming(f"{location.uri}/{path}"):
        file = open_parquet(location, path)
        return file.read(columns=names, use_threads=not location.is_local)  # threads cost more than small columns do


@contextmanager
def naming(path: str) -> Iterator[None]:
    """What is raised while a Parquet file is read, by a damaged page, footer or schema, is a DamagedFile."""
    try:
        yield
    except (FileNotFoundError, DamagedFile):  # with their file's name
        raise
    except (OSError, pa.ArrowException, ValueError, LookupError, RuntimeError, MemoryError, OverflowError) as error:
        raise DamagedFile(f"{path}: cannot be read: {one_line(error)}") from error

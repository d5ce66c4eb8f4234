"""One Parquet file of a table: opened with its checksums verified, its columns, and what damage is called."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from factory.store.location import Location
from factory.wording import one_line


class DamagedFile(OSError):
    """A file of the table cannot be read; the message names it."""


def with_partition(stored: pa.Table, schema: pa.Schema, partition: Mapping[str, object]) -> pa.Table:
    """The columns of `schema` from what a file holds and what the log says of it."""
    n = stored.num_rows
    arrays = [
        _repeated(partition[f.name], f.type, n) if f.name in partition else stored[f.name].cast(f.type) for f in schema
    ]
    return pa.table(arrays, schema=schema)


def _repeated(value: object, kind: pa.DataType, n: int) -> pa.Array:
    if pa.types.is_dictionary(kind):
        return pa.DictionaryArray.from_arrays(pa.repeat(pa.scalar(0, kind.index_type), n), [value])
    return pa.repeat(pa.scalar(value).cast(kind), n)


def encoded_text(field: pa.Field) -> pa.Field:
    """The column with its texts as numbers into a dictionary."""
    return field.with_type(pa.dictionary(pa.int32(), pa.string())) if field.type == pa.string() else field


def open_parquet(location: Location, path: str, encoded: Sequence[str] = ()) -> pq.ParquetFile:
    """One file; encoded: columns that are read as numbers into a dictionary."""
    filesystem, base = location.filesystem()
    options: dict[str, Any] = {"filesystem": filesystem, "page_checksum_verification": True}
    return pq.ParquetFile(f"{base}/{path}", read_dictionary=list(encoded), **options)


def read_parquet(location: Location, path: str, schema: pa.Schema, without: Collection[str] = ()) -> pa.Table:
    """The columns of `schema` that stand in a file. Raises DamagedFile for a damaged page."""
    names = [name for name in schema.names if name not in without]
    encoded = [name for name in names if pa.types.is_dictionary(schema.field(name).type)]
    with naming(f"{location.uri}/{path}"):
        return open_parquet(location, path, encoded).read(columns=names)


@contextmanager
def naming(path: str) -> Iterator[None]:
    """What is raised while a Parquet file is read, by a damaged page, footer or schema, is a DamagedFile."""
    try:
        yield
    except (FileNotFoundError, DamagedFile):  # with their file's name
        raise
    except (OSError, pa.ArrowException, ValueError, LookupError, RuntimeError, MemoryError, OverflowError) as error:
        raise DamagedFile(f"{path}: cannot be read: {one_line(error)}") from error

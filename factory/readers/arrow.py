"""Tables of Arrow's file format (IPC, feather), whose columns may be packed."""

import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from factory.files import broken_link
from factory.readers.base import BadClip

if TYPE_CHECKING:
    import pyarrow as pa

UNPACKED_PER_BYTE, UNPACKED_BYTES = 16, 1 << 24  # of a file's size, and besides; real logs unpack to 1 to 5 times it
N_MAGIC = 8  # bytes in front of the stream


def read_feather(path: Path, columns: tuple[str, ...], whole: bool = True) -> dict[str, NDArray[np.generic]]:
    """Named columns of a feather file as writable arrays. Raises BadClip.

    whole: nulls, NaN and infinity are refused, else they are NaN and None.
    """
    import pyarrow as pa

    table = read_arrow(path, "feather")
    if table.num_rows == 0:
        raise BadClip(str(path), "file", "holds no rows")
    out = {}
    for name in columns:
        if name not in table.column_names:
            raise BadClip(str(path), name, "column is missing")
        kind = table[name].type
        if any(map(pa.types.is_nested, (kind, getattr(kind, "value_type", kind)))):  # numpy's words for such never end
            raise BadClip(str(path), name, "holds lists or records, expected one value a row")
        if whole and table[name].null_count:
            raise BadClip(str(path), name, "holds nulls")
        out[name] = np.array(table[name].to_numpy())
        if whole and out[name].dtype.kind == "f" and not np.isfinite(out[name]).all():
            raise BadClip(str(path), name, "holds NaN or infinity")
    return out


def read_arrow(path: Path, kind: str, rows: bool = True, mapped: bool = False) -> "pa.Table":
    """The table of a file, checked whole, or without its rows. Raises BadClip where it is missing, cut or too large.

    Nothing is unpacked before it is known to how much, of the stream that such a file is in front of its footer: a
    footer can name one batch many times, or one that hides in another. mapped: only what is looked at is loaded.
    """
    import pyarrow as pa

    try:
        if mapped:
            with pa.memory_map(str(path)) as source:
                data = source.read_buffer()
        else:
            data = pa.py_buffer(path.read_bytes())  # Arrow itself would look at the file 8 times
        file = pa.ipc.open_file(pa.BufferReader(data))  # what is cut off has no footer
        if not rows:
            return file.schema.empty_table()
        table, n_batches = read_stream(data.slice(N_MAGIC), str(path))
        names = table.schema.names  # each is text
        if n_batches != file.num_record_batches or not file.schema.equals(table.schema, check_metadata=True):
            raise ValueError(f"its footer tells of others than its {n_batches} batches and {len(names)} columns")
    except FileNotFoundError as error:
        raise BadClip(str(path), "file", broken_link(path) or "missing") from error
    except (pa.ArrowException, OSError, ValueError, struct.error) as error:  # ValueError also: a name that is no text
        raise BadClip(str(path), "file", f"cannot be read as {kind}, truncated? {error}") from error
    return table


def read_stream(stream: "pa.Buffer", name: str) -> tuple["pa.Table", int]:
    """The table of a stream, checked whole, and of how many batches it is; name: for errors.

    Raises BadClip where it unpacks to too much; pa.ArrowException, OSError, ValueError or struct.error for no stream.
    """
    import pyarrow as pa

    n_bytes, n_batches, most = 0, 0, UNPACKED_PER_BYTE * stream.size + UNPACKED_BYTES
    problem = f"unpacks to more than the {most:,} bytes that a file of {stream.size:,} may: export it again"
    too_large = BadClip(name, "size", problem)
    for message in pa.ipc.MessageReader.open_stream(pa.BufferReader(stream)):
        n_batches += message.type == "record batch"
        n_bytes += unpacked_bytes(message) if message.type != "schema" else 0
        if n_bytes > most:
            raise too_large
    table = pa.ipc.open_stream(pa.BufferReader(stream)).read_all()
    table.validate(full=True)
    if sum(map(_bytes_of_texts, table.columns)) > most:
        raise too_large
    return table, n_batches


def packed_rows(path: Path, rows: Collection[int]) -> Iterator[tuple[int, "pa.Buffer"]]:
    """Number and bytes of each row asked for, of the one column of bytes of a file. Raises BadClip."""
    import pyarrow as pa

    table = read_arrow(path, "an Arrow file", mapped=True)
    columns = [column for column in table.columns if pa.types.is_binary(column.type)]
    for row in rows:
        packed = columns[0][row] if len(columns) == 1 and row < table.num_rows else None
        if packed is None or not packed.is_valid:
            raise BadClip(f"{path}#frame={row}", "data", "nothing is packed there")
        yield row, packed.as_buffer()


def _bytes_of_texts(column: "pa.ChunkedArray") -> int:
    """Of a column of numbers into a dictionary of texts, once they are written out: one may stand in every row."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if not pa.types.is_dictionary(column.type) or not pa.types.is_string(column.type.value_type):
        return 0
    lengths = (pc.binary_length(chunk.dictionary).take(chunk.indices) for chunk in column.chunks)
    return sum(pc.sum(pc.cast(length, "int64")).as_py() or 0 for length in lengths)


def unpacked_bytes(batch: "pa.Message") -> int:
    """What a batch takes in memory by its own words: of Arrow's Message.fbs, and what stands before a packed buffer.

    A row counts 8 bytes, since columns of nothing have no buffer. Raises struct.error where the message is broken.
    """
    head, body = memoryview(batch.metadata), memoryview(batch.body or b"")

    def number(kind: str, at: int) -> int:
        return int(struct.unpack_from(f"<{kind}", head, at)[0])

    def field(table: int, k: int) -> int:
        """Where the k-th field of a table of flatbuffers is; 0: it has none."""
        fields = table - number("i", table)
        place = number("H", fields + 4 + 2 * k) if 4 + 2 * k < number("H", fields) else 0
        return table + place if place else 0

    def inside(at: int) -> int:
        return at + number("I", at)

    records = inside(field(inside(0), 2))
    if batch.type == "dictionary":
        records = inside(field(records, 1))
    rows, buffers, packed = field(records, 0), inside(field(records, 2)), field(records, 3)
    n_bytes = 8 * number("q", rows) if rows else 0
    for at in range(buffers + 4, buffers + 4 + 16 * number("I", buffers), 16):
        begin, length = number("q", at), number("q", at + 8)
        unpacked = struct.unpack_from("<q", body, begin)[0] if packed and length >= 8 else -1
        n_bytes += length if unpacked < 0 else unpacked  # -1: it is not packed
    return n_bytes

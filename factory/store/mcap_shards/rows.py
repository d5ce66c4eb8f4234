"""Columns of Arrow to the fields of messages and back, a row group at a time, every bit of every number kept.

Arrays are plain lists, as Parquet's own types have them: `list<list<float>>` for (40, 3).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from factory.store.columns import Column
from factory.store.mcap_shards.topics import Numbered, inner
from factory.store.mcap_shards.wire import Fields, delimited, fixed, parse, repeated
from tasks.world.arrays import Ints

WIRE = {"bool": "u1", "int8": "<i4", "int32": "<i4", "float32": "<f4", "float64": "<f8"}  # as arrays lie in a message
SIZE = "<i4"


def fields_of(at: Numbered, array: pa.Array) -> list[bytes]:
    """Of each row the fields of a column; nothing where it is null or has no entries."""
    column = at.column
    if column.dtype == "struct":
        offsets = array.offsets.to_numpy()
        parts = [fields_of(member, array.values.field(member.column.name)) for member in inner(column)]
        entries = [b"".join(part) for part in zip(*parts)]
        return [repeated(at.number, entries[a:b]) for a, b in pairwise(offsets)]
    if column.dtype in ("string", "binary"):
        return [repeated(at.number, map(_bytes, _items(value, column))) for value in array.to_pylist()]
    if not column.shape:
        values = array.fill_null(0).to_numpy(zero_copy_only=False).astype(WIRE[column.dtype])
        return [fixed(at.number, value.tobytes()) if there else b"" for value, there in zip(values, array.is_valid())]
    return _arrays(at, array)


def array_of(
    at: Numbered,
    messages: Sequence[Fields | None],
    members: Collection[str] = (),
    beside: Mapping[str, pa.Array] | None = None,
) -> pa.Array:
    """The opposite: one value a message. None: it has none, and the value is null.

    members: of a struct's, those that are wanted; beside: members whose values of all entries stand elsewhere.
    Raises ValueError where the lengths of fields do not fit the column.
    """
    column = at.column
    found = [[] if message is None else message.get(at.number, []) for message in messages]
    there = (
        np.array([message is not None for message in messages])
        if column.dtype == "struct"
        else np.array([bool(items) for items in found])
    )
    nulls = ~there if column.nullable else np.zeros(len(found), bool)
    if column.dtype == "struct":
        entries = [parse(item) for items in found for item in items]
        numbers = {member.column.name: member for member in inner(column)}
        arrays = {name: array_of(member, entries) for name, member in numbers.items() if name in members}
        arrays |= beside or {}
        names = [member.name for member in column.members if member.name in arrays]
        values = pa.StructArray.from_arrays([arrays[name] for name in names], names)
        return _listed(values, [len(items) for items in found], nulls)
    if column.dtype in ("string", "binary"):
        plain = [[_value(item, column) for item in items] for items in found]
        if column.shape:
            kind = column.arrow_type.value_type
            return _listed(pa.array([v for row in plain for v in row], kind), [len(row) for row in plain], nulls)
        return pa.array([row[0] if row else None for row in plain], column.arrow_type)
    return _numbers(at, messages, found, nulls)


def _numbers(
    at: Numbered, messages: Sequence[Fields | None], found: Sequence[Sequence[memoryview]], nulls: NDArray[np.bool_]
) -> pa.Array:
    column = at.column
    wire = np.dtype(WIRE[column.dtype])
    flat = np.frombuffer(b"".join(item for items in found for item in items[:1]), wire).astype(column.dtype)
    if not column.shape:
        values = np.zeros(len(found), column.dtype)
        values[[bool(items) for items in found]] = flat
        return pa.array(values, mask=nulls)
    counts = [len(items[0]) // wire.itemsize if items else 0 for items in found]
    values = pa.array(flat)
    fixed_sizes = [int(size) for size in column.shape[2 if at.sizes else 1 :]]
    for size in reversed(fixed_sizes):
        values = _listed(values, np.full(len(values) // size, size), None)
    if not at.sizes:
        each = math.prod(fixed_sizes)
        if any(count % each for count in counts):
            raise ValueError(f"{column.name}: numbers that are no multiple of {each}")
        return _listed(values, [count // each for count in counts], nulls)
    sizes = [
        np.frombuffer(message[at.sizes][0], SIZE) if message is not None and at.sizes in message else np.zeros(0, SIZE)
        for message in messages
    ]
    values = _listed(values, np.concatenate([np.zeros(0, SIZE), *sizes]), None)
    return _listed(values, [len(size) for size in sizes], nulls)


def _listed(values: pa.Array, lengths: Sequence[int] | Ints, nulls: NDArray[np.bool_] | None) -> pa.Array:
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    if offsets[-1] != len(values):
        raise ValueError(f"{len(values)} entries where {offsets[-1]} are told")
    mask = None if nulls is None or not nulls.any() else pa.array(nulls)
    return pa.ListArray.from_arrays(pa.array(offsets), values, mask=mask)


def _arrays(at: Numbered, array: pa.Array) -> list[bytes]:
    """Fields of numbers in the order of their rows, and with them the sizes where a second one is ragged."""
    bounds, sizes, sized = np.arange(len(array) + 1), np.zeros(0, SIZE), np.zeros(len(array) + 1, np.int64)
    for depth in range(len(at.column.shape)):
        offsets = array.offsets.to_numpy()
        if depth == 1 and at.sizes:
            sizes, sized = np.diff(offsets).astype(SIZE), bounds
        bounds, array = offsets[bounds], array.values
    values = array.to_numpy(zero_copy_only=False).astype(WIRE[at.column.dtype])
    found = []
    for row in range(len(bounds) - 1):
        numbers = values[bounds[row] : bounds[row + 1]]
        lengths = sizes[sized[row] : sized[row + 1]]
        field = delimited(at.number, numbers.tobytes()) if len(numbers) else b""
        found.append(field + (delimited(at.sizes, lengths.tobytes()) if len(lengths) else b""))
    return found


def _items(value: object, column: Column) -> Sequence[str | bytes]:
    if value is None:
        return ()
    return value if column.shape else (value,)  # type: ignore[return-value]


def _bytes(value: str | bytes) -> bytes:
    return value.encode() if isinstance(value, str) else value


def _value(item: memoryview, column: Column) -> str | bytes:
    return str(item, "utf-8") if column.dtype == "string" else bytes(item)

"""Declared columns: from one `Column` its Arrow type, its validation, its line in the docs, and arrays in and out.

A shape lists sizes: a number is a fixed size, a letter a ragged one. Rectangular values are arrays of that shape;
where a ragged size stands behind the first, the value is a list of arrays.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

Size = int | str

_ARROW = {
    "string": pa.string(),
    "binary": pa.binary(),
    "bool": pa.bool_(),
    "int8": pa.int8(),
    "int32": pa.int32(),
    "int64": pa.int64(),
    "float32": pa.float32(),
    "float64": pa.float64(),
}

_ARROW_OF = {  # type of a dataclass' field -> of its column
    str: pa.string(),
    bool: pa.bool_(),
    int: pa.int32(),
    float: pa.float64(),
    dict[str, int]: pa.map_(pa.string(), pa.int64()),
    dict[str, float]: pa.map_(pa.string(), pa.float64()),
}


class BadRow(ValueError):
    """A row does not fit its columns; says which column and why."""


@dataclass(frozen=True)
class Column:
    """One column, or one member of a struct column."""

    name: str
    dtype: str  # a key of _ARROW, or "struct"
    shape: tuple[Size, ...] = ()
    unit: str = ""
    frame: str = ""
    about: str = ""
    nullable: bool = False
    nan: bool = False  # NaN marks absent entries; elsewhere it is refused
    members: tuple["Column", ...] = ()  # of a struct

    @property
    def arrow_type(self) -> pa.DataType:
        inner = _ARROW[self.dtype] if self.dtype != "struct" else pa.struct([m.arrow_field for m in self.members])
        for size in reversed(self.shape):
            inner = pa.list_(inner, size) if isinstance(size, int) else pa.list_(inner)
        return inner

    @property
    def arrow_field(self) -> pa.Field:
        notes = {"unit": self.unit, "frame": self.frame, "shape": str(list(self.shape)), "about": self.about}
        return pa.field(self.name, self.arrow_type, metadata={k: v for k, v in notes.items() if v and v != "[]"})

    def to_arrow(self, value: object) -> pa.Array:
        """One value as an array of length 1. Raises BadRow."""
        if value is None:
            if not self.nullable:
                raise BadRow(f"{self.name}: missing")
            return pa.nulls(1, self.arrow_type)
        return _build(self, self.shape, [value], self.name)

    def to_python(self, value: pa.Scalar) -> object:
        """The opposite: an array, a list of arrays where ragged inside, a list of dicts for structs, None for null."""
        if not value.is_valid:
            return None
        return _read(self, self.shape, value)


def _build(column: Column, shape: tuple[Size, ...], values: Sequence[object], where: str) -> pa.Array:
    """Values, each of `shape`, as one Arrow array of len(values)."""
    if not shape:
        return _scalars(column, values, where)
    regular = column.dtype not in ("struct", "string", "binary") and not any(isinstance(s, str) for s in shape[1:])
    if regular:
        arrays = [_checked(column, shape, value, where) for value in values]
        flat = np.concatenate([a.ravel() for a in arrays]) if arrays else np.zeros(0, column.dtype)
        lengths = [len(a) for a in arrays]
        inner: pa.Array = pa.array(flat, _ARROW[column.dtype])
        for size in reversed(shape[1:]):
            assert isinstance(size, int)
            inner = pa.FixedSizeListArray.from_arrays(inner, size)
    else:
        items = [_sequence(value, where) for value in values]
        lengths = [len(item) for item in items]
        inner = _build(column, shape[1:], [entry for item in items for entry in item], where)
    if isinstance(shape[0], int):
        if any(length != shape[0] for length in lengths):
            raise BadRow(f"{where}: {shape[0]} entries expected, got {lengths}")
        return pa.FixedSizeListArray.from_arrays(inner, shape[0])
    return pa.ListArray.from_arrays(pa.array(np.concatenate([[0], np.cumsum(lengths)]), pa.int32()), inner)


def _sequence(value: object, where: str) -> Sequence[object]:
    if isinstance(value, str | bytes) or not hasattr(value, "__len__") or not hasattr(value, "__getitem__"):
        raise BadRow(f"{where}: a list is expected, got {type(value).__name__}")
    return value  # type: ignore[return-value]


def _checked(column: Column, shape: tuple[Size, ...], value: object, where: str) -> NDArray[np.generic]:
    wanted = np.dtype(column.dtype)
    array = np.asarray(value)
    if array.size == 0 and array.ndim < len(shape) and isinstance(shape[0], str):
        array = array.reshape(0, *(s for s in shape[1:] if isinstance(s, int)))
    fits = array.ndim == len(shape) and all(isinstance(s, str) or s == n for s, n in zip(shape, array.shape))
    if not fits:
        raise BadRow(f"{where}: shape {list(shape)} expected, got {list(array.shape)}")
    if array.size and not np.can_cast(array.dtype, wanted, casting="same_kind"):
        raise BadRow(f"{where}: {wanted} expected, got {array.dtype}")
    if wanted.kind == "f" and not column.nan and not np.isfinite(array).all():
        raise BadRow(f"{where}: holds NaN or infinity")
    return np.ascontiguousarray(array, wanted)


def _scalars(column: Column, values: Sequence[object], where: str) -> pa.Array:
    if column.dtype == "struct":
        return _structs(column, values, where)
    if column.dtype == "string":
        good = all(isinstance(v, str) for v in values)
    elif column.dtype == "binary":
        good = all(v is None or isinstance(v, bytes) for v in values)
    else:
        return pa.array(
            np.concatenate([np.zeros(0, column.dtype), *(_checked(column, (), v, where).reshape(1) for v in values)]),
            _ARROW[column.dtype],
        )
    if not good:
        raise BadRow(f"{where}: {column.dtype} expected, got {sorted({type(v).__name__ for v in values})}")
    return pa.array([str(v) for v in values] if column.dtype == "string" else list(values), _ARROW[column.dtype])


def _structs(column: Column, values: Sequence[object], where: str) -> pa.Array:
    names = [member.name for member in column.members]
    for value in values:
        if not isinstance(value, Mapping) or sorted(value) != sorted(names):
            got = sorted(value) if isinstance(value, Mapping) else type(value).__name__
            raise BadRow(f"{where}: members {names} expected, got {got}")
    children = [
        _build(member, member.shape, [value[member.name] for value in values], f"{where}.{member.name}")  # type: ignore[index]
        for member in column.members
    ]
    return pa.StructArray.from_arrays(children, fields=[m.arrow_field for m in column.members])


def _read(column: Column, shape: tuple[Size, ...], value: pa.Scalar) -> object:
    if column.dtype == "struct":
        if shape:
            return [_read(column, shape[1:], entry) for entry in value]
        return {member.name: _read(member, member.shape, value[member.name]) for member in column.members}
    if not shape or column.dtype in ("string", "binary"):
        return value.as_py()
    if any(isinstance(size, str) for size in shape[1:]):
        return [_read(column, shape[1:], entry) for entry in value]
    flat = value.values
    while pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        flat = flat.flatten()
    sizes = [size if isinstance(size, int) else -1 for size in shape]
    array: NDArray[np.generic] = flat.to_numpy(zero_copy_only=False)
    if -1 in sizes:
        sizes[0] = len(value)
    return array.reshape(sizes)


def schema_of(row: type) -> pa.Schema:
    """The columns of a dataclass: its fields in their order."""

    def arrow(hint: Any) -> pa.DataType:
        if is_dataclass(hint):
            return pa.struct(list(schema_of(hint)))  # type: ignore[arg-type]
        if get_origin(hint) is tuple:
            return pa.list_(arrow(get_args(hint)[0]))
        return _ARROW_OF[hint]

    return pa.schema([pa.field(name, arrow(hint)) for name, hint in get_type_hints(row).items()])

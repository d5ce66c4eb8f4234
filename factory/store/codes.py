"""Texts of millions of rows as integers: a number for each different text."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Codes = NDArray[np.int32]
Bytes = NDArray[np.bytes_]
T = TypeVar("T")
PACKED_ROWS = 2**16


def codes(column: pa.ChunkedArray) -> tuple[Codes, tuple[str, ...]]:
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


def equals(column: pa.ChunkedArray, text: str) -> NDArray[np.bool_]:
    """(N,) where a column of texts, numbers into dictionaries or not, has this one; without writing the texts out."""
    if not pa.types.is_dictionary(column.type):
        return np.asarray(pc.equal(column, text), bool)
    parts = [chunk.indices.to_numpy() == chunk.dictionary.index(text).as_py() for chunk in column.chunks]
    return np.concatenate([np.zeros(0, bool), *parts])


def packed(parts: Iterable[pa.Table], key: str) -> Iterator[pa.Table]:
    """The rows in tables of at least PACKED_ROWS, the last one aside; texts but the key as numbers into a dictionary.

    Dictionaries of many small files would cost more than their texts.
    """
    return (_encoded(pack, key) for pack in in_packs(parts, lambda rows: int(rows.num_rows)))


def in_packs(parts: Iterable[T], rows_of: Callable[[T], int]) -> Iterator[list[T]]:
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


def combinations(rows: pa.Table, names: Sequence[str]) -> tuple[list[tuple[str, ...]], Codes]:
    """The different combinations of texts that some columns have, and which of them each row has."""
    texts: list[tuple[str, ...]] = []

    def one_by_one() -> Iterator[Codes]:  # of millions of rows a column's numbers take their place in memory
        for name in names:
            numbers, different = codes(rows[name])
            texts.append(different)
            yield numbers

    found, at = distinct(one_by_one())
    return [tuple(words[i] for i, words in zip(row, texts)) for row in found.tolist()], at


def distinct(columns: Iterable[Ints | Codes]) -> tuple[Ints, Codes]:
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


def beginning(keys: Bytes, prefix: str) -> list[str]:
    """Those of sorted keys that begin so, in order."""
    first, behind = prefix.encode(), prefix.encode() + b"\xff"  # a byte that is in no text
    return [key.decode() for key in keys[np.searchsorted(keys, first) : np.searchsorted(keys, behind)].tolist()]


def both(a: Bytes, b: Bytes) -> Bytes:
    """What two sorted arrays without doubles have in common."""
    few, many = sorted((a, b), key=len)
    if not len(few):
        return few
    at = np.minimum(np.searchsorted(many, few), len(many) - 1)
    return few[many[at] == few]

"""Texts of millions of rows as integers: a number for each different text."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Bytes = NDArray[np.bytes_]


def codes(column: pa.ChunkedArray) -> tuple[Ints, tuple[str, ...]]:
    """A number for each text, in the order of the texts, and the texts."""
    if not pa.types.is_dictionary(column.type):
        column = column.dictionary_encode()
    whole = column.unify_dictionaries().combine_chunks()
    if isinstance(whole, pa.ChunkedArray):  # of no chunk
        return np.zeros(0, np.int64), ()
    texts = np.array(whole.dictionary.to_pylist(), object)
    used, at = np.unique(whole.indices.to_numpy().astype(np.int64), return_inverse=True)
    order = np.argsort(texts[used])
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order))
    return number[at], tuple(texts[used][order])


def distinct(columns: Sequence[Ints]) -> tuple[Ints, Ints]:
    """The different rows (D, columns), and which of them each row is."""
    key = np.zeros(len(columns[0]), np.int64)
    for numbers in columns:
        key = key * (int(numbers.max(initial=0)) + 1) + numbers
    _, first, at = np.unique(key, return_index=True, return_inverse=True)
    return np.stack([numbers[first] for numbers in columns], axis=1), at


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


def both(a: Bytes, b: Bytes) -> Bytes:
    """What two sorted arrays without doubles have in common."""
    few, many = sorted((a, b), key=len)
    if not len(few):
        return few
    at = np.minimum(np.searchsorted(many, few), len(many) - 1)
    return few[many[at] == few]

"""Files a little wrong: a mutant of a file's bytes, or of the values it holds, drawn by its number alone."""

import json
import math
import pickle
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Rng = np.random.Generator
VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 2**31, 2**63 - 1, -(2**63), 10**400, 0.0, -0.0, 1e308, math.nan, math.inf, -math.inf),
    *("", "x" * 10_000, "../../../etc/passwd", "\0", "nan", "\ud800", b"", b"\xff" * 100, [], {}, (), [[]], {"": None}),
    *([1, "a"], np.zeros(0), np.zeros((0, 3)), np.full((96, 3), np.nan), np.zeros((1, 1, 1)), np.array("x")),
)
WORDS = (
    b"-1",
    b"1e999",
    b"NaN",
    b"0",
    b"9" * 40,
    b"null",
    b'""',
    b"[]",
    b"{}",
    b"true",
    b"!!python/none",
    b"&a *a",
    b"",
)
NUMBER = re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")


def rng_of(kind: str, number: int) -> Rng:
    """Of one mutant of one kind."""
    return np.random.default_rng([number, *kind.encode()])


def of_bytes(whole: bytes, rng: Rng) -> bytes:
    """One to four times: bits flipped, bytes set, cut, taken out, doubled, moved, or a word set to an extreme."""
    data = bytearray(whole)
    for _ in range(int(rng.integers(1, 5))):
        if not data:
            break
        at = int(rng.integers(len(data)))
        end = min(len(data), at + int(2 ** rng.uniform(0, 10)))
        match int(rng.integers(8)):
            case 0 | 1:
                data[at] ^= 1 << int(rng.integers(8))
            case 2:
                data[at] = int(rng.choice([0, 1, 0x7F, 0x80, 0xFF]))
            case 3:
                del data[at:]
            case 4:
                del data[at:end]
            case 5:
                data[at:at] = data[at:end]
            case 6:
                other = int(rng.integers(len(data)))
                data[other:other] = bytes(data[at:end])
                del data[at:end]
            case _:
                word = int(rng.choice([0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, len(data), len(data) + 1]))
                data[at : at + 4] = word.to_bytes(4, "little")
    return bytes(data)


def of_text(whole: bytes, rng: Rng) -> bytes:
    """Numbers become other words; or as bytes."""
    if rng.random() < 0.5:
        return of_bytes(whole, rng)
    found = list(NUMBER.finditer(whole))
    if not found:
        return of_bytes(whole, rng)
    one = found[int(rng.integers(len(found)))]
    return whole[: one.start()] + WORDS[int(rng.integers(len(WORDS)))] + whole[one.end() :]


def of_json(whole: bytes, rng: Rng) -> bytes:
    """A value anywhere in it becomes another; or as text."""
    if rng.random() < 0.5:
        return of_text(whole, rng)
    return json.dumps(_harmed(json.loads(whole), rng), default=lambda value: repr(value)).encode()


def of_pickle(whole: bytes, rng: Rng) -> bytes:
    """The same for plain values; or as bytes."""
    if rng.random() < 0.5:
        return of_bytes(whole, rng)
    return pickle.dumps(_harmed(pickle.loads(whole), rng), int(rng.integers(2, 6)))


def _harmed(value: Any, rng: Rng) -> Any:
    """One value in a tree of dicts and lists, or an array's element or shape, is another; now and then it is gone."""
    if isinstance(value, Mapping) and value and rng.random() < 0.95:
        names = list(value)
        name = names[int(rng.integers(len(names)))]
        if rng.random() < 0.05:
            return {key: child for key, child in value.items() if key != name}
        return {**value, name: _harmed(value[name], rng)}
    if isinstance(value, list | tuple) and value and rng.random() < 0.95:
        at = int(rng.integers(len(value)))
        changed = [*value[:at], *([] if rng.random() < 0.05 else [_harmed(value[at], rng)]), *value[at + 1 :]]
        return changed if isinstance(value, list) else tuple(changed)
    if isinstance(value, np.ndarray) and value.size and rng.random() < 0.8:
        changes: list[Callable[[], Any]] = [
            lambda: value[: len(value) // 2] if value.ndim else value,
            lambda: value.astype(np.float32 if value.dtype.kind in "fiub" else value.dtype),
            lambda: value.reshape(-1),
            lambda: value.tolist(),
            lambda: _with_extreme(value, rng),
        ]
        return changes[int(rng.integers(len(changes)))]()
    return VALUES[int(rng.integers(len(VALUES)))]


def _with_extreme(value: np.ndarray, rng: Rng) -> np.ndarray:
    changed = value.copy()
    if value.dtype.kind == "f":
        changed.flat[int(rng.integers(value.size))] = rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e30, 0.0])
    elif value.dtype.kind in "iu":
        changed.flat[int(rng.integers(value.size))] = np.iinfo(value.dtype).max
    return changed

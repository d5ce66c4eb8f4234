"""Protobuf's wire format, as far as the topics need it (protobuf.dev/programming-guides/encoding).

Written here so that a packed array goes from and to a buffer at once: protobuf's runtime hands out a Python object for
every number, some 10,000 of a sample. Tests hold what is written against that runtime.
"""

from collections.abc import Iterable, Sequence

VARINT, FIXED64, LENGTH, FIXED32 = 0, 1, 2, 5
WIDTHS = {FIXED64: 8, FIXED32: 4}

Fields = dict[int, list[memoryview]]  # number -> what stands under it, in order


def varint(value: int) -> bytes:
    """Seven bits a byte, the lowest first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def fixed(number: int, data: bytes) -> bytes:
    """A field of 4 or 8 bytes."""
    return varint(number << 3 | (FIXED64 if len(data) == 8 else FIXED32)) + data


def delimited(number: int, data: bytes) -> bytes:
    """A text, bytes, an array without gaps or a message."""
    return varint(number << 3 | LENGTH) + varint(len(data)) + data


def repeated(number: int, items: Iterable[bytes]) -> bytes:
    """Several of them under one number."""
    return b"".join(delimited(number, item) for item in items)


def parse(message: bytes | memoryview) -> Fields:
    """The fields of a message, nothing copied. Raises ValueError where it is none."""
    data, at, found = memoryview(message), 0, Fields()
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == LENGTH:
            length, at = _varint(data, at)
        elif kind in WIDTHS:
            length = WIDTHS[kind]
        else:
            raise ValueError(f"a field of wire type {kind}, which no topic has")
        if at + length > len(data):
            raise ValueError("a field ends behind its message")
        found.setdefault(key >> 3, []).append(data[at : at + length])
        at += length
    return found


def _varint(data: Sequence[int] | memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise ValueError("a number that does not end")
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return value, at
        shift += 7

"""Damaged copies of a file: bits flipped all over it, cut short, cut in front, emptied, overwritten with zeros."""

from collections.abc import Iterator

EVERY = 50  # bytes between two flips


def damaged(whole: bytes, every: int = EVERY) -> Iterator[bytes]:
    """Each differs from `whole`; the flipped bit is another from flip to flip."""
    for at in (*range(0, len(whole), every), len(whole) - 1):
        yield whole[:at] + bytes([whole[at] ^ 1 << at // every % 8]) + whole[at + 1 :]
    yield from (whole[:-1], whole[: len(whole) // 2], whole[:1], b"", whole[1:], bytes(len(whole)), whole + whole)

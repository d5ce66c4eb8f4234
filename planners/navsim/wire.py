"""Arrays by name from one Python to another through a pipe: a length, then an .npz, in which nothing runs."""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np

LENGTH = struct.Struct("<Q")
MOST_BYTES = 1 << 30  # eight pictures of 1920 x 1080 take 50 MB


def send(pipe: BinaryIO, arrays: Mapping[str, Any]) -> None:
    """Write one message."""
    body = io.BytesIO()
    np.savez(body, **arrays)
    pipe.write(LENGTH.pack(body.tell()))
    pipe.write(body.getbuffer())
    pipe.flush()


def receive(pipe: BinaryIO) -> dict[str, Any] | None:
    """The next message; None where the other side has gone. Raises ValueError for what is no message."""
    head = pipe.read(LENGTH.size)
    if not head:
        return None
    (length,) = LENGTH.unpack(head) if len(head) == LENGTH.size else (MOST_BYTES + 1,)
    body = pipe.read(length) if length <= MOST_BYTES else b""
    if len(body) != length:
        raise ValueError("a message was cut off, or something else was written in between")
    with np.load(io.BytesIO(body), allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}

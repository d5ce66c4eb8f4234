"""Numbers in fewer bytes, to the last bit and quick to read: what a scene of a bank is stored as.

Each number is predicted from those before it, on the integers that floats are the bits of: order 0 says 0, order 1 the
last one again, order 2 that it moves on as the last two did. What is missed is folded to be positive and written in as
few bytes as it takes, 0 .. 8. A track that stands, or that is linear between instants, takes next to nothing.

    <lengths of the parts, 8 bytes each> <how many codes> <codes, half a byte each> <bytes of the misses> <8 zeros>

A code up to 8 is of one number: how many bytes it takes. One above is of 4, 8, .. 256 numbers, all as predicted.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from tasks.kernels.compiled import kernel
from tasks.world.arrays import Bytes, Ints

POSITIVE = 2**63 - 1
MASKS = np.array([(1 << 8 * n) - 1 for n in range(8)] + [-1], np.int64)  # of the lowest n bytes
PAD = 8  # bytes are read eight at a time
MOST = 2**24  # numbers in one scene: a length above it is damage
LONGEST = 15  # of the codes, and a run's of 2**(15 - RUN) numbers
RUN = 7


def packed(parts: Sequence[Any], orders: Sequence[int]) -> bytes:
    """Arrays of float64 or of integers, flattened, each with its order."""
    values = [np.ascontiguousarray(part, np.float64 if _is_float(part) else np.int64).ravel() for part in parts]
    lengths = np.array([len(value) for value in values], np.int64)
    found = [_misses(value.view(np.int64), order) for value, order in zip(values, orders, strict=True)]
    codes, payload = _written(np.concatenate(found), lengths)
    halves = np.append(codes, np.zeros(len(codes) % 2, np.uint8))
    heads = np.append(lengths, len(codes))
    return b"".join((heads.tobytes(), (halves[::2] | halves[1::2] << 4).tobytes(), payload.tobytes(), bytes(PAD)))


def _is_float(part: Any) -> bool:
    return np.asarray(part).dtype.kind == "f"


def _misses(values: Ints, order: int) -> Ints:
    before = np.concatenate([np.zeros(2, np.int64), values])
    guess = (0 * before[1:-1], before[1:-1], 2 * before[1:-1] - before[:-2])[order]
    missed = values - guess  # wraps around, and back when it is read
    return (missed << 1) ^ (missed >> 63)


@kernel
def _written(misses: Ints, lengths: Ints) -> tuple[Bytes, Bytes]:
    """Codes and bytes of the parts' misses; no run leads out of its part."""
    codes, payload = np.empty(len(misses), np.uint8), np.empty(8 * len(misses), np.uint8)
    n_codes, end, i, stop = 0, 0, 0, 0
    for length in lengths:
        stop += length
        while i < stop:
            still = i
            while still < stop and misses[still] == 0:
                still += 1
            code = LONGEST
            while code > 8 and 1 << (code - RUN) > still - i:
                code -= 1
            if code > 8:
                i += 1 << (code - RUN)
            else:
                left, code = misses[i], 0
                while left != 0:
                    payload[end + code] = left & 0xFF
                    left = (left >> 8) & (POSITIVE >> 7)
                    code += 1
                end += code
                i += 1
            codes[n_codes] = code
            n_codes += 1
    return codes[:n_codes].copy(), payload[:end].copy()


@intrinsic
def _eight_bytes(typing_context: Any, data: Any, at: Any) -> Any:
    """The int64 in bytes `at` .. `at` + 7 of a contiguous array, little-endian as all machines that numba runs on."""

    def build(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        start = context.make_array(sig.args[0])(context, builder, value=arguments[0]).data
        place = builder.bitcast(builder.gep(start, [arguments[1]]), ir.IntType(64).as_pointer())
        return builder.load(place, align=1)

    return types.int64(data, types.int64), build


@kernel
def unpacked(data: Bytes, orders: tuple[int, ...]) -> tuple[Ints, Ints]:
    """The numbers of all parts, floats as their bits, and where each part begins, and at last ends.

    No numbers at all where the bytes are not as `packed` wrote them: nothing beyond them is read.
    """
    n_parts, nothing = len(orders), np.empty(0, np.int64)
    starts = np.zeros(n_parts + 1, np.int64)
    if len(data) < 8 * n_parts + 8 + PAD:
        return nothing, starts
    for part in range(n_parts):
        length = _eight_bytes(data, 8 * part)
        if length < 0 or length > MOST:
            return nothing, starts
        starts[part + 1] = starts[part] + length
    n_codes, codes = _eight_bytes(data, 8 * n_parts), 8 * n_parts + 8
    if not 0 <= n_codes <= starts[n_parts] <= min(MOST, n_codes << (LONGEST - RUN)):
        return nothing, starts
    at, end, code = codes + (n_codes + 1) // 2, len(data) - PAD, 0
    values = np.empty(starts[n_parts], np.int64)
    for part in range(n_parts):
        last, before, order, i = 0, 0, orders[part], starts[part]
        while i < starts[part + 1]:
            if code == n_codes or at > end:
                return nothing, starts
            size, miss, stop = (data[codes + (code >> 1)] >> 4 * (code & 1)) & 15, 0, i + 1
            code += 1
            if size > 8:
                stop = i + (1 << (size - RUN))
            else:
                miss = _eight_bytes(data, at) & MASKS[size]
                at += size
            if stop > starts[part + 1] or at > end:
                return nothing, starts
            while i < stop:
                step = last - before if order == 2 else 0
                guess = 0 if order == 0 else last + step
                before, last = last, guess + (((miss >> 1) & POSITIVE) ^ -(miss & 1))
                values[i] = last
                i += 1
    return (values, starts) if at == end and code == n_codes else (nothing, starts)

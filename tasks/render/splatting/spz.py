"""Gaussians as the bytes of a compressed `.spz`, and back.

The format of Niantic Labs (nianticlabs/spz 21715c3, README.md and src/cc/load-spz.cc), a tenth of a `.ply`: positions
in fixed point of 24 bits, everything else in 8 bits, rotations as their three smallest components of 10. Written is
version 3, one stream of gzip, which viewers read today; read are versions 2 to 4, the last with a stream of zstd for
each attribute. Axes are x right, y up, z back there and x right, y down, z forward in a `.ply`: y and z change their
signs, so that a scene stands the same way round in either file.
"""

import gzip
import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.ply import LEAST, MOST
from tasks.world.arrays import F32

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
VERSION = 3
HEADER = np.dtype(
    [("magic", "S4"), ("version", "<u4"), ("count", "<u4"), ("degree", "u1"), ("bits", "u1"), ("flags", "u1")]
)  # the fields that both headers begin with
LEGACY_BYTES, ZSTD_BYTES = 16, 32  # of a header
MOST_BITS = 12  # behind the point of a position: quarters of a millimetre, up to 2 km
MOST_EXPANDED = 1024  # times what a file holds; honest ones stay far below
IS_ANTIALIASED, HAS_EXTENSIONS = 1, 2  # bits of the flags
COLOUR_SCALE = np.float32(0.15)  # of the constant coefficient, in which colours beyond 0 and 1 have room
SQRT_HALF = np.float32(np.sqrt(0.5))
MAGNITUDE = 511  # largest of a rotation's component: 9 bits, and one for the sign
SH_BUCKETS = (8, 16)  # what coefficients of degree 1, and of 2 and 3, are rounded to: 5 and 4 bits
TURN = np.array([1.0, -1.0, -1.0], np.float32)  # of the axes, and of a rotation's x, y, z
# Of the coefficients behind the constant one, by degree: what turning y and z round makes of them.
SH_TURN = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
Bytes = NDArray[np.uint8]
Inflate = Callable[[bytes, int], bytes]  # a stream of zstd and its size -> what it holds; raises OSError


def to_spz(gaussians: Gaussians, antialiased: bool) -> bytes:
    """The file's bytes; `antialiased`: whether they are to be drawn so.

    Raises ValueError for NaN, infinity and for means too far from the origin for 24 bits.
    """
    for name in ("means", "quats", "log_scales", "opacities", "colours", "sh_rest"):
        if not np.isfinite(getattr(gaussians, name)).all():
            raise ValueError(f"spz: {name}: NaN or infinity")
    degree = sh.COUNTS.index(gaussians.sh_rest.shape[1])
    reach = float(np.abs(gaussians.means).max(initial=0.0))
    bits = next((bits for bits in range(MOST_BITS, -1, -1) if reach * 2**bits < 2**23 - 1), None)
    if bits is None:
        raise ValueError(f"spz: means: {reach:.0f} m from the origin; 24 bits reach {2**23:,} m")
    header = np.zeros(1, HEADER)
    header[0] = (MAGIC, VERSION, len(gaussians), degree, bits, IS_ANTIALIASED if antialiased else 0)
    colours = (gaussians.colours - np.float32(0.5)) / np.float32(sh.C0)
    turned = gaussians.sh_rest * SH_TURN[: gaussians.sh_rest.shape[1], None]
    attributes = (
        _fixed_point(gaussians.means * TURN, bits),
        _byte(gaussians.opacities * np.float32(255.0)),
        _byte(colours * (COLOUR_SCALE * np.float32(255.0)) + np.float32(127.5)),
        _byte((gaussians.log_scales + np.float32(10.0)) * np.float32(16.0)),
        _smallest_three(gaussians.quats),
        _rounded_sh(turned),
    )
    head = header.tobytes().ljust(LEGACY_BYTES, b"\0")
    return gzip.compress(head + b"".join(part.tobytes() for part in attributes), mtime=0)


def from_spz(data: bytes, zstd: Inflate) -> tuple[Gaussians, bool]:
    """The Gaussians of a file, and whether they are to be drawn antialiased; `zstd` is asked for those of version 4.

    Raises ValueError that names the field where it is no spz, of another version, damaged, or holds extensions, which
    may change what the rest means.
    """
    packed = _packed(data, zstd)
    means, opacities, colours, scales, rotations, rest = packed.attributes
    n, version = packed.count, packed.version
    number = means.reshape(n, 3, 3).astype(np.int32)
    fixed = number[..., 0] | number[..., 1] << 8 | number[..., 2] << 16
    fixed -= (fixed & 0x800000) << 1
    coefficients = sh.COUNTS[packed.degree]
    quats = (_from_smallest_three if version >= 3 else _from_first_three)(rotations)
    constant = (colours.reshape(n, 3) / np.float32(255.0) - np.float32(0.5)) / COLOUR_SCALE
    turned = (rest.reshape(n, coefficients, 3).astype(np.float32) - 128.0) / np.float32(128.0)
    found = Gaussians(
        means=(fixed.astype(np.float32) * np.float32(2.0**-packed.bits) * TURN).astype(np.float32),
        quats=quats,
        log_scales=scales.reshape(n, 3).astype(np.float32) / np.float32(16.0) - np.float32(10.0),
        opacities=np.clip(opacities / np.float32(255.0), LEAST, MOST),
        colours=(0.5 + sh.C0 * constant).astype(np.float32),
        sh_rest=turned * SH_TURN[:coefficients, None],
    )
    return found, packed.antialiased


@dataclass(frozen=True)
class _Packed:
    version: int
    count: int
    degree: int
    bits: int
    antialiased: bool
    attributes: tuple[Bytes, ...]  # positions, opacities, colours, scales, rotations, coefficients


def _packed(data: bytes, zstd: Inflate) -> _Packed:
    is_zstd = data.startswith(MAGIC)
    if not is_zstd and not data.startswith(GZIP):
        raise ValueError("spz: magic: the file begins neither with NGSP nor as gzip does")
    plain = data if is_zstd else _unzipped(data)
    if len(plain) < (ZSTD_BYTES if is_zstd else LEGACY_BYTES):
        raise ValueError("spz: header: truncated")
    magic, version, count, degree, bits, flags = np.frombuffer(plain, HEADER, 1)[0].tolist()
    if magic != MAGIC or version not in ((4,) if is_zstd else (2, 3)):
        raise ValueError(f"spz: version: {version}, expected 2 or 3 in a gzip, 4 in a file that begins with NGSP")
    if flags & HAS_EXTENSIONS:
        raise ValueError("spz: flags: there are extensions, of which one may turn the axes; save it without")
    if degree >= len(sh.COUNTS):
        raise ValueError(f"spz: SH degree {degree}, expected 0 to {len(sh.COUNTS) - 1}")
    if not 0 < count * 9 <= len(data) * MOST_EXPANDED:
        raise ValueError(f"spz: count: {count:,} Gaussians in a file of {len(data):,} bytes")
    each = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * sh.COUNTS[degree])
    sizes = [count * width for width in each]
    if is_zstd:
        return _Packed(version, count, degree, bits, bool(flags & IS_ANTIALIASED), _streams(data, sizes, zstd))
    ends = LEGACY_BYTES + np.cumsum(sizes)
    if len(plain) != ends[-1]:
        raise ValueError(f"spz: {count:,} Gaussians take {ends[-1]:,} bytes, {len(plain):,} found")
    return _Packed(version, count, degree, bits, bool(flags & IS_ANTIALIASED), tuple(
        np.frombuffer(plain, np.uint8, size, int(end) - size) for size, end in zip(sizes, ends)
    ))  # fmt: skip


def _unzipped(data: bytes) -> bytes:
    """No more of it than an honest file expands to."""
    most = len(data) * MOST_EXPANDED
    try:
        stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
        plain = stream.decompress(data, most)
    except zlib.error as error:
        raise ValueError(f"spz: gzip: {error}") from error
    if not stream.eof:
        raise ValueError("spz: gzip: truncated, or it expands beyond what a scene can")
    return plain


def _streams(data: bytes, sizes: list[int], zstd: Inflate) -> tuple[Bytes, ...]:
    """The attributes of version 4; those of no bytes have no stream."""
    n_streams, at = data[15], int.from_bytes(data[16:20], "little")
    kept = [size for size in sizes if size]
    table = np.frombuffer(data[at : at + 16 * n_streams], "<u8").reshape(-1, 2)
    if at < ZSTD_BYTES or n_streams != len(kept) or len(table) != n_streams or table[:, 1].tolist() != kept:
        raise ValueError(f"spz: streams: expected {len(kept)} of {kept} bytes")
    ends = at + 16 * n_streams + np.cumsum(table[:, 0].astype(object))
    if ends[-1] != len(data):
        raise ValueError(f"spz: streams: they end at byte {ends[-1]:,} of {len(data):,}")
    pieces = [data[int(end) - int(length) : int(end)] for (length, _), end in zip(table, ends)]
    found = iter(_inflated(piece, size, zstd) for piece, size in zip(pieces, kept))
    return tuple(next(found) if size else np.empty(0, np.uint8) for size in sizes)


def _inflated(data: bytes, size: int, zstd: Inflate) -> Bytes:
    try:
        return np.frombuffer(zstd(data, size), np.uint8)
    except OSError as error:
        raise ValueError(f"spz: zstd: {error}") from error


def _round(values: F32) -> F32:
    """To the nearest whole number, halves away from zero."""
    return np.trunc(values + np.copysign(np.float32(0.5), values))


def _byte(values: F32) -> Bytes:
    return np.clip(_round(values), 0.0, 255.0).astype(np.uint8)


def _fixed_point(means: F32, bits: int) -> Bytes:
    """(N, 3, 3): three bytes, the lowest first."""
    fixed = _round(means * np.float32(2.0**bits)).astype("<i4")
    return np.ascontiguousarray(fixed.view(np.uint8).reshape(*fixed.shape, 4)[..., :3])


def _rounded_sh(coefficients: F32) -> Bytes:
    """(N, K, 3): 8 bits around 128, rounded to buckets of which one has 0 in its middle."""
    whole = (_round(coefficients * np.float32(128.0)) + 128.0).astype(np.int64)
    bucket = np.where(np.arange(coefficients.shape[1]) < 3, *SH_BUCKETS)[:, None]
    rounded = np.trunc((whole + bucket // 2) / bucket).astype(np.int64) * bucket
    return np.clip(rounded, 0, 255).astype(np.uint8)


def _smallest_three(quats: F32) -> NDArray[np.uint32]:
    """(N,): which component of x, y, z, w is the largest, and the others in order, made so that it is positive."""
    xyzw = (quats / np.linalg.norm(quats, axis=1, keepdims=True))[:, [1, 2, 3, 0]].astype(np.float32)
    xyzw[:, :3] *= TURN
    largest = np.abs(xyzw).argmax(axis=1)
    signs = (xyzw < 0) ^ np.take_along_axis(xyzw < 0, largest[:, None], 1)
    sizes = (MAGNITUDE * (np.abs(xyzw) / SQRT_HALF) + np.float32(0.5)).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for k in range(4):
        component = signs[:, k].astype(np.uint32) << 9 | sizes[:, k]
        packed = np.where(largest == k, packed, packed << 10 | component)
    return packed.astype("<u4")


def _from_smallest_three(rotations: Bytes) -> F32:
    """(N, 4), w first."""
    packed = rotations.view("<u4").copy()
    largest = packed >> 30
    xyzw = np.zeros((len(packed), 4), np.float32)
    for k in (3, 2, 1, 0):  # the last is lowest
        here = largest != k
        size = (packed & MAGNITUDE).astype(np.float32) * (SQRT_HALF / MAGNITUDE)
        xyzw[:, k] = np.where(here, np.where(packed >> 9 & 1, -size, size), 0.0)
        packed = np.where(here, packed >> 10, packed)
    rest = np.sqrt(np.maximum(1.0 - (xyzw**2).sum(axis=1), 0.0))
    np.put_along_axis(xyzw, largest[:, None].astype(np.int64), rest[:, None], 1)
    return _w_first(xyzw)


def _from_first_three(rotations: Bytes) -> F32:
    """(N, 4), w first, of version 2's x, y, z."""
    xyz = rotations.reshape(-1, 3) / np.float32(127.5) - np.float32(1.0)
    w = np.sqrt(np.maximum(1.0 - (xyz**2).sum(axis=1), 0.0))
    return _w_first(np.column_stack([xyz, w]))


def _w_first(xyzw: F32) -> F32:
    """With the axes turned, of length 1."""
    turned = np.concatenate([xyzw[:, 3:], xyzw[:, :3] * TURN], axis=1)
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True), np.float32)

"""Gaussians as the bytes of a standard 3D Gaussian splatting `.ply`, and back.

The format of Kerbl et al. 2023, which gsplat, nerfstudio (and MTGS, which is built on it) and SuperSplat read and
write: one element `vertex` of floats, binary little endian: x y z nx ny nz, f_dc_0..2, f_rest_*, opacity, scale_0..2,
rot_0..3. Opacity is a logit, scales are natural logs, rotations are w first and need not be unit; f_rest counts channel
by channel (all of red, then green, then blue). Properties are found by name: gsplat leaves the normals out, editors add
others. Nothing says where the frame's origin lies in the world; that stays with the scene.
"""

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians
from tasks.world.arrays import F32

FORMAT = "binary_little_endian 1.0"
MAX_HEADER_BYTES = 1 << 16
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
POSITION, NORMAL, COLOUR = ("x", "y", "z"), ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE, ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
REQUIRED = (*POSITION, *COLOUR, "opacity", *SCALE, *ROTATION)
LEAST, MOST = np.float32(2.0**-24), np.float32(1.0 - 2.0**-24)  # opacities whose logit is finite in 32 bits


def to_ply(gaussians: Gaussians) -> bytes:
    """The file's bytes, with the normals that old viewers ask for as zeros. Raises ValueError for NaN or infinity."""
    count = gaussians.sh_rest.shape[1]
    opacity = np.clip(gaussians.opacities, LEAST, MOST).astype(np.float64)
    columns = {
        POSITION: gaussians.means,
        NORMAL: np.zeros((len(gaussians), 3), np.float32),
        COLOUR: (gaussians.colours - 0.5) / sh.C0,
        _rest(3 * count): gaussians.sh_rest.transpose(0, 2, 1).reshape(len(gaussians), 3 * count),
        ("opacity",): np.log(opacity / (1.0 - opacity))[:, None],
        SCALE: gaussians.log_scales,
        ROTATION: gaussians.quats,
    }
    for group, values in columns.items():
        if not np.isfinite(values).all():
            raise ValueError(f"ply: {', '.join(group[:3])}: NaN or infinity")
    names = [name for group in columns for name in group]
    header = ["ply", f"format {FORMAT}", f"element vertex {len(gaussians)}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    rows = np.concatenate(list(columns.values()), axis=1).astype("<f4")
    return "\n".join(header).encode() + rows.tobytes()


def from_ply(data: bytes) -> Gaussians:
    """The Gaussians of a file, SH degree 0 to 3, rotations made unit.

    Raises ValueError that names the field: for a file that is ascii, compressed or no ply, for properties that are
    absent or of another type than float, truncated data, NaN and, but for an opacity, infinity.
    """
    header = _header(data)
    absent = [name for name in REQUIRED if name not in header.types]
    if absent:
        raise ValueError(f"ply: property {', '.join(absent)}: absent from element vertex, this is no 3DGS scene")
    found = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in header.types)
    if found not in [3 * count for count in sh.COUNTS]:
        raise ValueError(f"ply: f_rest: {found} coefficients, expected 0, 9, 24 or 45")
    rest = _rest(found)
    missing = [name for name in rest if name not in header.types]
    if missing:
        raise ValueError(f"ply: property {missing[0]}: absent, while there are {found} f_rest coefficients")
    for name in (*REQUIRED, *rest):
        if header.types[name] not in ("<f4", "<f8"):
            raise ValueError(f"ply: property {name}: expected float, found {header.types[name]}")
    table = _table(data, header)
    quats = _columns(table, ROTATION).astype(np.float64)
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    if not (length > 0.0).all():
        raise ValueError(f"ply: rot: {int((length == 0.0).sum())} rotations are all zero")
    logit = _columns(table, ("opacity",), infinite=True)[:, 0].astype(np.float64)  # of 0 and 1, as spz's tools write
    coefficients = _columns(table, rest).reshape(len(table), 3, found // 3).transpose(0, 2, 1)
    return Gaussians(
        means=_columns(table, POSITION),
        quats=(quats / length).astype(np.float32),
        log_scales=_columns(table, SCALE),
        opacities=np.clip(0.5 + 0.5 * np.tanh(0.5 * logit), LEAST, MOST).astype(np.float32),
        colours=(0.5 + sh.C0 * _columns(table, COLOUR)).astype(np.float32),
        sh_rest=np.ascontiguousarray(coefficients),
    )


@dataclass(frozen=True)
class _Header:
    types: dict[str, str]  # property -> numpy's name of its type, in the order of the file
    count: int  # rows of element vertex
    start: int  # byte at which they begin
    is_last: bool  # no other element follows


def _header(data: bytes) -> _Header:
    if not data.startswith((b"ply\n", b"ply\r\n")):
        raise ValueError("ply: magic: the file does not begin with the line 'ply'")
    end = re.search(rb"\nend_header\r?\n", data[:MAX_HEADER_BYTES])
    if end is None:
        raise ValueError(f"ply: end_header: not within the first {MAX_HEADER_BYTES} bytes")
    types: dict[str, str] = {}
    elements: list[str] = []
    count, form = 0, ""
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", *words]:
                form = " ".join(words)
            case ["element", name, number] if number.isascii() and number.isdigit():
                elements.append(name)
                count = int(number) if name == "vertex" else count
            case ["property", kind, name] if kind in TYPES and elements:
                if elements[-1] == "vertex":
                    if name in types:
                        raise ValueError(f"ply: property {name}: stands twice")
                    types[name] = TYPES[kind]
            case ["property", "list", *_, name] if elements and elements[-1] != "vertex":
                pass  # of an element behind the vertices, which is not read
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"ply: header: cannot be understood: {line[:80]!r}")
    if form != FORMAT:
        raise ValueError(f"ply: format: {form or 'absent'}, expected {FORMAT}; save it as a binary file")
    if "chunk" in elements:
        raise ValueError("ply: element chunk: a compressed scene; save it as an uncompressed .ply")
    if elements[:1] != ["vertex"] or elements.count("vertex") > 1:
        raise ValueError(f"ply: element: expected vertex first and once, found {', '.join(elements) or 'none'}")
    return _Header(types, count, end.end(), len(elements) == 1)


def _table(data: bytes, header: _Header) -> NDArray[np.void]:
    row = np.dtype(list(header.types.items()))
    wanted, there = header.count * row.itemsize, len(data) - header.start
    if there < wanted or (there > wanted and header.is_last):
        fault = "truncated" if there < wanted else "something follows them"
        raise ValueError(f"ply: vertex: {header.count} rows of {row.itemsize} bytes announced, {there} found: {fault}")
    return np.frombuffer(data, row, header.count, header.start)


def _columns(table: NDArray[np.void], names: tuple[str, ...], infinite: bool = False) -> F32:
    """(N, len(names)), finite unless `infinite` is a value too."""
    out = np.empty((len(table), len(names)), np.float32)
    for k, name in enumerate(names):
        with np.errstate(over="ignore"):  # a double that is infinite as a float is found below
            out[:, k] = table[name]
        good = ~np.isnan(out[:, k]) if infinite else np.isfinite(out[:, k])
        if not good.all():
            fault = "NaN" if infinite else "NaN or infinite"
            raise ValueError(f"ply: property {name}: {int((~good).sum())} of {len(table)} values are {fault}")
    return out


def _rest(n: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(n))

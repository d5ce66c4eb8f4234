"""Files of points: binary PCD, nuScenes' rows, what 123D packed.

PCD files are the merged lidar sweeps of nuPlan and OpenScene. A text header of ten keys, then POINTS packed little-
endian records. Only what nuplan-devkit @ e924167 reads (nuplan/database/utils/pointclouds/pointcloud.py:96-180) is
read: `DATA binary`, one value a field.
"""

import io
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factory.readers.arrow import packed_rows, read_stream
from factory.readers.base import BadClip, bytes_of

KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
MAX_HEADER_BYTES = 1 << 14
_KINDS = {"F": ("f", (4, 8)), "I": ("i", (1, 2, 4, 8)), "U": ("u", (1, 2, 4, 8))}


def read_pcd(path: Path, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The named fields (N,), N >= 1, in the types they have in the file. Raises BadClip."""
    file, data = str(path), bytes_of(path)
    header, start = _header(data, file)
    record, n_points = _record_layout(header, file)
    if record.names is None or (missing := [name for name in columns if name not in record.names]):
        raise BadClip(file, "FIELDS", f"no {', '.join(missing)}; there are {', '.join(record.names or ())}")
    if n_points < 1:
        raise BadClip(file, "POINTS", "holds no points")
    if len(data) - start < n_points * record.itemsize:
        problem = f"{len(data) - start} bytes for {n_points} points of {record.itemsize}; truncated?"
        raise BadClip(file, "DATA", problem)
    points = np.frombuffer(data, record, n_points, start)
    return _finite({name: points[name].copy() for name in columns}, file)


def _finite(columns: dict[str, NDArray[Any]], file: str) -> dict[str, NDArray[Any]]:
    for name, values in columns.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise BadClip(file, name, "holds NaN or infinity")
    return columns


def _header(data: bytes, file: str) -> tuple[dict[str, list[str]], int]:
    """Key -> words, and where the records begin. Raises BadClip."""
    found: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in found:
        end = data.find(b"\n", at, MAX_HEADER_BYTES)
        if end < 0:
            raise BadClip(file, "header", "ends before DATA: truncated, or no PCD file")
        line, at = data[at:end], end + 1
        try:
            words = line.decode("ascii").split()
        except UnicodeDecodeError as error:
            raise BadClip(file, "header", "holds bytes that are no text: no PCD file") from error
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in KEYS:
            raise BadClip(file, "header", f"unknown key {words[0][:40]!r}; known: {', '.join(KEYS)}")
        found[words[0]] = words[1:]
    if missing := [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS") if key not in found]:
        raise BadClip(file, missing[0], "missing")
    return found, at


def _record_layout(header: dict[str, list[str]], file: str) -> tuple[np.dtype[Any], int]:
    """The type of one record, and how many there are. Raises BadClip."""
    if header["DATA"] != ["binary"]:
        raise BadClip(file, "DATA", f"is {' '.join(header['DATA'])}, only binary is read")
    names, sizes, kinds = header["FIELDS"], header["SIZE"], header["TYPE"]
    counts = header.get("COUNT", ["1"] * len(names))
    if len({len(names), len(sizes), len(kinds), len(counts)}) > 1 or len(set(names)) < len(names):
        raise BadClip(file, "FIELDS", "FIELDS, SIZE, TYPE and COUNT do not name the same fields, each once")
    if set(counts) != {"1"}:
        raise BadClip(file, "COUNT", f"is {' '.join(counts)}, only one value a field is read")
    fields = []
    for name, size, kind in zip(names, sizes, kinds):
        letter, known = _KINDS.get(kind, ("", ()))
        if not size.isdecimal() or int(size) not in known:
            raise BadClip(file, "TYPE", f"field {name} is of type {kind} and {size} bytes, which is not numeric")
        fields.append((name, f"<{letter}{size}"))
    (points, *more) = header["POINTS"] or [""]
    if more or not points.isdecimal():
        raise BadClip(file, "POINTS", f"is {' '.join(header['POINTS'])!r}, expected a number")
    return np.dtype(fields), int(points)


# nuScenes' lidar sweeps, `<name>.pcd.bin`: rows of five little-endian float32, x, y, z [m], intensity, ring.
#
# Layout: LidarPointCloud.from_file of nuscenes-devkit @ d9de17a (python-sdk/nuscenes/utils/data_classes.py). The
# frame is the lidar's own, the ego's motion during the turn taken out by the publisher (Caesar et al. 2020).

COLUMNS = ("x", "y", "z", "intensity", "ring")


def read_points(path: Path, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The named columns (N,) float32, N >= 1. Raises BadClip."""
    data = bytes_of(path)
    if not data or len(data) % (4 * len(COLUMNS)):
        raise BadClip(str(path), "points", f"{len(data)} bytes are not rows of {len(COLUMNS)} float32; truncated?")
    rows = np.frombuffer(data, "<f4").reshape(-1, len(COLUMNS))
    return _finite({name: rows[:, COLUMNS.index(name)].copy() for name in columns}, str(path))


# Sweeps that 123D packed into its tables, a row each, in one of its codecs: LAZ, or a stream of Arrow with columns x, y
# and z (kesai-labs/py123d, src/py123d/common/io/lidar, 0.7). Draco names no size before it is unpacked: not read.
#
# Of LAZ the header says where things lie (LAS 1.4 R15, tables 3 and 7); x, y and z are the first three numbers of every
# record, int32 times a scale [m] plus an offset. LASzip's own settings are the VLR 22204 of "laszip encoded".

MAX_LAZ_POINTS, MAX_LAZ_RECORD_BYTES, MAX_LAZ_VLRS = 1 << 22, 128, 100
AGAIN = "convert again with dataset.log_writer_config.lidar_codec=ipc_zstd"


def read_packed_points(path: Path, row: int, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The named columns (N,) of x, y and z [m], N >= 1, that a row of a table of 123D holds. Raises BadClip."""
    import pyarrow as pa

    file = f"{path}#frame={row}"
    ((_, packed),) = packed_rows(path, [row])
    begin = bytes(memoryview(packed)[:5])
    try:
        if begin[:4] == b"LASF":
            points = dict(zip("xyz", _laz_points(packed.to_pybytes(), file).T))
        elif begin[:4] == b"\xff\xff\xff\xff":
            table, _ = read_stream(packed, file)
            points = {name: table[name].to_numpy() for name in columns}
        else:
            codec = "Draco" if begin == b"DRACO" else f"bytes that begin with {begin!r}"
            raise BadClip(file, "points", f"packed as {codec}, LAZ and Arrow are read: {AGAIN}")
    except (pa.ArrowException, KeyError, OSError, ValueError, struct.error) as error:
        raise BadClip(file, "points", f"cannot be unpacked, truncated? {error}") from error
    if not len(points[columns[0]]):
        raise BadClip(file, "points", "holds no points")
    return _finite({name: points[name] for name in columns}, file)


def _laz_points(data: bytes, file: str) -> NDArray[np.float64]:
    """(N, 3) [m]. Raises BadClip; ValueError and struct.error where it is none."""
    try:
        import lazrs
    except ImportError as error:
        problem = f"packed as LAZ: pip install 'driving-data-factory[py123d]', or {AGAIN}"
        raise BadClip(file, "points", problem) from error

    at, begins, n_vlrs, _, width = struct.unpack_from("<HIIBH", data, 94)
    scale, offset = np.reshape(struct.unpack_from("<6d", data, 131), (2, 3))
    (n_points,) = struct.unpack_from("<Q", data, 247)
    if n_vlrs > MAX_LAZ_VLRS or n_points > MAX_LAZ_POINTS or not 12 <= width <= MAX_LAZ_RECORD_BYTES:
        raise ValueError(f"{n_points} points of {width} bytes and {n_vlrs} records of settings")
    for _ in range(n_vlrs):
        user, number, length = struct.unpack_from("<16sHH", data, at + 2)
        settings, at = data[at + 54 : at + 54 + length], at + 54 + length
        if (user.rstrip(b"\0"), number) == (b"laszip encoded", 22204):
            break
    else:
        raise ValueError("LASzip's settings are missing")
    records, source = np.zeros((n_points, width), np.uint8), io.BytesIO(data)
    source.seek(begins)
    try:
        lazrs.LasZipDecompressor(source, settings).decompress_many(records.reshape(-1))
    except lazrs.LazrsError as error:
        raise ValueError(str(error)) from error
    return np.asarray(np.ascontiguousarray(records[:, :12]).view("<i4") * scale + offset, np.float64)

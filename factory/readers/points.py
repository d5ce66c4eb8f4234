"""Files of points: binary PCD, nuScenes' rows.

PCD files are the merged lidar sweeps of nuPlan and OpenScene. A text header of ten keys, then POINTS packed little-
endian records. Only what nuplan-devkit @ e924167 reads (nuplan/database/utils/pointclouds/pointcloud.py:96-180) is
read: `DATA binary`, one value a field.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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

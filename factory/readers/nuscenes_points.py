"""nuScenes' lidar sweeps, `<name>.pcd.bin`: rows of five little-endian float32, x, y, z [m], intensity, ring.

Layout: LidarPointCloud.from_file of nuscenes-devkit @ d9de17a (python-sdk/nuscenes/utils/data_classes.py). The frame is
the lidar's own, the ego's motion during the turn taken out by the publisher (Caesar et al. 2020).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factory.readers.base import BadClip, bytes_of

COLUMNS = ("x", "y", "z", "intensity", "ring")


def read_points(path: Path, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The named columns (N,) float32, N >= 1. Raises BadClip."""
    data = bytes_of(path)
    if not data or len(data) % (4 * len(COLUMNS)):
        raise BadClip(str(path), "points", f"{len(data)} bytes are not rows of {len(COLUMNS)} float32; truncated?")
    rows = np.frombuffer(data, "<f4").reshape(-1, len(COLUMNS))
    out = {name: rows[:, COLUMNS.index(name)].copy() for name in columns}
    for name, values in out.items():
        if not np.isfinite(values).all():
            raise BadClip(str(path), name, "holds NaN or infinity")
    return out

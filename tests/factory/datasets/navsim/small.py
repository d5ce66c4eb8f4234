"""Small logs with sensors on a city of one road, for the tests beside this file."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from factory.datasets.navsim.reader import NavsimReader
from tasks.render.scene.engine import encode_jpeg
from tests.factory.datasets.navsim.geopackage_writer import CITIES, ORIGIN, stub_rows, write_geopackage
from tests.factory.datasets.navsim.logs import NAME, SPEED_MPS, frame
from tests.factory.datasets.navsim.openscene_writer import merged_pcd, write_frames

CITY = "us-ma-boston"
WIDTH, HEIGHT = 64, 36
FRAMES = 20


def write_city(root: Path) -> None:
    """maps/: two lanes of 50 m in a row and the connector between them."""
    version, zone = CITIES[CITY]
    write_geopackage(root / "maps" / CITY / version / "map.gpkg", stub_rows(), zone)


def road_frames(name: str = NAME, n: int = FRAMES, **other: Any) -> list[dict[str, Any]]:
    """Frames of an ego that drives along the city's road, with cameras of 64 x 36 pixels."""
    frames = []
    for k in range(n):
        here = np.array([ORIGIN[0] + 10.0 + SPEED_MPS * 0.5 * k, ORIGIN[1], 12.0])
        made = frame(k, name, ego2global_translation=here, roadblock_ids=["31", "33", "32"], traffic_lights=[], **other)
        for camera in made["cams"].values():
            camera["cam_intrinsic"] = np.array([[50.0, 0.0, 32.0], [0.0, 50.0, 18.0], [0.0, 0.0, 1.0]])
        frames.append(made)
    return frames


def write_blobs(root: Path, frames: list[dict[str, Any]]) -> None:
    """A photo for each camera and a sweep for each frame, below sensor_blobs/mini."""
    photo = picture(WIDTH, HEIGHT)
    sweep = merged_pcd(np.random.default_rng(0).uniform(5.0, 40.0, (50, 4)))
    for made in frames:
        for path, data in [*((c["data_path"], photo) for c in made["cams"].values()), (made["lidar_path"], sweep)]:
            blob(root, path).parent.mkdir(parents=True, exist_ok=True)
            blob(root, path).write_bytes(data)


def picture(width: int, height: int) -> bytes:
    """A JPEG of blots."""
    blots = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return encode_jpeg(np.asarray(cv2.GaussianBlur(blots, (0, 0), 2.0), np.uint8), 90)


def blob(root: Path, path: str) -> Path:
    """Where a sensor path of a log lies."""
    return root / "sensor_blobs" / "mini" / path


def write_log(root: Path, frames: list[dict[str, Any]]) -> Path:
    """The log's pickle, by the name that its frames give."""
    return write_frames(root, "mini", frames[0]["log_name"], frames)


def reader_of(root: Path, **other: Any) -> NavsimReader:
    """The reader of what was written below the root."""
    settings = {"sensors": root / "sensor_blobs" / "mini", "cache_dir": root / "kept", **other}
    return NavsimReader(root / "navsim_logs" / "mini", root / "maps", **settings)

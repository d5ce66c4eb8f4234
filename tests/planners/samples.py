"""Small tables of samples with pictures whose content is known."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

from factory.stages.rows import label_columns
from factory.store import location
from factory.store.location import Location, write_shard
from factory.store.samples import Store
from factory.store.schema import sample_rows_to_table
from planners.data.batch import COMMANDS
from tests.factory.toy import labels_of_stream, row_of, stream

Pixels = NDArray[np.uint8]

FRONT_YAWS = {"left": np.deg2rad(55.0), "front": 0.0, "right": np.deg2rad(-55.0)}
INSTANTS_S = (-0.5, 0.0)


@cache
def _base() -> dict[str, Any]:
    return row_of(stream("samples"))


def jpeg(pixels: Pixels, quality: int = 95) -> bytes:
    """RGB pixels as JPEG."""
    return cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def plain(colour: tuple[int, int, int], width: int = 32, height: int = 18) -> Pixels:
    return np.full((height, width, 3), colour, np.uint8)


def camera(name: str, yaw: float, width: int = 32, height: int = 18) -> dict[str, Any]:
    """A level camera on the ego that looks along `yaw`."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[np.sin(yaw), 0, np.cos(yaw)], [-np.cos(yaw), 0, np.sin(yaw)], [0, -1, 0]])
    focal = [width / 2, 0, width / 2, 0, width / 2, height / 2, 0, 0, 1]
    return {
        "name": name,
        "width": width,
        "height": height,
        "intrinsics": np.array(focal, float),
        "distortion": np.zeros(5),
        "ego_from_camera": pose.reshape(16),
    }


def pictures(views: Mapping[str, bytes], yaws: Mapping[str, float] = FRONT_YAWS) -> dict[str, Any]:
    """The columns cameras and images: the views at now, and at an earlier instant what must not be looked at."""
    old = jpeg(plain((255, 0, 255)))
    shots = [(time_s, name, view if time_s == 0.0 else old) for time_s in INSTANTS_S for name, view in views.items()]
    return {
        "cameras": [camera(name, yaws[name]) for name in yaws],
        "images": [
            {"camera": name, "time_s": time_s, "ego_pose": np.eye(4).reshape(16), "jpeg": data}
            for time_s, name, data in shots
        ],
        "image_source": "render",
        "psnr": 28.0,
    }


def grey_pictures(value: int) -> dict[str, Any]:
    """Three front cameras that see one grey."""
    return pictures(dict.fromkeys(FRONT_YAWS, jpeg(plain((value, value, value)))))


def sample(
    number: int, expert: str = "human", round_: int = 0, clip: int | None = None, **columns: Any
) -> dict[str, Any]:
    """A row whose ego_status[0] is its number; without images and with labels, unless columns say otherwise."""
    human = expert == "human"
    row = _base() | {
        "attempt_id": f"attempt{number:05d}",
        "clip_id": f"clip{number if clip is None else clip:05d}",
        "expert": expert,
        "expert_digest": f"{expert}-1",
        "round": round_,
        "candidate_index": -1 if human else number,
        "vocabulary_digest": "vocabulary-1",
        "settings_hash": "settings-1",
        "stage_versions": "{}",
        "command": COMMANDS[number % 4],
        "ego_status": np.array([number, 0.5, -0.25, 0.125], np.float32),
        "candidate_end": None if human else np.array([number % 20 - 10.0, number % 5 / 2.0 - 1.0, 0.1, 5.0]),
        "off_log_end": None if human else np.full(3, 0.25),
        "off_log_most": None if human else np.full(3, 0.5),
        "stage2_score": number % 10 / 10.0,
        "cameras": None,
        "images": None,
        "image_source": "none",
        "psnr": None,
    }
    return row | columns


def labels(seed: int, k: int) -> dict[str, object]:
    """Label columns of k trajectories of vocabulary-1."""
    return label_columns(labels_of_stream(stream("labels", seed), k))


def write_table(
    out: Path | Location, rows: Sequence[Mapping[str, Any]], shard_rows: int = 1000, group_rows: int = 1000
) -> Path | Location:
    """A table of samples in `out`, in shards of at most `shard_rows` and row groups of `group_rows`."""
    table = Store(out).samples
    places: dict[tuple[int, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        places.setdefault((row["round"], row["expert"]), []).append(row)
    shards = []
    for same in places.values():
        for start in range(0, len(same), shard_rows):
            content = sample_rows_to_table(same[start : start + shard_rows])
            body = content.drop_columns(["round", "expert"])
            group_bytes = int((group_rows + 0.5) * body.nbytes / body.num_rows)
            with patch.object(location, "ROW_GROUP_BYTES", group_bytes):
                shards.append(write_shard(table.location, table.spec, content))
    table.commit(shards)
    return out

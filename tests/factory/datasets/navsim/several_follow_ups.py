"""NAVSIM's files of two groups with three and two follow-ups, whose starts lie around the ends of a steady plan.

`python -m tests.factory.datasets.navsim.several_follow_ups <folder>` writes them with the four cities, for NAVSIM's own
code: run_metric_caching.py and run_pdm_score.py with --config-dir <folder> and train_test_split=groups.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tasks.render.scene.engine import encode_jpeg
from tests.factory.datasets.navsim import scene_pickles
from tests.factory.datasets.navsim.geopackage_writer import ORIGIN, stub_rows, write_root
from tests.factory.datasets.navsim.logs import NAME, SPEED_MPS, frame
from tests.factory.datasets.navsim.openscene_writer import hex16, write_frames
from tests.factory.datasets.navsim.small import CITY

FRAMES = 24
SCALE = 3.0  # of the road's 110 m
START_M = 10.0  # along the road, at the first frame
GROUPS = (4, 6)  # frames at now


@dataclass(frozen=True)
class FollowUp:
    """Where it starts beside the log's frame 4 s later, and what it meets."""

    ahead_m: float
    left_m: float
    speed_mps: float
    gap_m: float  # to the car ahead, when it starts
    car_mps: float


FOLLOW_UPS = {  # frame at now of the group -> its follow-ups
    4: (
        FollowUp(-0.15, 0.1, 8.0, 20.0, 8.0),
        FollowUp(0.3, -0.2, 7.0, 9.0, 3.0),  # too near a slower car
        FollowUp(0.1, 0.6, 8.5, 25.0, 9.0),
    ),
    6: (
        FollowUp(0.25, 0.9, 8.0, 20.0, 8.0),  # a wheel off the road
        FollowUp(-0.2, -0.3, 6.0, 20.0, 8.0),
    ),
}


def log_frames() -> list[dict[str, Any]]:
    """Of an ego that drives steadily behind a car."""
    return driven(0, FollowUp(0.0, 0.0, SPEED_MPS, 20.0, SPEED_MPS))


def driven(at: int, how: FollowUp) -> list[dict[str, Any]]:
    """The log's frames as if the ego had come to frame `at` in another way."""
    frames = []
    for k in range(FRAMES):
        since_s = 0.5 * (k - at)
        x = START_M + SPEED_MPS * 0.5 * at + how.ahead_m + how.speed_mps * since_s
        gap_m = how.gap_m + (how.car_mps - how.speed_mps) * since_s
        made = frame(k, ego2global_translation=np.array([ORIGIN[0] + x, ORIGIN[1] + how.left_m, 0.0]))
        made |= {
            "roadblock_ids": ["31", "33", "32"],
            "traffic_lights": [],
            "ego_dynamic_state": [how.speed_mps, 0, 0, 0],
        }
        made["anns"] |= {
            "gt_boxes": np.array([[gap_m, -how.left_m, 0.8, 4.6, 1.9, 1.6, 0.0]]),
            "gt_names": np.array(["vehicle"]),
            "gt_velocity_3d": np.array([[how.car_mps, 0.0, 0.0]]),
            "instance_tokens": [hex16("car", k)],
            "track_tokens": [hex16("car")],
        }
        frames.append(made)
    return frames


def pairs_of(now: int) -> list[list[str]]:
    """The tokens of a group's follow-ups, now and 0.5 s before."""
    return [[f"{0x50000 + 256 * now + 2 * i + side:017x}" for side in (0, 1)] for i in range(len(FOLLOW_UPS[now]))]


def write(root: Path, pictures: bool = False) -> None:
    """navsim_logs/test, navhard_two_stage and the split's files; pictures: of every history, too."""
    frames = log_frames()
    write_frames(root, "test", NAME, frames)
    scenes = root / "navhard_two_stage/synthetic_scene_pickles"
    scenes.mkdir(parents=True)
    for now, follow_ups in FOLLOW_UPS.items():
        for pair, how in zip(pairs_of(now), follow_ups):
            for token, at in zip(pair, (now + 8, now + 7)):
                value = scene_pickles.scene_of_log(driven(now + 8, how), at, token, pictures)
                scene_pickles.write_scene(scenes, value)
    if pictures:
        write_pictures(root)
    groups = [[frames[now]["token"], frames[now - 1]["token"], pairs_of(now)] for now in GROUPS]
    synthetic = [token for _, _, pairs in groups for pair in pairs for token in pair]
    scene_pickles.write_split(
        root / "train_test_split",
        "groups",
        [token for now, before, _ in groups for token in (now, before)],
        groups,
        reactive_synthetic_initial_tokens=synthetic,
    )


def write_pictures(root: Path) -> None:
    """Of the frames of every history, another one for each camera, frame and stage."""
    for folder, wanted in blob_folders(root).items():
        for k in wanted:
            for camera, entry in log_frames()[k]["cams"].items():
                path = folder / entry["data_path"]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(picture(folder.parent.name, camera, k))


def blob_folders(root: Path) -> dict[Path, list[int]]:
    """Folder of pictures -> frames that have some in it."""
    return {
        root / "sensor_blobs/test": list(range(min(GROUPS) - 4, max(GROUPS) + 1)),
        root / "navhard_two_stage/sensor_blobs": list(range(min(GROUPS) + 4, max(GROUPS) + 9)),
    }


def picture(stage: str, camera: str, k: int) -> bytes:
    """A small JPEG of noise."""
    seed = int(hex16(stage, camera, k), 16)
    return encode_jpeg(np.random.default_rng(seed).integers(0, 256, (18, 32, 3), dtype=np.uint8), 90)


if __name__ == "__main__":
    into = Path(sys.argv[1])
    write(into)
    write_root(into / "maps", CITY, stub_rows(scale=SCALE))

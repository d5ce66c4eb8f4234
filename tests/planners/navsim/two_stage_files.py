"""NAVSIM's files of a small split of two stages, with pictures and without maps: what an agent is shown, no more.

`python -m tests.planners.navsim.two_stage_files <folder>` writes them and the four cities' maps, for NAVSIM's code.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tests.factory.datasets.navsim import scene_pickles
from tests.factory.datasets.navsim.geopackage_writer import ORIGIN, stub_rows, write_root
from tests.factory.datasets.navsim.logs import NAME, frame
from tests.factory.datasets.navsim.openscene_writer import write_frames
from tests.planners.navsim.agent_inputs import DISTORTION, YAWS, looking, photo, pinhole

SIZE = (160, 90)
STAGE_ONE, STAGE_TWO = (4, 3, 7), (12, 11)  # frames of the log
TOKENS = ("0000000000005a00c", "0000000000005a00b")
FRAMES = 20


def log_frames(name: str = NAME) -> list[dict[str, Any]]:
    """Of an ego that turns, is tilted, and speeds up; each camera sees a photo of its own."""
    made = []
    for k in range(FRAMES):
        turned = Rotation.from_euler("xyz", [0.01, -0.02, 0.7 + 0.03 * k]).as_quat()[[3, 0, 1, 2]]
        there = np.array([ORIGIN[0] + 10.0 + 3.7 * k, ORIGIN[1] + 0.1 * k**2, 12.0])
        motion = [7.4 + 0.1 * k, 0.05 * k, 0.2, -0.01 * k]
        command = np.eye(4, dtype=int)[k % 4]
        one = frame(k, name, ego2global_translation=there, ego2global_rotation=turned, ego_dynamic_state=motion)
        for camera, entry in one["cams"].items():
            entry["cam_intrinsic"], entry["distortion"] = pinhole(*SIZE), DISTORTION
            entry["sensor2lidar_rotation"] = looking(YAWS[camera.lower()])
        made.append({**one, "driving_command": command, "roadblock_ids": ["31", "33", "32"], "traffic_lights": []})
    return made


def write_split(root: Path, frames: list[dict[str, Any]]) -> Path:
    """navsim_logs/test, sensor_blobs/test, navhard_two_stage and split.yaml; the path of the latter."""
    write_frames(root, "test", frames[0]["log_name"], frames)
    scenes = root / "navhard_two_stage" / "synthetic_scene_pickles"
    scenes.mkdir(parents=True, exist_ok=True)
    for token, at in zip(TOKENS, STAGE_TWO):
        scene_pickles.write_scene(scenes, scene_pickles.scene_of_log(frames, at, token, cameras=True))
    for at, folder in (
        *((k, "sensor_blobs/test") for k in STAGE_ONE),
        *((k, "navhard_two_stage/sensor_blobs") for k in STAGE_TWO),
    ):
        for name, entry in frames[at]["cams"].items():
            path = root / folder / entry["data_path"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(photo(name.lower(), *SIZE))
    return write_filter(root, [frames[k]["token"] for k in STAGE_ONE])


def write_filter(root: Path, tokens: list[str], **other: Any) -> Path:
    """split.yaml and its scene filter."""
    synthetic = {"reactive_synthetic_initial_tokens": list(TOKENS)}
    return scene_pickles.write_split(root, "split", tokens, None, **synthetic | other)


if __name__ == "__main__":
    into = Path(sys.argv[1])
    print(write_split(into, log_frames()))
    write_root(into / "maps", "us-ma-boston", stub_rows())

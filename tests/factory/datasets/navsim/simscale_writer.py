"""Writes SimScale's released layout by its specification, as WorldEngine's data manager writes such logs.

A drive along a bend among four objects: one ahead, one that comes late, one that is seen once, a cone.
"""

import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

CAMERAS = ("CAM_F0", "CAM_L0", "CAM_L1", "CAM_L2", "CAM_R0", "CAM_R1", "CAM_R2", "CAM_B0")
SOURCE = "2021.05.12.19.36.12_veh-35_00005_00204"
N_FRAMES, NOW = 12, 3
ORIGIN = np.array([587_640.25, 4_475_361.5])
DISTORTION = np.array([-0.356123, 0.172545, -0.00213, 0.000464, -0.05231])
SIZE = (96, 54)  # of a picture, width and height


def names(seed: int, round: int | None) -> tuple[str, str, str]:
    """Log, scene token and the token of frame 3; round: None of a human log, which begins at the frame of its name."""
    if round is None:
        return f"{SOURCE}-{seed:016x}", f"{seed:016x}", f"{seed:016x}"
    scene = f"{seed:016x}-{round:03d}"
    return f"{SOURCE}-{scene}", scene, f"{seed + 0xB0000:016x}-{round:03d}"


def poses(seed: int) -> np.ndarray:
    """(12, 3) on a bend; every seed another."""
    t, turn = 0.5 * np.arange(N_FRAMES), 0.05 + 0.01 * (seed % 7)
    heading = 3.0 + turn * t  # passes pi
    forward = 6.0 * t[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return np.column_stack([ORIGIN + forward, (heading + np.pi) % (2 * np.pi) - np.pi])


def frames(seed: int, round: int | None) -> list[dict[str, Any]]:
    """The 12 frames of one log."""
    log, scene, token = names(seed, round)
    suffix = "" if round is None else f"-{round:03d}"
    tokens = [f"{seed + 0xA0000 + i:016x}{suffix}" for i in range(N_FRAMES)]
    tokens[NOW] = token
    return [_frame(i, log, scene, tokens, poses(seed)) for i in range(N_FRAMES)]


def _frame(i: int, log: str, scene: str, tokens: Sequence[str], ego: np.ndarray) -> dict[str, Any]:
    x, y, heading = ego[i]
    quaternion = Rotation.from_euler("XYZ", [0.0, 0.0, heading]).as_quat()[[3, 0, 1, 2]]
    seen = [k for k, there in enumerate((True, i >= 5, i == 6, True)) if there]
    boxes = np.array([[12.0 + 0.3 * i, 1.0 + 0.1 * k, 0.8, 4.6, 1.9, 1.6, 0.1 + 0.02 * i] for k in range(4)])
    boxes[:, 0] += [0.0, 9.0, -3.0, 5.0]
    boxes[3, 3:6] = 0.4, 0.4, 0.7
    return {
        "token": tokens[i],
        "frame_idx": i,
        "timestamp": 1_620_848_172_000_000 + 500_000 * i,
        "log_name": log,
        "scene_name": log,
        "log_token": scene,
        "scene_token": scene,
        "map_location": "us-nv-las-vegas-strip",
        "roadblock_ids": ["49374", "49375", "49376"],
        "vehicle_name": "veh-35",
        "can_bus": np.zeros(18),
        "lidar_path": None,
        "ego2global_translation": np.array([x, y, 608.1]),
        "ego2global_rotation": quaternion,
        "ego_dynamic_state": [6.0 + 0.1 * i, 0.01, 0.2, -0.03],
        "traffic_lights": [(21, False), (22, True)],
        "driving_command": np.array([1, 0, 0, 0]),
        "cams": {name: _camera(k, name, f"{scene}/{name}/{0xC000 + i:016x}-000.jpg") for k, name in enumerate(CAMERAS)},
        "sample_prev": tokens[i - 1] if i else None,
        "sample_next": tokens[i + 1] if i + 1 < N_FRAMES else None,
        "anns": {
            "gt_boxes": boxes[seen],
            "gt_names": np.array(["vehicle", "pedestrian", "bicycle", "traffic_cone"])[seen],
            "gt_velocity_3d": np.array([[5.0, 0.5, 0.0], [1.0, 0.1, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]])[seen],
            "instance_tokens": [f"{0xD000 + k:016x}" for k in seen],
            "track_tokens": [f"{0xD000 + k:016x}" for k in seen],
            "original_track_tokens": [f"{0xE000 + k:016x}" for k in seen],
        },
    }


def _camera(k: int, name: str, path: str) -> dict[str, Any]:
    turned = Rotation.from_euler("z", 45.0 * k, degrees=True).as_matrix()
    return {
        "data_path": path,
        "sensor2lidar_rotation": turned @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
        "sensor2lidar_translation": np.array([1.6, 0.1 * k, 1.5]),
        "cam_intrinsic": np.array([[77.25, 0.0, 48.0], [0.0, 77.25, 28.0], [0.0, 0.0, 1.0]]),
        "distortion": DISTORTION,
    }


def write_log(
    root: Path, folder: str, seed: int, round: int | None, log: Sequence[dict[str, Any]] | None = None
) -> Path:
    """A log and the pictures of its history below navsim_logs/<folder> and sensor_blobs/<folder>."""
    log = frames(seed, round) if log is None else log
    path = root / "navsim_logs" / folder / f"{names(seed, round)[0]}.pkl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(list(log), pickle.HIGHEST_PROTOCOL))
    for i, frame in enumerate(log[: NOW + 1]):
        for k, camera in enumerate(frame["cams"].values()):
            file = root / "sensor_blobs" / folder / camera["data_path"]
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(jpeg(100 * seed + 10 * i + k))
    return path


def jpeg(shade: int) -> bytes:
    """A small picture, another for every shade."""
    pixels = np.full((SIZE[1], SIZE[0], 3), shade % 251, np.uint8)
    return bytes(cv2.imencode(".jpg", pixels)[1])

"""Frames of a small log, by hand, for the tests beside this file."""

from typing import Any

import numpy as np

from factory.datasets.navsim.log import CAMERA_NAMES
from tests.factory.datasets.navsim.openscene_writer import FIRST_STAMP_US, hex16

NAME = "2021.06.14.18.00.00_veh-51_00000_00100"
SPEED_MPS = 8.0


def frame(k: int, name: str = NAME, **other: Any) -> dict[str, Any]:
    """Frame k of an ego that drives east at 8 m/s; a car 20 m ahead of it, as fast; a cone that stands at x = 60 m."""
    x = SPEED_MPS * 0.5 * k
    boxes = [[20.0, 0.5, 0.8, 4.6, 1.9, 1.6, 0.0], [60.0 - x, -3.0, 0.4, 0.4, 0.4, 0.7, 0.0]]
    camera = {
        "sensor2lidar_rotation": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
        "sensor2lidar_translation": np.array([1.6, 0.0, 1.5]),
        "cam_intrinsic": np.array([[1545.0, 0.0, 960.0], [0.0, 1545.0, 560.0], [0.0, 0.0, 1.0]]),
        "distortion": np.array([-0.356123, 0.172545, -0.00213, 0.000464, -0.05231]),
    }
    return {
        "token": hex16(name, k),
        "timestamp": FIRST_STAMP_US + 500_000 * k,
        "log_name": name,
        "scene_token": hex16(name),
        "map_location": "us-ma-boston",
        "roadblock_ids": ["10", "20", "30"],
        "can_bus": np.zeros(18),
        "lidar_path": f"{name}/MergedPointCloud/{hex16(name, k)}.pcd",
        "ego2global_translation": np.array([331_000.0 + x, 4_690_000.0, 12.0]),
        "ego2global_rotation": np.array([1.0, 0.0, 0.0, 0.0]),
        "ego_dynamic_state": [SPEED_MPS, 0.0, 0.25, 0.0],
        "traffic_lights": [(21, k >= 6)],
        "driving_command": np.array([0, 1, 0, 0]),
        "cams": {c: {"data_path": f"{name}/{c}/{hex16(name, c, k)}.jpg", **camera} for c in CAMERA_NAMES},
        "anns": {
            "gt_boxes": np.array(boxes),
            "gt_names": np.array(["vehicle", "traffic_cone"]),
            "gt_velocity_3d": np.array([[SPEED_MPS, 0.0, 0.0], [0.0, 0.0, 0.0]]),
            "instance_tokens": [hex16("car", k), hex16("cone", k)],
            "track_tokens": [hex16("car"), hex16("cone")],
        },
        **other,
    }

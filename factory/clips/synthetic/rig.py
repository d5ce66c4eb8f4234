"""The calibrated cameras of the synthetic ego: an eight-camera ring, pinhole, no distortion."""

import numpy as np

from factory.clips.synthetic.curves import Array
from tasks.world.camera import Camera

REAR_AXLE_Z_M = 0.33  # the ego frame's origin above the road
FIELD_OF_VIEW_RAD = np.deg2rad(70.0)  # horizontal
_MOUNTS = {  # name: yaw [deg], x, y, z in the ego frame [m]; names as in AV2, but for the eighth
    "ring_front_center": (0.0, 1.62, 0.0, 1.32),
    "ring_front_left": (50.0, 1.52, 0.35, 1.32),
    "ring_front_right": (-50.0, 1.52, -0.35, 1.32),
    "ring_side_left": (100.0, 1.20, 0.45, 1.32),
    "ring_side_right": (-100.0, 1.20, -0.45, 1.32),
    "ring_rear_left": (150.0, 0.80, 0.35, 1.32),
    "ring_rear_right": (-150.0, 0.80, -0.35, 1.32),
    "ring_rear_center": (180.0, 0.70, 0.0, 1.32),
}
CAMERA_NAMES = tuple(_MOUNTS)


def build_rig(names: tuple[str, ...], width: int, height: int) -> tuple[Camera, ...]:
    """The named cameras at width x height pixels; pixel (0, 0) covers image coordinates 0..1. Raises ValueError."""
    unknown = [name for name in names if name not in _MOUNTS]
    if unknown:
        raise ValueError(f"unknown cameras {unknown}; known: {', '.join(CAMERA_NAMES)}")
    focal = width / 2 / np.tan(FIELD_OF_VIEW_RAD / 2)
    intrinsics = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return tuple(Camera(name, width, height, intrinsics, np.zeros(3), _pose(*_MOUNTS[name])) for name in names)


def _pose(yaw_deg: float, x: float, y: float, z: float) -> Array:
    """(4, 4) ego from camera (x right, y down, z forward) of a level camera."""
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    return np.array([[s, 0.0, c, x], [-c, 0.0, s, y], [0.0, -1.0, 0.0, z], [0.0, 0.0, 0.0, 1.0]])


def world_from_ego(rear_axle: Array) -> Array:
    """(4, 4) pose of the ego frame from its rear axle's x, y, heading on the flat road."""
    c, s = np.cos(rear_axle[2]), np.sin(rear_axle[2])
    return np.array(
        [[c, -s, 0.0, rear_axle[0]], [s, c, 0.0, rear_axle[1]], [0.0, 0.0, 1.0, REAR_AXLE_Z_M], [0.0, 0.0, 0.0, 1.0]]
    )

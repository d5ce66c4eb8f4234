"""Named camera rigs, for clips that have no calibrated cameras of their own (render=map)."""

import numpy as np

from tasks.world.clip import Camera

HEIGHT_M = 1.6  # of every camera above the ground; all sit above the rear axle's x + 1.5 m


def pinhole(name: str, yaw_deg: float, field_of_view_deg: float, width: int = 640, height: int = 360) -> Camera:
    """A level camera that looks `yaw_deg` to the left of the ego's heading."""
    yaw = np.radians(yaw_deg)
    focal = width / 2.0 / np.tan(np.radians(field_of_view_deg) / 2.0)
    ego_from_camera = np.eye(4)
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    ego_from_camera[:3, :3] = np.stack([np.cross(down, forward), down, forward], axis=1)
    ego_from_camera[:3, 3] = [1.5, 0.0, HEIGHT_M]
    intrinsics = np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])
    return Camera(name, width, height, intrinsics, np.zeros(5), ego_from_camera)


MAP_RIG = (pinhole("front_left", 55.0, 70.0), pinhole("front", 0.0, 70.0), pinhole("front_right", -55.0, 70.0))

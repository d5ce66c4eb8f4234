"""Cameras and where a clip's sensor files are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with radial distortion, mounted on the ego. Camera frame: x right, y down, z forward."""

    name: str
    width: int  # pixels
    height: int
    intrinsics: NDArray[np.float64]  # (3, 3) pixels
    distortion: NDArray[np.float64]  # (3,) k1, k2, k3; zeros for an undistorted image
    ego_from_camera: NDArray[np.float64]  # (4, 4)

    def resized(self, width: int, height: int) -> "Camera":
        """The same view on a width x height image."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return Camera(self.name, width, height, scale @ self.intrinsics, self.distortion, self.ego_from_camera)


@dataclass(frozen=True)
class SensorFile:
    """One image or lidar sweep of the clip; opened by the factory, never by a task."""

    sensor: str  # camera name or lidar name
    uri: str
    time_s: float  # relative to the clip's start (its first step)
    world_from_ego: NDArray[np.float64]  # (4, 4) at this time

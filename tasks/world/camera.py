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

    def window(self, width: int, height: int) -> tuple[int, int, int, int]:
        """Left, top, width, height [px] of the largest centred part of the image with the shape width : height."""
        scale = min(self.width / width, self.height / height)
        w, h = min(round(width * scale), self.width), min(round(height * scale), self.height)
        return (self.width - w) // 2, (self.height - h) // 2, w, h

    def resized(self, width: int, height: int) -> "Camera":
        """The camera of a width x height image: `window`, scaled. A portrait camera's view is cut, not squashed."""
        left, top, w, h = self.window(width, height)
        cut = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]])
        scale = np.diag([width / w, height / h, 1.0])
        return Camera(self.name, width, height, scale @ cut @ self.intrinsics, self.distortion, self.ego_from_camera)


@dataclass(frozen=True)
class SensorFile:
    """One image or lidar sweep of the clip; opened by the factory, never by a task."""

    sensor: str  # camera name or lidar name
    uri: str
    time_s: float  # relative to the clip's start (its first step)
    world_from_ego: NDArray[np.float64]  # (4, 4) at this time

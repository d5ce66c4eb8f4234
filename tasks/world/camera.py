"""Cameras and where a clip's sensor files are."""

from dataclasses import dataclass

import numpy as np

from tasks.world.arrays import Array

ROTATION_SLACK = 1e-3  # of calibrations written with few digits
MAX_READOUT_S = 0.2  # slower is no camera of a car: seconds were meant to be milliseconds


@dataclass(frozen=True)
class Fisheye:
    """A lens by the angle theta to its axis, as OpenCV's `fisheye` has it (Kannala and Brandt 2006).

    What is seen at theta lies theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) focal lengths from the
    centre. Photos become those of a pinhole with the same `intrinsics` as they are opened.
    """

    intrinsics: Array  # (3, 3) pixels
    terms: Array  # (4,) k1, k2, k3, k4


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with lens distortion, mounted on the ego. Camera frame: x right, y down, z forward.

    Distortion is OpenCV's and nuPlan's: radial k1, k2, k3 and tangential p1, p2 (`tasks.render.views.undistorted`).
    Raises ValueError that names camera and field for what is no calibration.
    """

    name: str
    width: int  # pixels
    height: int
    intrinsics: Array  # (3, 3) pixels
    distortion: Array  # (5,) k1, k2, p1, p2, k3; zeros for an undistorted image
    ego_from_camera: Array  # (4, 4) rigid
    fisheye: Fisheye | None = None  # the lens its photos were taken with, which all else knows nothing of
    readout_s: float = 0.0  # from the first row's exposure to the last one's; below 0: from below; 0: all rows at once

    def __post_init__(self) -> None:
        for name, shape in (("intrinsics", (3, 3)), ("distortion", (5,)), ("ego_from_camera", (4, 4))):
            array = getattr(self, name)
            if np.shape(array) != shape:
                raise ValueError(f"camera {self.name}: {name}: shape {np.shape(array)}, expected {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"camera {self.name}: {name}: NaN or infinity")
        if not abs(self.readout_s) <= MAX_READOUT_S:
            raise ValueError(f"camera {self.name}: readout_s: {self.readout_s}, expected {MAX_READOUT_S:g} s at most")
        if self.readout_s and self.fisheye is not None:
            raise ValueError(f"camera {self.name}: readout_s: not for a fisheye, whose rows a pinhole has not")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera {self.name}: size: {self.width}x{self.height} pixels")
        if min(self.intrinsics[0, 0], self.intrinsics[1, 1]) <= 0.0:
            raise ValueError(f"camera {self.name}: intrinsics: focal lengths must be positive")
        turned = self.ego_from_camera[:3, :3]
        if np.abs(turned @ turned.T - np.eye(3)).max() > ROTATION_SLACK or np.linalg.det(turned) < 0.0:
            raise ValueError(f"camera {self.name}: ego_from_camera: not a rotation and a shift")

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
class Pinhole:
    """A camera without distortion somewhere in the world. Raises ValueError for arrays that are no camera."""

    intrinsics: Array  # (3, 3) pixels, without skew, the centre of pixel (0, 0) at (0.5, 0.5)
    world_from_camera: Array  # (4, 4) rigid; camera x right, y down, z forward
    width: int  # pixels
    height: int

    def __post_init__(self) -> None:
        shapes = (self.intrinsics.shape, self.world_from_camera.shape)
        if shapes != ((3, 3), (4, 4)):
            raise ValueError(f"Pinhole: intrinsics, pose are {shapes[0]}, {shapes[1]}, expected (3, 3) and (4, 4)")
        if not (np.isfinite(self.intrinsics).all() and np.isfinite(self.world_from_camera).all()):
            raise ValueError("Pinhole: intrinsics or pose hold NaN or infinity")
        if min(self.intrinsics[0, 0], self.intrinsics[1, 1], self.width, self.height) <= 0:
            raise ValueError("Pinhole: focal lengths, width and height must be positive")


@dataclass(frozen=True)
class SensorFile:
    """One image or lidar sweep of the clip; opened by the factory, never by a task."""

    sensor: str  # camera name or lidar name
    uri: str  # path, of a frame of a video with #frame=<k>
    time_s: float  # relative to the clip's start (its first step)
    world_from_ego: Array  # (4, 4) at this time
    ego_from_sensor: Array | None = None  # (4, 4) of a sweep whose points are in its sensor's frame; None: in the ego's
    late_s: float = 0.0  # so much later than said was it taken, where photos say so; its pose is that of then

    @property
    def taken_s(self) -> float:
        """When it was taken, on the clock of `time_s`, which it keeps as its name."""
        return self.time_s + self.late_s

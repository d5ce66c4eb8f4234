"""What NAVSIM shows an agent, by the names of its dataclasses, and the row of a table with the same content."""

from dataclasses import dataclass, field
from functools import cache
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from planners.data.batch import COMMANDS
from planners.navsim.agent import CAMERAS
from tests.planners.samples import jpeg, sample

YAWS = dict(zip(CAMERAS, np.deg2rad([0.0, 55.0, 110.0, 150.0, -55.0, -110.0, -150.0, 180.0])))
DISTORTION = np.array([-0.356, 0.172, -0.002, 0.0003, -0.052])  # like the rig's


@dataclass
class Camera:
    image: NDArray[np.uint8] | None = None
    sensor2lidar_rotation: Any = None
    sensor2lidar_translation: Any = None
    intrinsics: Any = None
    distortion: Any = None


@dataclass
class EgoStatus:
    ego_pose: NDArray[np.float32]
    ego_velocity: NDArray[np.float32]
    ego_acceleration: NDArray[np.float32]
    driving_command: NDArray[np.int_]
    in_global_frame: bool = False


@dataclass
class Cameras:
    cam_f0: Camera = field(default_factory=Camera)
    cam_l0: Camera = field(default_factory=Camera)
    cam_l1: Camera = field(default_factory=Camera)
    cam_l2: Camera = field(default_factory=Camera)
    cam_r0: Camera = field(default_factory=Camera)
    cam_r1: Camera = field(default_factory=Camera)
    cam_r2: Camera = field(default_factory=Camera)
    cam_b0: Camera = field(default_factory=Camera)


@dataclass
class AgentInput:
    ego_statuses: list[EgoStatus]
    cameras: list[Cameras]


@cache
def photo(name: str, width: int, height: int) -> bytes:
    """A JPEG of soft patches, another one for each camera."""
    coarse = np.random.default_rng(CAMERAS.index(name)).integers(0, 256, (9, 16, 3)).astype(np.uint8)
    return jpeg(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))


def looking(yaw: float) -> NDArray[np.float64]:
    """(3, 3) of a level camera: its axes right, down, ahead in those of the ego."""
    return np.array([[np.sin(yaw), 0, np.cos(yaw)], [-np.cos(yaw), 0, np.sin(yaw)], [0, -1, 0]])


def pinhole(width: int, height: int) -> NDArray[np.float64]:
    return np.array([[0.8 * width, 0.0, width / 2], [0.0, 0.8 * width, height / 2], [0.0, 0.0, 1.0]])


HISTORY = np.array([[-9.0, 0.5, -0.2], [-6.0, 0.2, -0.1], [-3.0, 0.05, -0.05], [0.0, 0.0, 0.0]], np.float32)
MOTION = np.array([6.2, 0.1, -0.4, 0.3], np.float32)


def agent_input(names: tuple[str, ...], command: str = "left", size: tuple[int, int] = (160, 90)) -> AgentInput:
    """Only now's cameras of these names are loaded, as SensorConfig has it, and decoded by PIL, as there."""
    one_hot = np.array([one == command for one in COMMANDS]).astype(int)
    statuses = [EgoStatus(pose, MOTION[:2], MOTION[2:], one_hot) for pose in HISTORY]
    shot = {
        name: Camera(
            np.array(Image.open(BytesIO(photo(name, *size)))),
            looking(YAWS[name]),
            np.array([1.5, 0.0, 1.6]),
            pinhole(*size),
            DISTORTION,
        )
        for name in names
    }
    return AgentInput(statuses, [Cameras(), Cameras(), Cameras(), Cameras(**shot)])


def row(names: tuple[str, ...], command: str = "left", size: tuple[int, int] = (160, 90)) -> dict[str, Any]:
    """The same, as a run of the factory writes it."""
    poses = {name: np.eye(4) for name in names}
    for name, pose in poses.items():
        pose[:3, :3], pose[:3, 3] = looking(YAWS[name]), [1.5, 0.0, 1.6]
    cameras = [
        {
            "name": name,
            "width": size[0],
            "height": size[1],
            "intrinsics": pinhole(*size).reshape(9),
            "distortion": DISTORTION,
            "ego_from_camera": poses[name].reshape(16),
        }
        for name in names
    ]
    images = [
        {"camera": name, "time_s": 0.0, "ego_pose": np.eye(4).reshape(16), "jpeg": photo(name, *size)} for name in names
    ]
    pictures = {"cameras": cameras, "images": images, "image_source": "photo"}
    made = sample(0, command=command, ego_status=MOTION, ego_history_2hz=HISTORY, **pictures)
    around = {"agent_kinds": ["VEHICLE"] * len(made["agent_kinds"]), "agent_boxes": np.nan_to_num(made["agent_boxes"])}
    return made | around

"""Which camera of a rig stands for which of the eight that NAVSIM knows."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from tasks.render.rigs import pinhole
from tasks.world.camera import Camera

# Where nuPlan's cameras look, degrees to the left of the ego's heading.
YAW_DEG = {
    "CAM_F0": 0.0,
    "CAM_L0": 55.0,
    "CAM_L1": 111.0,
    "CAM_L2": 141.0,
    "CAM_R0": -55.0,
    "CAM_R1": -111.0,
    "CAM_R2": -141.0,
    "CAM_B0": 180.0,
}
CAMERAS = tuple(YAW_DEG)
MOST_DEG = 30.0  # off the direction that a camera stands for
NOMINAL_VIEW_DEG = 63.7  # horizontal, of nuPlan's cameras: 1920 px at a focal length of 1545 px


def slots(cameras: Sequence[Camera]) -> Mapping[str, Camera]:
    """NAVSIM's name -> the rig's camera: by name where the rig has these names, else by viewing direction.

    Directions are paired so that their squared differences sum up to the least, and none differs by more than MOST_DEG.
    What is not paired is left out.
    """
    by_name = {camera.name.upper(): camera for camera in cameras}
    if by_name.keys() <= YAW_DEG.keys():
        return {name: by_name[name] for name in CAMERAS if name in by_name}
    looks = np.array([_yaw_deg(camera) for camera in cameras])
    off = np.abs((looks[:, None] - np.array(list(YAW_DEG.values())) + 180.0) % 360.0 - 180.0)
    cost = np.where(off <= MOST_DEG, off, 1e3) ** 2
    pairs = sorted((int(slot), int(i)) for i, slot in zip(*linear_sum_assignment(cost)) if off[i, slot] <= MOST_DEG)
    return {CAMERAS[slot]: cameras[i] for slot, i in pairs}


def nominal(name: str, size: tuple[int, int]) -> Camera:
    """A level camera that looks where the named one does, for one that a rig has not."""
    return pinhole(name, YAW_DEG[name], NOMINAL_VIEW_DEG, *size)


def _yaw_deg(camera: Camera) -> float:
    ahead = camera.ego_from_camera[:3, 2]
    return float(np.degrees(np.arctan2(ahead[1], ahead[0])))

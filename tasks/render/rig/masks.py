"""What of a photo is not matched: boxes of what can move, and the own body."""

import cv2
import numpy as np

from tasks.render.scene.movers import behind_boxes
from tasks.render.scene.sensed import Tracks
from tasks.render.scene.sky import directions
from tasks.render.scene.stereo import FAR_M
from tasks.world.agents import AgentTracks
from tasks.world.arrays import Bools
from tasks.world.camera import Camera, SensorFile

WIDTH = 240  # pixels of the mask
LARGER_M = 0.6  # than the box: calibration and poses are what is not known yet


def hidden_by(
    agents: AgentTracks | None, camera: Camera, file: SensorFile, own_body: Bools | None = None
) -> Bools | None:
    """(h, w) pixels where something movable may be, or of the `own_body` (H, W); None where nothing is."""
    boxes, there = Tracks(agents, np.zeros(3)).at(file.time_s)
    if not there.any():
        return own_body
    small = camera.resized(WIDTH, round(WIDTH * camera.height / camera.width))
    pose = file.world_from_ego @ camera.ego_from_camera
    eye = np.ascontiguousarray(pose[:3, 3])
    rays = directions(small.intrinsics, pose, small.width, small.height)
    larger = boxes[there] + np.array([0.0, 0.0, 0.0, 0.0, LARGER_M, LARGER_M, LARGER_M])
    hidden = behind_boxes((rays * FAR_M).reshape(-1, 3) + eye, eye, larger)
    hidden = np.asarray(hidden.reshape(small.height, small.width))
    if own_body is None:
        return hidden
    size = (small.width, small.height)
    return hidden | np.asarray(cv2.resize(own_body.astype(np.uint8), size, interpolation=cv2.INTER_AREA), bool)

"""What the rig sees from poses nobody drove, with the agents where the simulation put them."""

from collections.abc import Sequence

import cv2
import numpy as np

from tasks.render.scene.asset import RenderAsset
from tasks.render.scene.engine import Backend, render, vehicles_at
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import STEP_S, AgentTracks, Camera, Fisheye, Pinhole
from tasks.world.frames import HEADING, X, Y

VISIBLE_M = 150.0  # agents further away are not drawn


def render_views(
    asset: RenderAsset,
    cameras: Sequence[Camera],
    world_from_ego: Array,
    agents: AgentTracks,
    steps: Sequence[int],
    width: int,
    height: int,
    backend: Backend = Backend.CPU,
) -> Bytes:
    """Images (F, C, height, width, 3) rgb.

    `world_from_ego` (F, 4, 4) in 3-D (`pose_on_ground`), `steps` (F,) rows of `agents` at these instants. The images
    are those of ideal pinholes, `camera.resized(width, height)` with distortion zero: photos are undistorted before
    they enter the scene. Each camera shows the scene in its own colours at that time, step 0 being the scene's 0
    (`RenderAsset.since`), and before it what it sees of the car that carries it.
    Raises BackendMissing where the backend cannot work on this machine.
    """
    out = np.empty((len(steps), len(cameras), height, width, 3), np.uint8)
    rig = [camera.resized(width, height) for camera in cameras]
    for f, step in enumerate(steps):
        affines = [asset.affine_of(camera.name, step * STEP_S) for camera in cameras]
        there = vehicles_at(agents, step * STEP_S, world_from_ego[f, :2, 3], VISIBLE_M)
        eyes = [Pinhole(c.intrinsics, world_from_ego[f] @ c.ego_from_camera, width, height) for c in rig]
        for c, view in enumerate(render(asset, eyes, there, backend, affines=affines)):
            out[f, c] = np.rint(view.rgb * 255.0).astype(np.uint8)
            if (body := asset.own_body(cameras[c].name)) is not None:
                out[f, c] = body.drawn_on(out[f, c])
    return out


def undistorted(image: Bytes, camera: Camera) -> Bytes:
    """The photo (H, W, 3), or a mask of it (H, W), that an ideal pinhole of the same intrinsics would have taken.

    Outside of the photo: edge colours.

    `Camera.distortion` is Brown's model as OpenCV has it. Where an ideal pinhole sees x, y over depth, the lens shows
    x s + 2 p1 x y + p2 (r2 + 2 x^2), y s + p1 (r2 + 2 y^2) + 2 p2 x y with s = 1 + k1 r2 + k2 r2^2 + k3 r2^3.
    """
    if not np.any(camera.distortion):
        return image
    height, width = image.shape[:2]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    fx, fy, cx, cy = (camera.intrinsics[i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y = (u - cx) / fx, (v - cy) / fy
    r2 = x * x + y * y
    k1, k2, p1, p2, k3 = camera.distortion
    stretch = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    seen_x = x * stretch + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    seen_y = y * stretch + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    map_x, map_y = (fx * seen_x + cx - 0.5).astype(np.float32), (fy * seen_y + cy - 0.5).astype(np.float32)
    return np.asarray(cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def straightened(image: Bytes, lens: Fisheye) -> Bytes:
    """A fisheye's photo (H, W, 3), or a mask of it (H, W), as a pinhole of the same intrinsics takes it."""
    to_first_centre = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])  # OpenCV's pixels begin there
    k, size = to_first_centre @ lens.intrinsics, (image.shape[1], image.shape[0])
    maps = cv2.fisheye.initUndistortRectifyMap(k, lens.terms, np.eye(3), k, size, cv2.CV_32FC1)
    return np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def pose_on_ground(logged: Array, ego_states: Array) -> Array:
    """3-D poses (F, 4, 4) of planar ego states (F, 11), standing on the road as the log knows it.

    `logged` (S, 4, 4) world_from_ego: each state takes height, roll and pitch from the plane under the nearest logged
    pose.
    """
    xy = ego_states[:, [X, Y]]
    distance = np.linalg.norm(logged[None, :, :2, 3] - xy[:, None, :], axis=-1)
    base = logged[np.argmin(distance, axis=1)]
    up = base[:, :3, 2]
    out = np.tile(np.eye(4), (len(xy), 1, 1))
    out[:, :2, 3] = xy
    offset = xy - base[:, :2, 3]
    out[:, 2, 3] = base[:, 2, 3] - (offset * up[:, :2]).sum(axis=1) / up[:, 2]
    flat = np.stack([np.cos(ego_states[:, HEADING]), np.sin(ego_states[:, HEADING])], axis=-1)
    forward = np.column_stack([flat, -(flat * up[:, :2]).sum(axis=1) / up[:, 2]])
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    out[:, :3, 0], out[:, :3, 1], out[:, :3, 2] = forward, np.cross(up, forward), up
    return out

"""A street with printed road and walls, driven along by two cameras at seven instants: photos whose truth is known."""

from pathlib import Path

import cv2
import numpy as np

from tasks.render.rig.adjust import motions_of_twists
from tasks.world.clip import AgentTracks, Block, Camera, SensorFile

WIDTH, HEIGHT, FOCAL, WALL_M, ROAD_M, CELL_M = 400, 224, 260.0, 6.0, -0.3, 0.03
NOBODY = AgentTracks(
    (), (), np.zeros((96, 0, 5)), np.zeros((96, 0, 2)), np.zeros((96, 0), bool), np.zeros((96, 0)), np.zeros(0)
)


def camera(name: str, yaw_deg: float) -> Camera:
    yaw = np.radians(yaw_deg)
    forward, down = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([0.0, 0.0, -1.0])
    mount = np.eye(4)
    mount[:3, :3] = np.stack([np.cross(down, forward), down, forward], axis=1)
    mount[:3, 3] = [1.5, 0.3 * np.sin(yaw), 1.5]
    k = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Camera(name, WIDTH, HEIGHT, k, np.zeros(5), mount)


CAMERAS = (camera("front", 0.0), camera("left", 50.0))


def prints() -> list[np.ndarray]:
    """Of the road and of the walls: blots of several sizes, grey."""
    rng = np.random.default_rng(0)
    out = []
    for _ in range(3):
        sheet = np.zeros((1024, 2048), np.float32)
        for cells in (8, 32, 128):
            blots = rng.normal(size=(cells, 2 * cells)).astype(np.float32)
            sheet += cv2.resize(blots, sheet.shape[::-1], interpolation=cv2.INTER_CUBIC)
        out.append(np.clip(120.0 + 35.0 * sheet, 0.0, 255.0))
    return out


def picture(pose: np.ndarray, sheets: list[np.ndarray]) -> np.ndarray:
    """(H, W, 3) what a camera at a pose (4, 4) sees of the road at ROAD_M and the walls at +-WALL_M."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1) @ pose[:3, :3].T
    eye, best = pose[:3, 3], np.full(u.shape, 80.0)
    out = np.full(u.shape, 200.0, np.float32)
    for sheet, axis, at in zip(sheets, (2, 1, 1), (ROAD_M, WALL_M, -WALL_M)):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (at - eye[axis]) / rays[..., axis]
        near = (t > 0.0) & (t < best)
        points = eye + np.where(near, t, 0.0)[..., None] * rays
        along, other = points[..., 0] + 10.0, points[..., 3 - axis] + 10.0
        size = (along / CELL_M).astype(np.float32), (other / CELL_M).astype(np.float32)
        drawn = cv2.remap(sheet, *size, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        out, best = np.where(near, drawn, out), np.where(near, t, best)
    return np.repeat(np.rint(out).astype(np.uint8)[..., None], 3, axis=-1)


def ego(k: int) -> np.ndarray:
    return motions_of_twists(np.array([[1.2 * k, 0.02 * k * k, 0.0, 0.0, 0.0, 0.03 * k]]))[0]


def photographed(folder: Path) -> Block:
    """The block, its pictures in a folder."""
    sheets, files = prints(), []
    for k in range(7):
        for one in CAMERAS:
            path = folder / f"{one.name}_{k}.png"
            cv2.imwrite(str(path), picture(ego(k) @ one.ego_from_camera, sheets))
            files.append(SensorFile(one.name, str(path), 0.5 * k, ego(k)))
    return Block(0.0, NOBODY, tuple(files), ())

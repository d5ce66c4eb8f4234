"""The sensors of the synthetic ego: a ring of eight pinhole cameras without distortion, and a spinning lidar.

The lidar sees the triangles the cameras see, through the same rasteriser. Four views of 90 degrees around the sensor
tell each beam which triangle it meets; where it meets that triangle's plane is exact. All beams of a sweep fire at the
stamp, so the points need no motion compensation.
"""

from dataclasses import dataclass

import numpy as np

from factory.readers.settings import MOUNTS, check_cameras
from factory.readers.town import textures as tx
from factory.readers.town.draw import LitScene, camera_view, look
from tasks.world.arrays import F32, Array, Bytes, ShortInts
from tasks.world.camera import Camera

REAR_AXLE_Z_M = 0.33  # the ego frame's origin above the road
FIELD_OF_VIEW_RAD = np.deg2rad(70.0)  # horizontal


def build_rig(names: tuple[str, ...], width: int, height: int) -> tuple[Camera, ...]:
    """The named cameras at width x height pixels; pixel (0, 0) covers image coordinates 0..1. Raises ValueError."""
    check_cameras(names)
    focal = width / 2 / np.tan(FIELD_OF_VIEW_RAD / 2)
    intrinsics = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return tuple(Camera(name, width, height, intrinsics, np.zeros(5), _pose(*MOUNTS[name])) for name in names)


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


MOUNT_M = np.array([1.2, 0.0, 1.62])  # in the ego frame
ELEVATIONS_DEG = (-22.5, 22.5)  # as high as the cameras look: what no beam meets, photos have to guess
RANGE_M = (1.5, 110.0)
VIEW_SAMPLES = (640, 440)  # of one 90 degree view: 0.18 degrees apart in its middle
_REFLECTANCE = {tx.ROAD: 0.22, tx.ASPHALT: 0.20, tx.GLOW: 0.9, tx.SIGN: 0.95, tx.LEAVES: 0.35, tx.CABIN: 0.08}


@dataclass(frozen=True)
class LidarReturns:
    """P returns, ego frame."""

    points: F32  # (P, 3) m
    intensity: Bytes  # (P,)
    laser_number: Bytes  # (P,)
    offset_ns: ShortInts  # (P,) of the beam within its turn of 0.1 s


def scan(scene: LitScene, world_from_ego: Array, beams: int, azimuths: int) -> LidarReturns:
    """One sweep of `beams` x `azimuths` shots from the ego at `world_from_ego` (4, 4)."""
    elevation = np.deg2rad(np.linspace(*ELEVATIONS_DEG, beams))
    turn = np.arange(azimuths) * 2 * np.pi / azimuths
    laser, shot = (grid.ravel() for grid in np.meshgrid(np.arange(beams), np.arange(azimuths), indexing="ij"))
    angle, up = turn[shot], elevation[laser]
    direction = np.column_stack([np.cos(up) * np.cos(angle), np.cos(up) * np.sin(angle), np.sin(up)])
    width, height = VIEW_SAMPLES
    intrinsics = np.array([[width / 2, 0.0, width / 2], [0.0, width / 2, height / 2], [0.0, 0.0, 1.0]])
    distance = np.full(len(laser), np.nan)
    intensity = np.zeros(len(laser))
    quarter = np.round(angle / (np.pi / 2)).astype(int) % 4
    for k in range(4):
        c, s = np.cos(k * np.pi / 2), np.sin(k * np.pi / 2)
        ego_from_view = np.eye(4)
        ego_from_view[:3, :3] = [[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]]
        ego_from_view[:3, 3] = MOUNT_M
        view, _rays = camera_view(intrinsics, world_from_ego @ ego_from_view)
        mine = np.flatnonzero(quarter == k)
        local = direction[mine] @ ego_from_view[:3, :3]  # x right, y down, z forward
        x = local[:, 0] / local[:, 2] * width / 2 + width / 2
        y = local[:, 1] / local[:, 2] * width / 2 + height / 2
        ids, planes = look(scene, view, width, height)
        hit = ids[np.clip(y.astype(int), 0, height - 1), np.clip(x.astype(int), 0, width - 1)]
        plane = planes[np.maximum(hit, 0)]
        inverse_depth = plane[:, 0] * x + plane[:, 1] * y + plane[:, 2]
        met = (hit >= 0) & (inverse_depth > 1.0 / (2 * RANGE_M[1]))
        distance[mine[met]] = 1.0 / (inverse_depth[met] * local[met, 2])
        normals = scene.mesh.normals[hit[met]] @ world_from_ego[:3, :3]
        facing = np.abs(np.einsum("ij,ij->i", normals, direction[mine[met]]))
        intensity[mine[met]] = _reflectance(scene, hit[met]) * (0.35 + 0.65 * facing)
    keep = np.flatnonzero((distance > RANGE_M[0]) & (distance < RANGE_M[1]))  # false for NaN
    return LidarReturns(
        (MOUNT_M + direction[keep] * distance[keep, None]).astype(np.float32),
        np.clip(intensity[keep] * 255, 0, 255).astype(np.uint8),
        laser[keep].astype(np.uint8),
        (shot[keep] * (100_000_000 // azimuths)).astype(np.int32),
    )


def _reflectance(scene: LitScene, triangle: ShortInts) -> Array:
    out = np.clip(scene.mesh.colour[triangle].mean(axis=1), 0.05, 0.6)
    for material, value in _REFLECTANCE.items():
        out[scene.mesh.material[triangle] == material] = value
    return out

"""A spinning lidar that sees the triangles the cameras see, through the same rasteriser.

Four views of 90 degrees around the sensor tell each beam which triangle it meets; where it meets that triangle's plane
is exact. All beams of a sweep fire at the stamp, so the points need no motion compensation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factory.clips.synthetic import textures as tx
from factory.clips.synthetic.curves import Array
from factory.clips.synthetic.draw import Stage, camera_view, look

MOUNT_M = np.array([1.2, 0.0, 1.62])  # in the ego frame
ELEVATIONS_DEG = (-22.5, 22.5)  # as high as the cameras look: what no beam meets, photos have to guess
RANGE_M = (1.5, 110.0)
VIEW_SAMPLES = (640, 440)  # of one 90 degree view: 0.18 degrees apart in its middle
_REFLECTANCE = {tx.ROAD: 0.22, tx.ASPHALT: 0.20, tx.GLOW: 0.9, tx.SIGN: 0.95, tx.LEAVES: 0.35, tx.CABIN: 0.08}


@dataclass(frozen=True)
class Sweep:
    """P returns, ego frame."""

    points: NDArray[np.float32]  # (P, 3) m
    intensity: NDArray[np.uint8]  # (P,)
    laser_number: NDArray[np.uint8]  # (P,)
    offset_ns: NDArray[np.int32]  # (P,) of the beam within its turn of 0.1 s


def scan(stage: Stage, world_from_ego: Array, beams: int, azimuths: int) -> Sweep:
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
        seen = look(stage, view, width, height)
        column = np.clip(x.astype(int), 0, width - 1)
        hit = seen.ids[np.clip(y.astype(int), 0, height - 1), column]
        plane = seen.planes[np.maximum(hit, 0)]
        inverse_depth = plane[:, 0] * x + plane[:, 1] * y + plane[:, 2]
        met = (hit >= 0) & (inverse_depth > 1.0 / (2 * RANGE_M[1]))
        distance[mine[met]] = 1.0 / (inverse_depth[met] * local[met, 2])
        facing = np.abs(
            np.einsum("ij,ij->i", stage.mesh.normals[hit[met]] @ world_from_ego[:3, :3], direction[mine[met]])
        )
        intensity[mine[met]] = _reflectance(stage, hit[met]) * (0.35 + 0.65 * facing)
    keep = np.flatnonzero((distance > RANGE_M[0]) & (distance < RANGE_M[1]))  # false for NaN
    return Sweep(
        (MOUNT_M + direction[keep] * distance[keep, None]).astype(np.float32),
        np.clip(intensity[keep] * 255, 0, 255).astype(np.uint8),
        laser[keep].astype(np.uint8),
        (shot[keep] * (100_000_000 // azimuths)).astype(np.int32),
    )


def _reflectance(stage: Stage, triangle: NDArray[np.int32]) -> Array:
    out = np.clip(stage.mesh.colour[triangle].mean(axis=1), 0.05, 0.6)
    for material, value in _REFLECTANCE.items():
        out[stage.mesh.material[triangle] == material] = value
    return out

"""Draws the town: rasterise, shade what is visible in each half pixel, and blur as a lens does.

Textures live in surface coordinates and the sun's shadows in a depth map, so a place looks the same from everywhere.
Nothing finer than a pixel may be left in a picture: it would shimmer from photo to photo, and no scene that is learned
from photos could tell how. One shading per pixel differs by 30 to 36 dB from the picture with 64, four by 35 to 40.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factory.datasets.town import textures as tx
from factory.datasets.town.drive import TownDrive, TownTrack
from factory.datasets.town.raster import LitScene, Mesh, Sun, merged, rasterise, shade
from factory.datasets.town.scenery import Scenery, lamps_lit, track_mesh
from factory.datasets.town.settings import MOUNTS, check_cameras
from factory.datasets.town.textures import TREELINE
from tasks.world.arrays import F32, Array, Bytes, ShortInts
from tasks.world.clip import Camera

CELLS = 2  # shaded places per pixel and axis
SAMPLES = 2  # per cell and axis, of what is visible
OPTICS = (0.125, 0.375, 0.375, 0.125)  # weights of the cells in a pixel and one beside it: 0.46 pixels of blur
SHADOW_TEXEL_M = 0.2
SHADOW_SIZE = 1500  # texels: 300 m around the drive
STANDING_RANGE_M = 330.0  # of the drive's middle
MOVING_RANGE_M = 120.0  # of the ego


def sun_over(middle: Array, azimuth: float, elevation: float) -> Sun:
    """The sun at azimuth and elevation [rad] for shadows around `middle` (2,)."""
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    direction = np.cos(elevation) * flat + np.array([0.0, 0.0, np.sin(elevation)])
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    view = np.zeros((4, 4))
    view[[0, 1, 3], :3] = right / SHADOW_TEXEL_M, np.cross(direction, right) / SHADOW_TEXEL_M, direction
    view[:, 3] = -view[:, :3] @ np.array([middle[0], middle[1], 0.0])
    view[:2, 3] += SHADOW_SIZE / 2
    view[2, 3] = 1.0
    return Sun(direction, view)


class TownRenderer:
    """The town around one drive: standing triangles and their shadows once, what moves per instant."""

    def __init__(
        self, scenery: Scenery, drive: TownDrive, sun_azimuth: float, sun_elevation: float, sky_seed: int
    ) -> None:
        middle = drive.ego[len(drive.ego) // 2, :2]
        mesh = scenery.mesh
        centre = mesh.vertices[..., :2].mean(axis=1)
        radius = np.abs(mesh.vertices[..., :2] - centre[:, None]).max(axis=(1, 2))
        near = np.hypot(*(centre - middle).T) - 1.5 * radius < STANDING_RANGE_M
        near |= mesh.material == TREELINE
        self._scenery, self._drive = scenery, drive
        shadow = np.full((SHADOW_SIZE, SHADOW_SIZE), -1e9, np.float32)
        standing, sun = Mesh(*(field[near] for field in mesh)), sun_over(middle, sun_azimuth, sun_elevation)
        self._standing = LitScene(standing, shadow, sun, scenery.marks, sky_seed)
        cast_shadows(shadow, standing, sun)

    def scene_at(self, step: int) -> LitScene:
        """The scene at a step of the drive."""
        drive = self._drive
        return self.scene_among(drive.tracks, step, drive.ego[step, :2], float(drive.times_s[step]))

    def scene_among(self, tracks: Sequence[TownTrack], step: int, around: Array, time_s: float) -> LitScene:
        """The scene with these tracks where they are at a step, those near a place (2,), and the lights of a time."""
        moving = [
            track_mesh(track, step)
            for track in tracks
            if np.hypot(*(track.poses[step, :2] - around)) < MOVING_RANGE_M  # false where absent (NaN)
        ]
        for lamps, group in zip(self._scenery.lamps, self._scenery.lamp_groups, strict=True):
            moving.append(lamps_lit(lamps, self._drive.signals.state(int(group), time_s)))
        actors, standing = merged(moving), self._standing
        shadow = standing.shadow.copy()
        cast_shadows(shadow, actors, standing.sun)
        return standing._replace(mesh=merged([standing.mesh, actors]), shadow=shadow)


def cast_shadows(shadow: F32, mesh: Mesh, sun: Sun) -> None:
    """Puts the mesh into the sun's depth map."""
    rasterise(mesh, sun.projection, shadow, np.zeros(shadow.shape, np.int32))


def camera_view(intrinsics: Array, world_from_camera: Array) -> tuple[Array, Array]:
    """(view (4, 4) for rasterise, rays (3, 3): image point (x, y, 1) -> world direction of depth 1)."""
    view = np.zeros((4, 4))
    view[:3] = intrinsics @ np.linalg.inv(world_from_camera)[:3]
    view[3, 3] = 1.0  # key = 1 / w
    return view, world_from_camera[:3, :3] @ np.linalg.inv(intrinsics)


def rasterise_view(scene: LitScene, view: Array, width: int, height: int) -> tuple[ShortInts, Array]:
    """Which triangle is visible in each of height x width samples, -1: none; the triangles' planes (T, 9)."""
    ids = np.full((height, width), -1, np.int32)
    return ids, rasterise(scene.mesh, view, np.zeros((height, width), np.float32), ids)


def paint(scene: LitScene, camera: Camera, world_from_ego: Array) -> Bytes:
    """(H, W, 3) RGB picture of the scene by a camera of the ego at `world_from_ego` (4, 4)."""
    per_pixel, margin = CELLS * SAMPLES, SAMPLES  # of one cell: what the optics reach beyond the picture's edge
    scale = np.array([[per_pixel, 0.0, margin], [0.0, per_pixel, margin], [0.0, 0.0, 1.0]])
    world_from_camera = world_from_ego @ camera.ego_from_camera
    view, rays = camera_view(scale @ camera.intrinsics, world_from_camera)
    height, width = CELLS * camera.height + 2, CELLS * camera.width + 2
    ids, planes = rasterise_view(scene, view, SAMPLES * width, SAMPLES * height)
    cells = shade(scene, ids, planes, np.ascontiguousarray(world_from_camera[:3, 3]), rays)  # (2 H + 2, 2 W + 2, 3)
    n_rows, n_columns = len(cells) - 3, cells.shape[1] - 3
    rows = np.sum([weight * cells[k : n_rows + k : CELLS] for k, weight in enumerate(OPTICS)], axis=0)
    both = np.sum([weight * rows[:, k : n_columns + k : CELLS] for k, weight in enumerate(OPTICS)], axis=0)
    return np.asarray(np.rint(both), np.uint8)


# The sensors of the synthetic ego: a ring of eight pinhole cameras without distortion, and a spinning lidar.
#
# The lidar sees the triangles the cameras see, through the same rasteriser. Four views of 90 degrees around the
# sensor tell each beam which triangle it meets; where it meets that triangle's plane is exact. All beams of a sweep
# fire at the stamp, so the points need no motion compensation.

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


def scan_lidar(scene: LitScene, world_from_ego: Array, beams: int, azimuths: int) -> LidarReturns:
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
        ids, planes = rasterise_view(scene, view, width, height)
        hit = ids[np.clip(y.astype(int), 0, height - 1), np.clip(x.astype(int), 0, width - 1)]
        plane = planes[np.maximum(hit, 0)]
        inverse_depth = plane[:, 0] * x + plane[:, 1] * y + plane[:, 2]
        met = (hit >= 0) & (inverse_depth > 1.0 / (2 * RANGE_M[1]))
        distance[mine[met]] = 1.0 / (inverse_depth[met] * local[met, 2])
        normals = scene.mesh.normals[hit[met]] @ world_from_ego[:3, :3]
        facing = np.abs(np.einsum("ij,ij->i", normals, direction[mine[met]]))
        reflected = np.clip(scene.mesh.colour[hit[met]].mean(axis=1), 0.05, 0.6)
        for material, value in _REFLECTANCE.items():
            reflected[scene.mesh.material[hit[met]] == material] = value
        intensity[mine[met]] = reflected * (0.35 + 0.65 * facing)
    keep = np.flatnonzero((distance > RANGE_M[0]) & (distance < RANGE_M[1]))  # false for NaN
    return LidarReturns(
        (MOUNT_M + direction[keep] * distance[keep, None]).astype(np.float32),
        np.clip(intensity[keep] * 255, 0, 255).astype(np.uint8),
        laser[keep].astype(np.uint8),
        (shot[keep] * (100_000_000 // azimuths)).astype(np.int32),
    )

"""Draws the town: rasterise, shade what is visible in each half pixel, and blur as a lens does.

Textures live in surface coordinates and the sun's shadows in a depth map, so a place looks the same from everywhere.
Nothing finer than a pixel may be left in a picture: it would shimmer from photo to photo, and no scene that is learned
from photos could tell how. One shading per pixel differs by 30 to 36 dB from the picture with 64, four by 35 to 40.
"""

from dataclasses import dataclass

import numpy as np

from factory.readers.town.drive import Drive
from factory.readers.town.figures import figure
from factory.readers.town.mesh import Mesh, merged
from factory.readers.town.raster import rasterise
from factory.readers.town.scenery import Scenery, lamps_lit
from factory.readers.town.shade import shade
from factory.readers.town.textures import TREELINE
from tasks.world.arrays import F32, Array, Bytes, ShortInts
from tasks.world.camera import Camera

CELLS = 2  # shaded places per pixel and axis
SAMPLES = 2  # per cell and axis, of what is visible
OPTICS = (0.125, 0.375, 0.375, 0.125)  # weights of the cells in a pixel and one beside it: 0.46 pixels of blur
SHADOW_TEXEL_M = 0.2
SHADOW_SIZE = 1500  # texels: 300 m around the drive
STANDING_RANGE_M = 330.0  # of the drive's middle
MOVING_RANGE_M = 120.0  # of the ego
NO_PLANES = np.zeros((0, 9))


@dataclass(frozen=True)
class Sun:
    """Direction and the orthographic view from it, in which `key` is height towards the sun."""

    direction: Array  # (3,) unit, towards the sun
    view: Array  # (4, 4)


def sun_over(middle: Array, azimuth: float, elevation: float) -> Sun:
    """The sun at azimuth and elevation [rad] for shadows around `middle` (2,)."""
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    direction = np.cos(elevation) * flat + np.array([0.0, 0.0, np.sin(elevation)])
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    up = np.cross(direction, right)
    view = np.zeros((4, 4))
    view[0, :3], view[1, :3] = right / SHADOW_TEXEL_M, up / SHADOW_TEXEL_M
    view[3, :3] = direction
    centre = np.array([middle[0], middle[1], 0.0])
    view[:, 3] = -view[:, :3] @ centre
    view[:2, 3] += SHADOW_SIZE / 2
    view[2, 3] = 1.0
    return Sun(direction, view)


@dataclass(frozen=True)
class Stage:
    """One instant of a drive, ready to be seen: all triangles and the sun's depth map."""

    mesh: Mesh
    shadow: F32
    sun: Sun
    marks: Array
    sky_seed: int


@dataclass(frozen=True)
class Visible:
    """What the rasteriser found."""

    keys: F32  # (H, W) 1 / depth, 0: nothing
    ids: ShortInts  # (H, W) triangle, -1: nothing
    planes: Array  # (T, 9)


class Theatre:
    """The town around one drive: standing triangles and their shadows once, what moves per instant."""

    def __init__(self, scenery: Scenery, drive: Drive, sun_azimuth: float, sun_elevation: float, sky_seed: int) -> None:
        middle = drive.ego[len(drive.ego) // 2, :2]
        mesh = scenery.mesh
        centre = mesh.vertices[..., :2].mean(axis=1)
        radius = np.abs(mesh.vertices[..., :2] - centre[:, None]).max(axis=(1, 2))
        near = np.hypot(*(centre - middle).T) - 1.5 * radius < STANDING_RANGE_M
        near |= mesh.material == TREELINE
        self._standing = Mesh(*(getattr(mesh, f)[near] for f in mesh.__dataclass_fields__))
        self._scenery, self._drive, self._sky_seed = scenery, drive, sky_seed
        self._sun = sun_over(middle, sun_azimuth, sun_elevation)
        self._shadow = np.full((SHADOW_SIZE, SHADOW_SIZE), -1e9, np.float32)
        _cast(self._shadow, self._standing, self._sun)

    def at(self, step: int) -> Stage:
        """The scene at a step of the drive."""
        ego = self._drive.ego[step, :2]
        moving = [
            figure(track, step)
            for track in self._drive.tracks
            if np.hypot(*(track.poses[step, :2] - ego)) < MOVING_RANGE_M  # false where absent (NaN)
        ]
        time = float(self._drive.times_s[step])
        for lamps, group in zip(self._scenery.lamps, self._scenery.lamp_groups, strict=True):
            moving.append(lamps_lit(lamps, self._drive.signals.state(int(group), time)))
        actors = merged(moving)
        shadow = self._shadow.copy()
        _cast(shadow, actors, self._sun)
        return Stage(merged([self._standing, actors]), shadow, self._sun, self._scenery.marks, self._sky_seed)


def _cast(shadow: F32, mesh: Mesh, sun: Sun) -> None:
    ids = np.zeros(shadow.shape, np.int32)
    rasterise(mesh.vertices, mesh.uv, mesh.material, mesh.seed, sun.view, 0, shadow, ids, NO_PLANES)


def camera_view(intrinsics: Array, world_from_camera: Array) -> tuple[Array, Array]:
    """(view (4, 4) for rasterise, rays (3, 3): image point (x, y, 1) -> world direction of depth 1)."""
    world_to_camera = np.linalg.inv(world_from_camera)
    view = np.zeros((4, 4))
    view[:3] = intrinsics @ world_to_camera[:3]
    view[3, 3] = 1.0  # key = 1 / w
    return view, world_from_camera[:3, :3] @ np.linalg.inv(intrinsics)


def look(stage: Stage, view: Array, width: int, height: int) -> Visible:
    """What is visible in each of height x width samples."""
    mesh = stage.mesh
    keys, ids = np.zeros((height, width), np.float32), np.full((height, width), -1, np.int32)
    planes = np.zeros((len(mesh), 9))
    rasterise(mesh.vertices, mesh.uv, mesh.material, mesh.seed, view, 0, keys, ids, planes)
    return Visible(keys, ids, planes)


def paint(stage: Stage, camera: Camera, world_from_ego: Array) -> Bytes:
    """(H, W, 3) RGB picture of the stage by a camera of the ego at `world_from_ego` (4, 4)."""
    per_pixel, margin = CELLS * SAMPLES, SAMPLES  # of one cell: what the optics reach beyond the picture's edge
    scale = np.array([[per_pixel, 0.0, margin], [0.0, per_pixel, margin], [0.0, 0.0, 1.0]])
    world_from_camera = world_from_ego @ camera.ego_from_camera
    view, rays = camera_view(scale @ camera.intrinsics, world_from_camera)
    cells = np.empty((CELLS * camera.height + 2, CELLS * camera.width + 2, 3), np.float32)
    seen = look(stage, view, SAMPLES * cells.shape[1], SAMPLES * cells.shape[0])
    mesh = stage.mesh
    shade(
        seen.ids,
        seen.planes,
        mesh.normals,
        mesh.material,
        mesh.colour,
        mesh.extent,
        mesh.seed,
        stage.marks,
        np.ascontiguousarray(world_from_camera[:3, 3]),
        np.ascontiguousarray(rays),
        stage.sun.direction,
        stage.sun.view,
        stage.shadow,
        stage.sky_seed,
        cells,
    )
    return _through_optics(cells)


def _through_optics(cells: F32) -> Bytes:
    """(H, W, 3) of cells (2 H + 2, 2 W + 2, 3) in [0, 255]."""
    n_rows, n_columns = len(cells) - 3, cells.shape[1] - 3
    rows = np.sum([weight * cells[k : n_rows + k : CELLS] for k, weight in enumerate(OPTICS)], axis=0)
    both = np.sum([weight * rows[:, k : n_columns + k : CELLS] for k, weight in enumerate(OPTICS)], axis=0)
    return np.asarray(np.rint(both), np.uint8)

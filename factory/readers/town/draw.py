"""Draws the town: rasterise, shade what is visible in each half pixel, and blur as a lens does.

Textures live in surface coordinates and the sun's shadows in a depth map, so a place looks the same from everywhere.
Nothing finer than a pixel may be left in a picture: it would shimmer from photo to photo, and no scene that is learned
from photos could tell how. One shading per pixel differs by 30 to 36 dB from the picture with 64, four by 35 to 40.
"""

from collections.abc import Sequence

import numpy as np

from factory.readers.town.drive import TownDrive
from factory.readers.town.figures import figure
from factory.readers.town.mesh import merged
from factory.readers.town.raster import Mesh, rasterise
from factory.readers.town.scenery import Scenery, lamps_lit
from factory.readers.town.shade import LitScene, Sun, shade
from factory.readers.town.textures import TREELINE
from factory.readers.town.traffic import TownTrack
from tasks.world.arrays import F32, Array, Bytes, ShortInts
from tasks.world.camera import Camera

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


class Theatre:
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
        cast(shadow, standing, sun)

    def at(self, step: int) -> LitScene:
        """The scene at a step of the drive."""
        drive = self._drive
        return self.among(drive.tracks, step, drive.ego[step, :2], float(drive.times_s[step]))

    def among(self, tracks: Sequence[TownTrack], step: int, around: Array, time_s: float) -> LitScene:
        """The scene with these tracks where they are at a step, those near a place (2,), and the lights of a time."""
        moving = [
            figure(track, step)
            for track in tracks
            if np.hypot(*(track.poses[step, :2] - around)) < MOVING_RANGE_M  # false where absent (NaN)
        ]
        for lamps, group in zip(self._scenery.lamps, self._scenery.lamp_groups, strict=True):
            moving.append(lamps_lit(lamps, self._drive.signals.state(int(group), time_s)))
        actors, standing = merged(moving), self._standing
        shadow = standing.shadow.copy()
        cast(shadow, actors, standing.sun)
        return standing._replace(mesh=merged([standing.mesh, actors]), shadow=shadow)


def cast(shadow: F32, mesh: Mesh, sun: Sun) -> None:
    """Puts the mesh into the sun's depth map."""
    rasterise(mesh, sun.projection, shadow, np.zeros(shadow.shape, np.int32))


def camera_view(intrinsics: Array, world_from_camera: Array) -> tuple[Array, Array]:
    """(view (4, 4) for rasterise, rays (3, 3): image point (x, y, 1) -> world direction of depth 1)."""
    view = np.zeros((4, 4))
    view[:3] = intrinsics @ np.linalg.inv(world_from_camera)[:3]
    view[3, 3] = 1.0  # key = 1 / w
    return view, world_from_camera[:3, :3] @ np.linalg.inv(intrinsics)


def look(scene: LitScene, view: Array, width: int, height: int) -> tuple[ShortInts, Array]:
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
    ids, planes = look(scene, view, SAMPLES * width, SAMPLES * height)
    return _through_optics(shade(scene, ids, planes, np.ascontiguousarray(world_from_camera[:3, 3]), rays))


def _through_optics(cells: F32) -> Bytes:
    """(H, W, 3) of cells (2 H + 2, 2 W + 2, 3) in [0, 255]."""
    n_rows, n_columns = len(cells) - 3, cells.shape[1] - 3
    rows = np.sum([weight * cells[k : n_rows + k : CELLS] for k, weight in enumerate(OPTICS)], axis=0)
    both = np.sum([weight * rows[:, k : n_columns + k : CELLS] for k, weight in enumerate(OPTICS)], axis=0)
    return np.asarray(np.rint(both), np.uint8)

"""The body of a vehicle as far as its box tells: where it drives through photos, and what none of them shows of it.

Photos of one instant hardly overlap, and at the next a vehicle that drives is elsewhere: what a sweep over them finds
of it lies anywhere, most of it outside its box, where it would be taken for the street.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from tasks.kernels.compiled import kernel
from tasks.render.scene.depth import SHALLOW, STREET, PhotoDepth
from tasks.render.scene.sensed import Photo, Tracks
from tasks.render.scene.sky import pixel_directions
from tasks.render.splatting.gaussians import Gaussians
from tasks.world.arrays import Array, Bools
from tasks.world.clip import AgentKind

SPACING_M = 0.3
SIGMA_M = 0.17  # of a Gaussian along its face
THICKNESS_M = 0.02
FAR_M = 0.3  # from all that was seen: there it begins
OPACITY = 0.95
# Shares of half the box, from its centre: length, width, bottom, top.
LOWER, CABIN, TALL = (0.94, 0.92, -0.65, 0.1), (0.5, 0.8, 0.1, 0.88), (0.95, 0.95, -0.65, 0.95)
TALL_M = 2.2  # vehicles at least this high have no bonnet
REACH_M = 40.0  # farther off boxes are not drawn as well as that
BEFORE_M = 1.0  # what two photos saw so much nearer stands before the vehicle


def with_body_depths(photos: Sequence[Photo], seen: Sequence[PhotoDepth], tracks: Tracks) -> list[PhotoDepth]:
    """The same, pixels that look at a vehicle which drives at the depth of its body.

    Not those that look at a parked one before it, at what other photos confirmed to stand there (`label_confirmed`), or
    at the own body.
    """
    return [_with_body_depth(photo, sight, tracks) for photo, sight in zip(photos, seen)]


def _with_body_depth(photo: Photo, sight: PhotoDepth, tracks: Tracks) -> PhotoDepth:
    eye = np.ascontiguousarray(photo.world_from_camera[:3, 3])
    bodies, driving = bodies_near(*tracks.at(photo.time_s), tracks, eye)
    if not driving.any():
        return sight
    height, width = sight.depth.shape
    rays = pixel_directions(photo.intrinsics, photo.world_from_camera, width, height).reshape(-1, 3)
    depth, first = nearest_box_along_rays(rays, eye, bodies)
    drives = (first >= 0) & driving[first]
    depth, drives = depth.reshape(height, width), drives.reshape(height, width)
    hidden = (sight.label == STREET) & (sight.depth > 0.0) & (sight.depth < depth - BEFORE_M)
    put = drives & ~hidden
    if photo.own_body is not None:
        put &= ~photo.own_body
    return replace(
        sight,
        depth=np.where(put, depth, sight.depth).astype(np.float32),
        label=np.where(put, np.int32(SHALLOW), sight.label),
        sky=sight.sky & ~put,
    )


def bodies_near(boxes: Array, valid: Bools, tracks: Tracks, eye: Array) -> tuple[Array, Bools]:
    """Bodies (M, 7) of the vehicles among the tracks' `boxes` (N, 7), those that are `valid` (N,) and within REACH_M of
    an eye (3,); and which of them (M,) are of one that drives."""
    vehicles = np.array([kind == AgentKind.VEHICLE for kind in tracks.kinds], bool)
    away = np.linalg.norm(boxes[:, :2] - eye[:2], axis=1)
    found = [(j, part) for j in np.flatnonzero(valid & vehicles & (away < REACH_M)) for part in body_boxes(boxes[j])]
    bodies = np.array([part for _, part in found]).reshape(-1, 7)
    return bodies, tracks.driving[[j for j, _ in found]]


def body_boxes(box: Array) -> list[Array]:
    """Boxes (7,) that make the body of the vehicle in a box (7,): bonnet and cabin, or one where it is tall."""
    out = []
    for length, width, low, high in _shares(box[6]):
        part = box.copy()
        part[2] += box[6] * (low + high) / 4.0
        part[4:7] *= length, width, (high - low) / 2.0
        out.append(part)
    return out


@kernel
def nearest_box_along_rays(rays: Any, eye: Any, boxes: Any) -> Any:
    """How many lengths of rays (M, 3) from `eye` (3,) the first of boxes (N, 7) is away (M,), and which it is (M,).

    Infinite, and -1, where a ray meets none. A box around the eye is not met.
    """
    along, which = np.full(rays.shape[0], np.inf), np.full(rays.shape[0], -1, np.int64)
    for j in range(boxes.shape[0]):
        cosine, sine = np.cos(boxes[j, 3]), np.sin(boxes[j, 3])
        ex, ey, ez = eye[0] - boxes[j, 0], eye[1] - boxes[j, 1], eye[2] - boxes[j, 2]
        start = (cosine * ex + sine * ey, cosine * ey - sine * ex, ez)
        reach = 0.25 * (boxes[j, 4] ** 2 + boxes[j, 5] ** 2 + boxes[j, 6] ** 2)
        beyond = ex * ex + ey * ey + ez * ez - reach
        for i in range(rays.shape[0]):
            dx, dy, dz = rays[i, 0], rays[i, 1], rays[i, 2]
            towards = ex * dx + ey * dy + ez * dz
            if towards > 0.0 or beyond * (dx * dx + dy * dy + dz * dz) > towards * towards:
                continue  # most rays miss the ball around most boxes
            step = (cosine * dx + sine * dy, cosine * dy - sine * dx, dz)
            enter, leave = 0.0, np.inf
            for axis in range(3):
                half = 0.5 * boxes[j, 4 + axis]
                if abs(step[axis]) < 1e-12:
                    if abs(start[axis]) > half:
                        leave = -1.0
                    continue
                a, b = (-half - start[axis]) / step[axis], (half - start[axis]) / step[axis]
                enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
            if 0.0 < enter <= leave and enter < along[i]:
                along[i], which[i] = enter, j
    return along, which


# What stands before, or behind, the body of a vehicle that drives, as a photo shows it.

NEAREST_M = 0.3  # to a camera


@dataclass(frozen=True)
class BodyView:
    """A photo's view of bodies, in one frame."""

    scene_from_camera: Array  # (4, 4)
    intrinsics: Array  # (3, 3)
    height: int
    width: int
    bodies: Array  # (B, 7)
    drives: Bools  # (B,) of a vehicle that does

    @property
    def eye(self) -> Array:
        """Where the camera is (3,)."""
        return np.ascontiguousarray(self.scene_from_camera[:3, 3])

    @property
    def camera_from_scene(self) -> Array:
        """(4, 4)"""
        return np.asarray(np.linalg.inv(self.scene_from_camera), np.float64)


def distance_before_bodies(points: Array, view: BodyView) -> tuple[Array, Array]:
    """How far [m] points (M, 3) stand before the body of a vehicle that drives, and their depths [m]; (M,) each.

    Negative: behind it; NaN where the photo shows no such body in the point's place.
    """
    camera = view.camera_from_scene, view.intrinsics, view.height, view.width
    before_m, depth_m = _distance_before(points, *camera, view.eye, view.bodies, view.drives)
    return before_m, depth_m


@kernel
def project_points(points: Any, camera_from_scene: Any, k: Any, height: int, width: int) -> Any:
    """Which pixel of a camera (4, 4) with intrinsics (3, 3) shows each of `points` (M, 3), row by row, -1 where none
    does; and their depths [m]."""
    pixel, depth = np.full(points.shape[0], -1, np.int64), np.zeros(points.shape[0])
    m = camera_from_scene
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth[i] = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if depth[i] <= NEAREST_M:
            continue
        u = k[0, 0] * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth[i] + k[0, 2]
        v = k[1, 1] * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth[i] + k[1, 2]
        if 0.0 <= u < width and 0.0 <= v < height:
            pixel[i] = int(v) * width + int(u)
    return pixel, depth


@kernel
def _distance_before(
    points: Any, camera_from_scene: Any, k: Any, height: int, width: int, eye: Any, bodies: Any, drives: Any
) -> Any:
    pixel, depth_m = project_points(points, camera_from_scene, k, height, width)
    rows = np.flatnonzero(pixel >= 0)
    rays = np.empty((len(rows), 3))
    for n, i in enumerate(rows):
        for axis in range(3):
            rays[n, axis] = points[i, axis] - eye[axis]
    _, driving = nearest_box_along_rays(rays, eye, bodies[drives])  # most bodies stand, and most rays meet none
    rows, rays = rows[driving >= 0], rays[driving >= 0]
    along, first = nearest_box_along_rays(rays, eye, bodies)
    before_m = np.full(points.shape[0], np.nan)
    for n, i in enumerate(rows):
        if first[n] >= 0 and drives[first[n]]:
            x, y, z = rays[n, 0], rays[n, 1], rays[n, 2]
            before_m[i] = (along[n] - 1.0) * np.sqrt(x * x + y * y + z * z)
    return before_m, depth_m


def unseen_body_gaussians(seen: Gaussians, size: Array) -> Gaussians:
    """What no photo shows of a vehicle, so that it is not hollow: Gaussians (M,) in the frame of its box of `size` (3,)
    [m], coloured like the nearest of what was seen.

    Where a photo does show the place, the fit takes away what is wrong; what none shows stays.
    """
    parts = [_faces(np.asarray(size) / 2.0, shares) for shares in _shares(size[2])]
    points, scales = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    distance, nearest = cKDTree(seen.means).query(points)
    far = distance > FAR_M
    n = int(far.sum())
    return Gaussians(
        points[far].astype(np.float32),
        np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (n, 1)),
        np.log(scales[far]).astype(np.float32),
        np.full(n, OPACITY, np.float32),
        seen.colours[nearest[far]],
    )


def _shares(height_m: float) -> tuple[tuple[float, float, float, float], ...]:
    return (TALL,) if height_m >= TALL_M else (LOWER, CABIN)


def _faces(half: Array, shares: tuple[float, float, float, float]) -> tuple[Array, Array]:
    """Points (M, 3) and scales (M, 3) [m] on four sides and the top."""
    x, y, low, high = half[0] * shares[0], half[1] * shares[1], half[2] * shares[2], half[2] * shares[3]
    along, across, up = _spaced(-x, x), _spaced(-y, y), _spaced(low, high)
    points, scales = [], []
    for axis, at, grids in (
        (0, (-x, x), (None, across, up)),
        (1, (-y, y), (along, None, up)),
        (2, (high,), (along, across, None)),
    ):
        for value in at:
            grid = np.meshgrid(*(np.array([value]) if g is None else g for g in grids), indexing="ij")
            points.append(np.stack(grid, axis=-1).reshape(-1, 3))
            flat = np.full(3, SIGMA_M)
            flat[axis] = THICKNESS_M
            scales.append(np.tile(flat, (len(points[-1]), 1)))
    return np.concatenate(points), np.concatenate(scales)


def _spaced(first: float, last: float) -> Array:
    return np.linspace(first, last, max(2, round((last - first) / SPACING_M) + 1))

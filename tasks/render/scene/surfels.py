"""Photos with depth to flat Gaussians: one disc per pixel, or per block of pixels where the photo is plain."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tasks.kernels.compiled import kernel
from tasks.render.scene.sky import camera_rays
from tasks.render.splatting.gaussians import Gaussians, quats_of
from tasks.world.arrays import F32, Array, Bools, Indices, ShortInts
from tasks.world.clip import AgentKind

SIGMA_PER_PIXEL = 0.5  # standard deviation of a disc in units of its spacing on the surface (measured: .45 .. .55)
FLATNESS = 0.1  # thickness as a share of the short side
OPACITY = 0.8  # several discs overlap everywhere; measured .7 .. .95: less is better where photos were, more beside
MAX_ELONGATION = 8.0  # a disc on the road far ahead is that much longer than wide at most
BEND = 0.02  # change of slope of the inverse depth, as a share of it, up to which pixels lie on one surface
STEEP = 1.3  # neighbouring pixels whose depths differ by more do not share a surface
PLAIN = 0.07  # rgb range of a block that one disc stands for
BLOCKS = (4, 2)  # pixels


@dataclass(frozen=True)
class Discs:
    """M discs, all in one frame."""

    points: Array  # (M, 3) [m]
    across: F32  # (M, 3) from one disc to the next along the photo's rows [m]
    down: F32  # (M, 3) the same along its columns
    rgb: F32  # (M, 3) in [0, 1]
    spacing: F32  # (M,) size of the photo's pixel at the disc's depth [m]: how closely it was looked at
    pixels: ShortInts  # (M, 2) row and column in its photo

    def take(self, rows: Bools | Indices) -> "Discs":
        return Discs(*(getattr(self, field.name)[rows] for field in fields(self)))

    def mirrored(self) -> "Discs":
        """Reflected at y = 0."""
        flip = np.array([1.0, -1.0, 1.0])
        across, down = (self.across * flip).astype(np.float32), (self.down * flip).astype(np.float32)
        return Discs(self.points * flip, across, down, self.rgb, self.spacing, self.pixels)

    def moved(self, target_from_source: Array) -> "Discs":
        """In another frame; (4, 4) rigid."""
        r, t = target_from_source[:3, :3], target_from_source[:3, 3]
        across, down = (self.across @ r.T).astype(np.float32), (self.down @ r.T).astype(np.float32)
        return Discs(self.points @ r.T + t, across, down, self.rgb, self.spacing, self.pixels)


def concatenate_discs(parts: list[Discs]) -> Discs:
    """All parts in order; at least one."""
    return Discs(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Discs)))


def discs_of_photo(rgb: F32, depth: F32, label: ShortInts, intrinsics: Array, world_from_camera: Array) -> Discs:
    """Discs in the world, for every pixel with depth: blocks where colour, label and depth allow, else single pixels.

    `rgb` (H, W, 3) from 0 on, `depth` (H, W) [m] along the optical axis (0: none), `label` (H, W).
    """
    height, width = depth.shape
    points = camera_rays(intrinsics, width, height) * depth[..., None].astype(np.float64)
    across = _tangents(points, depth, 1, np.array([1.0 / intrinsics[0, 0], 0.0, 0.0]))
    down = _tangents(points, depth, 0, np.array([0.0, 1.0 / intrinsics[1, 1], 0.0]))
    free = depth > 0
    rotation = world_from_camera[:3, :3]
    parts = []
    for size in (*BLOCKS, 1):
        rows, columns = _blocks(rgb, depth, label, free, size)
        for dy in range(size):
            for dx in range(size):
                free[rows + dy, columns + dx] = False
        cells = [(rows + dy, columns + dx) for dy in range(size) for dx in range(size)]
        middle = (rows + size // 2, columns + size // 2)
        mean_point, mean_across, mean_down, mean_rgb = (_mean_of(cells, image) for image in (points, across, down, rgb))
        parts.append(
            Discs(
                mean_point @ rotation.T + world_from_camera[:3, 3],
                ((mean_across * size) @ rotation.T).astype(np.float32),
                ((mean_down * size) @ rotation.T).astype(np.float32),
                mean_rgb.astype(np.float32),
                (depth[middle] / intrinsics[0, 0]).astype(np.float32),
                np.stack(middle, axis=1).astype(np.int32),
            )
        )
    return concatenate_discs(parts)


def _mean_of(cells: Sequence[tuple[Indices, Indices]], image: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(reduce(np.add, (image[cell] for cell in cells)) / len(cells))


def _blocks(rgb: F32, depth: F32, label: ShortInts, free: Bools, size: int) -> tuple[Indices, Indices]:
    """Upper left pixels (rows, columns) of the blocks of size x size that are plain, free and on one surface."""
    if size == 1:
        rows, columns = np.nonzero(free)
        return rows, columns
    height, width = depth.shape[0] // size, depth.shape[1] // size

    def over_blocks(merge: Callable[[Any, Any], Any], image: NDArray[Any]) -> NDArray[Any]:
        pixels = (image[k // size : height * size : size, k % size : width * size : size] for k in range(size * size))
        return reduce(merge, pixels)

    inverse = 1.0 / np.maximum(depth, 1e-3)
    corner = inverse[: height * size, : width * size]
    bend = corner[::size, ::size] + corner[size - 1 :: size, size - 1 :: size]
    bend = bend - corner[::size, size - 1 :: size] - corner[size - 1 :: size, ::size]
    mean = over_blocks(np.add, inverse) / size**2
    plain = (over_blocks(np.maximum, rgb) - over_blocks(np.minimum, rgb)).max(axis=-1) < PLAIN
    across_edge = over_blocks(np.maximum, depth) > STEEP * over_blocks(np.minimum, depth)
    same = over_blocks(np.maximum, label) == over_blocks(np.minimum, label)
    good = plain & same & ~across_edge & (np.abs(bend) < BEND * mean) & over_blocks(np.logical_and, free)
    rows, columns = np.nonzero(good)
    return rows * size, columns * size


def _tangents(points: Array, depth: F32, axis: int, flat: Array) -> Array:
    """Steps on the surface from pixel to pixel along an image axis; facing the camera where there is no plane."""
    inverse = 1.0 / np.maximum(depth, 1e-3).astype(np.float64)
    before, after = np.roll(inverse, 1, axis), np.roll(inverse, -1, axis)
    known = (depth > 0) & (np.roll(depth, 1, axis) > 0) & (np.roll(depth, -1, axis) > 0)
    straight = np.abs(before + after - 2.0 * inverse) < BEND * inverse
    flat_enough = (np.maximum(before, after) < STEEP * inverse) & (np.minimum(before, after) > inverse / STEEP)
    smooth = known & straight & flat_enough
    border = [slice(None), slice(None)]
    for end in (slice(0, 1), slice(-1, None)):
        border[axis] = end
        smooth[tuple(border)] = False
    mean = 0.5 * (np.roll(points, -1, axis) - np.roll(points, 1, axis))
    facing = flat * depth[..., None]
    step = np.where(smooth[..., None], mean, facing)
    length, shortest = np.sqrt(np.einsum("hwc,hwc->hw", step, step)), np.linalg.norm(flat) * depth
    return np.asarray(step * (np.minimum(length, MAX_ELONGATION * shortest) / np.maximum(length, 1e-9))[..., None])


def discs_to_gaussians(discs: Discs) -> Gaussians:
    """Flat Gaussians that spread over each disc."""
    across, down = discs.across.astype(np.float64), discs.down.astype(np.float64)
    # Principal axes of across across^T + down down^T in its own plane.
    e1 = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    rest = down - np.sum(down * e1, axis=1, keepdims=True) * e1
    length = np.linalg.norm(rest, axis=1, keepdims=True)
    spare = np.where(np.abs(e1[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    spare = np.cross(e1, spare)
    e2 = np.where(length > 1e-6, rest / np.maximum(length, 1e-9), spare / np.linalg.norm(spare, axis=1, keepdims=True))
    xx = np.sum(across**2, axis=1) + np.sum(down * e1, axis=1) ** 2
    xy = np.sum(down * e1, axis=1) * np.sum(down * e2, axis=1)
    yy = np.sum(down * e2, axis=1) ** 2
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    first, second = c * e1 + s * e2, c * e2 - s * e1
    spread = np.hypot(0.5 * (xx - yy), xy)
    major = np.sqrt(np.maximum(0.5 * (xx + yy) + spread, 1e-8))
    minor = np.sqrt(np.maximum(0.5 * (xx + yy) - spread, 1e-8))
    minor = np.maximum(minor, 0.15 * major)
    axes = np.stack([first, second, np.cross(first, second)], axis=-1)
    scales = SIGMA_PER_PIXEL * np.stack([major, minor, FLATNESS * minor], axis=1)
    return Gaussians(
        discs.points.astype(np.float32),
        quats_of(axes).astype(np.float32),
        np.log(scales).astype(np.float32),
        np.full(len(discs.points), OPACITY, np.float32),
        discs.rgb.astype(np.float32),
    )


# A plain shaded box made of Gaussians, for an agent nobody took a good photo of.

SPACING_M = 0.15
BODY = {
    AgentKind.VEHICLE: (0.50, 0.52, 0.55),
    AgentKind.PEDESTRIAN: (0.35, 0.30, 0.30),
    AgentKind.BICYCLE: (0.30, 0.33, 0.38),
    AgentKind.TRAFFIC_CONE: (0.90, 0.45, 0.10),
}
OTHER = (0.6, 0.6, 0.6)
# Face normal -> how much light it gets: an overcast day.
SHADE = {(0, 0, 1): 1.0, (1, 0, 0): 0.8, (-1, 0, 0): 0.7, (0, 1, 0): 0.75, (0, -1, 0): 0.65}


def box_gaussians(size: Array, kind: AgentKind) -> Gaussians:
    """Five faces (the underside is never seen) of a box (3,) length, width, height [m], in box coordinates.

    Neutral colours, lit from above; vehicles get a dark band where windows are, so that they read as cars.
    """
    return _box(tuple(float(s) for s in np.round(size, 2)), kind)


@lru_cache(maxsize=256)
def _box(size: tuple[float, float, float], kind: AgentKind) -> Gaussians:
    points, across, down, colours = [], [], [], []
    half = np.array(size) / 2.0
    for normal, light in SHADE.items():
        axis = int(np.argmax(np.abs(normal)))
        first, second = [k for k in range(3) if k != axis]
        n1, n2 = (max(2, int(np.ceil(size[k] / SPACING_M))) for k in (first, second))
        grid1, grid2 = np.meshgrid((np.arange(n1) + 0.5) / n1 - 0.5, (np.arange(n2) + 0.5) / n2 - 0.5)
        face = np.zeros((n1 * n2, 3))
        face[:, first], face[:, second] = grid1.ravel() * size[first], grid2.ravel() * size[second]
        face[:, axis] = normal[axis] * half[axis]
        step1, step2 = np.zeros((len(face), 3)), np.zeros((len(face), 3))
        step1[:, first], step2[:, second] = size[first] / n1, size[second] / n2
        colour = np.tile(np.array(BODY.get(kind, OTHER)) * light, (len(face), 1))
        if kind == AgentKind.VEHICLE and axis != 2:
            height = face[:, 2] / size[2] + 0.5
            colour[(height > 0.55) & (height < 0.88)] *= 0.35
            colour[height < 0.15] *= 0.4
        points.append(face)
        across.append(step1)
        down.append(step2)
        colours.append(colour)
    stacked = np.concatenate(points)
    return discs_to_gaussians(
        Discs(
            stacked,
            np.concatenate(across).astype(np.float32),
            np.concatenate(down).astype(np.float32),
            np.concatenate(colours).astype(np.float32),
            np.full(len(stacked), SPACING_M, np.float32),
            np.zeros((len(stacked), 2), np.int32),
        )
    )


# Which discs to keep: each surface from its closest photo, and every pixel of every photo covered.
#
# Photos are gone through in bands of depth, nearest first. A pixel adds its disc only where no disc kept so far shows
# the same surface about as finely, so that nothing is kept twice and no photo has a hole.

BANDS_M = (8.0, 16.0, 32.0, 64.0)
COARSER = 1.6  # a kept disc may have been seen with pixels that much larger and still do
SAME_DEPTH, SAME_DEPTH_M = 0.08, 0.2  # share of the depth, plus metres, within which two surfaces are one
MOST_PARTS = 12  # places per side that a disc is marked at
UNSEEN_M = 0.15  # a mirrored disc is used where nothing was seen within this distance
BACKGROUND = -1


@dataclass(frozen=True)
class PhotoDiscs:
    """One photo's discs, before choosing."""

    discs: Discs  # in the scene
    owner: ShortInts  # (M,) BACKGROUND or row of a track
    late: Bools  # (M,) depth is a guess: only where nothing better is
    depth: F32  # (H, W)
    intrinsics: Array
    scene_from_camera: Array
    scene_from_box: Mapping[int, Array]  # poses of the tracks that are there


def choose_discs(looks: Sequence[PhotoDiscs]) -> dict[int, Discs]:
    """Kept discs by owner: the background's in the scene, a track's in its box's frame."""
    kept: dict[int, list[Discs]] = {}
    covered = [np.zeros(look.depth.shape, np.bool_) for look in looks]
    held_against = [dict[int, int]() for _ in looks]  # how many of an owner's discs each photo was
    for band in range(len(BANDS_M) + 2):
        for i, look in enumerate(looks):
            depth = look.discs.spacing * look.intrinsics[0, 0]
            mine = np.where(look.late, len(BANDS_M) + 1, np.searchsorted(BANDS_M, depth)) == band
            if not mine.any():
                continue
            for owner, parts in kept.items():
                pose = np.eye(4) if owner == BACKGROUND else look.scene_from_box.get(owner)
                if pose is None:
                    continue
                photo = np.ascontiguousarray(np.linalg.inv(look.scene_from_camera) @ pose), look.intrinsics, look.depth
                first, known = 0, held_against[i].get(owner, 0)
                for part in parts:
                    later = slice(max(known - first, 0), None)
                    disc = part.points[later], part.across[later], part.down[later], part.spacing[later]
                    _mark_covered(*disc, *photo, covered[i])
                    first += len(part.points)
                held_against[i][owner] = first
            rows, columns = look.discs.pixels.T
            new = np.flatnonzero(mine & ~covered[i][rows, columns])
            for owner in np.unique(look.owner[new]):
                part = look.discs.take(new[look.owner[new] == owner])
                if owner != BACKGROUND:
                    part = part.moved(np.linalg.inv(look.scene_from_box[int(owner)]).astype(np.float64))
                _append(kept.setdefault(int(owner), []), part)
    return {owner: concatenate_discs(parts) for owner, parts in sorted(kept.items())}


def _append(parts: list[Discs], part: Discs) -> None:
    """Keeps the parts few and each disc copied few times: a part joins the one before unless that is twice as large."""
    while parts and len(parts[-1].points) < 2 * len(part.points):
        part = concatenate_discs([parts.pop(), part])
    parts.append(part)


def with_mirror_image(discs: Discs) -> Discs:
    """A vehicle's discs and, where its other side was never seen, their reflection."""
    mirror = discs.mirrored()
    distance, _ = cKDTree(discs.points).query(mirror.points)
    return concatenate_discs([discs, mirror.take(np.flatnonzero(distance > UNSEEN_M))])


@kernel
def _mark_covered(
    points: Any,
    across: Any,
    down: Any,
    spacing: Any,
    camera_from_scene: Any,
    k: Any,
    depth: Any,
    covered: Any,
) -> None:
    """Marks the pixels (H, W) whose surface a disc shows about as finely as the photo does."""
    height, width = depth.shape
    r = camera_from_scene
    fx, fy = k[0, 0], k[1, 1]
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
        if z < 0.5 or spacing[i] > COARSER * z / fx:
            continue
        ax, ay, az = float(across[i, 0]), float(across[i, 1]), float(across[i, 2])
        bx, by, bz = float(down[i, 0]), float(down[i, 1]), float(down[i, 2])
        cz, dz = r[2, 0] * ax + r[2, 1] * ay + r[2, 2] * az, r[2, 0] * bx + r[2, 1] * by + r[2, 2] * bz
        x = (r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]) / z
        y = (r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]) / z
        u, v = fx * x + k[0, 2], fy * y + k[1, 2]
        if u < -8.0 or v < -8.0 or u > width + 8.0 or v > height + 8.0:
            continue
        au = fx * (r[0, 0] * ax + r[0, 1] * ay + r[0, 2] * az - x * cz) / z
        av = fy * (r[1, 0] * ax + r[1, 1] * ay + r[1, 2] * az - y * cz) / z
        bu = fx * (r[0, 0] * bx + r[0, 1] * by + r[0, 2] * bz - x * dz) / z
        bv = fy * (r[1, 0] * bx + r[1, 1] * by + r[1, 2] * bz - y * dz) / z
        na = min(MOST_PARTS, int(np.sqrt(au * au + av * av) * 1.5) + 1)
        nb = min(MOST_PARTS, int(np.sqrt(bu * bu + bv * bv) * 1.5) + 1)
        for ia in range(na):
            sa = (ia + 0.5) / na - 0.5
            for ib in range(nb):
                sb = (ib + 0.5) / nb - 0.5
                column, row = int(np.floor(u + sa * au + sb * bu)), int(np.floor(v + sa * av + sb * bv))
                if row < 0 or column < 0 or row >= height or column >= width or covered[row, column]:
                    continue
                here = z + sa * cz + sb * dz
                if abs(here - depth[row, column]) < SAME_DEPTH * here + SAME_DEPTH_M:
                    covered[row, column] = True


@kernel
def count_free_space(points: Any, camera_from_world: Any, k: Any, depth: Any, in_front: Any, agreeing: Any) -> None:
    """Adds to `in_front` (M,) where a photo looks through a point (M, 3), to `agreeing` where it sees it.

    `depth` (H, W) of the photo, 0 = unknown.
    """
    height, width = depth.shape
    r = camera_from_world
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
        if z < 0.5:
            continue
        u = k[0, 0] * (r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]) / z + k[0, 2]
        v = k[1, 1] * (r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]) / z + k[1, 2]
        if u < 0.0 or v < 0.0 or u >= width or v >= height:
            continue
        seen = depth[int(v), int(u)]
        if seen == 0.0:
            continue
        if z < 0.8 * seen:
            in_front[i] += 1
        elif z < 1.1 * seen:
            agreeing[i] += 1

"""Photos with depth to flat Gaussians: one disc per pixel, or per block of pixels where the photo is plain."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tasks.render.scene.sky import camera_rays
from tasks.render.splatting.gaussians import Gaussians, quats_of
from tasks.world.arrays import F32, Array, Bools, Indices, ShortInts

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
        mean_point = np.mean([points[cell] for cell in cells], axis=0)
        mean_across = np.mean([across[cell] for cell in cells], axis=0) * size
        mean_down = np.mean([down[cell] for cell in cells], axis=0) * size
        parts.append(
            Discs(
                mean_point @ rotation.T + world_from_camera[:3, 3],
                (mean_across @ rotation.T).astype(np.float32),
                (mean_down @ rotation.T).astype(np.float32),
                np.mean([rgb[cell] for cell in cells], axis=0).astype(np.float32),
                (depth[middle] / intrinsics[0, 0]).astype(np.float32),
                np.stack(middle, axis=1).astype(np.int32),
            )
        )
    return concatenate_discs(parts)


def _blocks(rgb: F32, depth: F32, label: ShortInts, free: Bools, size: int) -> tuple[Indices, Indices]:
    """Upper left pixels (rows, columns) of the blocks of size x size that are plain, free and on one surface."""
    if size == 1:
        rows, columns = np.nonzero(free)
        return rows, columns
    height, width = depth.shape[0] // size, depth.shape[1] // size

    def tiled(image: NDArray[Any]) -> NDArray[Any]:
        cut = image[: height * size, : width * size]
        return cut.reshape(height, size, width, size, *image.shape[2:]).swapaxes(1, 2)

    colour, z, owner = tiled(rgb), tiled(depth), tiled(label)
    plain = (colour.max(axis=(2, 3)) - colour.min(axis=(2, 3))).max(axis=-1) < PLAIN
    inverse = 1.0 / np.maximum(z, 1e-3)
    bend = inverse[..., 0, 0] + inverse[..., -1, -1] - inverse[..., 0, -1] - inverse[..., -1, 0]
    mean = inverse.mean(axis=(2, 3))
    across_edge = z.max(axis=(2, 3)) > STEEP * z.min(axis=(2, 3))
    same = owner.max(axis=(2, 3)) == owner.min(axis=(2, 3))
    good = plain & same & ~across_edge & (np.abs(bend) < BEND * mean) & tiled(free).all(axis=(2, 3))
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
    length, shortest = np.linalg.norm(step, axis=-1), np.linalg.norm(facing, axis=-1)
    return np.asarray(step * (np.minimum(length, MAX_ELONGATION * shortest) / np.maximum(length, 1e-9))[..., None])


def gaussians_of(discs: Discs) -> Gaussians:
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

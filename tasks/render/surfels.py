"""Photos with depth to flat Gaussians: one disc per pixel, thinned so that the closest look at a surface is kept."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tasks.kernels import kernel
from tasks.render.gaussians import F32, F64, Gaussians, quats_of

SIGMA_PER_PIXEL = 0.5  # standard deviation of a disc in units of the pixel spacing on its surface (measured)
FLATNESS = 0.1  # thickness as a share of the short side
OPACITY = 0.7
MAX_ELONGATION = 8.0  # a disc on the road far ahead is that much longer than wide at most
SMOOTH_RATIO = 1.3  # neighbouring pixels whose depths differ by more do not share a surface
LEVELS = 11  # voxel sides 2^0 .. 2^10 times FINEST_M
FINEST_M = 0.16
COVERED = 0.7  # share of a voxel's face that must be covered before another disc there is superfluous
STRIDE = 8  # most voxels along a disc's long side that its area is spread over


@dataclass(frozen=True)
class Discs:
    """M discs before thinning; all in one frame."""

    points: F64  # (M, 3) [m]
    across: F32  # (M, 3) from one pixel to the next along the image's rows [m]
    down: F32  # (M, 3) the same along its columns
    rgb: F32  # (M, 3) in [0, 1]
    rank: F32  # (M,) smaller is preferred: the disc's size [m], times a penalty where its depth is less sure

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> "Discs":
        return Discs(self.points[rows], self.across[rows], self.down[rows], self.rgb[rows], self.rank[rows])

    def mirrored(self, penalty: float) -> "Discs":
        """Reflected at y = 0, ranked behind what was seen."""
        flip = np.array([1.0, -1.0, 1.0])
        return Discs(
            self.points * flip,
            (self.across * flip).astype(np.float32),
            (self.down * flip).astype(np.float32),
            self.rgb,
            self.rank * np.float32(penalty),
        )

    def moved(self, target_from_source: F64) -> "Discs":
        """In another frame; (4, 4) rigid."""
        r, t = target_from_source[:3, :3], target_from_source[:3, 3]
        return Discs(
            self.points @ r.T + t,
            (self.across @ r.T).astype(np.float32),
            (self.down @ r.T).astype(np.float32),
            self.rgb,
            self.rank,
        )


def concatenate_discs(parts: list[Discs]) -> Discs:
    """All parts in order; at least one."""
    return Discs(
        np.concatenate([p.points for p in parts]),
        np.concatenate([p.across for p in parts]),
        np.concatenate([p.down for p in parts]),
        np.concatenate([p.rgb for p in parts]),
        np.concatenate([p.rank for p in parts]),
    )


def discs_of_photo(rgb: F32, depth: F32, penalty: F32, intrinsics: F64, world_from_camera: F64) -> Discs:
    """One disc per pixel (H * W, row by row), in the world; those without depth have rank inf.

    `rgb` (H, W, 3) in [0, 1], `depth` (H, W) [m] along the optical axis, `penalty` (H, W) >= 1 on the rank.
    """
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack(
        [(u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1], np.ones_like(u)], axis=-1
    )
    points = rays * depth[..., None].astype(np.float64)
    across = _tangents(points, depth, 1, np.array([1.0 / intrinsics[0, 0], 0.0, 0.0]))
    down = _tangents(points, depth, 0, np.array([0.0, 1.0 / intrinsics[1, 1], 0.0]))
    area = np.linalg.norm(np.cross(across, down), axis=-1)
    rank = np.where(depth > 0, np.sqrt(area) * penalty, np.inf)
    rotation = world_from_camera[:3, :3]
    return Discs(
        points.reshape(-1, 3) @ rotation.T + world_from_camera[:3, 3],
        (across.reshape(-1, 3) @ rotation.T).astype(np.float32),
        (down.reshape(-1, 3) @ rotation.T).astype(np.float32),
        rgb.reshape(-1, 3).astype(np.float32),
        rank.reshape(-1).astype(np.float32),
    )


def _tangents(points: F64, depth: F32, axis: int, flat: F64) -> F64:
    """Steps on the surface from pixel to pixel along an image axis; facing the camera at depth edges."""
    ahead = np.roll(points, -1, axis) - points
    ratio = np.roll(depth, -1, axis) / np.maximum(depth, 1e-6)
    smooth = (ratio < SMOOTH_RATIO) & (ratio > 1.0 / SMOOTH_RATIO) & (depth > 0)
    last = [slice(None), slice(None)]
    last[axis] = slice(-1, None)
    smooth[tuple(last)] = False
    behind, smooth_behind = np.roll(ahead, 1, axis), np.roll(smooth, 1, axis)
    count = smooth.astype(np.float64) + smooth_behind
    mean = (ahead * smooth[..., None] + behind * smooth_behind[..., None]) / np.maximum(count, 1.0)[..., None]
    facing = flat * depth[..., None]
    step = np.where((count > 0)[..., None], mean, facing)
    length, shortest = np.linalg.norm(step, axis=-1), np.linalg.norm(facing, axis=-1)
    return np.asarray(step * (np.minimum(length, MAX_ELONGATION * shortest) / np.maximum(length, 1e-9))[..., None])


def thin(discs: Discs, fineness: float) -> NDArray[np.intp]:
    """Rows to keep, best rank first: a disc is dropped where better ones already cover its voxel.

    The voxel of a disc is its short side / `fineness` (rounded down to a power of two).
    """
    known = np.flatnonzero(np.isfinite(discs.rank))
    order = known[np.argsort(discs.rank[known], kind="stable")]
    if not len(order):
        return order
    origin = discs.points[order].min(axis=0) - 1.0
    kept = _thin(discs.points[order] - origin, discs.across[order], discs.down[order], fineness)
    return order[kept]


@kernel
def _slot(keys: Any, key: int, mask: int) -> int:
    """Where a key is, or the free place it would take, in an open-addressed table."""
    at = ((key * -7046029254386353131) >> 20) & mask
    while keys[at] != -1 and keys[at] != key:
        at = (at + 1) & mask
    return at


@kernel
def _key(x: float, y: float, z: float, side: float, level: int) -> int:
    return (((int(x / side) << 19) | int(y / side)) << 19 | int(z / side)) << 4 | level


@kernel
def _thin(points: Any, across: Any, down: Any, fineness: float) -> Any:
    n = points.shape[0]
    size = 1 << 16
    keys, covered, used = np.full(size, -1, np.int64), np.zeros(size, np.float32), 0
    kept = np.zeros(n, np.bool_)
    for i in range(n):
        a = np.sqrt(across[i, 0] ** 2 + across[i, 1] ** 2 + across[i, 2] ** 2)
        b = np.sqrt(down[i, 0] ** 2 + down[i, 1] ** 2 + down[i, 2] ** 2)
        short, long = min(a, b), max(a, b)
        axis = down[i] if b > a else across[i]
        level = int(np.floor(np.log2(max(short / fineness / FINEST_M, 1.0))))
        level = min(level, LEVELS - 1)
        side = FINEST_M * 2.0**level
        at = _slot(keys, _key(points[i, 0], points[i, 1], points[i, 2], side, level), keys.shape[0] - 1)
        if keys[at] != -1 and covered[at] > COVERED * side * side:
            continue
        kept[i] = True
        for coarser in range(level, LEVELS):
            side = FINEST_M * 2.0**coarser
            parts = int(min(max(long / side, 1.0), STRIDE))
            for part in range(parts):
                shift = (part + 0.5) / parts - 0.5
                x, y, z = points[i, 0] + shift * axis[0], points[i, 1] + shift * axis[1], points[i, 2] + shift * axis[2]
                key = _key(max(x, 0.0), max(y, 0.0), max(z, 0.0), side, coarser)
                at = _slot(keys, key, keys.shape[0] - 1)
                if keys[at] == -1:
                    keys[at] = key
                    used += 1
                covered[at] += a * b / parts
        if used * 2 > keys.shape[0]:
            old_keys, old_covered = keys, covered
            keys = np.full(old_keys.shape[0] * 4, -1, np.int64)
            covered = np.zeros(old_keys.shape[0] * 4, np.float32)
            for j in range(old_keys.shape[0]):
                if old_keys[j] != -1:
                    at = _slot(keys, old_keys[j], keys.shape[0] - 1)
                    keys[at], covered[at] = old_keys[j], old_covered[j]
    return kept


def gaussians_of(discs: Discs, origin: F64) -> Gaussians:
    """Flat Gaussians that spread over each disc; means relative to `origin` (3,)."""
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
        (discs.points - origin).astype(np.float32),
        quats_of(axes).astype(np.float32),
        np.log(scales).astype(np.float32),
        np.full(len(discs.points), OPACITY, np.float32),
        discs.rgb.astype(np.float32),
    )


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

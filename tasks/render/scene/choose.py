"""Which discs to keep: each surface from its closest photo, and every pixel of every photo covered.

Photos are gone through in bands of depth, nearest first. A pixel adds its disc only where no disc kept so far shows the
same surface about as finely, so that nothing is kept twice and no photo has a hole.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from tasks.kernels.compiled import kernel
from tasks.render.scene.surfels import Discs, concatenate_discs
from tasks.world.arrays import F32, Array, Bools, ShortInts

BANDS_M = (8.0, 16.0, 32.0, 64.0)
COARSER = 1.6  # a kept disc may have been seen with pixels that much larger and still do
SAME_DEPTH, SAME_DEPTH_M = 0.08, 0.2  # share of the depth, plus metres, within which two surfaces are one
MOST_PARTS = 12  # places per side that a disc is marked at
UNSEEN_M = 0.15  # a mirrored disc is used where nothing was seen within this distance
BACKGROUND = -1


@dataclass(frozen=True)
class Look:
    """One photo's discs, before choosing."""

    discs: Discs  # in the scene
    owner: ShortInts  # (M,) BACKGROUND or row of a track
    late: Bools  # (M,) depth is a guess: only where nothing better is
    depth: F32  # (H, W)
    intrinsics: Array
    scene_from_camera: Array
    scene_from_box: Mapping[int, Array]  # poses of the tracks that are there


def choose(looks: Sequence[Look]) -> dict[int, Discs]:
    """Kept discs by owner: the background's in the scene, a track's in its box's frame."""
    kept: dict[int, list[Discs]] = {}
    for band in range(len(BANDS_M) + 2):
        for look in looks:
            depth = look.discs.spacing * look.intrinsics[0, 0]
            mine = np.where(look.late, len(BANDS_M) + 1, np.searchsorted(BANDS_M, depth)) == band
            if not mine.any():
                continue
            covered = np.zeros(look.depth.shape, np.bool_)
            for owner, parts in kept.items():
                pose = np.eye(4) if owner == BACKGROUND else look.scene_from_box.get(owner)
                if pose is None:
                    continue
                photo = np.ascontiguousarray(np.linalg.inv(look.scene_from_camera) @ pose), look.intrinsics, look.depth
                for part in parts:
                    _cover(part.points, part.across, part.down, part.spacing, *photo, covered)
            rows, columns = look.discs.pixels.T
            new = np.flatnonzero(mine & ~covered[rows, columns])
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
def _cover(
    points: Any, across: Any, down: Any, spacing: Any, camera_from_scene: Any, k: Any, depth: Any, covered: Any
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
        x = (r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]) / z
        y = (r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]) / z
        u, v = fx * x + k[0, 2], fy * y + k[1, 2]
        if u < -8.0 or v < -8.0 or u > width + 8.0 or v > height + 8.0:
            continue
        ax, ay, az = float(across[i, 0]), float(across[i, 1]), float(across[i, 2])
        cz = r[2, 0] * ax + r[2, 1] * ay + r[2, 2] * az
        au = fx * (r[0, 0] * ax + r[0, 1] * ay + r[0, 2] * az - x * cz) / z
        av = fy * (r[1, 0] * ax + r[1, 1] * ay + r[1, 2] * az - y * cz) / z
        bx, by, bz = float(down[i, 0]), float(down[i, 1]), float(down[i, 2])
        dz = r[2, 0] * bx + r[2, 1] * by + r[2, 2] * bz
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

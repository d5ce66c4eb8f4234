"""Depths of photos that other photos' depths confirm: what two saw from two places is not a guess."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel
from tasks.render.scene.sensed import Photo
from tasks.render.scene.sight import SHALLOW, Seen
from tasks.render.scene.stereo import FAR_M
from tasks.world.arrays import F32, Bools

STREET = -1  # label of a pixel that shows what stays
ALIKE, ALIKE_PER_M = 0.03, 0.001  # two depths are one within this share, and this share more for each metre of it
NEAREST_M = 0.5


def with_confirmed(photos: Sequence[Photo], seen: Sequence[Seen]) -> list[Seen]:
    """The same, guesses that another photo confirms labelled as what is known."""
    depths = [np.where(s.sky | (s.depth >= FAR_M), np.float32(0.0), s.depth) for s in seen]
    agreed = confirmed(photos, depths)
    return [
        replace(s, label=np.where(sure & (s.label == SHALLOW), np.int32(STREET), s.label))
        for s, sure in zip(seen, agreed)
    ]


def confirmed(photos: Sequence[Photo], depths: Sequence[F32]) -> list[Bools]:
    """Of each photo the pixels (H, W) whose depth [m] (H, W) is another photo's there as well; 0: nothing known."""
    from_world = [np.linalg.inv(photo.world_from_camera) for photo in photos]
    out = []
    for i, photo in enumerate(photos):
        sure = np.zeros(depths[i].shape, np.bool_)
        for j, other in enumerate(photos):
            if j != i:
                there_from_here = from_world[j] @ photo.world_from_camera
                _confirm(depths[i], photo.intrinsics, there_from_here, depths[j], other.intrinsics, sure)
        out.append(sure)
    return out


@kernel
def _confirm(depth: Any, k: Any, there_from_here: Any, seen: Any, k_there: Any, sure: Any) -> None:
    """Marks in `sure` (H, W) where a photo's `depth` (H, W) and what another has `seen` (h, w) are one surface."""
    height, width = depth.shape
    r = there_from_here
    for row in range(height):
        for column in range(width):
            z0 = depth[row, column]
            if z0 <= 0.0 or sure[row, column]:
                continue
            a, b = z0 * (column + 0.5 - k[0, 2]) / k[0, 0], z0 * (row + 0.5 - k[1, 2]) / k[1, 1]
            z = r[2, 0] * a + r[2, 1] * b + r[2, 2] * z0 + r[2, 3]
            if z < NEAREST_M:
                continue
            u = (r[0, 0] * a + r[0, 1] * b + r[0, 2] * z0 + r[0, 3]) / z * k_there[0, 0] + k_there[0, 2]
            v = (r[1, 0] * a + r[1, 1] * b + r[1, 2] * z0 + r[1, 3]) / z * k_there[1, 1] + k_there[1, 2]
            if u < 0.0 or v < 0.0 or u >= seen.shape[1] or v >= seen.shape[0]:
                continue
            there = seen[int(v), int(u)]
            sure[row, column] = there > 0.0 and abs(z - there) < (ALIKE + ALIKE_PER_M * z) * z

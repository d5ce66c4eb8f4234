"""Exposure alignment: cameras that looked at the same instant agree on the lidar points that several of them saw.

As the paper's data engine does it (section 3DGS Simulation Data Engine), before anything is coloured by the photos.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tasks.render.fit.exposure import SIZE, aligned, exposed, inverse
from tasks.render.scene.sensed import Photo
from tasks.render.scene.sight import Seen
from tasks.world.arrays import F32, Array, Bools

INSTANT_S = 0.05  # photos no further apart were taken at once
POINTS = 40_000  # of the cloud are looked at, evenly
NEAR = 0.05  # of its depth: a point this close to what the photo shows there is seen


def exposures_of(photos: Sequence[Photo], seen: Sequence[Seen], points: Array) -> F32:
    """Rows (N, 12) of the photos: photo colour = row applied to what the cameras of its instant agree on.

    `points` (M, 3) lidar that stays, in the photos' frame. Zeros, which is identity, where a photo shares no point.
    """
    rows = np.zeros((len(photos), SIZE), np.float32)
    cloud = points[:: max(1, len(points) // POINTS)]
    for instant in instants(photos):
        if len(instant) < 2:
            continue
        looked = [_colours(photos[i], seen[i], cloud) for i in instant]
        found = aligned(np.stack([colours for colours, _ in looked]), np.stack([shown for _, shown in looked]))
        rows[instant] = [inverse(row) for row in found]
    return rows


def instants(photos: Sequence[Photo]) -> list[list[int]]:
    """Rows of the photos by instant, of each camera one at most."""
    groups: list[list[int]] = []
    for i in sorted(range(len(photos)), key=lambda i: photos[i].time_s):
        last = groups[-1] if groups else []
        same = last and photos[i].time_s - photos[last[0]].time_s <= INSTANT_S
        if same and photos[i].camera not in {photos[k].camera for k in last}:
            last.append(i)
        else:
            groups.append([i])
    return groups


def in_agreement(photos: Sequence[Photo], rows: F32) -> list[Photo]:
    """The photos as their instant's common exposure shows them."""
    out = []
    for photo, row in zip(photos, rows):
        if row.any():
            rgb = exposed(photo.rgb.astype(np.float32) / np.float32(255.0), inverse(row))
            photo = replace(photo, rgb=np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8))
        out.append(photo)
    return out


def _colours(photo: Photo, seen: Seen, points: Array) -> tuple[Array, Bools]:
    """Colours (M, 3) in [0, 1] of the points in a photo, and which of them (M,) it shows."""
    height, width = seen.depth.shape
    camera_from_scene = np.linalg.inv(photo.world_from_camera)
    x, y, z = (points @ camera_from_scene[:3, :3].T + camera_from_scene[:3, 3]).T
    ahead = np.maximum(z, 1e-3)
    column = np.floor(photo.intrinsics[0, 0] * x / ahead + photo.intrinsics[0, 2])
    row = np.floor(photo.intrinsics[1, 1] * y / ahead + photo.intrinsics[1, 2])
    inside = (z > 0.5) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    u, v = np.where(inside, column, 0).astype(int), np.where(inside, row, 0).astype(int)
    shown = inside & (np.abs(seen.depth[v, u] - z) < NEAR * z)
    return photo.rgb[v, u] / 255.0, shown

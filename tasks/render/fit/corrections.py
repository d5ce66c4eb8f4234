"""What photos do not agree about: how bright the scene is, an affine colour for each, and where its camera was.

Cameras are made to agree on the lidar points that several of them saw at the same instants (`agreement`) before
anything is coloured by the photos, as in the paper's data engine (section 3DGS Simulation Data Engine); the fit goes on
from there.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from operator import add

import cv2
import numpy as np

from tasks.render.fit.agreement import aligned, brightness, shared
from tasks.render.scene.sensed import Photo
from tasks.render.scene.sight import Seen
from tasks.world.arrays import F32, Array, Bools, Bytes, FloatArray

EXPOSURE_SIZE = 12  # a photo's row: 3 x 3 matrix minus identity, then 3 offsets
POSE_SIZE = 6  # a photo's row: shift [m], turn [rad], both in its camera's frame
INSTANT_S = 0.05  # photos no further apart were taken at once
POINTS = 40_000  # of the cloud are looked at, evenly
OVER_TIME = 4_000_000  # pairs of photo and point at most by which the photos of a camera are compared
STEADY = 0.05  # of its brightness: a camera that varies less has one exposure
AROUND_PX = 5  # a point's brightness is the mean of a window
NEAR = 0.05  # of its depth: a point this close to what the photo shows there is seen


def matrix_of(row: F32) -> tuple[F32, F32]:
    """Matrix (3, 3) and offset (3,): photo colour = matrix @ scene colour + offset."""
    return np.eye(3, dtype=np.float32) + row[:9].reshape(3, 3), row[9:]


def exposed(rgb: F32, row: F32) -> F32:
    """A picture (H, W, 3) as the photo with exposure `row` (12,) would show it."""
    matrix, offset = matrix_of(row)
    return np.asarray(rgb @ matrix.T + offset, np.float32)


def inverse(row: F32) -> F32:
    """The row (12,) that takes back what `row` does. Raises LinAlgError where that cannot be."""
    matrix, offset = matrix_of(row)
    back = np.linalg.inv(matrix.astype(np.float64))
    return np.concatenate([(back - np.eye(3)).ravel(), -back @ offset]).astype(np.float32)


def after(row: F32, first: F32) -> F32:
    """The row (12,) that does what `first` does and then what `row` does."""
    matrix, offset = matrix_of(row)
    before, shift = matrix_of(first)
    together = matrix @ before - np.eye(3, dtype=np.float32)
    return np.concatenate([together.ravel(), matrix @ shift + offset]).astype(np.float32)


def reference(cameras: Sequence[str], rows: F32) -> F32:
    """The row (12,) of a camera that exposes as the `cameras` (N,) do on average, each by its own mean over its photos'
    rows (N, 12)."""
    of = np.array(cameras)
    return np.mean([rows[of == camera].mean(axis=0) for camera in dict.fromkeys(cameras)], axis=0, dtype=np.float32)


def exposed_gradient(rgb: F32, row: F32, d_exposed: F32) -> tuple[F32, F32]:
    """Gradients by rgb (H, W, 3) and by the row (12,)."""
    matrix, _ = matrix_of(row)
    flat = d_exposed.reshape(-1, 3)
    d_row = np.concatenate([(flat.T @ rgb.reshape(-1, 3)).ravel(), flat.sum(axis=0)])
    return np.asarray(d_exposed @ matrix, np.float32), d_row.astype(np.float32)


def affine_between(source: FloatArray, target: FloatArray, ridge: float = 1e-3) -> F32:
    """The row (12,) that takes colours `source` (M, 3) closest to `target` (M, 3); identity where they say nothing.

    Least squares with a pull of `ridge` per sample towards identity.
    """
    padded = np.column_stack([source, np.ones(len(source))]).astype(np.float64)
    keep = ridge * max(len(source), 1) * np.eye(4)
    off = np.linalg.solve(padded.T @ padded + keep, padded.T @ (np.asarray(target, np.float64) - source))
    return np.concatenate([off[:3].T.ravel(), off[3]]).astype(np.float32)


def exposures_of(photos: Sequence[Photo], seen: Sequence[Seen], points: Array) -> F32:
    """Rows (N, 12) of the photos: photo colour = row applied to what all cameras agree on.

    Photos of a camera have one, but for how bright each is where the camera exposes anew from photo to photo.
    `points` (M, 3) that stay, in the photos' frame. Zeros, which is identity, where a camera shares no point.
    """
    rows = np.zeros((len(photos), EXPOSURE_SIZE), np.float32)
    cameras = list(dict.fromkeys(photo.camera for photo in photos))
    cloud = points[:: max(1, len(points) // POINTS)]
    gains = _gains(photos, seen, points)
    found = []
    for instant in instants(photos):
        if len(instant) < 2:
            continue
        colours, shown = np.zeros((len(cameras), len(cloud), 3)), np.zeros((len(cameras), len(cloud)), bool)
        for i in instant:
            c = cameras.index(photos[i].camera)
            colours[c], shown[c] = _colours(photos[i].rgb, photos[i], seen[i], cloud)
            colours[c] /= gains[i]
        found.append(shared(colours, shown))
    if found:
        back = [inverse(row) for row in aligned(reduce(add, found))]
        rows[:] = [back[cameras.index(photo.camera)] for photo in photos]
    for i in np.flatnonzero(gains != 1.0).tolist():
        gain = np.concatenate([((gains[i] - 1.0) * np.eye(3)).ravel(), np.zeros(3)]).astype(np.float32)
        rows[i] = after(gain, rows[i])
    return rows


def _gains(photos: Sequence[Photo], seen: Sequence[Seen], points: Array) -> Array:
    """How much brighter than its camera's mean each photo is (N,); 1 for all of a camera that is STEADY."""
    cloud = points[:: max(1, len(points) * len(photos) // OVER_TIME, len(points) // POINTS)]
    grey, shown = np.ones((len(photos), len(cloud)), np.float32), np.zeros((len(photos), len(cloud)), bool)
    for i, photo in enumerate(photos):
        blurred = np.asarray(cv2.blur(photo.rgb, (AROUND_PX, AROUND_PX)), np.uint8)
        colours, shown[i] = _colours(blurred, photo, seen[i], cloud)
        grey[i] = colours.mean(axis=-1)
    logs, of = brightness(grey, shown), np.array([photo.camera for photo in photos])
    for camera in dict.fromkeys(of):
        mine = logs[of == camera]
        logs[of == camera] = mine - mine.mean() if np.ptp(mine) > STEADY else 0.0
    return np.exp(logs)


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
    """The photos, whose `light` is as their instant's common exposure shows it."""
    return [
        replace(photo, to_common=np.column_stack(matrix_of(inverse(row)))) if row.any() else photo
        for photo, row in zip(photos, rows)
    ]


def _colours(rgb: Bytes, photo: Photo, seen: Seen, points: Array) -> tuple[Array, Bools]:
    """Colours (M, 3) in [0, 1] of the points in a photo's `rgb` (H, W, 3), and which of them (M,) it shows."""
    height, width = seen.depth.shape
    camera_from_scene = np.linalg.inv(photo.world_from_camera)
    x, y, z = (points @ camera_from_scene[:3, :3].T + camera_from_scene[:3, 3]).T
    ahead = np.maximum(z, 1e-3)
    column = np.floor(photo.intrinsics[0, 0] * x / ahead + photo.intrinsics[0, 2])
    row = np.floor(photo.intrinsics[1, 1] * y / ahead + photo.intrinsics[1, 2])
    inside = (z > 0.5) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    u, v = np.where(inside, column, 0).astype(int), np.where(inside, row, 0).astype(int)
    shown = inside & (np.abs(seen.depth[v, u] - z) < NEAR * z)
    return rgb[v, u] / 255.0, shown


def motion(row: FloatArray) -> Array:
    """(4, 4): x' = R(turn) x + shift of a row (6,)."""
    out = np.eye(4)
    turn = np.asarray(row[3:], np.float64)
    angle = float(np.linalg.norm(turn))
    cross = np.array([[0.0, -turn[2], turn[1]], [turn[2], 0.0, -turn[0]], [-turn[1], turn[0], 0.0]])
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    out[:3, :3] += first * cross + second * cross @ cross
    out[:3, 3] = row[:3]
    return out


def corrected(scene_from_camera: Array, row: FloatArray) -> Array:
    """The pose (4, 4) of a camera whose points move by `row` (6,)."""
    return np.asarray(scene_from_camera @ np.linalg.inv(motion(row)))


def between(times: FloatArray, rows: F32, time_s: float) -> F32:
    """The row (C,) at a time, linear between those (N, C) at `times` (N,) in any order; the nearest one outside."""
    by_time = np.argsort(times, kind="stable")
    return np.array([np.interp(time_s, times[by_time], column[by_time]) for column in rows.T], np.float32)

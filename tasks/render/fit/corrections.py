"""What photos do not agree about: how bright the scene is, an affine colour for each, and where its camera was.

Cameras are made to agree on the lidar points that several of them saw at the same instants (`agreement`) before
anything is coloured by the photos, as in the paper's data engine (section 3DGS Simulation Data Engine); the fit goes on
from there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import cast

import cv2
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from tasks.render.scene.depth import PhotoDepth
from tasks.render.scene.sensed import Photo
from tasks.world.arrays import F32, Array, Bools, Bytes, FloatArray

# Cameras that see the same points made to agree about colour, without one of them being the truth.
#
# Both sides of a comparison are noisy: the same spot of the street falls on other pixels, a window mirrors, a depth
# is a little off. Least squares from one side to the other takes that noise for contrast that the other lacks; two
# equal cameras with noise of 0.10 would each lose a fifth of theirs. So moments are matched instead: a camera is
# given the mean and the covariance that the others show on the points they share, by the optimal transport between
# two normal distributions (Knott and Smith 1984). Equal cameras get the identity, and from there to here is the
# inverse of from here to there.

ROUNDS = 60  # of fitting each camera to all others; of a ring of eight 5 % of an error are left after 20
LEAST = 8  # shared points that say something
BRIGHTNESS_ROUNDS, DISAGREES = 10, 0.05  # of reweighting, and the difference of log colours from which less counts
FLOOR, PULL = 1e-4, 0.2  # added to variances in [0, 1]^2: FLOOR always, PULL / n for n points


@dataclass(frozen=True)
class OverlapColourMoments:
    """What C cameras show of points that another camera sees as well: moments of colours in [0, 1], by pair."""

    count: Array  # (C, C) points that cameras c and d both see; nothing on the diagonal
    first: Array  # (C, C, 3) sums of the colours that c shows of them
    second: Array  # (C, C, 3, 3) sums of their products

    def __add__(self, other: "OverlapColourMoments") -> "OverlapColourMoments":
        """Of the points of both."""
        return OverlapColourMoments(self.count + other.count, self.first + other.first, self.second + other.second)


def shared_colours(colours: Array, seen: Bools) -> OverlapColourMoments:
    """The moments of M points' `colours` (C, M, 3) in [0, 1] in C cameras that have `seen` (C, M) them."""
    n, both = len(colours), seen.astype(np.float64)
    products = colours[..., :, None] * colours[..., None, :]
    masked = both[..., None] * np.concatenate([colours, products.reshape(*seen.shape, 9)], axis=-1)
    sums = np.einsum("cmk,dm->cdk", masked, both, optimize=True)
    count = both @ both.T
    others = 1.0 - np.eye(n)
    sums, count = sums * others[..., None], count * others
    return OverlapColourMoments(count, sums[..., :3], sums[..., 3:].reshape(n, n, 3, 3))


def align_cameras(of: OverlapColourMoments) -> F32:
    """Rows (C, 12) that make cameras agree on the points that several of them see.

    A row is a 3 x 3 matrix minus the identity, then 3 offsets (`tasks.render.fit.corrections`). What brings the common
    colours back to a camera's is, as a mean over the cameras that are tied together, the identity: the common colours
    are those of photos. Cameras that share fewer than LEAST points keep theirs.
    """
    n = len(of.count)
    matrices, offsets = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    tied = np.flatnonzero(of.count.sum(axis=1) >= LEAST)
    for _ in range(ROUNDS):
        for c in tied.tolist():
            shown = _moments(of.count[c], of.first[c], of.second[c])
            now = _aligned_moments(of, matrices, offsets, c)
            matrices[c], offsets[c] = _transport(*shown, *_moments(*now), PULL / of.count[c].sum())
    _, group = connected_components(of.count > 0, directed=False)
    for number in np.unique(group[tied]):
        rows = tied[group[tied] == number]  # whose exposures' inverses are the identity on average
        back = np.linalg.inv(matrices[rows])
        turn, shift = back.mean(axis=0), -np.einsum("cij,cj->ci", back, offsets[rows]).mean(axis=0)
        matrices[rows], offsets[rows] = turn @ matrices[rows], offsets[rows] @ turn.T + shift
    return np.column_stack([(matrices - np.eye(3)).reshape(n, 9), offsets]).astype(np.float32)


def relative_brightness(grey: F32, seen: Bools) -> Array:
    """Log of how much brighter each of N photos shows its points than the others do (N,); their mean is 0.

    `grey` (N, M) in (0, 1] of M points in the photos that have `seen` (N, M) them. Least squares over log grey =
    photo + point with Cauchy's weights; a photo that shares fewer than LEAST points with others gets 0.
    """
    photo, point = np.nonzero(seen & (seen.sum(axis=0) > 1))  # most photos see few of the points
    logs = np.log(np.maximum(grey[photo, point], 1e-2)).astype(np.float64)
    n, points = len(grey), seen.shape[1]
    tied = np.bincount(photo, minlength=n) >= LEAST
    weight, of, out = np.ones(len(logs)), np.bincount(point, minlength=points), np.zeros(n)
    for turn in range(BRIGHTNESS_ROUNDS if tied.any() else 0):
        if turn > 0:
            off = logs - out[photo]
            means = np.bincount(point, weight * off, points) / np.maximum(of, 1e-12)
            weight = 1.0 / (1.0 + ((off - means[point]) / DISAGREES) ** 2)
        of = np.bincount(point, weight, points)
        every = csr_array((weight, (photo, point)), shape=seen.shape)
        shares = csr_array((weight / of[point], (photo, point)), shape=seen.shape)
        system = np.diag(every.sum(axis=1) + 1.0) - (shares @ every.T).toarray()  # a point's own colour is eliminated
        right = np.bincount(photo, weight * logs, n) - shares @ np.bincount(point, weight * logs, points)
        out = np.linalg.solve(system, right)
        out[~tied] = 0.0
        out[tied] -= out[tied].mean()
    return out


def _moments(count: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) over all pairs (D, ...)."""
    n = count.sum()
    mean = first.sum(axis=0) / n
    return mean, second.sum(axis=0) / n - np.outer(mean, mean)


def _aligned_moments(of: OverlapColourMoments, matrices: Array, offsets: Array, c: int) -> tuple[Array, Array, Array]:
    """Moments (D, ...) of what the other cameras, as they are aligned by now, show of the points shared with `c`."""
    count, first, second = of.count[:, c], of.first[:, c], of.second[:, c]
    turned = np.einsum("dij,dj->di", matrices, first)
    mixed = turned[:, :, None] * offsets[:, None, :]
    square = np.einsum("dij,djk,dlk->dil", matrices, second, matrices) + mixed + mixed.transpose(0, 2, 1)
    square += count[:, None, None] * offsets[:, :, None] * offsets[:, None, :]
    return count, turned + count[:, None] * offsets, square


def _transport(mean: Array, cov: Array, to_mean: Array, to_cov: Array, pull: float) -> tuple[Array, Array]:
    """The symmetric matrix and the offset that take one mean and covariance to another; `pull` towards the identity."""
    noise = (FLOOR + pull) * np.eye(3)
    root = _matrix_root(cov + noise)
    back = np.linalg.inv(root)
    matrix = back @ _matrix_root(root @ (to_cov + noise) @ root) @ back
    return matrix, to_mean - matrix @ mean


def _matrix_root(matrix: Array) -> Array:
    """The symmetric root of a positive matrix (3, 3)."""
    values, vectors = np.linalg.eigh(matrix)
    return cast(Array, (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


EXPOSURE_SIZE = 12  # a photo's row: 3 x 3 matrix minus identity, then 3 offsets
POSE_SIZE = 6  # a photo's row: shift [m], turn [rad], both in its camera's frame
INSTANT_S = 0.05  # photos no further apart were taken at once
POINTS = 40_000  # of the cloud are looked at, evenly
OVER_TIME = 4_000_000  # pairs of photo and point at most by which the photos of a camera are compared
STEADY = 0.05  # of its brightness: a camera that varies less has one exposure
AROUND_PX = 5  # a point's brightness is the mean of a window
NEAR = 0.05  # of its depth: a point this close to what the photo shows there is seen


def exposure_matrix(row: F32) -> tuple[F32, F32]:
    """Matrix (3, 3) and offset (3,): photo colour = matrix @ scene colour + offset."""
    return np.eye(3, dtype=np.float32) + row[:9].reshape(3, 3), row[9:]


def apply_exposure(rgb: F32, row: F32) -> F32:
    """A picture (H, W, 3) as the photo with exposure `row` (12,) would show it."""
    matrix, offset = exposure_matrix(row)
    return np.asarray((rgb.reshape(-1, 3) @ matrix.T + offset).reshape(rgb.shape), np.float32)


def invert_exposure(row: F32) -> F32:
    """The row (12,) that takes back what `row` does. Raises LinAlgError where that cannot be."""
    matrix, offset = exposure_matrix(row)
    back = np.linalg.inv(matrix.astype(np.float64))
    return np.concatenate([(back - np.eye(3)).ravel(), -back @ offset]).astype(np.float32)


def chain_exposures(row: F32, first: F32) -> F32:
    """The row (12,) that does what `first` does and then what `row` does."""
    matrix, offset = exposure_matrix(row)
    before, shift = exposure_matrix(first)
    together = matrix @ before - np.eye(3, dtype=np.float32)
    return np.concatenate([together.ravel(), matrix @ shift + offset]).astype(np.float32)


def mean_exposure(cameras: Sequence[str], rows: F32) -> F32:
    """The row (12,) of a camera that exposes as the `cameras` (N,) do on average, each by its own mean over its photos'
    rows (N, 12)."""
    of = np.array(cameras)
    return np.mean([rows[of == camera].mean(axis=0) for camera in dict.fromkeys(cameras)], axis=0, dtype=np.float32)


def apply_exposure_gradient(rgb: F32, row: F32, d_exposed: F32) -> tuple[F32, F32]:
    """Gradients by rgb (H, W, 3) and by the row (12,)."""
    matrix, _ = exposure_matrix(row)
    flat = d_exposed.reshape(-1, 3)
    d_row = np.concatenate([(flat.T @ rgb.reshape(-1, 3)).ravel(), flat.T @ np.ones(len(flat), np.float32)])
    return np.asarray((flat @ matrix).reshape(rgb.shape), np.float32), d_row.astype(np.float32)


def estimate_exposures(photos: Sequence[Photo], seen: Sequence[PhotoDepth], points: Array) -> F32:
    """Rows (N, 12) of the photos: photo colour = row applied to what all cameras agree on.

    Photos of a camera have one, but for how bright each is where the camera exposes anew from photo to photo.
    `points` (M, 3) that stay, in the photos' frame. Zeros, which is identity, where a camera shares no point.
    """
    rows = np.zeros((len(photos), EXPOSURE_SIZE), np.float32)
    cameras = list(dict.fromkeys(photo.camera for photo in photos))
    cloud = points[:: max(1, len(points) // POINTS)]
    gains = _photo_gains(photos, seen, points)
    found = []
    for instant in group_by_instant(photos):
        if len(instant) < 2:
            continue
        colours, shown = np.zeros((len(cameras), len(cloud), 3)), np.zeros((len(cameras), len(cloud)), bool)
        for i in instant:
            c = cameras.index(photos[i].camera)
            colours[c], shown[c] = _colours_at_points(photos[i].rgb, photos[i], seen[i], cloud)
            colours[c] /= gains[i]
        found.append(shared_colours(colours, shown))
    if found:
        back = [invert_exposure(row) for row in align_cameras(reduce(add, found))]
        rows[:] = [back[cameras.index(photo.camera)] for photo in photos]
    for i in np.flatnonzero(gains != 1.0).tolist():
        gain = np.concatenate([((gains[i] - 1.0) * np.eye(3)).ravel(), np.zeros(3)]).astype(np.float32)
        rows[i] = chain_exposures(gain, rows[i])
    return rows


def _photo_gains(photos: Sequence[Photo], seen: Sequence[PhotoDepth], points: Array) -> Array:
    """How much brighter than its camera's mean each photo is (N,); 1 for all of a camera that is STEADY."""
    cloud = points[:: max(1, len(points) * len(photos) // OVER_TIME, len(points) // POINTS)]
    grey, shown = np.ones((len(photos), len(cloud)), np.float32), np.zeros((len(photos), len(cloud)), bool)
    for i, photo in enumerate(photos):
        blurred = np.asarray(cv2.blur(photo.rgb, (AROUND_PX, AROUND_PX)), np.uint8)
        colours, shown[i] = _colours_at_points(blurred, photo, seen[i], cloud)
        grey[i] = colours.mean(axis=-1)
    logs, of = relative_brightness(grey, shown), np.array([photo.camera for photo in photos])
    for camera in dict.fromkeys(of):
        mine = logs[of == camera]
        logs[of == camera] = mine - mine.mean() if np.ptp(mine) > STEADY else 0.0
    return np.exp(logs)


def group_by_instant(photos: Sequence[Photo]) -> list[list[int]]:
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


def with_common_exposure(photos: Sequence[Photo], rows: F32) -> list[Photo]:
    """The photos, whose `light` is as their instant's common exposure shows it."""
    return [
        replace(photo, to_common=np.column_stack(exposure_matrix(invert_exposure(row)))) if row.any() else photo
        for photo, row in zip(photos, rows)
    ]


def _colours_at_points(rgb: Bytes, photo: Photo, seen: PhotoDepth, points: Array) -> tuple[Array, Bools]:
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


def rigid_motion(row: FloatArray) -> Array:
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


def corrected_pose(scene_from_camera: Array, row: FloatArray) -> Array:
    """The pose (4, 4) of a camera whose points move by `row` (6,)."""
    return np.asarray(scene_from_camera @ np.linalg.inv(rigid_motion(row))) if row.any() else scene_from_camera


def interpolate_in_time(times: FloatArray, rows: F32, time_s: float) -> F32:
    """The row (C,) at a time, linear between those (N, C) at `times` (N,) in any order; the nearest one outside."""
    by_time = np.argsort(times, kind="stable")
    return np.array([np.interp(time_s, times[by_time], column[by_time]) for column in rows.T], np.float32)

"""What is behind everything: colour by direction."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from tasks.kernels.compiled import inlined, kernel, numpy_division_kernel
from tasks.kernels.threads import run_in_chunks
from tasks.world.arrays import F32, Array, Bools

# Where in the sky map each pixel of a camera looks, and what it sees there.

ROWS, COLUMNS = 256, 1024  # of the map: elevation +90 deg .. -90 deg, azimuth -180 deg .. 180 deg
ROWS_CHUNK = 16  # of the picture, looked up by a thread at a time


@dataclass(frozen=True)
class SkyCells:
    """The four cells of the sky around each pixel's direction; angles are dear, and an iteration needs them twice.

    Of pixels that hide the sky nothing is known.
    """

    corners: NDArray[np.int16]  # (H, W, 2) row of the upper two, column of the left two
    shares: F32  # (H, W, 2) of the right and of the lower ones


LEAST_LIGHT = 1.0 / 1024.0  # that passes, for the sky to be looked up: what less adds is a quarter of a step of 8 bits


def sky_cells(
    intrinsics: Array, scene_from_camera: Array, width: int, height: int, threads: int = 1, alpha: F32 | None = None
) -> SkyCells:
    """Where a camera looks, of those pixels where `alpha` (H, W) lets light pass; None: nothing is in the way."""
    found = SkyCells(np.zeros((height, width, 2), np.int16), np.zeros((height, width, 2), np.float32))
    camera = np.array(intrinsics, np.float64), np.array(scene_from_camera, np.float64)
    before = np.zeros((height, width), np.float32) if alpha is None else alpha
    run_in_chunks(partial(_find, *camera, before, found.corners, found.shares), height, ROWS_CHUNK, threads)
    return found


@inlined
def _angle(y: Any, x: Any) -> Any:
    """atan2(y, x) within 2e-8, without branches: a library's takes most of the time of a picture with sky.

    The series on [0, 1] is Abramowitz and Stegun's 4.4.49.
    """
    away, beside = abs(y), abs(x)
    t = min(away, beside) / max(max(away, beside), 1e-300)
    s = t * t
    high = 0.0429096138 + s * (-0.0161657367 + s * 0.0028662257)
    low = -0.3333314528 + s * (0.1999355085 + s * (-0.1420889944 + s * (0.1065626393 + s * (-0.0752896400 + s * high))))
    angle = t + t * s * low
    angle = 0.5 * np.pi - angle if away > beside else angle
    angle = np.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@inlined
def _open_columns(alpha: Any, row: int) -> Any:
    """From which column of a row on, and up to which, light passes: none beside them shows the sky."""
    start, end = 0, alpha.shape[1]
    while start < end and np.float32(1.0) - alpha[row, start] <= LEAST_LIGHT:
        start += 1
    while start < end and np.float32(1.0) - alpha[row, end - 1] <= LEAST_LIGHT:
        end -= 1
    return start, end


@inlined
def _places(k: Any, turn: Any, row: int, start: int, end: int, v: Any, u: Any) -> None:
    """Rows `v` and columns `u` of the sky, with fractions, that pixels of a row look at; several at a time."""
    for column in range(start, end):
        a, b = (column + 0.5 - k[0, 2]) / k[0, 0], (row + 0.5 - k[1, 2]) / k[1, 1]
        x = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2]
        y = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2]
        z = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2]
        v[column] = (0.5 - _angle(z, np.sqrt(x * x + y * y)) / np.pi) * ROWS - 0.5
        u[column] = (_angle(y, x) / (2.0 * np.pi) + 0.5) * COLUMNS - 0.5


@numpy_division_kernel
def _find(k: Any, turn: Any, alpha: Any, corners: Any, shares: Any, first: int, last: int) -> None:
    vs, us = np.empty(alpha.shape[1]), np.empty(alpha.shape[1])
    for row in range(first, last):
        start, end = _open_columns(alpha, row)
        _places(k, turn, row, start, end, vs, us)
        for column in range(start, end):
            if np.float32(1.0) - alpha[row, column] <= LEAST_LIGHT:
                continue
            v, u = vs[column], us[column]
            v0, u0 = min(max(int(np.floor(v)), 0), ROWS - 2), int(np.floor(u))
            corners[row, column, 0] = v0
            corners[row, column, 1] = u0 & (COLUMNS - 1)
            shares[row, column, 0] = u - u0
            shares[row, column, 1] = min(max(v - v0, 0.0), 1.0)


def look_up_sky(cells: F32, where: SkyCells, threads: int = 1) -> F32:
    """The sky (H, W, 3), linear between its `cells` (ROWS * COLUMNS, 3)."""
    out = np.zeros((*where.corners.shape[:2], 3), np.float32)
    put_sky_behind(out, np.zeros(out.shape[:2], np.float32), cells, where, threads)
    return out


def put_sky_behind(rgb: F32, alpha: F32, cells: F32, where: SkyCells, threads: int = 1) -> None:
    """Adds to a picture (H, W, 3), in place, the sky that `alpha` (H, W) lets through: `where` is of that alpha."""
    run_in_chunks(partial(_add_sky, cells, where.corners, where.shares, alpha, rgb), len(rgb), ROWS_CHUNK, threads)


@kernel
def _add_sky(cells: Any, corners: Any, shares: Any, alpha: Any, rgb: Any, first: int, last: int) -> None:
    for row in range(first, last):
        for column in range(rgb.shape[1]):
            light = np.float32(1.0) - alpha[row, column]
            if light <= LEAST_LIGHT:
                continue
            fu, fv = shares[row, column, 0], shares[row, column, 1]
            left, right = upper_cells(corners[row, column])
            for c in range(3):
                rgb[row, column, c] += _between(cells, left, right, fu, fv, c) * light


@inlined
def upper_cells(corner: Any) -> Any:
    """The upper left and the upper right one of four cells of the sky; the lower ones are a row further on."""
    row, column = int(corner[0]) * COLUMNS, int(corner[1])
    return row + column, row + ((column + 1) & (COLUMNS - 1))


@inlined
def _between(cells: Any, left: int, right: int, fu: Any, fv: Any, c: int) -> Any:
    """A channel of the sky between four cells, of which the upper two are given."""
    high = cells[left, c] + (cells[right, c] - cells[left, c]) * fu
    low = cells[left + COLUMNS, c] + (cells[right + COLUMNS, c] - cells[left + COLUMNS, c]) * fu
    return high + (low - high) * fv


@inlined
def _mix(weights: Any, red: Any, green: Any, blue: Any) -> Any:
    """A channel as a camera shows it, from 0 to 1."""
    seen = weights[0] * red + weights[1] * green + weights[2] * blue + weights[3]
    return min(max(seen, np.float32(0.0)), np.float32(1.0))


@numpy_division_kernel
def _finish(cells: Any, k: Any, turn: Any, affine: Any, alpha: Any, rgb: Any, first: int, last: int) -> None:
    """Rows of a picture (H, W, 3): the sky put behind them, in the camera's colours, from 0 to 1."""
    vs, us = np.empty(alpha.shape[1]), np.empty(alpha.shape[1])
    to_red = affine[0, 0], affine[0, 1], affine[0, 2], affine[0, 3]
    to_green = affine[1, 0], affine[1, 1], affine[1, 2], affine[1, 3]
    to_blue = affine[2, 0], affine[2, 1], affine[2, 2], affine[2, 3]
    for row in range(first, last):
        start, end = _open_columns(alpha, row)
        _places(k, turn, row, start, end, vs, us)
        for column in range(start, end):
            light = np.float32(1.0) - alpha[row, column]
            if light <= LEAST_LIGHT:
                continue
            v, u = min(max(vs[column], 0.0), ROWS - 1.0), us[column] + COLUMNS
            v0, u0 = min(int(v), ROWS - 2), int(u)  # which rounds down, being positive
            fu, fv = np.float32(u - u0), np.float32(v - v0)
            left, right = v0 * COLUMNS + (u0 & (COLUMNS - 1)), v0 * COLUMNS + ((u0 + 1) & (COLUMNS - 1))
            for c in range(3):
                rgb[row, column, c] += light * _between(cells, left, right, fu, fv, c)
        for column in range(rgb.shape[1]):
            colour = rgb[row, column, 0], rgb[row, column, 1], rgb[row, column, 2]
            rgb[row, column, 0] = _mix(to_red, *colour)
            rgb[row, column, 1] = _mix(to_green, *colour)
            rgb[row, column, 2] = _mix(to_blue, *colour)


WINDOWS = 96  # side by side in a picture, in which it is smooth or not
SMOOTH, SMOOTH_SHARE = 0.02, 0.3  # deviation of the grey of a smooth window, and the share of them that makes it sky
SKY_WEIGHT = 1.0e4  # against one pixel of something else in the same direction


@dataclass(frozen=True)
class SkyMap:
    """Infinitely far colours. Where no photo saw sky: the mean colour seen in that direction, so that a hole in the
    scene is no hole to the sky."""

    rgb: F32  # (ROWS, COLUMNS, 3) from 0 on, above 1 where a photo of mean exposure is white; world directions

    @property
    def cells(self) -> F32:
        """(ROWS * COLUMNS, 3). Raises ValueError for a map of another size, which a file may hold."""
        if self.rgb.shape != (ROWS, COLUMNS, 3):
            raise ValueError(f"sky: {self.rgb.shape}, expected ({ROWS}, {COLUMNS}, 3)")
        return np.require(self.rgb, np.float32, ["C", "W"]).reshape(-1, 3)  # kernels compile once more for read-only

    def finish(
        self, rgb: F32, alpha: F32, affine: F32, intrinsics: Array, world_from_camera: Array, threads: int = 1
    ) -> None:
        """Makes a picture (H, W, 3) of a scene's own light, in place: the sky behind it where `alpha` (H, W) lets it
        through, then all in the colours of a camera with `affine` (3, 4), from 0 to 1. Raises ValueError as `cells`."""
        camera = np.array(intrinsics, np.float64), np.array(world_from_camera, np.float64)
        colours = np.ascontiguousarray(affine, np.float32)
        run_in_chunks(partial(_finish, self.cells, *camera, colours, alpha, rgb), len(rgb), ROWS_CHUNK, threads)


SKY_RGB, HAZE_RGB = (0.72, 0.78, 0.85), (0.30, 0.30, 0.31)  # above and below the horizon


def plain_sky() -> SkyMap:
    """One colour above the horizon, one below: of a scene from elsewhere that brings no sky."""
    rgb = np.empty((ROWS, COLUMNS, 3), np.float32)
    rgb[: ROWS // 2], rgb[ROWS // 2 :] = SKY_RGB, HAZE_RGB
    return SkyMap(rgb)


def may_be_sky(rgb: F32) -> Bools:
    """Pixels (H, W) of a picture in [0, 1] that are as bright or as blue as the sky."""
    grey = rgb.mean(axis=-1)
    return np.asarray((grey > 0.6) | ((rgb[..., 2] > rgb[..., 0] + 0.04) & (grey > 0.4)))


def sky_agrees(sky_cost: F32, cost: F32) -> Bools:
    """Where the sky agrees with other photos about as well as the best depth does: (H, W)."""
    return np.asarray(sky_cost < 1.3 * cost + 0.03)


def is_smooth_around(rgb: F32, among: Bools) -> Bools:
    """Pixels (H, W) around which much of what is `among` (H, W) is smooth: sky and its clouds, but no boarded wall."""
    grey = rgb.mean(axis=-1)
    n = max(rgb.shape[1] // WINDOWS, 2) // 2 * 2 + 1
    mean = cv2.blur(grey, (n, n))
    rough = np.sqrt(np.maximum(cv2.blur(grey * grey, (n, n)) - mean * mean, 0.0))
    wide = (6 * n + 1, 6 * n + 1)
    smooth = cv2.blur((among & (rough < SMOOTH)).astype(np.float32), wide)
    return np.asarray(smooth > SMOOTH_SHARE * cv2.blur(among.astype(np.float32), wide))


def pixel_directions(intrinsics: Array, world_from_camera: Array, width: int, height: int) -> Array:
    """(H, W, 3) viewing directions in the world, not normalised."""
    return np.asarray(camera_rays(intrinsics, width, height) @ world_from_camera[:3, :3].T)


def camera_rays(intrinsics: Array, width: int, height: int) -> Array:
    """(H, W, 3) viewing directions in camera coordinates, z = 1."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x, y = (u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1]
    return np.stack([x, y, np.ones_like(u)], axis=-1)


def rises(intrinsics: Array, up: Array, width: int, height: int) -> tuple[Array, Array]:
    """(H, W) how far viewing directions of depth 1 rise along `up` (3,) in camera coordinates, and how long they are:
    of `camera_rays`, without working them out."""
    x = (np.arange(width) + 0.5 - intrinsics[0, 2]) / intrinsics[0, 0]
    y = ((np.arange(height) + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1])[:, None]
    return up[0] * x + (up[1] * y + up[2]), np.sqrt(x * x + (y * y + 1.0))


def _cells(rays: Array) -> tuple[Array, Array]:
    elevation = np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    return (0.5 - elevation / np.pi) * ROWS - 0.5, (azimuth / (2 * np.pi) + 0.5) * COLUMNS - 0.5


def sky_of_views(views: Iterable[tuple[Array, F32, Bools]]) -> SkyMap:
    """The mean of what views show of the sky (and, with next to no weight, of the street).

    Each is directions (M, 3), their colours (M, 3) from 0 on, and whether it was sky (M,). Cells nobody looked at take
    the colour of the nearest one that was; plain grey without any view.
    """
    sums = np.zeros((4, ROWS * COLUMNS))
    for rays, rgb, is_sky in views:
        weight = np.where(is_sky, SKY_WEIGHT, 1.0)
        rows, columns = _cells(rays)
        cell = np.clip(np.rint(rows), 0, ROWS - 1).astype(np.intp) * COLUMNS
        cell += np.rint(columns).astype(np.intp) % COLUMNS
        for channel in range(3):
            sums[channel] += np.bincount(cell, weight * rgb[:, channel], ROWS * COLUMNS)
        sums[3] += np.bincount(cell, weight, ROWS * COLUMNS)
    cells = sums.T.reshape(ROWS, COLUMNS, 4)
    seen = cells[..., 3] > 0
    if not seen.any():
        return SkyMap(np.full((ROWS, COLUMNS, 3), 0.7, np.float32))
    colours = cells[..., :3] / np.maximum(cells[..., 3:], 1e-9)
    out = np.empty((ROWS, COLUMNS, 3), np.float32)
    for half in (slice(0, ROWS // 2), slice(ROWS // 2, ROWS)):  # sky and street do not fill each other
        there = seen[half] if seen[half].any() else seen
        source = colours[half] if seen[half].any() else colours
        wrapped = np.concatenate([there] * 3, axis=1)
        nearest = distance_transform_edt(~wrapped, return_distances=False, return_indices=True)
        rows = nearest[0][: ROWS // 2, COLUMNS : 2 * COLUMNS]
        out[half] = source[rows, nearest[1][: ROWS // 2, COLUMNS : 2 * COLUMNS] % COLUMNS]
    return SkyMap(out)

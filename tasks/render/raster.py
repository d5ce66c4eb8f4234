"""Gaussians to pixels on one CPU core: small tiles, sorted by depth, blended front to back.

A tile keeps its pixels in a flat buffer and visits its Gaussians one after the other (Gaussian outer, pixels inner):
the inner loop over a row's columns has no branches, so that the compiler turns it into vector instructions.
No thread shares a result and nothing is summed in an order that could change: the same input gives the same bytes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tasks.kernels import kernel
from tasks.render.gaussians import F32, F64, Gaussians
from tasks.render.project import (
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    HALF_U,
    HALF_V,
    MIN_ALPHA,
    OPACITY,
    U,
    V,
    project,
)

TILE_WIDTH, TILE_HEIGHT = 16, 16  # pixels; a row is two vector registers (measured: 8 wide is slower)
OPAQUE = 1.0e-3  # a tile is done when no pixel lets more light than this through
MAX_ALPHA = 0.999


@dataclass(frozen=True)
class View:
    """What one camera sees."""

    rgb: F32  # (H, W, 3) in [0, 1] when colours and background are
    depth: F32  # (H, W) [m] mean of the Gaussians' depths by weight; 0 where nothing is
    alpha: F32  # (H, W) 1 - the part of the background that shines through


@dataclass(frozen=True)
class Splats:
    """The Gaussians of one view, projected, sorted and dealt out to tiles."""

    index: NDArray[np.int64]  # (M,) rows in the scene, ascending
    projected: F32  # (M, 9) columns of tasks.render.project
    tile_start: NDArray[np.int64]  # (tiles + 1,) into tile_splats
    tile_splats: NDArray[np.int32]  # (pairs,) rows of `projected`, by tile, nearest first
    width: int
    height: int


def splat(gaussians: Gaussians, intrinsics: F64, scene_from_camera: F64, width: int, height: int) -> Splats:
    """Projects and sorts. `intrinsics` (3, 3) pixels, without skew; `scene_from_camera` (4, 4) rigid."""
    index, projected = project(
        gaussians.means,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.opacities,
        np.ascontiguousarray(np.linalg.inv(scene_from_camera)),
        float(intrinsics[0, 0]),
        float(intrinsics[1, 1]),
        float(intrinsics[0, 2]),
        float(intrinsics[1, 2]),
        width,
        height,
    )
    tile_start, tile_splats = _deal(projected, _nearest_first(projected), width, height)
    return Splats(index, projected, tile_start, tile_splats, width, height)


def rasterize(
    gaussians: Gaussians,
    intrinsics: F64,
    scene_from_camera: F64,
    width: int,
    height: int,
    background: F32,
) -> View:
    """The picture of a pinhole camera.

    `intrinsics` (3, 3) pixels, the centre of pixel (0, 0) at (0.5, 0.5); `scene_from_camera` (4, 4), camera x right,
    y down, z forward; `background` (3,) or (H, W, 3) rgb behind everything. Kerbl et al. 2023, with per-Gaussian depth
    order.
    """
    splats = splat(gaussians, intrinsics, scene_from_camera, width, height)
    return shade(splats, gaussians.colours[splats.index], background)


def shade(splats: Splats, colours: F32, background: F32) -> View:
    """The picture of sorted splats; `colours` (M, 3) of the Gaussians at `splats.index`."""
    height, width = splats.height, splats.width
    behind = np.ascontiguousarray(np.broadcast_to(background, (height, width, 3)), np.float32)
    rgb, depth, alpha = _blend(splats.projected, colours, splats.tile_start, splats.tile_splats, behind, width, height)
    return View(rgb, depth, alpha)


def gather(splats: Splats, image: F32, masked: NDArray[np.bool_] | None = None, n_masked: int = 0) -> tuple[F32, F32]:
    """Carries an image back to the Gaussians at `splats.index`: (sum of weight * image (M, 3), sum of weight (M,))
    with the weights that `shade` blends with.

    `image` (H, W, 3); the first `n_masked` Gaussians of the scene get nothing from the pixels `masked` (H, W).
    """
    pixels = np.empty((*image.shape[:2], 4), np.float32)
    pixels[..., :3] = image
    pixels[..., 3] = 1.0 if masked is None else ~masked
    sums, weights = _gather(splats.projected, splats.tile_start, splats.tile_splats, pixels, splats.index < n_masked)
    return sums, weights


@kernel
def _nearest_first(projected: Any) -> Any:
    """Rows (M,) by depth, equal depths in the order they have: radix sort of the bits, which for positive numbers are
    in the order of the numbers."""
    n = projected.shape[0]
    keys = np.ascontiguousarray(projected[:, DEPTH]).view(np.uint32)
    rows, spare = np.arange(n).astype(np.int32), np.empty(n, np.int32)
    for shift in (0, 11, 22):
        start = np.zeros(2049, np.int64)
        for i in range(n):
            start[((keys[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for digit in range(2048):
            start[digit + 1] += start[digit]
        for j in range(n):
            digit = (keys[rows[j]] >> np.uint32(shift)) & np.uint32(2047)
            spare[start[digit]] = rows[j]
            start[digit] += 1
        rows, spare = spare, rows
    return rows


@kernel
def _tile_range(row: Any, tiles_x: int, tiles_y: int) -> Any:
    x0 = max(0, int(np.floor((row[U] - row[HALF_U]) / TILE_WIDTH)))
    x1 = min(tiles_x, int(np.floor((row[U] + row[HALF_U]) / TILE_WIDTH)) + 1)
    y0 = max(0, int(np.floor((row[V] - row[HALF_V]) / TILE_HEIGHT)))
    y1 = min(tiles_y, int(np.floor((row[V] + row[HALF_V]) / TILE_HEIGHT)) + 1)
    return x0, x1, y0, y1


@kernel
def _deal(projected: Any, order: Any, width: int, height: int) -> Any:
    """Counting sort of (tile, splat) pairs: rows come nearest first, so every tile's list does too."""
    tiles_x, tiles_y = (width + TILE_WIDTH - 1) // TILE_WIDTH, (height + TILE_HEIGHT - 1) // TILE_HEIGHT
    start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    for i in range(projected.shape[0]):
        x0, x1, y0, y1 = _tile_range(projected[i], tiles_x, tiles_y)
        for ty in range(y0, y1):
            for tx in range(x0, x1):
                start[ty * tiles_x + tx + 1] += 1
    for t in range(tiles_x * tiles_y):
        start[t + 1] += start[t]
    fill = start[:-1].copy()
    pairs = np.empty(start[-1], np.int32)
    for i in order:
        x0, x1, y0, y1 = _tile_range(projected[i], tiles_x, tiles_y)
        for ty in range(y0, y1):
            for tx in range(x0, x1):
                t = ty * tiles_x + tx
                pairs[fill[t]] = i
                fill[t] += 1
    return start, pairs


@kernel
def _row_alphas(row: Any, x0: int, y: int, alphas: Any) -> None:
    """Alphas of one Gaussian on the pixels of a tile's row; exp by a polynomial (relative error < 1e-5)."""
    f = np.float32
    dy = f(y + 0.5) - row[V]
    a, b = f(-0.5) * row[CONIC_XX], -row[CONIC_XY] * dy
    c = f(-0.5) * row[CONIC_YY] * dy * dy
    u = row[U] - f(x0 + 0.5)
    for k in range(TILE_WIDTH):
        dx = f(k) - u
        # exp(p) = exp(p / 16)^16 for p in [-7, 0]; below -7 the contribution is invisible anyway.
        p = max(min(a * dx * dx + b * dx + c, f(0.0)), f(-7.0)) * f(0.0625)
        e = f(1.0) + p * (
            f(1.0) + p * (f(0.5) + p * (f(1.0 / 6.0) + p * (f(1.0 / 24.0) + p * (f(1.0 / 120.0) + p * f(1.0 / 720.0)))))
        )
        e = e * e
        e = e * e
        e = e * e
        e = e * e
        alpha = min(row[OPACITY] * e, f(MAX_ALPHA))
        alphas[k] = alpha if alpha >= f(MIN_ALPHA) else f(0.0)


@kernel
def _blend(
    projected: Any, colours: Any, tile_start: Any, tile_splats: Any, behind: Any, width: int, height: int
) -> Any:
    f = np.float32
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    rgb = np.empty((height, width, 3), np.float32)
    depth = np.zeros((height, width), np.float32)
    alpha = np.empty((height, width), np.float32)
    light = np.empty((TILE_HEIGHT, TILE_WIDTH), np.float32)  # what still passes, per pixel of the tile
    sums = np.empty((4, TILE_HEIGHT, TILE_WIDTH), np.float32)  # red, green, blue, depth
    alphas = np.empty(TILE_WIDTH, np.float32)
    for t in range(tile_start.shape[0] - 1):
        x0, y0 = (t % tiles_x) * TILE_WIDTH, (t // tiles_x) * TILE_HEIGHT
        rows = min(TILE_HEIGHT, height - y0)
        columns = min(TILE_WIDTH, width - x0)
        light[:] = f(1.0)
        sums[:] = f(0.0)
        for j in range(tile_start[t], tile_start[t + 1]):
            i = tile_splats[j]
            g = projected[i]
            first = max(0, int(np.floor(g[V] - g[HALF_V])) - y0)
            last = min(rows, int(np.floor(g[V] + g[HALF_V])) - y0 + 1)
            red, green, blue, z = colours[i, 0], colours[i, 1], colours[i, 2], g[DEPTH]
            for y in range(first, last):
                _row_alphas(g, x0, y0 + y, alphas)
                for k in range(TILE_WIDTH):
                    w = alphas[k] * light[y, k]
                    light[y, k] -= w
                    sums[0, y, k] += w * red
                    sums[1, y, k] += w * green
                    sums[2, y, k] += w * blue
                    sums[3, y, k] += w * z
            if (j & 15) == 15 and _is_opaque(light, rows, columns):
                break
        for y in range(rows):
            for k in range(columns):
                left = light[y, k]
                covered = f(1.0) - left
                for channel in range(3):
                    rgb[y0 + y, x0 + k, channel] = sums[channel, y, k] + left * behind[y0 + y, x0 + k, channel]
                alpha[y0 + y, x0 + k] = covered
                if covered > f(0.0):
                    depth[y0 + y, x0 + k] = sums[3, y, k] / covered
    return rgb, depth, alpha


@kernel
def _is_opaque(light: Any, rows: int, columns: int) -> bool:
    for y in range(rows):
        for k in range(columns):
            if light[y, k] > OPAQUE:
                return False
    return True


@kernel
def _gather(projected: Any, tile_start: Any, tile_splats: Any, image: Any, is_masked: Any) -> Any:
    f = np.float32
    height, width = image.shape[:2]
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    sums = np.zeros((projected.shape[0], 3), np.float32)
    weights = np.zeros(projected.shape[0], np.float32)
    light = np.empty((TILE_HEIGHT, TILE_WIDTH), np.float32)
    pixels = np.zeros((4, TILE_HEIGHT, TILE_WIDTH), np.float32)
    alphas = np.empty(TILE_WIDTH, np.float32)
    lanes = np.empty((4, TILE_WIDTH), np.float32)  # sums per column, so that the loop has no reduction
    for t in range(tile_start.shape[0] - 1):
        x0, y0 = (t % tiles_x) * TILE_WIDTH, (t // tiles_x) * TILE_HEIGHT
        rows = min(TILE_HEIGHT, height - y0)
        columns = min(TILE_WIDTH, width - x0)
        light[:] = f(0.0)
        for y in range(rows):
            for k in range(columns):
                light[y, k] = f(1.0)  # pixels outside the image carry no weight
                for channel in range(4):
                    pixels[channel, y, k] = image[y0 + y, x0 + k, channel]
        for j in range(tile_start[t], tile_start[t + 1]):
            i = tile_splats[j]
            g = projected[i]
            first = max(0, int(np.floor(g[V] - g[HALF_V])) - y0)
            last = min(rows, int(np.floor(g[V] + g[HALF_V])) - y0 + 1)
            lanes[:] = f(0.0)
            ignores_mask = f(0.0) if is_masked[i] else f(1.0)
            for y in range(first, last):
                _row_alphas(g, x0, y0 + y, alphas)
                for k in range(TILE_WIDTH):
                    w = alphas[k] * light[y, k]
                    light[y, k] -= w
                    w *= max(pixels[3, y, k], ignores_mask)
                    lanes[0, k] += w * pixels[0, y, k]
                    lanes[1, k] += w * pixels[1, y, k]
                    lanes[2, k] += w * pixels[2, y, k]
                    lanes[3, k] += w
            for k in range(TILE_WIDTH):
                sums[i, 0] += lanes[0, k]
                sums[i, 1] += lanes[1, k]
                sums[i, 2] += lanes[2, k]
                weights[i] += lanes[3, k]
            if (j & 15) == 15 and _is_opaque(light, rows, columns):
                break
    return sums, weights

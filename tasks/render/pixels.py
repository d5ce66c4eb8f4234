"""The kernels that go over pixels: blending a tile's Gaussians, and summing an image up by the same weights.

A tile keeps its pixels in a flat buffer and visits its Gaussians one after the other (Gaussian outer, pixels inner):
the inner loop over a row's columns has no branches, so that the compiler turns it into vector instructions. Sums over
pixels are kept per column and added up at the end, in one fixed order.
"""

from typing import Any

import numpy as np

from tasks.kernels import kernel
from tasks.render.project import CONIC_XX, CONIC_XY, CONIC_YY, DEPTH, HALF_V, MIN_ALPHA, OPACITY, U, V
from tasks.render.tiles import TILE_HEIGHT, TILE_WIDTH

OPAQUE = 1.0e-3  # a tile is done when no pixel lets more light than this through
MAX_ALPHA = 0.999


@kernel
def row_alphas(row: Any, x0: int, y: int, alphas: Any) -> None:
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
def blend(
    projected: Any,
    colours: Any,
    tile_start: Any,
    tile_splats: Any,
    behind: Any,
    first_tile: int,
    last_tile: int,
    rgb: Any,
    depth: Any,
    alpha: Any,
    ends: Any,
) -> None:
    """Fills rgb (H, W, 3), depth and alpha (H, W) on some tiles, and where in `tile_splats` each was opaque."""
    f = np.float32
    height, width = alpha.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    light = np.empty((TILE_HEIGHT, TILE_WIDTH), np.float32)  # what still passes, per pixel of the tile
    sums = np.empty((4, TILE_HEIGHT, TILE_WIDTH), np.float32)  # red, green, blue, depth
    alphas = np.empty(TILE_WIDTH, np.float32)
    for t in range(first_tile, last_tile):
        x0, y0 = (t % tiles_x) * TILE_WIDTH, (t // tiles_x) * TILE_HEIGHT
        rows = min(TILE_HEIGHT, height - y0)
        columns = min(TILE_WIDTH, width - x0)
        light[:] = f(1.0)
        sums[:] = f(0.0)
        ends[t] = tile_start[t + 1]
        for j in range(tile_start[t], tile_start[t + 1]):
            i = tile_splats[j]
            g = projected[i]
            first = max(0, int(np.floor(g[V] - g[HALF_V])) - y0)
            last = min(rows, int(np.floor(g[V] + g[HALF_V])) - y0 + 1)
            red, green, blue, z = colours[i, 0], colours[i, 1], colours[i, 2], g[DEPTH]
            for y in range(first, last):
                row_alphas(g, x0, y0 + y, alphas)
                for k in range(TILE_WIDTH):
                    w = alphas[k] * light[y, k]
                    light[y, k] -= w
                    sums[0, y, k] += w * red
                    sums[1, y, k] += w * green
                    sums[2, y, k] += w * blue
                    sums[3, y, k] += w * z
            if (j & 15) == 15 and _is_opaque(light, rows, columns):
                ends[t] = j + 1
                break
        for y in range(rows):
            for k in range(columns):
                left = light[y, k]
                covered = f(1.0) - left
                for channel in range(3):
                    rgb[y0 + y, x0 + k, channel] = sums[channel, y, k] + left * behind[y0 + y, x0 + k, channel]
                alpha[y0 + y, x0 + k] = covered
                depth[y0 + y, x0 + k] = sums[3, y, k] / covered if covered > f(0.0) else f(0.0)


@kernel
def _is_opaque(light: Any, rows: int, columns: int) -> bool:
    for y in range(rows):
        for k in range(columns):
            if light[y, k] > OPAQUE:
                return False
    return True


@kernel
def carry_back(projected: Any, tile_start: Any, tile_splats: Any, image: Any, is_masked: Any) -> Any:
    """Sums (M, 3) of weight times image and (M,) of weight; `image` (H, W, 4), the last being 0 where masked."""
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
                row_alphas(g, x0, y0 + y, alphas)
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

"""The way back through `blend`: what a change of the pixels means for each Gaussian on each tile."""

from typing import Any

import numpy as np

from tasks.kernels import kernel
from tasks.render.pixels import MAX_ALPHA, row_alphas
from tasks.render.project import DEPTH, HALF_V, U, V
from tasks.render.tiles import TILE_HEIGHT, TILE_WIDTH, tile_range

# What a tile adds to the derivatives of one of its Gaussians: moments of q = dL/d(log alpha) about its centre ...
Q, QX, QY, QXX, QXY, QYY = range(6)
W_DEPTH, W_RED, W_GREEN, W_BLUE, PEAK = range(6, 11)  # ... weight times upstream, and the largest weight
SUMS_SIZE = 11


@kernel
def blend_gradient(
    projected: Any,
    colours: Any,
    tile_start: Any,
    tile_splats: Any,
    ends: Any,
    pair_start: Any,
    upstream: Any,
    totals: Any,
    first_tile: int,
    last_tile: int,
    rows_out: Any,
) -> None:
    """Fills a row of `rows_out` (pairs, 11), zero before, for each Gaussian on each of some tiles, as far as blended.

    `upstream` (H, W, 5): derivatives by red, green, blue, sum of weight * depth, sum of weight; `totals` (H, W): those
    times the sums themselves, added up, background included. With v a Gaussian's share of that per weight, what lies
    behind it is the total minus what has been seen, so that one walk from front to back is enough.
    """
    f = np.float32
    height, width = totals.shape
    tiles_x, tiles_y = (width + TILE_WIDTH - 1) // TILE_WIDTH, (height + TILE_HEIGHT - 1) // TILE_HEIGHT
    light = np.empty((TILE_HEIGHT, TILE_WIDTH), np.float32)
    rest = np.empty((TILE_HEIGHT, TILE_WIDTH), np.float32)
    pull = np.empty((5, TILE_HEIGHT, TILE_WIDTH), np.float32)
    alphas = np.empty(TILE_WIDTH, np.float32)
    lanes = np.empty((SUMS_SIZE, TILE_WIDTH), np.float32)
    for t in range(first_tile, last_tile):
        tx, ty = t % tiles_x, t // tiles_x
        x0, y0 = tx * TILE_WIDTH, ty * TILE_HEIGHT
        rows = min(TILE_HEIGHT, height - y0)
        columns = min(TILE_WIDTH, width - x0)
        light[:], rest[:], pull[:] = f(0.0), f(0.0), f(0.0)
        for y in range(rows):
            for k in range(columns):
                light[y, k] = f(1.0)  # pixels outside the image carry no weight
                rest[y, k] = totals[y0 + y, x0 + k]
                for channel in range(5):
                    pull[channel, y, k] = upstream[y0 + y, x0 + k, channel]
        for j in range(tile_start[t], ends[t]):
            i = tile_splats[j]
            g = projected[i]
            first = max(0, int(np.floor(g[V] - g[HALF_V])) - y0)
            last = min(rows, int(np.floor(g[V] + g[HALF_V])) - y0 + 1)
            red, green, blue, z = colours[i, 0], colours[i, 1], colours[i, 2], g[DEPTH]
            lanes[:] = f(0.0)
            for y in range(first, last):
                row_alphas(g, x0, y0 + y, alphas)
                dy = f(y0 + y + 0.5) - g[V]
                for k in range(TILE_WIDTH):
                    opaque = alphas[k]
                    w = opaque * light[y, k]
                    light[y, k] -= w
                    v = red * pull[0, y, k] + green * pull[1, y, k] + blue * pull[2, y, k]
                    v += z * pull[3, y, k] + pull[4, y, k]
                    rest[y, k] -= w * v
                    q = w * v - rest[y, k] * (opaque / (f(1.0) - opaque))
                    q = q if opaque < f(MAX_ALPHA) else f(0.0)
                    dx = f(x0 + k + 0.5) - g[U]
                    lanes[Q, k] += q
                    lanes[QX, k] += q * dx
                    lanes[QY, k] += q * dy
                    lanes[QXX, k] += q * dx * dx
                    lanes[QXY, k] += q * dx * dy
                    lanes[QYY, k] += q * dy * dy
                    lanes[W_DEPTH, k] += w * pull[3, y, k]
                    lanes[W_RED, k] += w * pull[0, y, k]
                    lanes[W_GREEN, k] += w * pull[1, y, k]
                    lanes[W_BLUE, k] += w * pull[2, y, k]
                    lanes[PEAK, k] = max(lanes[PEAK, k], w)
            left, right, top, _ = tile_range(g, tiles_x, tiles_y)
            out = rows_out[pair_start[i] + (ty - top) * (right - left) + tx - left]
            for channel in range(PEAK):
                total = f(0.0)
                for k in range(TILE_WIDTH):
                    total += lanes[channel, k]
                out[channel] = total
            out[PEAK] = lanes[PEAK].max()


@kernel
def add_pairs(pair_start: Any, rows: Any, first: int, last: int, out: Any) -> None:
    """Adds up the rows (pairs, 11) of each Gaussian from `first` to `last` into `out` (M, 11) float32."""
    for i in range(first, last):
        for channel in range(SUMS_SIZE):
            total = np.float32(0.0)
            for j in range(pair_start[i], pair_start[i + 1]):
                total = max(total, rows[j, channel]) if channel == PEAK else total + rows[j, channel]
            out[i, channel] = total

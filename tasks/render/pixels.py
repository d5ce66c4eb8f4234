"""The kernels that go over pixels: blending a tile's Gaussians, and summing an image up by the same weights.

A tile visits its Gaussians one after the other (Gaussian outer, pixels inner): the inner loop over a row of 16 pixels
has no branches, so that the compiler turns it into vector instructions. What decides the speed else (each measured):
all channels lie in one array, 17 cache lines apart, for channels 4 KiB apart stall each other; unsigned indices need no
wrap-around; 16 Gaussians at a time are fetched into a small table, so that their cache misses overlap. Sums over pixels
are kept per column and added up at the end, in one fixed order.
"""

from typing import Any

import numpy as np

from tasks.kernels import inlined, kernel
from tasks.render.fused import fma
from tasks.render.project import (
    BLUE,
    BOTTOM,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    CUT,
    DEPTH,
    GREEN,
    OPACITY,
    RED,
    TILE,
    TOP,
    U,
    V,
)

OPAQUE = np.float32(1.0e-3)  # a tile is done when no pixel lets more light than this through
MAX_ALPHA = np.float32(0.999)
BATCH = 16  # Gaussians fetched at a time; then it is seen whether the tile is opaque
PIXELS = TILE * TILE
STRIDE = PIXELS + 16  # between channels, in float32
TABLE_SIZE = 11

# exp(p) = polynomial(p / 16)^16; least squares of the relative error on [log(MIN_ALPHA), 0]: below 1.5e-6 there.
SIXTEENTH = np.float32(1.0 / 16.0)
E0, E1, E2, E3, E4 = (np.float32(c) for c in (0.99999991, 0.99998831, 0.49974119, 0.16462338, 0.03492385))
NOTHING, HALF = np.float32(0.0), np.float32(0.5)


@inlined
def alpha_at(a: Any, b: Any, c: Any, dx: Any, opacity: Any, cut: Any) -> Any:
    """Alpha where the sixteenth of the exponent is a dx^2 + b dx + c; 0 where that is below `cut`."""
    p = fma(fma(a, dx, b), dx, c)
    e = min(p, NOTHING)
    e = fma(fma(fma(fma(E4, e, E3), e, E2), e, E1), e, E0)
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    alpha = min(opacity * e, MAX_ALPHA)
    return alpha if p >= cut else NOTHING


@kernel
def fetch(projected: Any, splats: Any, start: int, n: int, x0: int, y0: int, table: Any, spans: Any) -> None:
    """The Gaussians `start` to `start + n` of a tile's list, ready for its pixels.

    `table` (BATCH, 11): centre from that of the tile's first pixel, depth, a sixteenth of the exponent's coefficients,
    opacity, a sixteenth of CUT, rgb; `spans` (BATCH, 2): rows of the tile first <= y < last.
    """
    for k in range(n):
        i = np.uint64(splats[start + k])
        spans[k, 0] = max(0, int(projected[i, TOP]) - y0)
        spans[k, 1] = min(TILE, int(projected[i, BOTTOM]) - y0)
        table[k, 0] = projected[i, U] - np.float32(x0 + 0.5)
        table[k, 1] = projected[i, V] - np.float32(y0 + 0.5)
        table[k, 2] = projected[i, DEPTH]
        table[k, 3] = -HALF * SIXTEENTH * projected[i, CONIC_XX]
        table[k, 4] = -SIXTEENTH * projected[i, CONIC_XY]
        table[k, 5] = -HALF * SIXTEENTH * projected[i, CONIC_YY]
        table[k, 6] = projected[i, OPACITY]
        table[k, 7] = SIXTEENTH * projected[i, CUT]
        table[k, 8], table[k, 9], table[k, 10] = projected[i, RED], projected[i, GREEN], projected[i, BLUE]


@kernel
def blend(
    projected: Any,
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
    height, width = alpha.shape
    tiles_x = (width + TILE - 1) // TILE
    buffer = np.empty(5 * STRIDE, np.float32)  # light that still passes; sums of red, green, blue, depth
    table, spans = np.empty((BATCH, TABLE_SIZE), np.float32), np.empty((BATCH, 2), np.int64)
    step = np.uint64(STRIDE)
    for t in range(first_tile, last_tile):
        x0, y0 = (t % tiles_x) * TILE, (t // tiles_x) * TILE
        buffer[:PIXELS] = np.float32(1.0)
        buffer[PIXELS:] = NOTHING
        ends[t] = tile_start[t + 1]
        for batch in range(tile_start[t], tile_start[t + 1], BATCH):
            n = min(BATCH, tile_start[t + 1] - batch)
            fetch(projected, tile_splats, batch, n, x0, y0, table, spans)
            for j in range(n):
                u, v, z, a, b, c = table[j, 0], table[j, 1], table[j, 2], table[j, 3], table[j, 4], table[j, 5]
                opacity, cut = table[j, 6], table[j, 7]
                red, green, blue = table[j, 8], table[j, 9], table[j, 10]
                for y in range(spans[j, 0], spans[j, 1]):
                    dy = np.float32(y) - v
                    b_dy, c_dy2 = b * dy, c * dy * dy
                    row = np.uint64(y * TILE)
                    for k in range(TILE):
                        at = row + np.uint64(k)
                        opaque = alpha_at(a, b_dy, c_dy2, np.float32(k) - u, opacity, cut)
                        light = buffer[at]
                        w = opaque * light
                        buffer[at] = light - w
                        at += step
                        buffer[at] = fma(w, red, buffer[at])
                        at += step
                        buffer[at] = fma(w, green, buffer[at])
                        at += step
                        buffer[at] = fma(w, blue, buffer[at])
                        at += step
                        buffer[at] = fma(w, z, buffer[at])
            if most_light(buffer, min(TILE, height - y0), min(TILE, width - x0)) <= OPAQUE:
                ends[t] = batch + n
                break
        for y in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                pixel = y * TILE + x
                light = buffer[pixel]
                covered = np.float32(1.0) - light
                for channel in range(3):
                    total = buffer[(channel + 1) * STRIDE + pixel]
                    rgb[y0 + y, x0 + x, channel] = fma(light, behind[y0 + y, x0 + x, channel], total)
                alpha[y0 + y, x0 + x] = covered
                depth[y0 + y, x0 + x] = buffer[4 * STRIDE + pixel] / covered if covered > NOTHING else NOTHING


@kernel
def most_light(buffer: Any, rows: int, columns: int) -> Any:
    """The largest of a tile's first channel, on the pixels that the picture has."""
    most = np.zeros(TILE, np.float32)
    for y in range(rows):
        for k in range(TILE):
            most[k] = max(most[k], buffer[np.uint64(y * TILE) + np.uint64(k)])
    return most[:columns].max()


@kernel
def carry_back(projected: Any, tile_start: Any, tile_splats: Any, image: Any, is_masked: Any) -> Any:
    """Sums (M, 3) of weight times image and (M,) of weight; `image` (H, W, 4), the last being 0 where masked."""
    height, width = image.shape[:2]
    tiles_x = (width + TILE - 1) // TILE
    sums = np.zeros((projected.shape[0], 4), np.float32)
    buffer = np.empty(5 * STRIDE, np.float32)
    lanes = np.empty(4 * TILE, np.float32)
    table, spans = np.empty((BATCH, TABLE_SIZE), np.float32), np.empty((BATCH, 2), np.int64)
    for t in range(tile_start.shape[0] - 1):
        x0, y0 = (t % tiles_x) * TILE, (t // tiles_x) * TILE
        buffer[:] = NOTHING  # pixels outside the image carry no weight
        for y in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                buffer[y * TILE + x] = np.float32(1.0)
                for channel in range(4):
                    buffer[(channel + 1) * STRIDE + y * TILE + x] = image[y0 + y, x0 + x, channel]
        for batch in range(tile_start[t], tile_start[t + 1], BATCH):
            n = min(BATCH, tile_start[t + 1] - batch)
            fetch(projected, tile_splats, batch, n, x0, y0, table, spans)
            for j in range(n):
                u, v, a, b, c = table[j, 0], table[j, 1], table[j, 3], table[j, 4], table[j, 5]
                opacity, cut = table[j, 6], table[j, 7]
                ignores_mask = NOTHING if is_masked[tile_splats[batch + j]] else np.float32(1.0)
                lanes[:] = NOTHING
                for y in range(spans[j, 0], spans[j, 1]):
                    dy = np.float32(y) - v
                    b_dy, c_dy2 = b * dy, c * dy * dy
                    row = np.uint64(y * TILE)
                    for k in range(TILE):
                        at, lane = row + np.uint64(k), np.uint64(k)
                        light = buffer[at]
                        w = light * alpha_at(a, b_dy, c_dy2, np.float32(k) - u, opacity, cut)
                        buffer[at] = light - w
                        w *= max(buffer[at + np.uint64(4 * STRIDE)], ignores_mask)
                        lanes[lane] += w * buffer[at + np.uint64(STRIDE)]
                        lanes[lane + np.uint64(TILE)] += w * buffer[at + np.uint64(2 * STRIDE)]
                        lanes[lane + np.uint64(2 * TILE)] += w * buffer[at + np.uint64(3 * STRIDE)]
                        lanes[lane + np.uint64(3 * TILE)] += w
                for channel in range(4):
                    for k in range(TILE):
                        sums[tile_splats[batch + j], channel] += lanes[channel * TILE + k]
            if most_light(buffer, min(TILE, height - y0), min(TILE, width - x0)) <= OPAQUE:
                break
    return sums[:, :3].copy(), sums[:, 3].copy()

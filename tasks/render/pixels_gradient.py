"""The way back through `blend`: what a change of the pixels means for each Gaussian on each tile."""

from typing import Any

import numpy as np

from tasks.kernels import inlined, kernel
from tasks.render.fused import fma
from tasks.render.pixels import BATCH, MAX_ALPHA, NOTHING, STRIDE, TABLE_SIZE, alpha_at, fetch
from tasks.render.project import TILE

# What a tile adds to the derivatives of one of its Gaussians: moments, about its centre, of q = dL/d(log alpha) ...
Q, Q_X, Q_Y, Q_XX, Q_XY, Q_YY = range(6)
W_DEPTH, W_RED, W_GREEN, W_BLUE, PEAK = range(6, 11)  # ... weight times upstream, and the largest weight
SUMS_SIZE = 11
# Channels of a tile's buffer after light that still passes and the rest of the total: the upstream derivatives.
RED_AT, GREEN_AT, BLUE_AT, DEPTH_AT, WEIGHT_AT = (np.uint64(channel * STRIDE) for channel in range(2, 7))
LANE = np.uint64(TILE)


@inlined
def _log_alpha_gradient(opaque: Any, seen: Any, behind: Any) -> Any:
    """alpha dL/dalpha: its own share of the pixel less what it hides; flat where alpha is capped."""
    q = seen - behind * (opaque / (np.float32(1.0) - opaque))
    return q if opaque < MAX_ALPHA else NOTHING


@kernel
def _load(
    buffer: Any,
    x0: int,
    y0: int,
    d_rgb: Any,
    d_depth: Any,
    d_alpha: Any,
    rgb: Any,
    depth: Any,
    alpha: Any,
) -> None:
    """A tile's upstream derivatives by rgb, sum of weight * depth and sum of weight; and in channel 1 those times the
    sums themselves, added up, background included. Pixels outside the picture carry no light."""
    height, width = alpha.shape
    buffer[:] = NOTHING
    for y in range(min(TILE, height - y0)):
        for x in range(min(TILE, width - x0)):
            at, row, column = np.uint64(y * TILE + x), y0 + y, x0 + x
            covered, mean_depth = alpha[row, column], depth[row, column]
            by_depth = d_depth[row, column] / covered if covered > NOTHING else NOTHING
            by_weight = d_alpha[row, column] - by_depth * mean_depth  # depth = (sum of weight * depth) / alpha
            total = covered * (by_depth * mean_depth + by_weight)
            for channel in range(3):
                by_channel = d_rgb[row, column, channel]
                buffer[at + np.uint64((2 + channel) * STRIDE)] = by_channel
                total += by_channel * rgb[row, column, channel]
            buffer[at] = np.float32(1.0)
            buffer[at + np.uint64(STRIDE)] = total
            buffer[at + DEPTH_AT] = by_depth
            buffer[at + WEIGHT_AT] = by_weight


@kernel
def blend_gradient(
    projected: Any,
    tiles: Any,
    tile_start: Any,
    tile_splats: Any,
    ends: Any,
    pair_start: Any,
    d_rgb: Any,
    d_depth: Any,
    d_alpha: Any,
    rgb: Any,
    depth: Any,
    alpha: Any,
    first_tile: int,
    last_tile: int,
    out: Any,
) -> None:
    """Fills a row of `out` (pairs, 11) for each Gaussian on each of some tiles; zero where it was not blended.

    With v a Gaussian's share of the loss per weight, what lies behind it is the total less what has been seen, so that
    one walk from front to back is enough.
    """
    width = alpha.shape[1]
    tiles_x = (width + TILE - 1) // TILE
    buffer = np.empty(7 * STRIDE, np.float32)
    lanes = np.empty(SUMS_SIZE * TILE, np.float32)
    table, spans = np.empty((BATCH, TABLE_SIZE), np.float32), np.empty((BATCH, 2), np.int64)
    step = np.uint64(STRIDE)
    for t in range(first_tile, last_tile):
        tx, ty = t % tiles_x, t // tiles_x
        x0, y0 = tx * TILE, ty * TILE
        _load(buffer, x0, y0, d_rgb, d_depth, d_alpha, rgb, depth, alpha)
        for batch in range(tile_start[t], ends[t], BATCH):
            n = min(BATCH, ends[t] - batch)
            fetch(projected, tile_splats, batch, n, x0, y0, table, spans)
            for j in range(n):
                u, v, z, a, b, c = table[j, 0], table[j, 1], table[j, 2], table[j, 3], table[j, 4], table[j, 5]
                opacity, cut = table[j, 6], table[j, 7]
                red, green, blue = table[j, 8], table[j, 9], table[j, 10]
                lanes[:] = NOTHING
                for y in range(spans[j, 0], spans[j, 1]):
                    dy = np.float32(y) - v
                    b_dy, c_dy2, dy2 = b * dy, c * dy * dy, dy * dy
                    row = np.uint64(y * TILE)
                    for k in range(TILE):
                        at, lane = row + np.uint64(k), np.uint64(k)
                        dx = np.float32(k) - u
                        opaque = alpha_at(a, b_dy, c_dy2, dx, opacity, cut)
                        light = buffer[at]
                        w = opaque * light
                        buffer[at] = light - w
                        by_red, by_green, by_blue = buffer[at + RED_AT], buffer[at + GREEN_AT], buffer[at + BLUE_AT]
                        by_depth = buffer[at + DEPTH_AT]
                        share = fma(z, by_depth, buffer[at + WEIGHT_AT])
                        seen = w * fma(red, by_red, fma(green, by_green, fma(blue, by_blue, share)))
                        behind = buffer[at + step] - seen
                        buffer[at + step] = behind
                        q = _log_alpha_gradient(opaque, seen, behind)
                        q_x = q * dx
                        lanes[lane] += q
                        lane += LANE
                        lanes[lane] += q_x
                        lane += LANE
                        lanes[lane] = fma(q, dy, lanes[lane])
                        lane += LANE
                        lanes[lane] = fma(q_x, dx, lanes[lane])
                        lane += LANE
                        lanes[lane] = fma(q_x, dy, lanes[lane])
                        lane += LANE
                        lanes[lane] = fma(q, dy2, lanes[lane])
                        lane += LANE
                        lanes[lane] = fma(w, by_depth, lanes[lane])
                        lane += LANE
                        lanes[lane] = fma(w, by_red, lanes[lane])
                        lane += LANE
                        lanes[lane] = fma(w, by_green, lanes[lane])
                        lane += LANE
                        lanes[lane] = fma(w, by_blue, lanes[lane])
                        lane += LANE
                        lanes[lane] += max(w - lanes[lane], NOTHING)  # the larger; a plain max is stored under a mask
                _fold(lanes, out, _row(tiles, pair_start, tile_splats[batch + j], tx, ty))
        for j in range(ends[t], tile_start[t + 1]):
            row = _row(tiles, pair_start, tile_splats[j], tx, ty)
            for channel in range(SUMS_SIZE):
                out[row, channel] = NOTHING


@kernel
def _row(tiles: Any, pair_start: Any, i: int, tx: int, ty: int) -> Any:
    """Where the pair of a Gaussian and a tile stands among the rows of sums."""
    return np.uint64(pair_start[i] + (ty - tiles[i, 2]) * (tiles[i, 1] - tiles[i, 0]) + tx - tiles[i, 0])


@kernel
def _fold(lanes: Any, out: Any, row: Any) -> None:
    """Adds up the 16 columns of each channel, halves onto halves; of PEAK takes the largest."""
    for channel in range(PEAK):
        start = np.uint64(channel * TILE)
        for k in range(8):
            lanes[start + np.uint64(k)] += lanes[start + np.uint64(k + 8)]
        for k in range(4):
            lanes[start + np.uint64(k)] += lanes[start + np.uint64(k + 4)]
        first, second = (
            lanes[start] + lanes[start + np.uint64(2)],
            lanes[start + np.uint64(1)] + lanes[start + np.uint64(3)],
        )
        out[row, channel] = first + second
    largest = NOTHING
    for k in range(TILE):
        largest = max(largest, lanes[np.uint64(PEAK * TILE + k)])
    out[row, PEAK] = largest


@kernel
def add_pairs(pair_start: Any, rows: Any, first: int, last: int, out: Any) -> None:
    """Adds up the rows (pairs, 11) of each Gaussian from `first` to `last` into `out` (M, 11) float32."""
    for i in range(first, last):
        start = np.uint64(pair_start[i])
        for channel in range(SUMS_SIZE):
            out[i, channel] = rows[start, channel]
        for j in range(start + np.uint64(1), np.uint64(pair_start[i + 1])):
            for channel in range(PEAK):
                out[i, channel] += rows[j, channel]
            out[i, PEAK] = max(out[i, PEAK], rows[j, PEAK])

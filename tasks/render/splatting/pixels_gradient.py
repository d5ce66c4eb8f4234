"""The backward pass of `blend`: what a change of the pixels means for each Gaussian on each tile."""

from typing import Any

import numpy as np

from tasks.kernels.compiled import inlined, kernel
from tasks.kernels.simd import fill, fused, load, store, sums, where_below
from tasks.render.splatting.pixels import ALL, BATCH, MAX_ALPHA, NOTHING, aligned, alpha_at, exponent, fetch_ahead
from tasks.render.splatting.project import BLUE, BOTTOM, DEPTH, GREEN, RED, TILE, TOP, V

# What a tile adds to the derivatives of one of its Gaussians: moments, about its centre, of q = dL/d(log alpha), and
# weight times upstream. A row is a cache line.
Q, Q_X, Q_Y, Q_XX, Q_XY, Q_YY, W_DEPTH, W_RED, W_GREEN, W_BLUE = range(10)
SUMS_SIZE = 16
# Channels of a row of a tile, after light that still passes and the rest of the total: the upstream derivatives.
CHANNELS = 7
REST_AT, RED_AT, GREEN_AT, BLUE_AT, DEPTH_AT, WEIGHT_AT = (np.uint64(channel * TILE) for channel in range(1, CHANNELS))
ROW = np.uint64(CHANNELS * TILE)


@kernel
def _load(
    buffer: Any, x0: int, y0: int, d_rgb: Any, d_depth: Any, d_alpha: Any, rgb: Any, depth: Any, alpha: Any
) -> None:
    """A tile's upstream derivatives by rgb, sum of weight * depth and sum of weight; and in channel 1 those times the
    sums themselves, added up, background included. Pixels outside the picture carry no light."""
    height, width = alpha.shape
    buffer[:] = NOTHING
    for y in range(min(TILE, height - y0)):
        for x in range(min(TILE, width - x0)):
            at, row, column = np.uint64(y) * ROW + np.uint64(x), y0 + y, x0 + x
            covered, mean_depth = alpha[row, column], depth[row, column]
            by_depth = d_depth[row, column] / covered if covered > NOTHING else NOTHING
            by_weight = d_alpha[row, column] - by_depth * mean_depth  # depth = (sum of weight * depth) / alpha
            total = covered * (by_depth * mean_depth + by_weight)
            for channel in range(3):
                by_channel = d_rgb[row, column, channel]
                buffer[at + RED_AT + np.uint64(channel * TILE)] = by_channel
                total += by_channel * rgb[row, column, channel]
            buffer[at] = ALL
            buffer[at + REST_AT] = total
            buffer[at + DEPTH_AT] = by_depth
            buffer[at + WEIGHT_AT] = by_weight


@inlined
def _log_alpha_gradient(opaque: Any, seen: Any, behind: Any) -> Any:
    """alpha dL/dalpha: its own share of the pixel less what it hides; flat where alpha is capped."""
    return where_below(opaque, fill(MAX_ALPHA), seen - behind * (opaque / (fill(ALL) - opaque)))


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
    out: Any,
    first_tile: int,
    last_tile: int,
) -> None:
    """Fills a row of `out` (pairs, 16) for each Gaussian on each of some tiles; zero where it was not blended.

    With v a Gaussian's share of the loss per weight, what lies behind it is the total less what has been seen, so that
    one walk from front to back is enough.
    """
    width = alpha.shape[1]
    tiles_x = (width + TILE - 1) // TILE
    buffer = aligned(TILE * CHANNELS * TILE)
    for t in range(first_tile, last_tile):
        tx, ty = t % tiles_x, t // tiles_x
        x0, y0 = tx * TILE, ty * TILE
        _load(buffer, x0, y0, d_rgb, d_depth, d_alpha, rgb, depth, alpha)
        fetch_ahead(projected, tile_splats, tile_start[t], min(tile_start[t] + BATCH, ends[t]))
        for batch in range(tile_start[t], ends[t], BATCH):
            following = min(batch + BATCH, ends[t])
            fetch_ahead(projected, tile_splats, following, min(following + BATCH, ends[t]))
            for j in range(batch, following):
                i = np.uint64(tile_splats[j])
                dx, steep, slope, level = exponent(projected, i, x0)
                red, green, blue = fill(projected[i, RED]), fill(projected[i, GREEN]), fill(projected[i, BLUE])
                z = fill(projected[i, DEPTH])
                first, last = max(0, int(projected[i, TOP]) - y0), min(TILE, int(projected[i, BOTTOM]) - y0)
                dy = fill(np.float32(y0 + first) + np.float32(0.5) - projected[i, V])
                at = np.uint64(first) * ROW
                q, q_y, q_yy = fill(NOTHING), fill(NOTHING), fill(NOTHING)
                w_depth, w_red, w_green, w_blue = fill(NOTHING), fill(NOTHING), fill(NOTHING), fill(NOTHING)
                for _ in range(first, last):
                    opaque = alpha_at(fused(fused(dy, steep, slope), dy, level))
                    light = load(buffer, at)
                    w = opaque * light
                    store(buffer, at, light - w)
                    by_red, by_green = load(buffer, at + RED_AT), load(buffer, at + GREEN_AT)
                    by_blue, by_depth = load(buffer, at + BLUE_AT), load(buffer, at + DEPTH_AT)
                    share = fused(z, by_depth, load(buffer, at + WEIGHT_AT))
                    seen = w * fused(red, by_red, fused(green, by_green, fused(blue, by_blue, share)))
                    behind = load(buffer, at + REST_AT) - seen
                    store(buffer, at + REST_AT, behind)
                    here = _log_alpha_gradient(opaque, seen, behind)
                    here_y = here * dy
                    q, q_y, q_yy = q + here, q_y + here_y, fused(here_y, dy, q_yy)
                    w_depth, w_red = fused(w, by_depth, w_depth), fused(w, by_red, w_red)
                    w_green, w_blue = fused(w, by_green, w_green), fused(w, by_blue, w_blue)
                    at += ROW
                    dy = dy + fill(ALL)
                q_x = q * dx
                row = _row(tiles, pair_start, i, tx, ty) * np.uint64(SUMS_SIZE)
                store(out, row, sums((q, q_x, q_y, q_x * dx, q_y * dx, q_yy, w_depth, w_red, w_green, w_blue)))
        for j in range(ends[t], tile_start[t + 1]):
            store(out, _row(tiles, pair_start, tile_splats[j], tx, ty) * np.uint64(SUMS_SIZE), fill(NOTHING))


@inlined
def _row(tiles: Any, pair_start: Any, i: Any, tx: Any, ty: Any) -> Any:
    """Where the pair of a Gaussian and a tile stands among the rows of sums."""
    return np.uint64(pair_start[i] + (ty - tiles[i, 2]) * (tiles[i, 1] - tiles[i, 0]) + tx - tiles[i, 0])


@kernel
def add_pairs(pair_start: Any, rows: Any, first: int, last: int, out: Any) -> None:
    """Adds up the rows (pairs, 16) of each Gaussian from `first` to `last` into `out` (M, 16) float32."""
    step = np.uint64(SUMS_SIZE)
    for i in range(first, last):
        total = load(rows, np.uint64(pair_start[i]) * step)
        for j in range(pair_start[i] + 1, pair_start[i + 1]):
            total = total + load(rows, np.uint64(j) * step)
        store(out, np.uint64(i) * step, total)

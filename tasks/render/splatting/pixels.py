"""The kernels that go over pixels: blending a tile's Gaussians, and summing an image up by the same weights.

A tile visits its Gaussians one after the other (Gaussian outer, pixels inner); a row of 16 pixels is one vector
(tasks.kernels.simd). All channels of a row lie side by side, so that no two of them are 4 KiB apart, which would stall;
the Gaussians of the next batch are fetched while this one is blended. Sums over pixels are kept per column and added up
at the end, in one fixed order.
"""

from typing import Any

import numpy as np

from tasks.kernels.compiled import inlined, kernel
from tasks.kernels.simd import (
    columns,
    fill,
    fused,
    greatest,
    larger,
    load,
    prefetch,
    smaller,
    store,
    sums,
    where_at_least,
)
from tasks.render.splatting.project import (
    BLUE,
    BOTTOM,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    GREEN,
    LOG_OPACITY,
    MIN_ALPHA,
    PROJECTED_SIZE,
    RED,
    TILE,
    TOP,
    U,
    V,
)

OPAQUE = np.float32(1.0e-3)  # a tile is done when no pixel lets more light than this through
MAX_ALPHA = np.float32(0.999)
BATCH = 16  # Gaussians after which it is seen whether the tile is opaque
NOTHING, ALL = np.float32(0.0), np.float32(1.0)

# exp(x) = polynomial(x / 8)^8; on [log(MIN_ALPHA), 0] its relative error is below 2.1e-5.
EIGHTH = np.float32(1.0 / 8.0)
E0, E1, E2, E3, E4 = (np.float32(c) for c in (0.99999742, 0.99983170, 0.49816077, 0.15937914, 0.02932304))
FAINTEST = np.float32(np.log(MIN_ALPHA) / 8.0)


@inlined
def exponent(projected: Any, i: Any, x0: Any) -> Any:
    """What a Gaussian's log(alpha) / 8 on a tile is made of: on the row at dy from its centre, in the columns `dx`,
    (dy * steep + slope) * dy + level. Returns dx, steep, slope, level."""
    dx = columns() - fill(projected[i, U] - np.float32(x0 + 0.5))
    steep = fill(np.float32(-0.5) * EIGHTH * projected[i, CONIC_YY])
    slope = fill(-EIGHTH * projected[i, CONIC_XY]) * dx
    level = fused(
        fill(np.float32(-0.5) * EIGHTH * projected[i, CONIC_XX]) * dx, dx, fill(EIGHTH * projected[i, LOG_OPACITY])
    )
    return dx, steep, slope, level


@inlined
def alpha_at(x: Any) -> Any:
    """Alpha where its logarithm is 8 x; 0 where that is below MIN_ALPHA."""
    e = fused(fused(fused(fused(fill(E4), x, fill(E3)), x, fill(E2)), x, fill(E1)), x, fill(E0))
    e = e * e
    e = e * e
    return where_at_least(x, fill(FAINTEST), smaller(e * e, fill(MAX_ALPHA)))


@kernel
def aligned(n: int) -> Any:
    """Memory for n float32, at the start of a cache line."""
    memory = np.empty(n + 16, np.float32)
    first = (-memory.ctypes.data % 64) // 4
    return memory[first : first + n]


@inlined
def most_light(buffer: Any, channels: Any) -> Any:
    """The largest of a tile's first channel."""
    most = fill(NOTHING)
    for y in range(TILE):
        most = larger(most, load(buffer, np.uint64(y * channels * TILE)))
    return greatest(most)


@inlined
def fetch_ahead(projected: Any, splats: Any, first: Any, last: Any) -> None:
    """Has the rows of the next Gaussians of a tile's list on their way before they are needed."""
    for j in range(first, last):
        prefetch(projected, np.uint64(splats[j]) * np.uint64(PROJECTED_SIZE))


@kernel
def blend(
    projected: Any,
    tile_start: Any,
    tile_splats: Any,
    behind: Any,
    rgb: Any,
    depth: Any,
    alpha: Any,
    ends: Any,
    first_tile: int,
    last_tile: int,
) -> None:
    """Fills rgb (H, W, 3), depth and alpha (H, W) on some tiles, and where in `tile_splats` each was opaque."""
    height, width = alpha.shape
    tiles_x = (width + TILE - 1) // TILE
    buffer = aligned(TILE * 5 * TILE)  # by row: light that still passes; sums of red, green, blue, depth
    for t in range(first_tile, last_tile):
        x0, y0 = (t % tiles_x) * TILE, (t // tiles_x) * TILE
        rows, across = min(TILE, height - y0), min(TILE, width - x0)
        buffer[:] = NOTHING
        for y in range(rows):
            for x in range(across):
                buffer[y * 5 * TILE + x] = ALL
        start, end = tile_start[t], tile_start[t + 1]
        ends[t] = end
        fetch_ahead(projected, tile_splats, start, min(start + BATCH, end))
        for batch in range(start, end, BATCH):
            following = min(batch + BATCH, end)
            fetch_ahead(projected, tile_splats, following, min(following + BATCH, end))
            for j in range(batch, following):
                i = np.uint64(tile_splats[j])
                _, steep, slope, level = exponent(projected, i, x0)
                red, green, blue = fill(projected[i, RED]), fill(projected[i, GREEN]), fill(projected[i, BLUE])
                z = fill(projected[i, DEPTH])
                first, last = max(0, int(projected[i, TOP]) - y0), min(TILE, int(projected[i, BOTTOM]) - y0)
                dy = fill(np.float32(y0 + first) + np.float32(0.5) - projected[i, V])
                at = np.uint64(first * 5 * TILE)
                for _ in range(first, last):
                    opaque = alpha_at(fused(fused(dy, steep, slope), dy, level))
                    light = load(buffer, at)
                    w = opaque * light
                    store(buffer, at, light - w)
                    store(buffer, at + np.uint64(16), fused(w, red, load(buffer, at + np.uint64(16))))
                    store(buffer, at + np.uint64(32), fused(w, green, load(buffer, at + np.uint64(32))))
                    store(buffer, at + np.uint64(48), fused(w, blue, load(buffer, at + np.uint64(48))))
                    store(buffer, at + np.uint64(64), fused(w, z, load(buffer, at + np.uint64(64))))
                    at += np.uint64(80)
                    dy = dy + fill(ALL)
            if most_light(buffer, 5) <= OPAQUE:
                ends[t] = following
                break
        for y in range(rows):
            for x in range(across):
                pixel = np.uint64(y * 5 * TILE + x)
                light = buffer[pixel]
                covered = ALL - light
                for channel in range(3):
                    total = buffer[pixel + np.uint64((channel + 1) * TILE)]
                    rgb[y0 + y, x0 + x, channel] = light * behind[y0 + y, x0 + x, channel] + total
                alpha[y0 + y, x0 + x] = covered
                depth[y0 + y, x0 + x] = buffer[pixel + np.uint64(4 * TILE)] / covered if covered > NOTHING else NOTHING


@kernel
def carry_back(projected: Any, tile_start: Any, tile_splats: Any, image: Any, is_masked: Any) -> Any:
    """Sums (M, 3) of weight times image and (M,) of weight; `image` (H, W, 4), the last being 0 where masked."""
    height, width = image.shape[:2]
    tiles_x = (width + TILE - 1) // TILE
    totals = np.zeros((projected.shape[0], 4), np.float32)
    added = np.empty(TILE, np.float32)
    buffer = aligned(TILE * 5 * TILE)  # by row: light that still passes; the image
    for t in range(tile_start.shape[0] - 1):
        x0, y0 = (t % tiles_x) * TILE, (t // tiles_x) * TILE
        buffer[:] = NOTHING  # pixels outside the image carry no weight
        for y in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                buffer[y * 5 * TILE + x] = ALL
                for channel in range(4):
                    buffer[(y * 5 + channel + 1) * TILE + x] = image[y0 + y, x0 + x, channel]
        for batch in range(tile_start[t], tile_start[t + 1], BATCH):
            following = min(batch + BATCH, tile_start[t + 1])
            for j in range(batch, following):
                i = np.uint64(tile_splats[j])
                _, steep, slope, level = exponent(projected, i, x0)
                ignores_mask = fill(NOTHING if is_masked[i] else ALL)
                first, last = max(0, int(projected[i, TOP]) - y0), min(TILE, int(projected[i, BOTTOM]) - y0)
                dy = fill(np.float32(y0 + first) + np.float32(0.5) - projected[i, V])
                red, green, blue, weight = fill(NOTHING), fill(NOTHING), fill(NOTHING), fill(NOTHING)
                at = np.uint64(first * 5 * TILE)
                for _ in range(first, last):
                    light = load(buffer, at)
                    w = light * alpha_at(fused(fused(dy, steep, slope), dy, level))
                    store(buffer, at, light - w)
                    w = w * larger(load(buffer, at + np.uint64(4 * TILE)), ignores_mask)
                    red = fused(w, load(buffer, at + np.uint64(TILE)), red)
                    green = fused(w, load(buffer, at + np.uint64(2 * TILE)), green)
                    blue = fused(w, load(buffer, at + np.uint64(3 * TILE)), blue)
                    weight = weight + w
                    at += np.uint64(5 * TILE)
                    dy = dy + fill(ALL)
                store(added, np.uint64(0), sums((red, green, blue, weight)))
                totals[i] += added[:4]
            if most_light(buffer, 5) <= OPAQUE:
                break
    return totals[:, :3].copy(), totals[:, 3].copy()

"""Gaussians to pixels on the CPU: small tiles, sorted by depth, blended front to back until nothing shines through.

A pinhole without distortion: photos are undistorted before they come here (factory/stages/sensors.py). The backward
pass, from pixels to Gaussians, is gradient.py beside this. Work is dealt to threads in fixed chunks and nothing is
summed in an order that could change: the same input gives the same bytes, on any number of threads.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from tasks.kernels.compiled import inlined, kernel
from tasks.kernels.simd import (
    fill,
    fma,
    greatest,
    lane_indices,
    larger,
    load,
    prefetch,
    smaller,
    store,
    sums,
    where_at_least,
)
from tasks.kernels.threads import run_in_chunks
from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.project import (
    BLUE,
    BOTTOM,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    FITTED,
    GREEN,
    LOG_OPACITY,
    MIN_ALPHA,
    PROJECTED_SIZE,
    RED,
    TILE,
    TOP,
    ScreenFilter,
    U,
    V,
    project,
)
from tasks.world.arrays import F32, Array, Bools, Ints, ShortInts

# Which ellipses touch which tile of the picture, nearest first.

CHUNK = 8192  # ellipses a thread deals out at a time


def assign_tiles(depths: F32, tiles: ShortInts, width: int, height: int, threads: int) -> tuple[Ints, ShortInts]:
    """Start of each tile (tiles + 1,), row by row, in the list (pairs,) of the ellipses that touch it, nearest first.

    `depths` (M,) positive, `tiles` (M, 4) as from tasks.render.splatting.project.
    """
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    order = _nearest_first(np.ascontiguousarray(depths))
    corners = np.zeros((-(-len(order) // CHUNK), tiles_y + 1, tiles_x + 1), np.int64)

    def mark(first: int, last: int) -> None:
        _mark_corners(tiles, order, first, last, corners[first // CHUNK])

    run_in_chunks(mark, len(order), CHUNK, threads)
    counts = corners.cumsum(axis=1).cumsum(axis=2)[:, :-1, :-1].reshape(len(corners), tiles_x * tiles_y)
    start = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    before = np.cumsum(counts, axis=0) - counts  # a tile's ellipses of the nearer chunks come first
    places = start[:-1] + before
    pairs = np.empty(start[-1], np.int32)

    def fill(first: int, last: int) -> None:
        _fill(tiles, order, tiles_x, first, last, places[first // CHUNK], pairs)

    run_in_chunks(fill, len(order), CHUNK, threads)
    return start, pairs


@kernel
def _nearest_first(depths: Any) -> Any:
    """Rows (M,) by depth, equal depths in the order they have: radix sort of the bits, which for positive numbers are
    in the order of the numbers."""
    n = depths.shape[0]
    keys = depths.view(np.uint32)
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
def _mark_corners(tiles: Any, order: Any, first: int, last: int, corners: Any) -> None:
    """Summed along both axes, `corners` (tiles_y + 1, tiles_x + 1) counts the ellipses on each tile."""
    for at in range(first, last):
        i = order[at]
        x0, x1, y0, y1 = tiles[i, 0], tiles[i, 1], tiles[i, 2], tiles[i, 3]
        corners[y0, x0] += 1
        corners[y0, x1] -= 1
        corners[y1, x0] -= 1
        corners[y1, x1] += 1


@kernel
def _fill(tiles: Any, order: Any, tiles_x: int, first: int, last: int, places: Any, pairs: Any) -> None:
    for at in range(first, last):
        i = order[at]
        for ty in range(tiles[i, 2], tiles[i, 3]):
            for tx in range(tiles[i, 0], tiles[i, 1]):
                t = ty * tiles_x + tx
                pairs[places[t]] = i
                places[t] += 1


# The kernels that go over pixels: blending a tile's Gaussians, and summing an image up by the same weights.
#
# A tile visits its Gaussians one after the other (Gaussian outer, pixels inner); a row of 16 pixels is one vector
# (tasks.kernels.simd). All channels of a row lie side by side, so that no two of them are 4 KiB apart, which would
# stall; the Gaussians of the next batch are fetched while this one is blended. Sums over pixels are kept per column
# and added up at the end, in one fixed order.

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
    dx = lane_indices() - fill(projected[i, U] - np.float32(x0 + 0.5))
    steep = fill(np.float32(-0.5) * EIGHTH * projected[i, CONIC_YY])
    slope = fill(-EIGHTH * projected[i, CONIC_XY]) * dx
    level = fma(
        fill(np.float32(-0.5) * EIGHTH * projected[i, CONIC_XX]) * dx, dx, fill(EIGHTH * projected[i, LOG_OPACITY])
    )
    return dx, steep, slope, level


@inlined
def alpha_from_exponent(x: Any) -> Any:
    """Alpha where its logarithm is 8 x; 0 where that is below MIN_ALPHA."""
    e = fma(fma(fma(fma(fill(E4), x, fill(E3)), x, fill(E2)), x, fill(E1)), x, fill(E0))
    e = e * e
    e = e * e
    return where_at_least(x, fill(FAINTEST), smaller(e * e, fill(MAX_ALPHA)))


@kernel
def aligned_memory(n: int) -> Any:
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
    """Fills rgb (H, W, 3), depth and alpha (H, W) on some tiles, and where in `tile_splats` each was opaque. `behind`
    (H, W, 3), or (1, 1, 3); depth (0, 0): nobody asks for it."""
    height, width = alpha.shape
    many, deep = behind.shape[0] > 1, depth.shape[0] > 0
    tiles_x = (width + TILE - 1) // TILE
    buffer = aligned_memory(TILE * 5 * TILE)  # by row: light that still passes; sums of red, green, blue, depth
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
                red, green, blue = (fill(projected[i, RED]), fill(projected[i, GREEN]), fill(projected[i, BLUE]))
                z = fill(projected[i, DEPTH])
                first, last = max(0, int(projected[i, TOP]) - y0), min(TILE, int(projected[i, BOTTOM]) - y0)
                dy = fill(np.float32(y0 + first) + np.float32(0.5) - projected[i, V])
                at = np.uint64(first * 5 * TILE)
                for _ in range(first, last):
                    opaque = alpha_from_exponent(fma(fma(dy, steep, slope), dy, level))
                    light = load(buffer, at)
                    w = opaque * light
                    store(buffer, at, light - w)
                    store(buffer, at + np.uint64(16), fma(w, red, load(buffer, at + np.uint64(16))))
                    store(buffer, at + np.uint64(32), fma(w, green, load(buffer, at + np.uint64(32))))
                    store(buffer, at + np.uint64(48), fma(w, blue, load(buffer, at + np.uint64(48))))
                    if deep:
                        store(buffer, at + np.uint64(64), fma(w, z, load(buffer, at + np.uint64(64))))
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
                v, u = (y0 + y, x0 + x) if many else (0, 0)
                for channel in range(3):
                    total = buffer[pixel + np.uint64((channel + 1) * TILE)]
                    rgb[y0 + y, x0 + x, channel] = light * behind[v, u, channel] + total
                alpha[y0 + y, x0 + x] = covered
                if deep:
                    total = buffer[pixel + np.uint64(4 * TILE)]
                    depth[y0 + y, x0 + x] = total / covered if covered > NOTHING else NOTHING


@kernel
def backproject_tiles(projected: Any, tile_start: Any, tile_splats: Any, image: Any, is_masked: Any) -> Any:
    """Sums (M, 3) of weight times image and (M,) of weight; `image` (H, W, 4), the last being 0 where masked."""
    height, width = image.shape[:2]
    tiles_x = (width + TILE - 1) // TILE
    totals = np.zeros((projected.shape[0], 4), np.float32)
    added = np.empty(TILE, np.float32)
    buffer = aligned_memory(TILE * 5 * TILE)  # by row: light that still passes; the image
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
                red, green, blue, weight = (fill(NOTHING), fill(NOTHING), fill(NOTHING), fill(NOTHING))
                at = np.uint64(first * 5 * TILE)
                for _ in range(first, last):
                    light = load(buffer, at)
                    w = light * alpha_from_exponent(fma(fma(dy, steep, slope), dy, level))
                    store(buffer, at, light - w)
                    w = w * larger(load(buffer, at + np.uint64(4 * TILE)), ignores_mask)
                    red = fma(w, load(buffer, at + np.uint64(TILE)), red)
                    green = fma(w, load(buffer, at + np.uint64(2 * TILE)), green)
                    blue = fma(w, load(buffer, at + np.uint64(3 * TILE)), blue)
                    weight = weight + w
                    at += np.uint64(5 * TILE)
                    dy = dy + fill(ALL)
                store(added, np.uint64(0), sums((red, green, blue, weight)))
                totals[i] += added[:4]
            if most_light(buffer, 5) <= OPAQUE:
                break
    return totals[:, :3].copy(), totals[:, 3].copy()


GAUSSIANS_CHUNK = 8192  # projected by a thread at a time
TILES_CHUNK = 16  # blended by a thread at a time


@dataclass(frozen=True)
class View:
    """What one camera sees."""

    rgb: F32  # (H, W, 3) in [0, 1] when colours and background are
    depth: F32  # (H, W) [m] mean of the Gaussians' depths by weight; 0 where nothing is; (0, 0): not asked for
    alpha: F32  # (H, W) 1 - the part of the background that shines through


@dataclass(frozen=True)
class Splats:
    """The Gaussians of one view, projected, sorted and dealt out to tiles."""

    index: Ints  # (M,) rows in the scene, ascending
    projected: F32  # (M, 16) columns of tasks.render.splatting.project; rows are cache lines
    tiles: ShortInts  # (M, 4) tiles x0 <= x < x1, y0 <= y < y1 that each touches
    tile_start: Ints  # (tiles + 1,) into tile_splats
    tile_splats: ShortInts  # (pairs,) rows of `projected`, by tile, nearest first
    intrinsics: Array  # (3, 3) [px]
    camera_from_scene: Array  # (4, 4)
    width: int
    height: int
    screen: ScreenFilter


@dataclass(frozen=True)
class ForwardPass:
    """A view and what its backward pass needs."""

    view: View
    splats: Splats  # with the colours they were blended with
    tile_end: Ints  # (tiles,) how far into `tile_splats` each tile was blended before it was opaque


def project_and_sort(
    gaussians: Gaussians,
    intrinsics: Array,
    scene_from_camera: Array,
    width: int,
    height: int,
    threads: int = 1,
    screen: ScreenFilter = FITTED,
) -> Splats:
    """Projects and sorts. `intrinsics` (3, 3) pixels, without skew; `scene_from_camera` (4, 4) rigid."""
    camera_from_scene = np.ascontiguousarray(np.linalg.inv(scene_from_camera))
    scene = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacities)
    intrinsics = np.array(intrinsics, np.float64)  # a copy: kernels compile once more for read-only arrays

    project_some = partial(project, *scene, camera_from_scene, intrinsics, width, height, *screen)
    parts = run_in_chunks(project_some, len(gaussians), GAUSSIANS_CHUNK, threads)
    start = np.cumsum([0, *(len(part[0]) for part in parts)])
    index, projected = np.empty(start[-1], np.int64), _cache_lines(start[-1])
    tiles = np.empty((start[-1], 4), np.int32)

    def place(first: int, last: int) -> None:
        for k in range(first, last):
            for whole, part in zip((index, projected, tiles), parts[k]):
                whole[start[k] : start[k + 1]] = part

    run_in_chunks(place, len(parts), 1, threads)
    tile_start, tile_splats = assign_tiles(projected[:, DEPTH], tiles, width, height, threads)
    return Splats(
        index, projected, tiles, tile_start, tile_splats, intrinsics, camera_from_scene, width, height, screen
    )


def _cache_lines(n: int) -> F32:
    """Memory for projected rows (n, 16), each of which is one line of the processor's cache (64 bytes)."""
    memory: F32 = aligned_memory(n * PROJECTED_SIZE)
    return memory.reshape(n, PROJECTED_SIZE)


def forward(
    gaussians: Gaussians,
    intrinsics: Array,
    scene_from_camera: Array,
    width: int,
    height: int,
    background: F32,
    threads: int = 1,
    screen: ScreenFilter = FITTED,
    with_depth: bool = True,
) -> ForwardPass:
    """The picture of a pinhole camera, with what `tasks.render.splatting.gradient.backward` needs.

    `intrinsics` (3, 3) pixels, the centre of pixel (0, 0) at (0.5, 0.5); `scene_from_camera` (4, 4), camera x right,
    y down, z forward; `background` (3,) or (H, W, 3) rgb behind everything. Kerbl et al. 2023, with per-Gaussian depth
    order.
    """
    splats = project_and_sort(gaussians, intrinsics, scene_from_camera, width, height, threads, screen)
    splats.projected[:, RED : BLUE + 1] = colours_seen(gaussians, scene_from_camera[:3, 3], splats.index, threads)
    view, tile_end = _shade(splats, background, threads, with_depth)
    return ForwardPass(view, splats, tile_end)


def colours_seen(gaussians: Gaussians, camera_center: Array, index: Ints, threads: int = 1) -> F32:
    """rgb (M, 3) of the Gaussians at `index` (M,), as seen from `camera_center` (3,) in their frame; never negative."""
    center, out = np.ascontiguousarray(camera_center, np.float64), np.empty((len(index), 3), np.float32)
    see = partial(sh.shade_from, gaussians.means, gaussians.colours, gaussians.sh_rest, center, index, out)
    run_in_chunks(see, len(index), GAUSSIANS_CHUNK, threads)
    return out


def shade(splats: Splats, colours: F32, background: F32, threads: int = 1) -> View:
    """The picture of sorted splats; `colours` (M, 3) of the Gaussians at `splats.index`."""
    projected = _cache_lines(len(splats.index))
    projected[:] = splats.projected
    projected[:, RED : BLUE + 1] = colours
    return _shade(replace(splats, projected=projected), background, threads)[0]


def _shade(splats: Splats, background: F32, threads: int, with_depth: bool = True) -> tuple[View, Ints]:
    height, width = splats.height, splats.width
    behind = np.ascontiguousarray(background, np.float32).reshape(-1, 1 if background.ndim == 1 else width, 3)
    sizes = (height, width, 3), (height, width) if with_depth else (0, 0), (height, width)
    view = View(*(np.empty(size, np.float32) for size in sizes))
    dealt = (splats.projected, splats.tile_start, splats.tile_splats)
    ends = np.empty(len(splats.tile_start) - 1, np.int64)

    blend_some = partial(blend, *dealt, behind, view.rgb, view.depth, view.alpha, ends)
    run_in_chunks(blend_some, len(ends), TILES_CHUNK, threads)
    return view, ends


def backproject(splats: Splats, image: F32, masked: Bools | None = None, n_masked: int = 0) -> tuple[F32, F32]:
    """Carries an image back to the Gaussians at `splats.index`: (sum of weight * image (M, 3), sum of weight (M,))
    with the weights that `shade` blends with.

    `image` (H, W, 3); the first `n_masked` Gaussians of the scene get nothing from the pixels `masked` (H, W).
    """
    pixels = np.empty((*image.shape[:2], 4), np.float32)
    pixels[..., :3] = image
    pixels[..., 3] = 1.0 if masked is None else ~masked
    sums, weights = backproject_tiles(
        splats.projected, splats.tile_start, splats.tile_splats, pixels, splats.index < n_masked
    )
    return sums, weights

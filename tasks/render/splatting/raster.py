"""Gaussians to pixels on the CPU: small tiles, sorted by depth, blended front to back until nothing shines through.

A pinhole without distortion: photos are undistorted before they come here (factory/stages/sensors.py). The backward
pass, from pixels to Gaussians, is gradient.py beside this. Work is dealt to threads in fixed chunks and nothing is
summed in an order that could change: the same input gives the same bytes, on any number of threads.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tasks.kernels.threads import in_chunks
from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.pixels import aligned, blend, carry_back
from tasks.render.splatting.project import BLUE, DEPTH, FITTED, PROJECTED_SIZE, RED, ScreenFilter, project
from tasks.render.splatting.tiles import deal
from tasks.world.arrays import F32, Array, Bools, Ints, ShortInts

GAUSSIANS_CHUNK = 8192  # projected by a thread at a time
TILES_CHUNK = 16  # blended by a thread at a time


@dataclass(frozen=True)
class View:
    """What one camera sees."""

    rgb: F32  # (H, W, 3) in [0, 1] when colours and background are
    depth: F32  # (H, W) [m] mean of the Gaussians' depths by weight; 0 where nothing is
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


def splat(
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
    parts = in_chunks(project_some, len(gaussians), GAUSSIANS_CHUNK, threads)
    start = np.cumsum([0, *(len(part[0]) for part in parts)])
    index, projected = np.empty(start[-1], np.int64), _cache_lines(start[-1])
    tiles = np.empty((start[-1], 4), np.int32)

    def place(first: int, last: int) -> None:
        for k in range(first, last):
            for whole, part in zip((index, projected, tiles), parts[k]):
                whole[start[k] : start[k + 1]] = part

    in_chunks(place, len(parts), 1, threads)
    tile_start, tile_splats = deal(projected[:, DEPTH], tiles, width, height, threads)
    return Splats(
        index, projected, tiles, tile_start, tile_splats, intrinsics, camera_from_scene, width, height, screen
    )


def _cache_lines(n: int) -> F32:
    """Memory for projected rows (n, 16), each of which is one line of the processor's cache (64 bytes)."""
    memory: F32 = aligned(n * PROJECTED_SIZE)
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
) -> ForwardPass:
    """The picture of a pinhole camera, with what `tasks.render.splatting.gradient.backward` needs.

    `intrinsics` (3, 3) pixels, the centre of pixel (0, 0) at (0.5, 0.5); `scene_from_camera` (4, 4), camera x right,
    y down, z forward; `background` (3,) or (H, W, 3) rgb behind everything. Kerbl et al. 2023, with per-Gaussian depth
    order.
    """
    splats = splat(gaussians, intrinsics, scene_from_camera, width, height, threads, screen)
    splats.projected[:, RED : BLUE + 1] = colours_seen(gaussians, scene_from_camera[:3, 3], splats.index, threads)
    view, tile_end = _shade(splats, background, threads)
    return ForwardPass(view, splats, tile_end)


def colours_seen(gaussians: Gaussians, camera_center: Array, index: Ints, threads: int = 1) -> F32:
    """rgb (M, 3) of the Gaussians at `index` (M,), as seen from `camera_center` (3,) in their frame; never negative."""
    center, out = np.ascontiguousarray(camera_center, np.float64), np.empty((len(index), 3), np.float32)
    see = partial(sh.seen, gaussians.means, gaussians.colours, gaussians.sh_rest, center, index, out)
    in_chunks(see, len(index), GAUSSIANS_CHUNK, threads)
    return out


def shade(splats: Splats, colours: F32, background: F32, threads: int = 1) -> View:
    """The picture of sorted splats; `colours` (M, 3) of the Gaussians at `splats.index`."""
    projected = _cache_lines(len(splats.index))
    projected[:] = splats.projected
    projected[:, RED : BLUE + 1] = colours
    return _shade(replace(splats, projected=projected), background, threads)[0]


def _shade(splats: Splats, background: F32, threads: int) -> tuple[View, Ints]:
    height, width = splats.height, splats.width
    behind = np.ascontiguousarray(np.broadcast_to(background, (height, width, 3)), np.float32)
    view = View(*(np.empty((height, width, *more), np.float32) for more in ((3,), (), ())))
    dealt = (splats.projected, splats.tile_start, splats.tile_splats)
    ends = np.empty(len(splats.tile_start) - 1, np.int64)

    blend_some = partial(blend, *dealt, behind, view.rgb, view.depth, view.alpha, ends)
    in_chunks(blend_some, len(ends), TILES_CHUNK, threads)
    return view, ends


def gather(splats: Splats, image: F32, masked: Bools | None = None, n_masked: int = 0) -> tuple[F32, F32]:
    """Carries an image back to the Gaussians at `splats.index`: (sum of weight * image (M, 3), sum of weight (M,))
    with the weights that `shade` blends with.

    `image` (H, W, 3); the first `n_masked` Gaussians of the scene get nothing from the pixels `masked` (H, W).
    """
    pixels = np.empty((*image.shape[:2], 4), np.float32)
    pixels[..., :3] = image
    pixels[..., 3] = 1.0 if masked is None else ~masked
    sums, weights = carry_back(splats.projected, splats.tile_start, splats.tile_splats, pixels, splats.index < n_masked)
    return sums, weights

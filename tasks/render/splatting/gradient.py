"""The backward pass from a picture to the Gaussians and the camera it was made with, written out by hand.

Tiles are gone through front to back once more; each leaves one row of sums per Gaussian on it, a Gaussian's rows are
then added up in a fixed order, so that the result does not depend on the number of threads.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tasks.kernels.threads import in_chunks
from tasks.render.splatting import sh
from tasks.render.splatting.gaussians import Gaussians, quats_of, turned_quats
from tasks.render.splatting.pixels_gradient import SUMS_SIZE, W_BLUE, W_RED, add_pairs, blend_gradient
from tasks.render.splatting.project_gradient import project_gradient
from tasks.render.splatting.raster import GAUSSIANS_CHUNK, TILES_CHUNK, ForwardPass
from tasks.render.splatting.tiles import pair_starts
from tasks.world.arrays import F32, Array, Ints


@dataclass(frozen=True)
class Gradients:
    """Derivatives of a loss by the M Gaussians of a view; those that are not in `index` have none."""

    index: Ints  # (M,) rows in the scene, ascending
    means: F32  # (M, 3) [1/m]
    quats: F32  # (M, 4) by the quaternions as given: rendering normalises them, so this has no part along them
    log_scales: F32  # (M, 3)
    logits: F32  # (M,) by log(opacity / (1 - opacity))
    colours: F32  # (M, 3)
    sh_rest: F32  # (M, count, 3)
    screen: F32  # (M, 2) [1/px] by the centre on the picture, u and v: how much density control wants it elsewhere
    camera: Array  # (6,) by v [1/m], w [1/rad] of a camera motion x' = x + v + w cross x, x in camera coordinates


def backward(
    forward: ForwardPass,
    gaussians: Gaussians,
    d_rgb: F32,
    d_depth: F32 | None = None,
    d_alpha: F32 | None = None,
    threads: int = 1,
) -> Gradients:
    """Derivatives of a loss, from its derivatives by the view's rgb (H, W, 3), depth and alpha (H, W).

    `gaussians` as traced. By the background it is d_rgb * (1 - alpha). Where the cut-off at 1/255, the cap on alpha or
    the order in depth changes the picture jumps, and its jumps have no derivative: alpha beyond the cap counts as flat.
    Raises ValueError where shapes are not the view's.
    """
    splats, n, count = forward.splats, len(forward.splats.index), gaussians.sh_rest.shape[1]
    pair_start = pair_starts(splats.tiles)
    pairs = _pairs(forward, pair_start, d_rgb, d_depth, d_alpha, threads)
    center = np.ascontiguousarray(np.linalg.inv(splats.camera_from_scene)[:3, 3])
    sums = np.empty((n, SUMS_SIZE), np.float32)
    sizes = ((n, 3), (n, 4), (n, 3), (n,), (n, 2), (n, 3), (n, count, 3))
    means, quats, log_scales, logits, screen, colours, sh_rest = (np.empty(size, np.float32) for size in sizes)
    shapes, light = (means, quats, log_scales, logits, screen), (gaussians.means, gaussians.colours, gaussians.sh_rest)
    camera_from_scene, view = splats.camera_from_scene, (splats.width, splats.height, splats.screen.keeps_light)
    scene = (gaussians.means, gaussians.quats, gaussians.log_scales, camera_from_scene, splats.intrinsics, *view)

    def run(first: int, last: int) -> Array:
        camera = np.zeros(6)
        add_pairs(pair_start, pairs, first, last, sums)
        project_gradient(*scene, splats.index, splats.projected, sums, first, last, *shapes, camera)
        upstream = sums[:, W_RED : W_BLUE + 1]
        by_direction = sh.seen_gradient(*light, center, splats.index, upstream, first, last, means, colours, sh_rest)
        # To the directions, a camera moved by v is as a scene moved by v; turning it changes none of them.
        camera[:3] += splats.camera_from_scene[:3, :3] @ by_direction
        return camera

    camera = np.sum([np.zeros(6), *in_chunks(run, n, GAUSSIANS_CHUNK, threads)], axis=0)
    return Gradients(splats.index, means, quats, log_scales, logits, colours, sh_rest, screen, camera)


def _pairs(
    forward: ForwardPass, pair_start: Ints, d_rgb: F32, d_depth: F32 | None, d_alpha: F32 | None, threads: int
) -> F32:
    """(pairs, 11) columns of tasks.render.splatting.pixels_gradient, Gaussian by Gaussian."""
    splats, view = forward.splats, forward.view
    by_depth = np.zeros_like(view.alpha) if d_depth is None else np.ascontiguousarray(d_depth, np.float32)
    by_alpha = np.zeros_like(view.alpha) if d_alpha is None else np.ascontiguousarray(d_alpha, np.float32)
    shapes = (d_rgb.shape, by_depth.shape, by_alpha.shape)
    if shapes != (view.rgb.shape, view.alpha.shape, view.alpha.shape):
        raise ValueError(f"backward: upstream shapes {shapes} do not fit a view of {view.rgb.shape}")
    upstream, seen = (np.ascontiguousarray(d_rgb, np.float32), by_depth, by_alpha), (view.rgb, view.depth, view.alpha)
    dealt = (splats.projected, splats.tiles, splats.tile_start, splats.tile_splats)
    out = np.empty((len(splats.tile_splats), SUMS_SIZE), np.float32)
    run = partial(blend_gradient, *dealt, forward.tile_end, pair_start, *upstream, *seen, out)
    in_chunks(run, len(forward.tile_end), TILES_CHUNK, threads)
    return out


def unmoved(gradients: Gradients, target_from_source: Array) -> Gradients:
    """Derivatives by the Gaussians in the frame that `gaussians.moved` took them from.

    `target_from_source` (4, 4) as given there; what belongs to the picture or the camera stays.
    """
    rotation = target_from_source[:3, :3]
    quats = turned_quats(quats_of(rotation.T[None])[0], gradients.quats)
    turn = sh.turning(rotation, gradients.sh_rest.shape[1])
    return replace(
        gradients,
        means=(gradients.means @ rotation).astype(np.float32),
        quats=quats.astype(np.float32),
        sh_rest=np.einsum("ba,nbc->nac", turn, gradients.sh_rest).astype(np.float32),
    )

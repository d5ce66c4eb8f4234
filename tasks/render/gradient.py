"""The way back from a picture to the Gaussians and the camera it was made with, written out by hand.

Tiles are gone through front to back once more; each leaves one row of sums per Gaussian on it, a Gaussian's rows are
then added up in a fixed order, so that the result does not depend on the number of threads.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tasks.render import sh
from tasks.render.gaussians import F32, F64, Gaussians, quat_multiply, quats_of
from tasks.render.pixels_gradient import (
    PEAK,
    QX,
    QXX,
    QXY,
    QY,
    QYY,
    SUMS_SIZE,
    W_BLUE,
    W_DEPTH,
    W_RED,
    Q,
    add_pairs,
    blend_gradient,
)
from tasks.render.project import CONIC_XX, CONIC_XY, CONIC_YY, OPACITY
from tasks.render.project_gradient import BACK_SIZE, LOG_SCALE, MEAN, QUAT, project_gradient
from tasks.render.raster import GAUSSIANS_CHUNK, TILES_CHUNK, Trace, pinhole
from tasks.render.threads import in_chunks
from tasks.render.tiles import tile_counts, tiles_of


@dataclass(frozen=True)
class Gradients:
    """Derivatives of a loss by the M Gaussians of a view; those that are not in `index` have none."""

    index: NDArray[np.int64]  # (M,) rows in the scene, ascending
    means: F32  # (M, 3) [1/m]
    quats: F32  # (M, 4) by the quaternions as given: rendering normalises them, so this has no part along them
    log_scales: F32  # (M, 3)
    logits: F32  # (M,) by log(opacity / (1 - opacity))
    colours: F32  # (M, 3)
    sh_rest: F32  # (M, count, 3)
    screen: F32  # (M, 2) [1/px] by the centre on the picture, u and v: how much density control wants it elsewhere
    peak: F32  # (M,) the largest weight it has on any pixel; 0 for one that is hidden
    camera: F64  # (6,) by v [1/m], w [1/rad] of a camera motion x' = x + v + w cross x, x in camera coordinates


def backward(
    trace: Trace,
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
    splats = trace.splats
    upstream, totals = _by_sums(trace, d_rgb, d_depth, d_alpha)
    sums = _sums(trace, upstream, totals, threads)

    projected = splats.projected
    a, b, c = projected[:, CONIC_XX], projected[:, CONIC_XY], projected[:, CONIC_YY]
    by_ellipse = np.empty((len(sums), 6), np.float32)
    by_ellipse[:, 0] = a * sums[:, QX] + b * sums[:, QY]
    by_ellipse[:, 1] = b * sums[:, QX] + c * sums[:, QY]
    by_ellipse[:, 2] = -0.5 * sums[:, QXX]
    by_ellipse[:, 3] = -sums[:, QXY]
    by_ellipse[:, 4] = -0.5 * sums[:, QYY]
    by_ellipse[:, 5] = sums[:, W_DEPTH]

    center = np.ascontiguousarray(np.linalg.inv(splats.camera_from_scene)[:3, 3])
    d_seen = np.ascontiguousarray(sums[:, W_RED : W_BLUE + 1])
    back = np.empty((len(sums), BACK_SIZE), np.float32)
    d_means = np.zeros((len(sums), 3), np.float32)

    def run(first: int, last: int) -> tuple[F64, F32, F32]:
        d_camera = np.zeros(6)
        project_gradient(
            gaussians.means,
            gaussians.quats,
            gaussians.log_scales,
            splats.camera_from_scene,
            *pinhole(splats.intrinsics),
            splats.width,
            splats.height,
            splats.index,
            projected,
            by_ellipse,
            first,
            last,
            back,
            d_camera,
        )
        d_colours, d_rest = sh.seen_gradient(
            gaussians.means, gaussians.colours, gaussians.sh_rest, center, splats.index, d_seen, first, last, d_means
        )
        # To the directions, a camera moved by v is as a scene moved by v; turning it changes none of them.
        d_camera[:3] += splats.camera_from_scene[:3, :3] @ d_means[first:last].sum(axis=0, dtype=np.float64)
        return d_camera, d_colours, d_rest

    parts = in_chunks(run, len(sums), GAUSSIANS_CHUNK, threads) or [run(0, 0)]
    return Gradients(
        index=splats.index,
        means=back[:, MEAN] + d_means,
        quats=back[:, QUAT],
        log_scales=back[:, LOG_SCALE],
        logits=sums[:, Q] * (1.0 - projected[:, OPACITY]),
        colours=np.concatenate([part[1] for part in parts]),
        sh_rest=np.concatenate([part[2] for part in parts]),
        screen=by_ellipse[:, :2],
        peak=sums[:, PEAK],
        camera=np.sum([part[0] for part in parts], axis=0),
    )


def _by_sums(trace: Trace, d_rgb: F32, d_depth: F32 | None, d_alpha: F32 | None) -> tuple[F32, F32]:
    """Derivatives (H, W, 5) by rgb, sum of weight * depth, sum of weight; and those times the sums, added up (H, W)."""
    view = trace.view
    shapes = [d_rgb.shape] + [d.shape for d in (d_depth, d_alpha) if d is not None]
    if shapes[0] != view.rgb.shape or any(shape != view.alpha.shape for shape in shapes[1:]):
        raise ValueError(f"backward: upstream shapes {shapes} do not fit a view of {view.rgb.shape}")
    upstream = np.zeros((*view.alpha.shape, 5), np.float32)
    upstream[..., :3] = d_rgb
    if d_depth is not None:  # depth = (sum of weight * depth) / alpha
        covered = np.where(view.alpha > 0.0, view.alpha, np.float32(1.0))
        upstream[..., 3] = d_depth / covered
        upstream[..., 4] = -upstream[..., 3] * view.depth
    if d_alpha is not None:
        upstream[..., 4] += d_alpha
    totals = np.einsum("hwc,hwc->hw", upstream[..., :3], view.rgb)
    totals += view.alpha * (upstream[..., 3] * view.depth + upstream[..., 4])
    return upstream, totals


def _sums(trace: Trace, upstream: F32, totals: F32, threads: int) -> F32:
    """(M, 11) columns of tasks.render.pixels_gradient, added up over the tiles of each Gaussian."""
    splats = trace.splats
    pair_start = tile_counts(splats.projected, *tiles_of(splats.width, splats.height))
    rows = np.zeros((len(splats.tile_splats), SUMS_SIZE), np.float32)
    sums = np.empty((len(splats.index), SUMS_SIZE), np.float32)

    def run_tiles(first: int, last: int) -> None:
        blend_gradient(
            splats.projected,
            trace.colours,
            splats.tile_start,
            splats.tile_splats,
            trace.tile_end,
            pair_start,
            upstream,
            totals,
            first,
            last,
            rows,
        )

    in_chunks(run_tiles, len(trace.tile_end), TILES_CHUNK, threads)
    in_chunks(lambda first, last: add_pairs(pair_start, rows, first, last, sums), len(sums), GAUSSIANS_CHUNK, threads)
    return sums


def unmoved(gradients: Gradients, target_from_source: F64) -> Gradients:
    """Derivatives by the Gaussians in the frame that `gaussians.moved` took them from.

    `target_from_source` (4, 4) as given there; what belongs to the picture or the camera stays.
    """
    rotation = target_from_source[:3, :3]
    inverse = quats_of(rotation.T[None])[0]
    count = gradients.sh_rest.shape[1]
    turn = sh.turning(rotation, count)
    return Gradients(
        gradients.index,
        (gradients.means @ rotation).astype(np.float32),
        quat_multiply(inverse, gradients.quats).astype(np.float32),
        gradients.log_scales,
        gradients.logits,
        gradients.colours,
        np.einsum("ba,nbc->nac", turn, gradients.sh_rest).astype(np.float32),
        gradients.screen,
        gradients.peak,
        gradients.camera,
    )

"""The backward pass from a picture to the Gaussians and the camera it was made with, written out by hand.

Tiles are gone through front to back once more; each leaves one row of sums per Gaussian on it, a Gaussian's rows are
then added up in a fixed order, so that the result does not depend on the number of threads.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from tasks.kernels.compiled import inlined, kernel
from tasks.kernels.simd import LANES, fill, fma, larger, load, smaller, store, sums, where_below
from tasks.kernels.threads import run_in_chunks
from tasks.render.splatting.gaussians import Gaussians, quats_of, turned_quats
from tasks.render.splatting.project import (
    BLOCK_SIZE,
    BLUE,
    BOTTOM,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    GREEN,
    OPACITY,
    QW,
    QX,
    QY,
    QZ,
    RED,
    S0,
    S1,
    S2,
    TILE,
    TOP,
    V,
    X,
    Y,
    Z,
    axes_of,
    covariance_determinant,
    dot,
    exponential,
    gather,
    rotation_and_centre,
    scaled,
    seen_from,
    slope_on_picture,
    tangent_limits,
)
from tasks.render.splatting.raster import (
    ALL,
    BATCH,
    GAUSSIANS_CHUNK,
    MAX_ALPHA,
    NOTHING,
    TILES_CHUNK,
    ForwardPass,
    aligned_memory,
    alpha_from_exponent,
    exponent,
    fetch_ahead,
)
from tasks.world.arrays import F32, Array, Ints

# The backward pass of `blend`: what a change of the pixels means for each Gaussian on each tile.

# What a tile adds to the derivatives of one of its Gaussians: moments, about its centre, of q = dL/d(log alpha), and
# weight times upstream. A row is a cache line.
Q, Q_X, Q_Y, Q_XX, Q_XY, Q_YY, W_DEPTH, W_RED, W_GREEN, W_BLUE = range(10)
SUMS_SIZE = 16
# Channels of a row of a tile, after light that still passes and the rest of the total: the upstream derivatives.
CHANNELS = 7
REST_AT, RED_AT, GREEN_AT, BLUE_AT, DEPTH_AT, WEIGHT_AT = (np.uint64(channel * TILE) for channel in range(1, CHANNELS))
ROW = np.uint64(CHANNELS * TILE)


@kernel
def _load_tile(
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
    buffer = aligned_memory(TILE * CHANNELS * TILE)
    for t in range(first_tile, last_tile):
        tx, ty = t % tiles_x, t // tiles_x
        x0, y0 = tx * TILE, ty * TILE
        _load_tile(buffer, x0, y0, d_rgb, d_depth, d_alpha, rgb, depth, alpha)
        fetch_ahead(projected, tile_splats, tile_start[t], min(tile_start[t] + BATCH, ends[t]))
        for batch in range(tile_start[t], ends[t], BATCH):
            following = min(batch + BATCH, ends[t])
            fetch_ahead(projected, tile_splats, following, min(following + BATCH, ends[t]))
            for j in range(batch, following):
                i = np.uint64(tile_splats[j])
                dx, steep, slope, level = exponent(projected, i, x0)
                red, green, blue = (fill(projected[i, RED]), fill(projected[i, GREEN]), fill(projected[i, BLUE]))
                z = fill(projected[i, DEPTH])
                first, last = max(0, int(projected[i, TOP]) - y0), min(TILE, int(projected[i, BOTTOM]) - y0)
                dy = fill(np.float32(y0 + first) + np.float32(0.5) - projected[i, V])
                at = np.uint64(first) * ROW
                q, q_y, q_yy = fill(NOTHING), fill(NOTHING), fill(NOTHING)
                w_depth, w_red, w_green, w_blue = (fill(NOTHING), fill(NOTHING), fill(NOTHING), fill(NOTHING))
                for _ in range(first, last):
                    opaque = alpha_from_exponent(fma(fma(dy, steep, slope), dy, level))
                    light = load(buffer, at)
                    w = opaque * light
                    store(buffer, at, light - w)
                    by_red, by_green = load(buffer, at + RED_AT), load(buffer, at + GREEN_AT)
                    by_blue, by_depth = load(buffer, at + BLUE_AT), load(buffer, at + DEPTH_AT)
                    share = fma(z, by_depth, load(buffer, at + WEIGHT_AT))
                    seen = w * fma(red, by_red, fma(green, by_green, fma(blue, by_blue, share)))
                    behind = load(buffer, at + REST_AT) - seen
                    store(buffer, at + REST_AT, behind)
                    here = _log_alpha_gradient(opaque, seen, behind)
                    here_y = here * dy
                    q, q_y, q_yy = q + here, q_y + here_y, fma(here_y, dy, q_yy)
                    w_depth, w_red = fma(w, by_depth, w_depth), fma(w, by_red, w_red)
                    w_green, w_blue = fma(w, by_green, w_green), fma(w, by_blue, w_blue)
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
def sum_pairs(pair_start: Any, rows: Any, first: int, last: int, out: Any) -> None:
    """Adds up the rows (pairs, 16) of each Gaussian from `first` to `last` into `out` (M, 16) float32."""
    step = np.uint64(SUMS_SIZE)
    for i in range(first, last):
        total = load(rows, np.uint64(pair_start[i]) * step)
        for j in range(pair_start[i] + 1, pair_start[i + 1]):
            total = total + load(rows, np.uint64(j) * step)
        store(out, np.uint64(i) * step, total)


# The backward pass of `project`: from a change of the ellipses to a change of the Gaussians and of the camera.

# Rows of a block beyond those of `project`: conics, what the pixels brought, and the derivatives by place and by the
# logarithm of the peak, where the filter lowers it.
CXX, CXY, CYY, BY_XX, BY_XY, BY_YY, BY_DEPTH, D_U, D_V, BY_PEAK = (np.uint64(LANES * row) for row in range(12, 22))
LEAST_AREA = np.float32(1e-20)  # [px4] of what is not on the picture


@inlined
def _covariance_gradient(block: Any) -> Any:
    """Derivatives by the screen covariance xx, xy (both places), yy: -conic (d conic) conic."""
    cxx, cxy, cyy = load(block, CXX), load(block, CXY), load(block, CYY)
    half = fill(np.float32(-0.5))
    gxx, gxy, gyy = half * load(block, BY_XX), half * load(block, BY_XY), half * load(block, BY_YY)
    left_xx, left_xy = cxx * gxx + cxy * gxy, cxx * gxy + cxy * gyy
    left_yx, left_yy = cxy * gxx + cyy * gxy, cxy * gxy + cyy * gyy
    minus = fill(np.float32(-1.0))
    return (
        minus * (left_xx * cxx + left_xy * cxy),
        fill(np.float32(-2.0)) * (left_xx * cxy + left_xy * cyy),
        minus * (left_yx * cxy + left_yy * cyy),
    )


@inlined
def _where_between(value: Any, at: Any, least: Any, most: Any) -> Any:
    """`value` where `at` is strictly between the limits, else 0."""
    return where_below(at, most, where_below(least, at, value))


@inlined
def _store_quaternion_gradient(block: Any, q: Any, shorten: Any, g: Any) -> None:
    """From the derivatives `g` by the principal axes, three triples, to those by the quaternions as given."""
    w, x, y, z = q
    twist_x, twist_y, twist_z = g[1][2] - g[2][1], g[2][0] - g[0][2], g[0][1] - g[1][0]
    both_xy, both_xz, both_yz = g[1][0] + g[0][1], g[2][0] + g[0][2], g[2][1] + g[1][2]
    two = fill(np.float32(2.0))
    d_w = two * (x * twist_x + y * twist_y + z * twist_z)
    d_x = two * (w * twist_x + y * both_xy + z * both_xz - two * x * (g[1][1] + g[2][2]))
    d_y = two * (w * twist_y + x * both_xy + z * both_yz - two * y * (g[0][0] + g[2][2]))
    d_z = two * (w * twist_z + x * both_xz + y * both_yz - two * z * (g[0][0] + g[1][1]))
    along = d_w * w + d_x * x + d_y * y + d_z * z  # a longer quaternion is the same rotation
    store(block, QW, shorten * (d_w - along * w))
    store(block, QX, shorten * (d_x - along * x))
    store(block, QY, shorten * (d_y - along * y))
    store(block, QZ, shorten * (d_z - along * z))


@inlined
def _pulled_back(block: Any, rows: Any, centre: Any, fx: Any, fy: Any, limits: Any, motion: Any) -> None:
    """Replaces a block's means, quaternions and log-scales by the derivatives by them; `motion` (16,): by the camera's,
    summed over the block."""
    x, y, z = seen_from(rows, centre, block)
    nearness = fill(np.float32(1.0)) / z
    tx, ty = x * nearness, y * nearness
    jx, jy = smaller(larger(tx, limits[0]), limits[1]), smaller(larger(ty, limits[2]), limits[3])
    a, b = fx * nearness, fy * nearness
    to_u, to_v = slope_on_picture(rows, rows[0], a, jx), slope_on_picture(rows, rows[1], b, jy)
    q, shorten, axes = axes_of(block)
    s = exponential(load(block, S0)), exponential(load(block, S1)), exponential(load(block, S2))
    d_xx, d_xy, d_yy = _covariance_gradient(block)

    # By each half axis p = s * axis: du = to_u . p and dv = to_v . p make up the screen covariance.
    du = s[0] * dot(to_u, axes[0]), s[1] * dot(to_u, axes[1]), s[2] * dot(to_u, axes[2])
    dv = s[0] * dot(to_v, axes[0]), s[1] * dot(to_v, axes[1]), s[2] * dot(to_v, axes[2])
    xx, xy, yy = dot(du, du), dot(du, dv), dot(dv, dv)
    by_peak, inverse = (
        load(block, BY_PEAK),
        fill(np.float32(1.0)) / larger(covariance_determinant(du, dv), fill(LEAST_AREA)),
    )
    half = fill(np.float32(0.5)) * by_peak  # the peak has half the logarithm of the determinants' ratio
    d_xx = d_xx + half * (yy * inverse - load(block, CXX))
    d_xy = d_xy - by_peak * (xy * inverse + load(block, CXY))
    d_yy = d_yy + half * (xx * inverse - load(block, CYY))
    twice_xx, twice_yy = d_xx + d_xx, d_yy + d_yy
    d_du = twice_xx * du[0] + d_xy * dv[0], twice_xx * du[1] + d_xy * dv[1], twice_xx * du[2] + d_xy * dv[2]
    d_dv = twice_yy * dv[0] + d_xy * du[0], twice_yy * dv[1] + d_xy * du[1], twice_yy * dv[2] + d_xy * du[2]
    store(block, S0, du[0] * d_du[0] + dv[0] * d_dv[0])
    store(block, S1, du[1] * d_du[1] + dv[1] * d_dv[1])
    store(block, S2, du[2] * d_du[2] + dv[2] * d_dv[2])
    by_u, by_v = (s[0] * d_du[0], s[1] * d_du[1], s[2] * d_du[2]), (s[0] * d_dv[0], s[1] * d_dv[1], s[2] * d_dv[2])
    by_axes = (
        _weighted_sum(to_u, by_u[0], to_v, by_v[0]),
        _weighted_sum(to_u, by_u[1], to_v, by_v[1]),
        _weighted_sum(to_u, by_u[2], to_v, by_v[2]),
    )
    _store_quaternion_gradient(block, q, shorten, by_axes)

    # By to_u and to_v, turned into camera coordinates; from there by the Jacobian's entries and the rotation.
    pull_u, pull_v = _turned(rows, _mixed(axes, by_u)), _turned(rows, _mixed(axes, by_v))
    d_a, d_b = pull_u[0] - jx * pull_u[2], pull_v[1] - jy * pull_v[2]
    d_u, d_v = load(block, D_U), load(block, D_V)
    d_tx = fx * d_u - _where_between(a * pull_u[2], tx, limits[0], limits[1])
    d_ty = fy * d_v - _where_between(b * pull_v[2], ty, limits[2], limits[3])
    d_x, d_y = d_tx * nearness, d_ty * nearness
    d_z = load(block, BY_DEPTH) - (d_tx * tx + d_ty * ty + d_a * a + d_b * b) * nearness
    turn_x = y * d_z - z * d_y - a * jx * pull_u[1] - b * (jy * pull_v[1] + pull_v[2])
    turn_y = z * d_x - x * d_z + a * (jx * pull_u[0] + pull_u[2]) + b * jy * pull_v[0]
    turn_z = x * d_y - y * d_x - a * pull_u[1] + b * pull_v[0]
    store(motion, np.uint64(0), sums((d_x, d_y, d_z, turn_x, turn_y, turn_z)))
    store(block, X, rows[0][0] * d_x + rows[1][0] * d_y + rows[2][0] * d_z)
    store(block, Y, rows[0][1] * d_x + rows[1][1] * d_y + rows[2][1] * d_z)
    store(block, Z, rows[0][2] * d_x + rows[1][2] * d_y + rows[2][2] * d_z)


@inlined
def _weighted_sum(a: Any, s: Any, b: Any, t: Any) -> Any:
    """s a + t b of triples a and b."""
    return (fma(a[0], s, b[0] * t), fma(a[1], s, b[1] * t), fma(a[2], s, b[2] * t))


@inlined
def _mixed(axes: Any, weights: Any) -> Any:
    """The sum of three triples, each times its weight."""
    first, second = _weighted_sum(axes[0], weights[0], axes[1], weights[1]), scaled(axes[2], weights[2])
    return first[0] + second[0], first[1] + second[1], first[2] + second[2]


@inlined
def _turned(rows: Any, place: Any) -> Any:
    return dot(rows[0], place), dot(rows[1], place), dot(rows[2], place)


@kernel
def project_gradient(
    means: Any,
    quats: Any,
    log_scales: Any,
    colours: Any,
    camera_from_scene: Any,
    intrinsics: Any,
    width: int,
    height: int,
    keeps_light: bool,
    index: Any,
    projected: Any,
    sums: Any,
    first: int,
    last: int,
    d_means: Any,
    d_quats: Any,
    d_log_scales: Any,
    d_logits: Any,
    d_colours: Any,
    d_screen: Any,
    d_pose: Any,
) -> None:
    """Fills the derivatives by mean, quaternion as given (any length), log-scale, opacity's logit, colour and place on
    the picture, each (M, ...) float32, for rows `first` to `last`. A colour below 0 is drawn as 0, and has none.

    Scene, camera, `index` and `projected` as for and from `project`; `sums` (M, 16) as pixels_gradient has them.
    Adds to `d_pose` (6,) float64 the derivative by a small motion of the camera: x' = x + v + w cross x in camera
    coordinates, v [m] before w [rad].
    """
    block, motion = np.zeros(BLOCK_SIZE, np.float32), np.empty(LANES, np.float32)
    rows, centre = rotation_and_centre(camera_from_scene)
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    limits = tangent_limits(fx, fy, cx, cy, width, height)
    for start in range(first, last, LANES):
        n = min(LANES, last - start)
        block[int(CXX) :] = np.float32(0.0)
        for k in range(LANES):  # lanes that are left over hold a Gaussian too, from which nothing is asked
            gather(means, quats, log_scales, index[start + min(k, n - 1)], block, k)
        for k in range(n):
            row, lane = start + k, np.uint64(k)
            cxx, cxy, cyy = projected[row, CONIC_XX], projected[row, CONIC_XY], projected[row, CONIC_YY]
            # The exponent is -(cxx dx^2 + 2 cxy dx dy + cyy dy^2) / 2, dx and dy from the centre to the pixel.
            d_screen[row, 0] = cxx * sums[row, Q_X] + cxy * sums[row, Q_Y]
            d_screen[row, 1] = cxy * sums[row, Q_X] + cyy * sums[row, Q_Y]
            d_logits[row] = sums[row, Q] * (np.float32(1.0) - projected[row, OPACITY])
            for c in range(3):
                shown = colours[index[row], c] >= np.float32(0.0)
                d_colours[row, c] = sums[row, W_RED + c] if shown else np.float32(0.0)
            if keeps_light:
                block[BY_PEAK + lane] = sums[row, Q]
            block[CXX + lane], block[CXY + lane], block[CYY + lane] = cxx, cxy, cyy
            block[D_U + lane], block[D_V + lane] = d_screen[row, 0], d_screen[row, 1]
            block[BY_XX + lane], block[BY_XY + lane] = sums[row, Q_XX], sums[row, Q_XY]
            block[BY_YY + lane], block[BY_DEPTH + lane] = sums[row, Q_YY], sums[row, W_DEPTH]
        _pulled_back(block, rows, centre, fill(fx), fill(fy), limits, motion)
        for c in range(6):
            d_pose[c] += motion[c]
        for k in range(n):
            row, lane = start + k, np.uint64(k)
            d_means[row, 0], d_means[row, 1], d_means[row, 2] = block[X + lane], block[Y + lane], block[Z + lane]
            d_quats[row, 0], d_quats[row, 1] = block[QW + lane], block[QX + lane]
            d_quats[row, 2], d_quats[row, 3] = block[QY + lane], block[QZ + lane]
            d_log_scales[row, 0], d_log_scales[row, 1] = block[S0 + lane], block[S1 + lane]
            d_log_scales[row, 2] = block[S2 + lane]


@dataclass(frozen=True)
class Gradients:
    """Derivatives of a loss by the M Gaussians of a view; those that are not in `index` have none."""

    index: Ints  # (M,) rows in the scene, ascending
    means: F32  # (M, 3) [1/m]
    quats: F32  # (M, 4) by the quaternions as given: rendering normalises them, so this has no part along them
    log_scales: F32  # (M, 3)
    logits: F32  # (M,) by log(opacity / (1 - opacity))
    colours: F32  # (M, 3)
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

    `gaussians` as traced, of SH degree 0. By the background it is d_rgb * (1 - alpha). Where the cut-off at 1/255, the
    cap on alpha or the order in depth changes the picture jumps, and its jumps have no derivative: alpha beyond the cap
    counts as flat.
    Raises ValueError where shapes are not the view's, or it has no depth and `d_depth` is given.
    """
    splats, n = forward.splats, len(forward.splats.index)
    # Pairs are numbered ellipse by ellipse, the tiles of each row by row.
    counts = (splats.tiles[:, 1] - splats.tiles[:, 0]) * (splats.tiles[:, 3] - splats.tiles[:, 2])
    pair_start = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    pairs = _pairs(forward, pair_start, d_rgb, d_depth, d_alpha, threads)
    sums = np.empty((n, SUMS_SIZE), np.float32)
    sizes = ((n, 3), (n, 4), (n, 3), (n,), (n, 3), (n, 2))
    means, quats, log_scales, logits, colours, screen = (np.empty(size, np.float32) for size in sizes)
    shapes = (means, quats, log_scales, logits, colours, screen)
    view = splats.camera_from_scene, splats.intrinsics, splats.width, splats.height, splats.screen.keeps_light
    scene = gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.colours, *view

    def run(first: int, last: int) -> Array:
        camera = np.zeros(6)
        sum_pairs(pair_start, pairs, first, last, sums)
        project_gradient(*scene, splats.index, splats.projected, sums, first, last, *shapes, camera)
        return camera

    camera = np.sum([np.zeros(6), *run_in_chunks(run, n, GAUSSIANS_CHUNK, threads)], axis=0)
    return Gradients(splats.index, means, quats, log_scales, logits, colours, screen, camera)


def _pairs(
    forward: ForwardPass, pair_start: Ints, d_rgb: F32, d_depth: F32 | None, d_alpha: F32 | None, threads: int
) -> F32:
    """(pairs, 11) columns of tasks.render.splatting.gradient, Gaussian by Gaussian."""
    splats, view = forward.splats, forward.view
    by_depth = np.zeros_like(view.alpha) if d_depth is None else np.ascontiguousarray(d_depth, np.float32)
    by_alpha = np.zeros_like(view.alpha) if d_alpha is None else np.ascontiguousarray(d_alpha, np.float32)
    shapes = (d_rgb.shape, by_depth.shape, by_alpha.shape)
    if shapes != (view.rgb.shape, view.alpha.shape, view.alpha.shape):
        raise ValueError(f"backward: upstream shapes {shapes} do not fit a view of {view.rgb.shape}")
    if d_depth is not None and not view.depth.size:
        raise ValueError("backward: derivatives by depth of a view that was drawn without")
    depth = view.depth if view.depth.size else by_depth
    upstream, seen = (np.ascontiguousarray(d_rgb, np.float32), by_depth, by_alpha), (view.rgb, depth, view.alpha)
    dealt = (splats.projected, splats.tiles, splats.tile_start, splats.tile_splats)
    out = np.empty((len(splats.tile_splats), SUMS_SIZE), np.float32)
    run = partial(blend_gradient, *dealt, forward.tile_end, pair_start, *upstream, *seen, out)
    run_in_chunks(run, len(forward.tile_end), TILES_CHUNK, threads)
    return out


def untransformed_gradients(gradients: Gradients, target_from_source: Array) -> Gradients:
    """Derivatives by the Gaussians in the frame that `gaussians.moved` took them from.

    `target_from_source` (4, 4) as given there; what belongs to the picture or the camera stays.
    """
    rotation = target_from_source[:3, :3]
    quats = turned_quats(quats_of(rotation.T[None])[0], gradients.quats)
    return replace(gradients, means=(gradients.means @ rotation).astype(np.float32), quats=quats.astype(np.float32))

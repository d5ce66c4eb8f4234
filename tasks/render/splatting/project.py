"""Gaussians in front of a camera, as ellipses on its image (EWA splatting, Zwicker et al. 2001).

Sixteen Gaussians at a time (tasks.kernels.simd), in float32: places are taken from the camera's centre, and the
determinant from minors, so that neither is the small difference of large numbers.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from tasks.kernels.compiled import inlined, kernel
from tasks.kernels.simd import LANES, fill, fma, larger, load, smaller, sqrt, store

NEAR_M = 0.3  # closer ones would cover the picture
MIN_ALPHA = 1.0 / 255.0  # a weaker contribution is not visible in 8 bits
MAX_REACH = math.sqrt(2.0 * math.log(1.0 / MIN_ALPHA))  # standard deviations at which opacity 1 falls to MIN_ALPHA
BESIDE = 0.15  # of its size beside the picture, the furthest that the Jacobian is linearised at; as in gsplat
TILE = 16  # pixels along a tile's side; a row is one value of tasks.kernels.simd


class ScreenFilter(NamedTuple):
    """What a scene's Gaussians are drawn through, so that none falls between two pixels: what it was made with."""

    dilation_px2: float  # added to the screen covariance
    keeps_light: bool  # opacity falls as the area grows (Yu et al. 2024): no brighter and no wider from afar


FITTED = ScreenFilter(0.15, True)  # of scenes that are made here (docs/reconstruction.md)
CLASSIC = ScreenFilter(0.3, False)  # Kerbl et al. 2023, and what gsplat and nerfstudio do if nothing is said
ANTIALIASED = ScreenFilter(0.3, True)  # what gsplat calls so
OF_DISCS = ScreenFilter(0.1, False)  # of scenes of discs that nothing was fitted to; 0.3 blurs pictures this small

# Columns of a projected row, which fills one cache line; colours are filled in by whoever shades. OPACITY is as given,
# LOG_OPACITY that of the peak on the picture.
U, V, DEPTH, CONIC_XX, CONIC_XY, CONIC_YY, OPACITY, LOG_OPACITY, TOP, BOTTOM, RED, GREEN, BLUE = range(13)
PROJECTED_SIZE = 16

# Rows of a block of 16 Gaussians: mean, quaternion, log-scales, half the ellipse's box, what the filter left of it.
X, Y, Z, QW, QX, QY, QZ, S0, S1, S2, HALF_U, HALF_V, SHARE = (np.uint64(LANES * row) for row in range(13))
BLOCK_SIZE = 28 * LANES  # with space for what the backward pass adds

# exp(x) = polynomial(x / 64)^64 for x from -30 to 12: its relative error is below 1e-5 there.
LEAST_LOG, MOST_LOG = np.float32(-30.0), np.float32(12.0)
F0, F1, F2, F3, F4, F5 = (np.float32(1.0 / math.factorial(k)) for k in range(6))


@inlined
def exponential(x: Any) -> Any:
    """exp of Lanes; that of LEAST_LOG or MOST_LOG beyond them."""
    x = smaller(larger(x, fill(LEAST_LOG)), fill(MOST_LOG)) * fill(np.float32(1.0 / 64.0))
    e = fma(fma(fma(fma(fma(fill(F5), x, fill(F4)), x, fill(F3)), x, fill(F2)), x, fill(F1)), x, fill(F0))
    for _ in range(6):
        e = e * e
    return e


@inlined
def dot(a: Any, b: Any) -> Any:
    """Of two triples of Lanes."""
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


@inlined
def scaled(a: Any, s: Any) -> Any:
    """A triple of Lanes times Lanes."""
    return a[0] * s, a[1] * s, a[2] * s


@inlined
def gather(means: Any, quats: Any, log_scales: Any, i: Any, block: Any, k: Any) -> None:
    """Puts one Gaussian into lane k of a block."""
    lane = np.uint64(k)
    block[X + lane], block[Y + lane], block[Z + lane] = means[i, 0], means[i, 1], means[i, 2]
    block[QW + lane], block[QX + lane] = quats[i, 0], quats[i, 1]
    block[QY + lane], block[QZ + lane] = quats[i, 2], quats[i, 3]
    block[S0 + lane], block[S1 + lane], block[S2 + lane] = log_scales[i, 0], log_scales[i, 1], log_scales[i, 2]


@inlined
def rotation_and_centre(camera: Any) -> Any:
    """Rows (3) of the rotation, each a triple of Lanes, and the camera's centre, from `camera` (4, 4)."""
    rows = (
        (fill(camera[0, 0]), fill(camera[0, 1]), fill(camera[0, 2])),
        (fill(camera[1, 0]), fill(camera[1, 1]), fill(camera[1, 2])),
        (fill(camera[2, 0]), fill(camera[2, 1]), fill(camera[2, 2])),
    )
    centre = (
        fill(-(camera[0, 0] * camera[0, 3] + camera[1, 0] * camera[1, 3] + camera[2, 0] * camera[2, 3])),
        fill(-(camera[0, 1] * camera[0, 3] + camera[1, 1] * camera[1, 3] + camera[2, 1] * camera[2, 3])),
        fill(-(camera[0, 2] * camera[0, 3] + camera[1, 2] * camera[1, 3] + camera[2, 2] * camera[2, 3])),
    )
    return rows, centre


@inlined
def seen_from(rows: Any, centre: Any, block: Any) -> Any:
    """A block's means in camera coordinates."""
    place = (load(block, X) - centre[0], load(block, Y) - centre[1], load(block, Z) - centre[2])
    return dot(rows[0], place), dot(rows[1], place), dot(rows[2], place)


@inlined
def axes_of(block: Any) -> Any:
    """A block's unit quaternions w, x, y, z; the factors that made them unit; principal axes, three triples."""
    w, x, y, z = load(block, QW), load(block, QX), load(block, QY), load(block, QZ)
    shorten = fill(np.float32(1.0)) / sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * shorten, x * shorten, y * shorten, z * shorten
    one, two = fill(np.float32(1.0)), fill(np.float32(2.0))
    axes = (
        (one - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)),
        (two * (x * y - w * z), one - two * (x * x + z * z), two * (y * z + w * x)),
        (two * (x * z + w * y), two * (y * z - w * x), one - two * (x * x + y * y)),
    )
    return (w, x, y, z), shorten, axes


@inlined
def slope_on_picture(rows: Any, near: Any, a: Any, jx: Any) -> Any:
    """What a step in the scene does to one coordinate on the picture: a (row `near` - jx times the row ahead)."""
    ahead = rows[2]
    return a * (near[0] - jx * ahead[0]), a * (near[1] - jx * ahead[1]), a * (near[2] - jx * ahead[2])


@inlined
def covariance_determinant(du: Any, dv: Any) -> Any:
    """The determinant of a screen covariance, whose half axes are du and dv, triples of Lanes."""
    return _minor(du, dv, 0, 1) + _minor(du, dv, 0, 2) + _minor(du, dv, 1, 2)


@inlined
def _minor(du: Any, dv: Any, i: Any, k: Any) -> Any:
    m = du[i] * dv[k] - du[k] * dv[i]
    return m * m


@inlined
def _ellipses(
    block: Any, rows: Any, centre: Any, fx: Any, fy: Any, cx: Any, cy: Any, limits: Any, dilation: Any
) -> None:
    """Replaces a block's Gaussians by U, V, DEPTH, conics (rows X to QY), half the box at one standard deviation and
    the share that the determinant before the dilation is of that after."""
    x, y, z = seen_from(rows, centre, block)
    nearness = fill(np.float32(1.0)) / z
    tx, ty = x * nearness, y * nearness
    to_u = slope_on_picture(rows, rows[0], fx * nearness, smaller(larger(tx, limits[0]), limits[1]))
    to_v = slope_on_picture(rows, rows[1], fy * nearness, smaller(larger(ty, limits[2]), limits[3]))
    _, _, axes = axes_of(block)
    s = exponential(load(block, S0)), exponential(load(block, S1)), exponential(load(block, S2))
    du = s[0] * dot(to_u, axes[0]), s[1] * dot(to_u, axes[1]), s[2] * dot(to_u, axes[2])
    dv = s[0] * dot(to_v, axes[0]), s[1] * dot(to_v, axes[1]), s[2] * dot(to_v, axes[2])
    xx, xy, yy = dot(du, du), dot(du, dv), dot(dv, dv)
    area = covariance_determinant(du, dv)
    inverse = fill(np.float32(1.0)) / (area + dilation * (xx + yy + dilation))  # of the determinant
    xx, yy = xx + dilation, yy + dilation
    store(block, X, fma(fx, tx, cx))
    store(block, Y, fma(fy, ty, cy))
    store(block, Z, z)
    store(block, QW, yy * inverse)
    store(block, QX, fill(np.float32(0.0)) - xy * inverse)
    store(block, QY, xx * inverse)
    store(block, HALF_U, sqrt(xx))
    store(block, HALF_V, sqrt(yy))
    store(block, SHARE, area * inverse)


@inlined
def tangent_limits(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> Any:
    """The least and largest x / z, then y / z, at which the projection is linearised."""
    return (
        fill(-(cx + BESIDE * width) / fx),
        fill((width - cx + BESIDE * width) / fx),
        fill(-(cy + BESIDE * height) / fy),
        fill((height - cy + BESIDE * height) / fy),
    )


@kernel
def project(
    means: Any,
    quats: Any,
    log_scales: Any,
    opacities: Any,
    camera_from_scene: Any,
    intrinsics: Any,
    width: int,
    height: int,
    dilation_px2: float,
    keeps_light: bool,
    first: int,
    last: int,
) -> Any:
    """Which of the Gaussians `first` to `last` can be seen, and their ellipses.

    Arrays as in `Gaussians`, quaternions of any length; `camera_from_scene` (4, 4) and `intrinsics` (3, 3) [px]
    float64, the centre of pixel (0, 0) being at (0.5, 0.5); then a ScreenFilter. Returns index (M,) int64; projected
    (M, 16) float32, rows of pixels TOP <= y < BOTTOM being all that it shows on; tiles (M, 4) int32, x0 <= x < x1,
    y0 <= y < y1 that it touches.
    """
    index = np.empty(last - first, np.int64)
    out = np.empty((last - first, PROJECTED_SIZE), np.float32)
    tiles = np.empty((last - first, 4), np.int32)
    count = 0
    block = np.zeros(BLOCK_SIZE, np.float32)
    rows, centre = rotation_and_centre(camera_from_scene)
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    limits = tangent_limits(fx, fy, cx, cy, width, height)
    middle_u, middle_v, dilation = width / 2.0, height / 2.0, fill(np.float32(dilation_px2))
    for start in range(first, last, LANES):
        n = min(LANES, last - start)
        for k in range(n):
            gather(means, quats, log_scales, start + k, block, k)
        _ellipses(block, rows, centre, fill(fx), fill(fy), fill(cx), fill(cy), limits, dilation)
        for k in range(n):
            i, lane = start + k, np.uint64(k)
            if not (block[Z + lane] >= NEAR_M and opacities[i] > MIN_ALPHA):
                continue
            u, v = float(block[X + lane]), float(block[Y + lane])
            half_u, half_v = MAX_REACH * block[HALF_U + lane], MAX_REACH * block[HALF_V + lane]
            if abs(u - middle_u) > half_u + middle_u or abs(v - middle_v) > half_v + middle_v:
                continue  # beside the picture: most of a long street is
            log_opacity = math.log(opacities[i])
            if keeps_light:
                if not block[SHARE + lane] * opacities[i] * opacities[i] > MIN_ALPHA * MIN_ALPHA:
                    continue
                log_opacity += 0.5 * math.log(block[SHARE + lane])
            reach = math.sqrt(2.0 * (log_opacity - math.log(MIN_ALPHA)))
            half_u, half_v = reach * block[HALF_U + lane], reach * block[HALF_V + lane]
            # Pixels whose centres the box of the ellipse holds; as floats, for they can be too far for integers.
            x0, x1 = max(np.ceil(u - half_u - 0.5), 0.0), min(np.floor(u + half_u + 0.5), float(width))
            y0, y1 = max(np.ceil(v - half_v - 0.5), 0.0), min(np.floor(v + half_v + 0.5), float(height))
            if not (x0 < x1 and y0 < y1):
                continue
            index[count] = i
            out[count, U], out[count, V], out[count, DEPTH] = block[X + lane], block[Y + lane], block[Z + lane]
            out[count, CONIC_XX], out[count, CONIC_XY] = block[QW + lane], block[QX + lane]
            out[count, CONIC_YY] = block[QY + lane]
            out[count, OPACITY], out[count, LOG_OPACITY] = opacities[i], log_opacity
            out[count, TOP], out[count, BOTTOM] = y0, y1
            tiles[count, 0], tiles[count, 1] = int(x0) // TILE, (int(x1) - 1) // TILE + 1
            tiles[count, 2], tiles[count, 3] = int(y0) // TILE, (int(y1) - 1) // TILE + 1
            count += 1
    return index[:count], out[:count], tiles[:count]

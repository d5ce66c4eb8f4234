"""The backward pass of `project`: from a change of the ellipses to a change of the Gaussians and of the camera."""

from typing import Any

import numpy as np

from tasks.kernels.compiled import inlined, kernel
from tasks.kernels.simd import LANES, fill, fused, larger, load, smaller, store, sums, where_below
from tasks.render.splatting.pixels_gradient import Q_X, Q_XX, Q_XY, Q_Y, Q_YY, W_DEPTH, Q
from tasks.render.splatting.project import (
    BLOCK_SIZE,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    OPACITY,
    QW,
    QX,
    QY,
    QZ,
    S0,
    S1,
    S2,
    X,
    Y,
    Z,
    area_of,
    axes_of,
    dot,
    exponential,
    gather,
    scaled,
    seen_from,
    slope_on_picture,
    tangent_limits,
    turned_by,
)

# Rows of a block beyond those of `project`: conics, what the pixels brought, and the derivatives by place and by the
# logarithm of the peak, where the filter lowers it.
CXX, CXY, CYY, BY_XX, BY_XY, BY_YY, BY_DEPTH, D_U, D_V, BY_PEAK = (np.uint64(LANES * row) for row in range(12, 22))
LEAST_AREA = np.float32(1e-20)  # [px4] of what is not on the picture


@inlined
def _conic_gradient(block: Any) -> Any:
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
def _between(value: Any, at: Any, least: Any, most: Any) -> Any:
    """`value` where `at` is strictly between the limits, else 0."""
    return where_below(at, most, where_below(least, at, value))


@inlined
def _store_quaternions(block: Any, q: Any, shorten: Any, g: Any) -> None:
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
    d_xx, d_xy, d_yy = _conic_gradient(block)

    # By each half axis p = s * axis: du = to_u . p and dv = to_v . p make up the screen covariance.
    du = s[0] * dot(to_u, axes[0]), s[1] * dot(to_u, axes[1]), s[2] * dot(to_u, axes[2])
    dv = s[0] * dot(to_v, axes[0]), s[1] * dot(to_v, axes[1]), s[2] * dot(to_v, axes[2])
    xx, xy, yy = dot(du, du), dot(du, dv), dot(dv, dv)
    by_peak, inverse = load(block, BY_PEAK), fill(np.float32(1.0)) / larger(area_of(du, dv), fill(LEAST_AREA))
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
        _both(to_u, by_u[0], to_v, by_v[0]),
        _both(to_u, by_u[1], to_v, by_v[1]),
        _both(to_u, by_u[2], to_v, by_v[2]),
    )
    _store_quaternions(block, q, shorten, by_axes)

    # By to_u and to_v, turned into camera coordinates; from there by the Jacobian's entries and the rotation.
    pull_u, pull_v = _turned(rows, _mixed(axes, by_u)), _turned(rows, _mixed(axes, by_v))
    d_a, d_b = pull_u[0] - jx * pull_u[2], pull_v[1] - jy * pull_v[2]
    d_u, d_v = load(block, D_U), load(block, D_V)
    d_tx = fx * d_u - _between(a * pull_u[2], tx, limits[0], limits[1])
    d_ty = fy * d_v - _between(b * pull_v[2], ty, limits[2], limits[3])
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
def _both(a: Any, s: Any, b: Any, t: Any) -> Any:
    """s a + t b of triples a and b."""
    return fused(a[0], s, b[0] * t), fused(a[1], s, b[1] * t), fused(a[2], s, b[2] * t)


@inlined
def _mixed(axes: Any, weights: Any) -> Any:
    """The sum of three triples, each times its weight."""
    first, second = _both(axes[0], weights[0], axes[1], weights[1]), scaled(axes[2], weights[2])
    return first[0] + second[0], first[1] + second[1], first[2] + second[2]


@inlined
def _turned(rows: Any, place: Any) -> Any:
    return dot(rows[0], place), dot(rows[1], place), dot(rows[2], place)


@kernel
def project_gradient(
    means: Any,
    quats: Any,
    log_scales: Any,
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
    d_screen: Any,
    d_pose: Any,
) -> None:
    """Fills the derivatives by mean, quaternion as given (any length), log-scale, opacity's logit and place on the
    picture, each (M, ...) float32, for rows `first` to `last`.

    Scene, camera, `index` and `projected` as for and from `project`; `sums` (M, 16) as pixels_gradient has them.
    Adds to `d_pose` (6,) float64 the derivative by a small motion of the camera: x' = x + v + w cross x in camera
    coordinates, v [m] before w [rad].
    """
    block, motion = np.zeros(BLOCK_SIZE, np.float32), np.empty(LANES, np.float32)
    rows, centre = turned_by(camera_from_scene)
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

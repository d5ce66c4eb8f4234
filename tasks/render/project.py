"""Gaussians in front of a camera, as ellipses on its image (EWA splatting, Zwicker et al. 2001)."""

import math
from typing import Any

import numpy as np

from tasks.kernels import kernel

NEAR_M = 0.3  # closer ones would cover the picture
DILATION_PX2 = 0.1  # added to the screen covariance; 0.3, made for megapixels, blurs images this small (measured)
MIN_ALPHA = 1.0 / 255.0  # a weaker contribution is not visible in 8 bits
MAX_REACH = math.sqrt(2.0 * math.log(1.0 / MIN_ALPHA))  # standard deviations at which opacity 1 falls to MIN_ALPHA
MAX_TANGENT_RATIO = 1.3  # the Jacobian is linearised at most this far outside the picture
TILE = 16  # pixels along a tile's side; a row is two vector registers (measured: 8 wide is slower)

# Columns of a projected row, which fills one cache line; colours are filled in by whoever shades.
U, V, DEPTH, CONIC_XX, CONIC_XY, CONIC_YY, OPACITY, LOG_OPACITY, TOP, BOTTOM, RED, GREEN, BLUE = range(13)
PROJECTED_SIZE = 16


@kernel
def project(
    means: Any,
    quats: Any,
    log_scales: Any,
    opacities: Any,
    camera_from_scene: Any,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
    first: int,
    last: int,
) -> Any:
    """Which of the Gaussians `first` to `last` can be seen, and their ellipses.

    Arrays as in `Gaussians`, quaternions of any length; `camera_from_scene` (4, 4) float64; focal lengths and centre in
    pixels, the centre of pixel (0, 0) being at (0.5, 0.5). Returns index (M,) int64; projected (M, 16) float32, rows of
    pixels TOP <= y < BOTTOM being all that it shows on; tiles (M, 4) int32, x0 <= x < x1, y0 <= y < y1 that it touches.
    """
    index = np.empty(last - first, np.int64)
    out = np.empty((last - first, PROJECTED_SIZE), np.float32)
    tiles = np.empty((last - first, 4), np.int32)
    count = 0
    r = camera_from_scene
    left, right = -MAX_TANGENT_RATIO * cx / fx, MAX_TANGENT_RATIO * (width - cx) / fx
    top, bottom = -MAX_TANGENT_RATIO * cy / fy, MAX_TANGENT_RATIO * (height - cy) / fy
    slant = max(fx, fy) * math.sqrt(1.0 + max(left * left, right * right, top * top, bottom * bottom))
    for i in range(first, last):
        px, py, pz = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
        if z < NEAR_M or opacities[i] <= MIN_ALPHA:
            continue
        x = r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]
        y = r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]
        tx, ty = x / z, y / z
        u, v = fx * tx + cx, fy * ty + cy
        # No ellipse reaches further than this; culling before the covariance is what makes large scenes cheap.
        longest = math.exp(max(log_scales[i, 0], max(log_scales[i, 1], log_scales[i, 2])))
        bound = MAX_REACH * (longest * slant / z + 1.0)
        if u + bound < 0.0 or u - bound > width or v + bound < 0.0 or v - bound > height:
            continue
        s0, s1, s2 = math.exp(log_scales[i, 0]), math.exp(log_scales[i, 1]), math.exp(log_scales[i, 2])
        log_opacity = math.log(opacities[i])
        reach = math.sqrt(2.0 * (log_opacity - math.log(MIN_ALPHA)))
        # Jacobian of the projection, at a point kept near the picture.
        jx = min(max(tx, left), right)
        jy = min(max(ty, top), bottom)
        a, b = fx / z, fy / z
        qw, qx, qy, qz = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
        shorten = 1.0 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        qw, qx, qy, qz = qw * shorten, qx * shorten, qy * shorten, qz * shorten
        xx = 0.0
        xy = 0.0
        yy = 0.0
        for axis in range(3):
            if axis == 0:
                ax, ay, az, s = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qw * qz), 2 * (qx * qz - qw * qy), s0
            elif axis == 1:
                ax, ay, az, s = 2 * (qx * qy - qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz + qw * qx), s1
            else:
                ax, ay, az, s = 2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy), s2
            dx = s * (r[0, 0] * ax + r[0, 1] * ay + r[0, 2] * az)
            dy = s * (r[1, 0] * ax + r[1, 1] * ay + r[1, 2] * az)
            dz = s * (r[2, 0] * ax + r[2, 1] * ay + r[2, 2] * az)
            du, dv = a * (dx - jx * dz), b * (dy - jy * dz)
            xx += du * du
            xy += du * dv
            yy += dv * dv
        xx += DILATION_PX2
        yy += DILATION_PX2
        # Pixels whose centres the box of the ellipse holds; compared as floats, for they can be too far for integers.
        half_u, half_v = reach * math.sqrt(xx), reach * math.sqrt(yy)
        x0, x1 = max(math.ceil(u - half_u - 0.5), 0.0), min(math.floor(u + half_u + 0.5), float(width))
        y0, y1 = max(math.ceil(v - half_v - 0.5), 0.0), min(math.floor(v + half_v + 0.5), float(height))
        det = xx * yy - xy * xy
        if not (x0 < x1 and y0 < y1 and det > 0.0):
            continue
        index[count] = i
        out[count, U], out[count, V], out[count, DEPTH] = u, v, z
        out[count, CONIC_XX], out[count, CONIC_XY], out[count, CONIC_YY] = yy / det, -xy / det, xx / det
        out[count, OPACITY], out[count, LOG_OPACITY] = opacities[i], log_opacity
        out[count, TOP], out[count, BOTTOM] = y0, y1
        tiles[count, 0], tiles[count, 1] = int(x0) // TILE, (int(x1) - 1) // TILE + 1
        tiles[count, 2], tiles[count, 3] = int(y0) // TILE, (int(y1) - 1) // TILE + 1
        count += 1
    return index[:count].copy(), out[:count].copy(), tiles[:count].copy()

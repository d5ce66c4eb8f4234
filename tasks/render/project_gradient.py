"""The way back through `project`: from a change of the ellipses to a change of the Gaussians and of the camera."""

import math
from typing import Any

import numpy as np

from tasks.kernels import kernel
from tasks.render.pixels_gradient import Q_X, Q_XX, Q_XY, Q_Y, Q_YY, W_DEPTH, Q
from tasks.render.project import CONIC_XX, CONIC_XY, CONIC_YY, MAX_TANGENT_RATIO, OPACITY


@kernel
def project_gradient(
    means: Any,
    quats: Any,
    log_scales: Any,
    camera_from_scene: Any,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
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

    Scene, camera, `index` and `projected` as for and from `project`; `sums` (M, 11) as tasks.render.pixels_gradient has
    them. Adds to `d_pose` (6,) float64 the derivative by a small motion of the camera: x' = x + v + w cross x in camera
    coordinates, v [m] before w [rad].
    """
    r = camera_from_scene
    left, right = -MAX_TANGENT_RATIO * cx / fx, MAX_TANGENT_RATIO * (width - cx) / fx
    top, bottom = -MAX_TANGENT_RATIO * cy / fy, MAX_TANGENT_RATIO * (height - cy) / fy
    axes = np.empty((3, 3))  # columns: principal axes in the scene
    spread = np.empty((3, 3))  # columns: principal axes times scales, in the camera
    d_axes = np.empty((3, 3))
    for k in range(first, last):
        i = index[k]
        px, py, pz = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
        x = r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]
        y = r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
        tx, ty = x / z, y / z
        jx, jy = min(max(tx, left), right), min(max(ty, top), bottom)
        a, b = fx / z, fy / z
        qw, qx, qy, qz = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
        shorten = 1.0 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        qw, qx, qy, qz = qw * shorten, qx * shorten, qy * shorten, qz * shorten
        axes[0, 0], axes[1, 1] = 1 - 2 * (qy * qy + qz * qz), 1 - 2 * (qx * qx + qz * qz)
        axes[2, 2] = 1 - 2 * (qx * qx + qy * qy)
        axes[0, 1], axes[1, 0] = 2 * (qx * qy - qw * qz), 2 * (qx * qy + qw * qz)
        axes[0, 2], axes[2, 0] = 2 * (qx * qz + qw * qy), 2 * (qx * qz - qw * qy)
        axes[1, 2], axes[2, 1] = 2 * (qy * qz - qw * qx), 2 * (qy * qz + qw * qx)

        cxx, cxy, cyy = float(projected[k, CONIC_XX]), float(projected[k, CONIC_XY]), float(projected[k, CONIC_YY])
        # The exponent is -(cxx dx^2 + 2 cxy dx dy + cyy dy^2) / 2, dx and dy from the centre to the pixel.
        d_u = cxx * sums[k, Q_X] + cxy * sums[k, Q_Y]
        d_v = cxy * sums[k, Q_X] + cyy * sums[k, Q_Y]
        d_screen[k, 0], d_screen[k, 1] = d_u, d_v
        d_logits[k] = sums[k, Q] * (1.0 - projected[k, OPACITY])
        # d covariance = -conic (d conic) conic.
        gxx, gxy, gyy = -0.5 * float(sums[k, Q_XX]), -0.5 * float(sums[k, Q_XY]), -0.5 * float(sums[k, Q_YY])
        left_xx, left_xy = cxx * gxx + cxy * gxy, cxx * gxy + cxy * gyy
        left_yx, left_yy = cxy * gxx + cyy * gxy, cxy * gxy + cyy * gyy
        d_xx = -(left_xx * cxx + left_xy * cxy)
        d_xy = -2.0 * (left_xx * cxy + left_xy * cyy)
        d_yy = -(left_yx * cxy + left_yy * cyy)

        d_a, d_b, d_jx, d_jy = 0.0, 0.0, 0.0, 0.0
        turn_x, turn_y, turn_z = 0.0, 0.0, 0.0
        for axis in range(3):
            scale = math.exp(log_scales[i, axis])
            for row in range(3):
                spread[row, axis] = scale * (
                    r[row, 0] * axes[0, axis] + r[row, 1] * axes[1, axis] + r[row, 2] * axes[2, axis]
                )
            dx, dy, dz = spread[0, axis], spread[1, axis], spread[2, axis]
            du, dv = a * (dx - jx * dz), b * (dy - jy * dz)
            d_du, d_dv = 2.0 * d_xx * du + d_xy * dv, 2.0 * d_yy * dv + d_xy * du
            d_a += d_du * (dx - jx * dz)
            d_b += d_dv * (dy - jy * dz)
            d_jx -= d_du * a * dz
            d_jy -= d_dv * b * dz
            gx, gy, gz = a * d_du, b * d_dv, -a * jx * d_du - b * jy * d_dv
            d_log_scales[k, axis] = gx * dx + gy * dy + gz * dz
            turn_x += dy * gz - dz * gy
            turn_y += dz * gx - dx * gz
            turn_z += dx * gy - dy * gx
            for row in range(3):
                d_axes[row, axis] = scale * (r[0, row] * gx + r[1, row] * gy + r[2, row] * gz)

        d_tx, d_ty = fx * d_u, fy * d_v
        if left < tx < right:
            d_tx += d_jx
        if top < ty < bottom:
            d_ty += d_jy
        d_x, d_y = d_tx / z, d_ty / z
        d_z = float(sums[k, W_DEPTH]) - (d_tx * tx + d_ty * ty + d_a * a + d_b * b) / z
        for column in range(3):
            d_means[k, column] = r[0, column] * d_x + r[1, column] * d_y + r[2, column] * d_z
        d_pose[0] += d_x
        d_pose[1] += d_y
        d_pose[2] += d_z
        d_pose[3] += y * d_z - z * d_y + turn_x
        d_pose[4] += z * d_x - x * d_z + turn_y
        d_pose[5] += x * d_y - y * d_x + turn_z

        g = d_axes
        twist_x, twist_y, twist_z = g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1]
        both_xy, both_xz, both_yz = g[0, 1] + g[1, 0], g[0, 2] + g[2, 0], g[1, 2] + g[2, 1]
        d_qw = 2.0 * (qx * twist_x + qy * twist_y + qz * twist_z)
        d_qx = 2.0 * (qw * twist_x + qy * both_xy + qz * both_xz - 2.0 * qx * (g[1, 1] + g[2, 2]))
        d_qy = 2.0 * (qw * twist_y + qx * both_xy + qz * both_yz - 2.0 * qy * (g[0, 0] + g[2, 2]))
        d_qz = 2.0 * (qw * twist_z + qx * both_xz + qy * both_yz - 2.0 * qz * (g[0, 0] + g[1, 1]))
        along = d_qw * qw + d_qx * qx + d_qy * qy + d_qz * qz  # a longer quaternion is the same rotation
        d_quats[k, 0], d_quats[k, 1] = shorten * (d_qw - along * qw), shorten * (d_qx - along * qx)
        d_quats[k, 2], d_quats[k, 3] = shorten * (d_qy - along * qy), shorten * (d_qz - along * qz)

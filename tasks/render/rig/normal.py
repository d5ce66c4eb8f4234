"""Reprojection of matched corners through a rig, and the normal equations of its least squares, points eliminated.

A point X of the world is seen by camera c of the ego at Xe = D^-1 E^-1 X, Xc = C^-1 Xe: E the ego's pose at the
camera's stamp, D what it is corrected by at that instant, C the camera's mount. The lens is Brown's
(`tasks.render.views.undistorted`). Corrections turn and shift in the frame they are applied in.
"""

from typing import Any

import numpy as np

from tasks.kernels.compiled import kernel

EGO, MOUNT, LENS, STAMP = 0, 6, 12, 21  # where they begin in the 22 parameters that one corner depends on
N_CORNER = 22
N_CAMERA = 16  # of a camera: shift, turn, fx, fy, cx, cy, k1, k2, p1, p2, k3, stamp
NEAR_M = 0.3


@kernel
def _see(point: Any, ego_from_world: Any, camera_from_ego: Any, lens: Any, out: Any) -> None:
    """Fills out (8,) with the pixel, the point in the ego's and in the camera's frame; not ahead: NaN for the pixel."""
    for r in range(3):
        e = ego_from_world
        out[2 + r] = e[r, 0] * point[0] + e[r, 1] * point[1] + e[r, 2] * point[2] + e[r, 3]
    for r in range(3):
        c = camera_from_ego
        out[5 + r] = c[r, 0] * out[2] + c[r, 1] * out[3] + c[r, 2] * out[4] + c[r, 3]
    if out[7] < NEAR_M:
        out[0], out[1] = np.nan, np.nan
        return
    x, y = out[5] / out[7], out[6] / out[7]
    r2 = x * x + y * y
    s = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    out[0] = lens[0] * (x * s + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)) + lens[2]
    out[1] = lens[1] * (y * s + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y) + lens[3]


@kernel
def residuals(
    points: Any, point_of: Any, view_of: Any, at: Any, camera_of: Any, ego_from_world: Any, camera_from_ego: Any,
    lenses: Any,
) -> Any:  # fmt: skip
    """(N, 2) pixels that corners `at` (N, 2) are off; infinite where the point is not ahead of the camera."""
    out, seen = np.empty((point_of.shape[0], 2)), np.empty(8)
    for i in range(point_of.shape[0]):
        v = view_of[i]
        c = camera_of[v]
        _see(points[point_of[i]], ego_from_world[v], camera_from_ego[c], lenses[c], seen)
        for k in range(2):
            out[i, k] = seen[k] - at[i, k] if seen[0] == seen[0] else np.inf
    return out


@kernel
def _slopes(
    seen: Any, camera_from_ego: Any, world_to_camera: Any, lens: Any, twist: Any, by_rig: Any, by_point: Any
) -> None:
    """Derivatives of a pixel by the 22 parameters (2, 22) and by the point (2, 3), of what `_see` filled in."""
    x, y, z = seen[5] / seen[7], seen[6] / seen[7], seen[7]
    fx, fy, k1, k2, p1, p2, k3 = lens[0], lens[1], lens[4], lens[5], lens[6], lens[7], lens[8]
    r2 = x * x + y * y
    s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    ds = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    xx, xy = s + x * x * ds + 2.0 * p1 * y + 6.0 * p2 * x, x * y * ds + 2.0 * p1 * x + 2.0 * p2 * y
    yy = s + y * y * ds + 6.0 * p1 * y + 2.0 * p2 * x
    d = np.empty((2, 3))  # by the point in the camera's frame
    d[0, 0], d[0, 1], d[0, 2] = fx * xx / z, fx * xy / z, -fx * (xx * x + xy * y) / z
    d[1, 0], d[1, 1], d[1, 2] = fy * xy / z, fy * yy / z, -fy * (xy * x + yy * y) / z
    ex, ey, ez = seen[2], seen[3], seen[4]
    cx, cy, cz = seen[5], seen[6], seen[7]
    for k in range(2):
        a, b, c = d[k, 0], d[k, 1], d[k, 2]
        for j in range(3):
            by_point[k, j] = a * world_to_camera[0, j] + b * world_to_camera[1, j] + c * world_to_camera[2, j]
        m = camera_from_ego
        ga = a * m[0, 0] + b * m[1, 0] + c * m[2, 0]
        gb = a * m[0, 1] + b * m[1, 1] + c * m[2, 1]
        gc = a * m[0, 2] + b * m[1, 2] + c * m[2, 2]
        by_rig[k, 0], by_rig[k, 1], by_rig[k, 2] = -ga, -gb, -gc
        by_rig[k, 3], by_rig[k, 4], by_rig[k, 5] = gb * ez - gc * ey, gc * ex - ga * ez, ga * ey - gb * ex
        by_rig[k, 6], by_rig[k, 7], by_rig[k, 8] = -a, -b, -c
        by_rig[k, 9], by_rig[k, 10], by_rig[k, 11] = b * cz - c * cy, c * cx - a * cz, a * cy - b * cx
        by_rig[k, STAMP] = -(
            ga * (twist[0] + twist[4] * ez - twist[5] * ey)
            + gb * (twist[1] + twist[5] * ex - twist[3] * ez)
            + gc * (twist[2] + twist[3] * ey - twist[4] * ex)
        )
        for j in range(LENS, STAMP):
            by_rig[k, j] = 0.0
    by_rig[0, 12], by_rig[0, 14] = x * s + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), 1.0
    by_rig[1, 13], by_rig[1, 15] = y * s + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y, 1.0
    by_rig[0, 16], by_rig[0, 17], by_rig[0, 20] = fx * x * r2, fx * x * r2 * r2, fx * x * r2 * r2 * r2
    by_rig[1, 16], by_rig[1, 17], by_rig[1, 20] = fy * y * r2, fy * y * r2 * r2, fy * y * r2 * r2 * r2
    by_rig[0, 18], by_rig[0, 19] = fx * 2.0 * x * y, fx * (r2 + 2.0 * x * x)
    by_rig[1, 18], by_rig[1, 19] = fy * (r2 + 2.0 * y * y), fy * 2.0 * x * y


@kernel
def normal_equations(
    points: Any, starts: Any, view_of: Any, at: Any, weights: Any, damping: float, camera_of: Any, places: Any,
    ego_from_world: Any, camera_from_ego: Any, lenses: Any, twists: Any, n: int,
) -> Any:  # fmt: skip
    """Matrix (n, n) and right side (n,) of the rig's parameters, and what gives the points' steps from theirs.

    Corners of point p are rows starts[p] to starts[p + 1]; a weight of 0 leaves one out. `places` (N, 22): which of
    the n parameters a corner depends on. The last three: inverse blocks (P, 3, 3) and right sides (P, 3) of the
    points, mixed blocks (N, 22, 3) of the corners.
    """
    matrix, right = np.zeros((n, n)), np.zeros(n)
    mixed = np.zeros((view_of.shape[0], N_CORNER, 3))
    inverses, sides = np.zeros((points.shape[0], 3, 3)), np.zeros((points.shape[0], 3))
    seen, by_rig, by_point = np.empty(8), np.empty((2, N_CORNER)), np.empty((2, 3))
    turn, scaled, block = np.empty((3, 3)), np.empty((N_CORNER, 3)), np.empty((3, 3))
    for p in range(points.shape[0]):
        block[:] = 0.0
        for i in range(starts[p], starts[p + 1]):
            w, v = weights[i], view_of[i]
            if w == 0.0:
                continue
            c = camera_of[v]
            _see(points[p], ego_from_world[v], camera_from_ego[c], lenses[c], seen)
            for r in range(3):
                for k in range(3):
                    turn[r, k] = 0.0
                    for m in range(3):
                        turn[r, k] += camera_from_ego[c, r, m] * ego_from_world[v, m, k]
            _slopes(seen, camera_from_ego[c], turn, lenses[c], twists[v], by_rig, by_point)
            off_x, off_y = at[i, 0] - seen[0], at[i, 1] - seen[1]
            for k in range(N_CORNER):
                gx, gy = w * by_rig[0, k], w * by_rig[1, k]
                right[places[i, k]] += gx * off_x + gy * off_y
                for m in range(N_CORNER):
                    matrix[places[i, k], places[i, m]] += gx * by_rig[0, m] + gy * by_rig[1, m]
                for m in range(3):
                    mixed[i, k, m] = gx * by_point[0, m] + gy * by_point[1, m]
            for k in range(3):
                sides[p, k] += w * (by_point[0, k] * off_x + by_point[1, k] * off_y)
                for m in range(3):
                    block[k, m] += w * (by_point[0, k] * by_point[0, m] + by_point[1, k] * by_point[1, m])
        inverses[p] = _inverse(block, damping)
        inverse, side = inverses[p], sides[p]
        for a in range(starts[p], starts[p + 1]):
            if weights[a] == 0.0:
                continue
            for k in range(N_CORNER):
                for m in range(3):
                    scaled[k, m] = 0.0
                    for j in range(3):
                        scaled[k, m] += mixed[a, k, j] * inverse[j, m]
                place = places[a, k]
                right[place] -= scaled[k, 0] * side[0] + scaled[k, 1] * side[1] + scaled[k, 2] * side[2]
            for b in range(starts[p], starts[p + 1]):
                if weights[b] == 0.0:
                    continue
                for k in range(N_CORNER):
                    for m in range(N_CORNER):
                        matrix[places[a, k], places[b, m]] -= (
                            scaled[k, 0] * mixed[b, m, 0]
                            + scaled[k, 1] * mixed[b, m, 1]
                            + scaled[k, 2] * mixed[b, m, 2]
                        )
    return matrix, right, inverses, sides, mixed


@kernel
def _inverse(block: Any, damping: float) -> Any:
    """Of a damped symmetric (3, 3); zeros where it is singular."""
    a, b, c = block[0, 0] * (1.0 + damping), block[1, 1] * (1.0 + damping), block[2, 2] * (1.0 + damping)
    d, e, f = block[0, 1], block[0, 2], block[1, 2]
    out = np.zeros((3, 3))
    det = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - e * b)
    if not det > 1e-12 * a * b * c:
        return out
    out[0, 0], out[1, 1], out[2, 2] = (b * c - f * f) / det, (a * c - e * e) / det, (a * b - d * d) / det
    out[0, 1] = out[1, 0] = (e * f - d * c) / det
    out[0, 2] = out[2, 0] = (d * f - e * b) / det
    out[1, 2] = out[2, 1] = (d * e - a * f) / det
    return out


@kernel
def solved(matrix: Any, right: Any) -> Any:
    """x (n,) of a symmetric positive definite matrix (n, n) x = right, by Cholesky; NaN where it is not.

    Here and not in LAPACK, whose sums change with the number of its threads.
    """
    n = right.shape[0]
    low, x = matrix.copy(), right.copy()
    for j in range(n):
        for k in range(j):
            low[j, j] -= low[j, k] * low[j, k]
        if not low[j, j] > 0.0:
            return np.full(n, np.nan)
        low[j, j] = np.sqrt(low[j, j])
        for i in range(j + 1, n):
            total = low[i, j]
            for k in range(j):
                total -= low[i, k] * low[j, k]
            low[i, j] = total / low[j, j]
    for i in range(n):
        for k in range(i):
            x[i] -= low[i, k] * x[k]
        x[i] /= low[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= low[k, i] * x[k]
        x[i] /= low[i, i]
    return x

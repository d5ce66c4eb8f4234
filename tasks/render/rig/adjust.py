"""Rig and points moved until the matched corners fall where they were seen (bundle adjustment, Triggs et al. 2000).

Cauchy's loss, whose width shrinks from round to round: what is far off at first, because the calibration is, counts
then, and what stays far off does not count in the end. Levenberg-Marquardt with the points eliminated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tasks.kernels.compiled import kernel
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import DRIVES_APART_S, Camera, SensorFile

# A rig under adjustment: what of it may change, and what its photos were given as.

INSTANT_S = 0.05  # photos no further apart were taken at once, by one pose of the ego


@dataclass(frozen=True)
class RigPhotos:
    """Where the photos of a block come from, as given; one row each."""

    camera_of: Ints  # (V,) row of the cameras
    instant_of: Ints  # (V,)
    world_from_ego: Array  # (V, 4, 4)
    twists: Array  # (V, 6) of the ego at that time, in its frame: shift [m/s], turn [rad/s]


@dataclass(frozen=True)
class Rig:
    """What is adjusted."""

    ego_from_camera: Array  # (C, 4, 4)
    lenses: Array  # (C, 9) fx, fy, cx, cy [px], k1, k2, p1, p2, k3
    corrections: Array  # (T, 4, 4) of each instant: world_from_ego @ correction is where the ego was

    def ego_poses(self, shots: RigPhotos, after_s: Array | None = None) -> Array:
        """(V, 4, 4) corrected world_from_ego of the photos, `after_s` (V,) after their middle row was read."""
        poses = shots.world_from_ego
        if after_s is not None:
            poses = poses @ motions_of_twists(after_s[:, None] * shots.twists)
        return np.asarray(poses @ self.corrections[shots.instant_of])

    def moved(self, step: Array) -> "Rig":
        """After a step (n,) of its parameters, in the order of `normal_equations`."""
        n = 6 * len(self.corrections)
        of_camera = step[n:].reshape(len(self.lenses), -1)
        return Rig(
            self.ego_from_camera @ motions_of_twists(of_camera[:, :6]),
            self.lenses + of_camera[:, 6:15],
            self.corrections @ motions_of_twists(step[:n].reshape(-1, 6)),
        )

    def away_from(self, given: "Rig") -> Array:
        """(n,) how far each parameter is from that of another, in the same order."""
        mounts = twists_of(np.linalg.inv(given.ego_from_camera) @ self.ego_from_camera)
        of_camera = np.column_stack([mounts, self.lenses - given.lenses])
        of_instant = twists_of(np.linalg.inv(given.corrections) @ self.corrections)
        return np.concatenate([of_instant.ravel(), of_camera.ravel()])


def initial_rig(cameras: Sequence[Camera], files: Sequence[SensorFile]) -> tuple[Rig, RigPhotos]:
    """The rig as it is said to be. The files are of these cameras."""
    row = {camera.name: i for i, camera in enumerate(cameras)}
    camera_of = np.array([row[file.sensor] for file in files])
    instant_of = _instants(files)
    k = np.stack([camera.intrinsics for camera in cameras])
    terms = np.stack([camera.distortion for camera in cameras])
    rig = Rig(
        np.stack([camera.ego_from_camera for camera in cameras]),
        np.column_stack([k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2], terms]),
        np.tile(np.eye(4), (instant_of.max() + 1, 1, 1)),
    )
    poses = np.stack([file.world_from_ego for file in files])
    return rig, RigPhotos(camera_of, instant_of, poses, _twists(poses, np.array([file.time_s for file in files])))


def adjusted_camera(camera: Camera, rig: Rig, row: int) -> Camera:
    """The camera as the rig has it."""
    fx, fy, cx, cy = rig.lenses[row, :4]
    intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return replace(
        camera, intrinsics=intrinsics, distortion=rig.lenses[row, 4:], ego_from_camera=rig.ego_from_camera[row]
    )


def motions_of_twists(twists: Array) -> Array:
    """(M, 4, 4): x' = R(turn) x + shift of rows (M, 6) shift [m], turn [rad]."""
    out = np.tile(np.eye(4), (len(twists), 1, 1))
    out[:, :3, :3] = Rotation.from_rotvec(twists[:, 3:]).as_matrix()
    out[:, :3, 3] = twists[:, :3]
    return out


def twists_of(motion: Array) -> Array:
    """The rows (M, 6) of motions (M, 4, 4)."""
    return np.column_stack([motion[:, :3, 3], Rotation.from_matrix(motion[:, :3, :3]).as_rotvec()])


def _instants(files: Sequence[SensorFile]) -> Ints:
    """(V,) which instant each file is of."""
    order = np.argsort([file.time_s for file in files], kind="stable")
    out, at, seen, since = np.zeros(len(files), np.int64), -1, set[str](), -np.inf
    for i in order:
        if files[i].time_s - since > INSTANT_S or files[i].sensor in seen:
            at, seen, since = at + 1, set(), files[i].time_s
        seen.add(files[i].sensor)
        out[i] = at
    return out


def _twists(poses: Array, times: Array) -> Array:
    """(V, 6) how the ego moves, from the poses (V, 4, 4) before and after; 0 where there is but one time."""
    order = np.argsort(times, kind="stable")
    stamps, first = np.unique(times[order], return_index=True)
    at = poses[order][first]
    if len(stamps) < 2:
        return np.zeros((len(times), 6))
    row = np.searchsorted(stamps, times)
    before, after = np.maximum(row - 1, 0), np.minimum(row + 1, len(stamps) - 1)
    before = np.where(stamps[row] - stamps[before] > DRIVES_APART_S / 2.0, row, before)  # of another drive
    after = np.where(stamps[after] - stamps[row] > DRIVES_APART_S / 2.0, row, after)
    here = np.linalg.inv(at[row])
    between = stamps[after] - stamps[before]
    per_s = np.where(between > 0.0, between, 1.0)[:, None]  # alone in its drive: not known to move
    moved = twists_of(here @ at[after]) - twists_of(here @ at[before])
    return np.asarray(moved / per_s)


# Reprojection of matched corners through a rig, and the normal equations of its least squares, points eliminated.
#
# A point X of the world is seen by camera c of the ego at Xe = D^-1 E^-1 X, Xc = C^-1 Xe: E the ego's pose at the
# camera's stamp, D what it is corrected by at that instant, C the camera's mount. The lens is Brown's
# (`tasks.render.views.undistorted`). Corrections turn and shift in the frame they are applied in.

EGO, MOUNT, LENS = 0, 6, 12  # where they begin in the 21 parameters that one corner depends on
N_CORNER = 21
N_CAMERA = 15  # of a camera: shift, turn, fx, fy, cx, cy, k1, k2, p1, p2, k3
NEAR_M = 0.3


@kernel
def _project_point(point: Any, ego_from_world: Any, camera_from_ego: Any, lens: Any, out: Any) -> None:
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
def reprojection_residuals(
    points: Any, point_of: Any, view_of: Any, at: Any, camera_of: Any, ego_from_world: Any, camera_from_ego: Any,
    lenses: Any,
) -> Any:  # fmt: skip
    """(N, 2) pixels that corners `at` (N, 2) are off; infinite where the point is not ahead of the camera."""
    out, seen = np.empty((point_of.shape[0], 2)), np.empty(8)
    for i in range(point_of.shape[0]):
        v = view_of[i]
        c = camera_of[v]
        _project_point(points[point_of[i]], ego_from_world[v], camera_from_ego[c], lenses[c], seen)
        for k in range(2):
            out[i, k] = seen[k] - at[i, k] if seen[0] == seen[0] else np.inf
    return out


@kernel
def _projection_jacobian(
    seen: Any, camera_from_ego: Any, world_to_camera: Any, lens: Any, by_rig: Any, by_point: Any
) -> None:
    """Derivatives of a pixel by the 21 parameters (2, 21) and by the point (2, 3), of what `_project_point` found."""
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
        for j in range(LENS, N_CORNER):
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
    ego_from_world: Any, camera_from_ego: Any, lenses: Any, n: int,
) -> Any:  # fmt: skip
    """Matrix (n, n) and right side (n,) of the rig's parameters, and what gives the points' steps from theirs.

    Corners of point p are rows starts[p] to starts[p + 1]; a weight of 0 leaves one out. `places` (N, 21): which of
    the n parameters a corner depends on. The last three: inverse blocks (P, 3, 3) and right sides (P, 3) of the
    points, mixed blocks (N, 21, 3) of the corners.
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
            _project_point(points[p], ego_from_world[v], camera_from_ego[c], lenses[c], seen)
            for r in range(3):
                for k in range(3):
                    turn[r, k] = 0.0
                    for m in range(3):
                        turn[r, k] += camera_from_ego[c, r, m] * ego_from_world[v, m, k]
            _projection_jacobian(seen, camera_from_ego[c], turn, lenses[c], by_rig, by_point)
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
        inverses[p] = _damped_inverse(block, damping)
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
def _damped_inverse(block: Any, damping: float) -> Any:
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
def cholesky_solve(matrix: Any, right: Any) -> Any:
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


WIDTHS_PX = (16.0, 8.0, 4.0, 2.0, 1.0)  # of the loss, in pixels of the pictures that corners were looked for in
OUT = 4.0  # times the width: a corner further off is left out of the round
STEPS = 12  # a round, at most
DAMPING = (1e-4, 1e-9, 1e8)  # first, least, most
SETTLED = 1e-4  # share of the cost by which a step must lower it to be followed by another
NO_MORE = 1e6  # square of an offset in widths: a point that a step puts behind a camera must not stop the others
LEAST_PARALLAX_DEG = 0.5
FARTHEST_M = 300.0


@dataclass(frozen=True)
class CornerTracks:
    """Corners that show one point each, ordered by point."""

    starts: Ints  # (P + 1,) rows of the corners of point p: starts[p] to starts[p + 1]
    view_of: Ints  # (N,) row of the photo
    at: Array  # (N, 2) pixels of the photo as taken
    pixel: Array  # (N,) pixels of the photo per pixel of the picture that corners were looked for in
    after_s: Array | None = None  # (N,) how long after the middle row of its photo a corner was read; None: all at once

    @property
    def point_of(self) -> Ints:
        """(N,)"""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))


@dataclass(frozen=True)
class AdjustedRig:
    """A rig and its points, and which corners agree with them."""

    rig: Rig
    points: Array  # (P, 3)
    used: Bools  # (N,)


def bundle_adjust(rig: Rig, shots: RigPhotos, matched: CornerTracks, sigmas: Array) -> AdjustedRig:
    """The rig that explains the corners best without leaving the given one by many `sigmas` (n,); 0 holds."""
    now, points = rig, np.zeros((len(matched.starts) - 1, 3))
    for width in WIDTHS_PX:
        points, there = triangulate_points(now, shots, matched)
        off = reprojection_errors(now, shots, matched, points)
        used = drop_lone_corners((off < OUT * width) & there[matched.point_of], matched)
        now, points = _levenberg_marquardt(rig, now, shots, matched, points, used, width, sigmas)
    points, there = triangulate_points(now, shots, matched)
    last = reprojection_errors(now, shots, matched, points)
    return AdjustedRig(now, points, drop_lone_corners((last < OUT * WIDTHS_PX[-1]) & there[matched.point_of], matched))


def without_views(matched: CornerTracks, views: Array) -> CornerTracks:
    """Without the corners of some photos, and without points that then have fewer than two."""
    keep = ~np.isin(matched.view_of, views)
    count = np.bincount(matched.point_of, keep, len(matched.starts) - 1)
    keep = keep & (count >= 2)[matched.point_of]
    ends = np.cumsum(count[count >= 2]).astype(np.int64)
    after_s = None if matched.after_s is None else matched.after_s[keep]
    return CornerTracks(
        np.concatenate([[0], ends]), matched.view_of[keep], matched.at[keep], matched.pixel[keep], after_s
    )


def drop_lone_corners(used: Bools, matched: CornerTracks) -> Bools:
    """Without corners whose point has no second one."""
    count = np.bincount(matched.point_of, used, len(matched.starts) - 1)
    return np.asarray(used & (count[matched.point_of] >= 2))


def reprojection_errors(rig: Rig, shots: RigPhotos, matched: CornerTracks, points: Array) -> Array:
    """(N,) distance of each corner from where its point falls, in pixels of the picture it was looked for in."""
    return np.asarray(np.hypot(*_residuals(rig, shots, matched, points).T) / matched.pixel)


def _residuals(rig: Rig, shots: RigPhotos, matched: CornerTracks, points: Array) -> Array:
    view_of, seen = _views_of_corners(shots, matched)
    ego_from_world = np.linalg.inv(rig.ego_poses(seen, matched.after_s))
    of_photo = view_of, matched.at, seen.camera_of, ego_from_world, np.linalg.inv(rig.ego_from_camera), rig.lenses
    return np.asarray(reprojection_residuals(points, matched.point_of, *of_photo))


def _views_of_corners(shots: RigPhotos, matched: CornerTracks) -> tuple[Ints, RigPhotos]:
    """The photos and which a corner (N,) is of; where rows are read one after the other, each corner as its own."""
    if matched.after_s is None:
        return matched.view_of, shots
    v = matched.view_of
    return np.arange(len(v)), RigPhotos(
        shots.camera_of[v], shots.instant_of[v], shots.world_from_ego[v], shots.twists[v]
    )


def corner_rays(rig: Rig, shots: RigPhotos, matched: CornerTracks) -> tuple[Array, Array]:
    """Eyes (N, 3) and unit directions (N, 3) in the world of the corners."""
    camera_of = shots.camera_of[matched.view_of]
    lens = rig.lenses[camera_of].T
    seen = (matched.at[:, 0] - lens[2]) / lens[0], (matched.at[:, 1] - lens[3]) / lens[1]
    x, y = seen
    k1, k2, p1, p2, k3 = lens[4:]
    for _ in range(20):  # as OpenCV does: the lens moves a pixel little
        r2 = x * x + y * y
        s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        x, y = (
            (seen[0] - 2.0 * p1 * x * y - p2 * (r2 + 2.0 * x * x)) / s,
            (seen[1] - p1 * (r2 + 2.0 * y * y) - 2.0 * p2 * x * y) / s,
        )
    view_of, seen_by = _views_of_corners(shots, matched)
    pose = (rig.ego_poses(seen_by, matched.after_s) @ rig.ego_from_camera[seen_by.camera_of])[view_of]
    way = np.einsum("nij,nj->ni", pose[:, :3, :3], np.column_stack([x, y, np.ones(len(x))]))
    return pose[:, :3, 3], way / np.linalg.norm(way, axis=1, keepdims=True)


def triangulate_points(
    rig: Rig, shots: RigPhotos, matched: CornerTracks, used: Bools | None = None
) -> tuple[Array, Bools]:
    """Points (P, 3) nearest to their corners' rays, and which of them are there: with parallax, ahead, not too far."""
    eyes, ways = corner_rays(rig, shots, matched)
    weight = np.ones(len(eyes)) if used is None else used.astype(np.float64)
    first = matched.starts[:-1]
    across = weight[:, None, None] * (np.eye(3) - ways[:, :, None] * ways[:, None, :])
    blocks = np.add.reduceat(across, first)
    sides = np.add.reduceat(np.einsum("nij,nj->ni", across, eyes), first)
    mean = np.add.reduceat(weight[:, None] * ways, first)
    count = np.maximum(np.add.reduceat(weight, first), 1.0)
    # Rays within an angle a of each other have a mean shorter than 1 by a^2 / 8.
    length = np.linalg.norm(mean / count[:, None], axis=1)
    there = (length < 1.0 - np.radians(LEAST_PARALLAX_DEG) ** 2 / 8.0) & (np.add.reduceat(weight, first) >= 2.0)
    blocks[~there] = np.eye(3)
    points = np.linalg.solve(blocks, sides[..., None])[..., 0]
    ahead = np.einsum("ni,ni->n", points[matched.point_of] - eyes, ways)
    ahead = np.where(weight > 0.0, ahead, 1.0)
    there &= (np.minimum.reduceat(ahead, first) > 0.0) & (np.maximum.reduceat(ahead, first) < FARTHEST_M)
    return points, there


def _levenberg_marquardt(
    given: Rig,
    rig: Rig,
    shots: RigPhotos,
    matched: CornerTracks,
    points: Array,
    used: Bools,
    width: float,
    sigmas: Array,
) -> tuple[Rig, Array]:
    """Rig and points after some steps of Levenberg-Marquardt."""
    free = sigmas > 0.0
    trust = np.where(free, 1.0 / np.where(free, sigmas, 1.0) ** 2, 0.0)
    of_instant = 6 * shots.instant_of[matched.view_of, None] + np.arange(MOUNT)
    of_camera = N_CAMERA * shots.camera_of[matched.view_of, None] + np.arange(N_CORNER - MOUNT)
    # (N, 21) rows of the parameters that a corner depends on.
    places = np.concatenate([of_instant, 6 * len(rig.corrections) + of_camera], axis=1)
    view_of, seen = _views_of_corners(shots, matched)
    damping = DAMPING[0]
    width_px = width * matched.pixel

    def cost_of(rig: Rig, points: Array) -> tuple[float, Array]:
        off = _residuals(rig, shots, matched, points)
        square = np.minimum((off[used] ** 2).sum(axis=1) / width_px[used] ** 2, NO_MORE)
        weights = np.zeros(len(used))
        weights[used] = np.where(square < NO_MORE, 1.0 / ((1.0 + square) * matched.pixel[used] ** 2), 0.0)
        away = rig.away_from(given)
        return float((np.log1p(square) * width**2).sum() + (trust * away**2).sum()), weights

    cost, weights = cost_of(rig, points)
    for _ in range(STEPS):
        ego_from_world = np.linalg.inv(rig.ego_poses(seen, matched.after_s))
        matrix, right, inverses, sides, mixed = normal_equations(
            points, matched.starts, view_of, matched.at, weights, damping, seen.camera_of, places,
            ego_from_world, np.linalg.inv(rig.ego_from_camera), rig.lenses, len(sigmas),
        )  # fmt: skip
        right = right - trust * rig.away_from(given)
        matrix[np.diag_indices(len(sigmas))] = np.diag(matrix) * (1.0 + damping) + trust
        matrix[~free], matrix[:, ~free], right[~free] = 0.0, 0.0, 0.0
        matrix[~free, ~free] = 1.0
        step = cholesky_solve(matrix, right)
        if np.isfinite(step).all():
            moved = np.einsum("nkm,nk->nm", mixed, step[places])
            by_point = np.add.reduceat(moved, matched.starts[:-1])
            there = points + np.einsum("pij,pj->pi", inverses, sides - by_point)
            tried = rig.moved(step)
            new_cost, new_weights = cost_of(tried, there)
        else:
            new_cost = np.inf
        if new_cost < cost:
            gained = (cost - new_cost) / cost
            rig, points, cost, weights = tried, there, new_cost, new_weights
            damping = max(damping / 10.0, DAMPING[1])
            if gained < SETTLED:
                break
        else:
            damping *= 10.0
            if damping > DAMPING[2]:
                break
    return rig, points

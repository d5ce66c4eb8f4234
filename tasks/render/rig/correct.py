"""The rig and the drive of a block as its photos say they are, and what that changed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from scipy.ndimage import uniform_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation, Slerp

from tasks.render.rig.adjust import (
    N_CAMERA,
    AdjustedRig,
    CornerTracks,
    Rig,
    RigPhotos,
    adjusted_camera,
    bundle_adjust,
    corner_rays,
    initial_rig,
    reprojection_errors,
    triangulate_points,
    twists_of,
    without_views,
)
from tasks.render.scene.features import WIDE_M, driven_roads
from tasks.render.scene.movers import behind_boxes
from tasks.render.scene.sensed import Photo, Tracks
from tasks.render.scene.sky import pixel_directions
from tasks.render.scene.stereo import FAR_M
from tasks.world.arrays import F32, Array, Bools, Bytes, Indices
from tasks.world.clip import AgentTracks, Camera, SensorFile

# Corners of a photo, and which of them two photos share (SIFT, Lowe 2004).

CORNERS_WIDTH_PX, MOST_CORNERS = 960, 4000  # of the photos that corners are looked for in, and how many a photo
CONTRAST = 0.02  # OpenCV's threshold, half its default: asphalt and facades have faint corners
RATIO = 0.85  # the second best match must be this much worse
UNIT = 512.0  # length of a descriptor: whole numbers whose products are exact in float32, in any order of the sum
EPIPOLAR_PX = 2.0  # of the picture that corners were looked for in: how far a match may miss its line
LEAST_MATCHES = 12  # that agree with one geometry of two photos


@dataclass(frozen=True)
class PhotoCorners:
    """What is remembered of one photo."""

    at: Array  # (K, 2) pixels of the photo as it was taken, the centre of the first at (0.5, 0.5)
    descriptors: F32  # (K, 128) whole numbers
    pixel: float  # pixels of the photo per pixel of the picture that was looked at


def detect_corners(rgb: Bytes, hidden: Bools | None = None) -> PhotoCorners:
    """The corners of a photo (H, W, 3), none where it is `hidden` (h, w), a mask of any size."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    scale = max(1.0, rgb.shape[1] / CORNERS_WIDTH_PX)
    size = round(rgb.shape[1] / scale), round(rgb.shape[0] / scale)
    if scale > 1.0:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    mask = None
    if hidden is not None:
        mask = 255 - 255 * cv2.resize(hidden.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    sift = cv2.SIFT_create(nfeatures=MOST_CORNERS, contrastThreshold=CONTRAST)  # type: ignore[attr-defined]
    found, descriptors = sift.detectAndCompute(grey, mask)
    if descriptors is None:
        return PhotoCorners(np.zeros((0, 2)), np.zeros((0, 128), np.float32), scale)
    at = (np.array([corner.pt for corner in found], np.float64) + 0.5) * [
        rgb.shape[1] / size[0],
        rgb.shape[0] / size[1],
    ]
    # One corner may be found with several orientations; distances of square roots compare better (Arandjelovic 2012).
    share = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1.0)
    return PhotoCorners(at, np.rint(UNIT * np.sqrt(share)).astype(np.float32), scale)


def match_corners(a: PhotoCorners, b: PhotoCorners) -> tuple[Indices, Indices]:
    """Rows of corners that are each other's best by far and agree with one geometry; none where too few do."""
    nobody = np.zeros(0, np.intp), np.zeros(0, np.intp)
    if min(len(a.at), len(b.at)) < LEAST_MATCHES:
        return nobody
    alike = a.descriptors @ b.descriptors.T
    best = alike.argmax(axis=1)
    rows = np.arange(len(best))
    first = alike[rows, best]
    mutual = first == alike.max(axis=0)[best]  # the row of a column's largest itself would take ten times as long
    alike[rows, best] = -1.0
    second = alike.max(axis=1)
    norms = [(c.descriptors**2).sum(axis=1) for c in (a, b)]
    near = norms[0] + norms[1][best] - 2.0 * first
    next_near = norms[0] + UNIT**2 - 2.0 * second
    keep = np.flatnonzero(mutual & (near < RATIO**2 * next_near))
    keep = np.sort(keep[np.unique(best[keep], return_index=True)[1]])  # of rows that are equally near the first
    if len(keep) < LEAST_MATCHES:
        return nobody
    pairs = [c.at[r] / c.pixel for c, r in ((a, keep), (b, best[keep]))]
    try:
        _, agree = cv2.findFundamentalMat(pairs[0], pairs[1], cv2.USAC_MAGSAC, EPIPOLAR_PX, 0.999, 2000)
    except cv2.error:  # its own assertion, of points that no geometry fits: those of small photos on a grid, say
        return nobody
    if agree is None or agree.sum() < LEAST_MATCHES:
        return nobody
    keep = keep[agree.ravel() > 0]
    return keep, best[keep]


# Which photos are compared, and the corners that show one point in several of them.

PARTNERS = 3  # photos of each camera that a photo is matched with
DEPTHS_M = (5.0, 12.0, 40.0)  # at which it is asked what two photos share
LIKELY, LIKELY_SHARE = 0.09, 0.5  # 5 degrees that a match may be off as given; share of a pair's that must not be
GRID = (6, 4)  # pixels of a photo that are asked for, across and down
LEAST_SHARE = 0.15  # of the first photo that the second must show
BASELINES_M = (0.3, 20.0)  # less: no parallax; more: nothing looks the same
BEST_M = (1.0, 3.0, 8.0)  # baselines that partners of the same camera are chosen near; a gap in one is filled by others


def choose_photo_pairs(rig: Rig, shots: RigPhotos, cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Rows of the photos that are compared: of each camera up to PARTNERS of those that show the same place."""
    poses = shots.world_from_ego @ rig.ego_from_camera[shots.camera_of]
    found = set()
    for i in range(len(poses)):
        share = _shared_view(i, poses, rig, shots, cameras)
        away = np.linalg.norm(poses[:, :3, 3] - poses[i, :3, 3], axis=1)
        for c in range(len(cameras)):
            mine = c == shots.camera_of[i]
            reach = (away > (BASELINES_M[0] if mine else 0.0)) & (away < BASELINES_M[1])
            rows = np.flatnonzero((shots.camera_of == c) & (share >= LEAST_SHARE) & reach)
            rows = rows[rows != i]
            if mine:
                rows = rows[rows > i]
                best = [rows[np.argmin(np.abs(np.log(away[rows] / m)))] for m in BEST_M if len(rows)]
                nearest = rows[np.argsort(away[rows], kind="stable")[:PARTNERS]]
                chosen = {int(j) for j in (*best, *nearest)}
            else:
                chosen = {int(j) for j in rows[np.argsort(-share[rows], kind="stable")[:PARTNERS]]}
            found |= {(min(i, j), max(i, j)) for j in chosen}
    return sorted(found)


def _shared_view(i: int, poses: Array, rig: Rig, shots: RigPhotos, cameras: Sequence[Camera]) -> Array:
    """(V,) share of photo i that each photo shows, were all of it at DEPTHS_M."""
    camera, lens = cameras[shots.camera_of[i]], rig.lenses[shots.camera_of[i]]
    u, v = np.meshgrid((np.arange(GRID[0]) + 0.5) / GRID[0], (np.arange(GRID[1]) + 0.5) / GRID[1])
    x, y = (u.ravel() * camera.width - lens[2]) / lens[0], (v.ravel() * camera.height - lens[3]) / lens[1]
    way = np.column_stack([x, y, np.ones(len(x))])
    points = np.concatenate([depth * way for depth in DEPTHS_M]) @ poses[i, :3, :3].T + poses[i, :3, 3]
    local = np.einsum("vji,vpj->vpi", poses[:, :3, :3], points - poses[:, None, :3, 3])
    lenses = rig.lenses[shots.camera_of][:, None]
    size = np.array([(c.width, c.height) for c in cameras])[shots.camera_of][:, None]
    ahead = np.maximum(local[..., 2], 0.1)
    column, row = (lenses[..., k] * local[..., k] / ahead + lenses[..., 2 + k] for k in range(2))
    inside = (local[..., 2] > 0.5) & (column > 0) & (column < size[..., 0]) & (row > 0) & (row < size[..., 1])
    return np.asarray(inside.mean(axis=1))


def _explained_share(rig: Rig, shots: RigPhotos, views: tuple[int, int], at_a: Array, at_b: Array) -> float:
    """Share of two photos' matches (M, 2) that the rig as given explains but for some degrees."""
    n = len(at_a)
    at = np.stack([at_a, at_b], axis=1).reshape(-1, 2)
    focal = rig.lenses[shots.camera_of[list(views)], 0]
    pair = CornerTracks(2 * np.arange(n + 1), np.tile(views, n), at, np.tile(focal, n))
    points, there = triangulate_points(rig, shots, pair)
    _, ways = corner_rays(rig, shots, pair)
    near = np.nan_to_num(reprojection_errors(rig, shots, pair, points).reshape(-1, 2).max(axis=1), nan=np.inf) < LIKELY
    far = np.linalg.norm(ways[0::2] - ways[1::2], axis=1) < LIKELY
    return float(((near & there) | far).mean())


def matched_corners(
    rig: Rig, shots: RigPhotos, corners: Sequence[PhotoCorners], compared: Sequence[tuple[int, int]]
) -> CornerTracks:
    """Matches of all pairs of photos, joined where they share a corner; without what has two corners in one photo.

    A pair of photos most of whose matches lie far from where the rig as given has them is left out: one of the two is
    not what it is said to be.
    """
    starts = np.concatenate([[0], np.cumsum([len(c.at) for c in corners])]).astype(np.int64)
    first, second = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for i, j in compared:
        a, b = match_corners(corners[i], corners[j])
        if len(a) and _explained_share(rig, shots, (i, j), corners[i].at[a], corners[j].at[b]) >= LIKELY_SHARE:
            first.append(starts[i] + a)
            second.append(starts[j] + b)
    edges = np.concatenate(first), np.concatenate(second)
    n = int(starts[-1])
    _, label = connected_components(coo_array((np.ones(len(edges[0]), bool), edges), shape=(n, n)), directed=False)
    view = np.searchsorted(starts, np.arange(n), side="right") - 1
    matched = np.zeros(n, bool)
    matched[edges[0]] = matched[edges[1]] = True
    size = np.bincount(label)
    # Rows of one point and photo stand side by side: a point with such a pair is a mix of several.
    order = np.lexsort((view, label))
    twice = (label[order][1:] == label[order][:-1]) & (view[order][1:] == view[order][:-1])
    mixed = np.zeros(len(size), bool)
    mixed[label[order][1:][twice]] = True
    rows = order[(matched & ~mixed[label])[order]]
    at = np.concatenate([c.at for c in corners])
    pixel = np.array([c.pixel for c in corners])
    ends = np.flatnonzero(np.diff(label[rows], append=-1)) + 1
    return CornerTracks(np.concatenate([[0], ends]).astype(np.int64), view[rows], at[rows], pixel[view[rows]])


# Sigmas: what calibration and poses are expected to be off by (docs/reconstruction.md, real rigs).
TURN_DEG, SHIFT_M = 1.0, 0.1  # of a camera on the ego
FOCAL, CENTRE = 0.01, 0.01  # of focal lengths and principal point, as shares of the focal length and of the width
LENS_TERM = 0.02  # of k1, k2, k3; of p1, p2 a tenth
POSE_TURN_DEG, POSE_SHIFT_M = 0.5, 0.2  # of the ego, root mean square over the drive
LEAST_CORNERS = 50  # of an instant: with fewer its correction is that between the instants before and after
TOO_FAR = 10.0  # times what poses are expected to be off by: no pose is
STRANGE = 0.15  # of the share of corners that agree in half of a camera's photos
LEAST_POINTS = 200  # of a block, below which nothing is corrected


@dataclass(frozen=True)
class CameraChange:
    """What was found about one camera."""

    camera: str
    corners: int  # that agree with the rig in the end
    shift_m: tuple[float, float, float]  # right, down, ahead, in the camera's frame
    turn_deg: tuple[float, float, float]  # about the same axes
    focal_px: tuple[float, float]  # fx, fy, in pixels of the photo as taken
    centre_px: tuple[float, float]
    before_px: float  # median distance of a corner from its point, in pixels of the photo as taken
    after_px: float


@dataclass(frozen=True)
class RigCorrection:
    """A block's cameras and photos after correction, in the order they came in."""

    cameras: tuple[Camera, ...]
    files: tuple[SensorFile, ...]  # with the poses corrected
    points: Array  # (P, 3) world, that corners of two photos or more show
    changes: tuple[CameraChange, ...]
    ego_shift_m: float  # root mean square over the instants
    ego_turn_deg: float
    strangers: tuple[int, ...] = ()  # rows of files that do not show what those before and after and beside them do


def correct_rig(
    cameras: Sequence[Camera], files: Sequence[SensorFile], corners: Sequence[PhotoCorners]
) -> RigCorrection | None:
    """Cameras and poses that make the photos' corners meet; None where too few do to say anything.

    `corners` of the files' photos, in their order; a file without any takes the correction of the times around it.
    """
    rig, shots = initial_rig(cameras, files)
    shift = shots.world_from_ego[0, :3, 3].round()
    local = shots.world_from_ego.copy()
    local[:, :3, 3] -= shift
    shots = replace(shots, world_from_ego=local)
    matched = matched_corners(rig, shots, corners, choose_photo_pairs(rig, shots, cameras))
    if len(matched.starts) <= LEAST_POINTS:
        return None
    readouts_s, heights = (np.array([getattr(c, name) for c in cameras]) for name in ("readout_s", "height"))
    if readouts_s.any():  # how long after the middle row of its photo each corner was read
        camera_of = shots.camera_of[matched.view_of]
        matched = replace(matched, after_s=readouts_s[camera_of] * (matched.at[:, 1] / heights[camera_of] - 0.5))
    sigmas = parameter_sigmas(cameras, len(rig.corrections))
    bundle = bundle_adjust(rig, shots, matched, sigmas)
    strangers = _inconsistent_photos(bundle, shots, matched, corners)
    if strangers:
        matched = without_views(matched, np.array(strangers))
        if len(matched.starts) <= LEAST_POINTS:
            return None
        bundle = bundle_adjust(rig, shots, matched, sigmas)
    points = bundle.points[np.bincount(matched.point_of, bundle.used, len(bundle.points)) > 0]
    if len(points) < LEAST_POINTS:
        return None
    times = np.array([file.time_s for file in files])
    end = replace(bundle.rig, corrections=_interpolate_corrections(bundle, shots, matched, times))
    poses = end.ego_poses(shots)
    start = replace(end, corrections=rig.corrections).ego_poses(shots)
    middle = poses[:, :3, 3].mean(axis=0)  # photos tell no scale, the drive as logged does
    off, wanted = poses[:, :3, 3] - middle, start[:, :3, 3] - start[:, :3, 3].mean(axis=0)
    spread = float((off * off).sum())
    scale = float((off * wanted).sum()) / spread if spread > 1.0 else 1.0
    mounts = end.ego_from_camera.copy()
    mounts[:, :3, 3] *= scale
    end = replace(end, ego_from_camera=mounts)
    poses[:, :3, 3] = middle + scale * (poses[:, :3, 3] - middle)
    points = middle + scale * (points - middle)
    of_pose = twists_of(np.linalg.inv(start) @ poses)
    of_camera = end.away_from(rig)[6 * len(rig.corrections) :].reshape(-1, N_CAMERA)
    poses[:, :3, 3] += shift
    found = ((one, triangulate_points(one, shots, matched, bundle.used)[0]) for one in (rig, bundle.rig))
    before, after = (reprojection_errors(one, shots, matched, seen) * matched.pixel for one, seen in found)
    camera_of = shots.camera_of[matched.view_of]
    changes = []
    for k, camera in enumerate(cameras):
        row, mine = of_camera[k], bundle.used & (camera_of == k)
        changes.append(
            CameraChange(
                camera.name,
                int(mine.sum()),
                _three(row[:3]),
                _three(np.degrees(row[3:6])),
                (float(row[6]), float(row[7])),
                (float(row[8]), float(row[9])),
                float(np.median(before[mine])) if mine.any() else float("nan"),
                float(np.median(after[mine])) if mine.any() else float("nan"),
            )
        )
    return RigCorrection(
        tuple(adjusted_camera(camera, end, k) for k, camera in enumerate(cameras)),
        tuple(replace(file, world_from_ego=pose) for file, pose in zip(files, poses)),
        points + shift,
        tuple(changes),
        float(np.sqrt((of_pose[:, :3] ** 2).sum(axis=1).mean())),
        float(np.degrees(np.sqrt((of_pose[:, 3:] ** 2).sum(axis=1).mean()))),
        strangers,
    )


def parameter_sigmas(cameras: Sequence[Camera], n_instants: int) -> Array:
    """(n,) what each parameter of a rig may be off by, in the order of `Rig.away_from`."""
    of_instant = np.repeat([POSE_SHIFT_M, np.radians(POSE_TURN_DEG)], 3)
    # Poses are off together, bit by bit along the drive: all of them weigh as much as one camera does.
    rows = [np.tile(of_instant * np.sqrt(n_instants), n_instants)]
    for camera in cameras:
        mount = [SHIFT_M] * 3 + [np.radians(TURN_DEG)] * 3
        pinhole = [FOCAL * camera.intrinsics[0, 0]] * 2 + [CENTRE * camera.width] * 2
        lens = LENS_TERM * np.array([1.0, 1.0, 0.1, 0.1, 1.0])
        rows += [np.array(mount), np.array(pinhole), lens]
    return np.concatenate(rows)


def _interpolate_corrections(bundle: AdjustedRig, shots: RigPhotos, matched: CornerTracks, times: Array) -> Array:
    """(T, 4, 4) corrections; of instants with few corners those between the instants before and after."""
    corrections = bundle.rig.corrections
    count = np.bincount(shots.instant_of[matched.view_of], bundle.used, len(corrections))
    known = np.flatnonzero(count >= LEAST_CORNERS)
    if len(known) in (0, len(corrections)):
        return corrections
    at = np.bincount(shots.instant_of, times) / np.bincount(shots.instant_of)
    out = corrections.copy()
    inside = np.clip(at, at[known[0]], at[known[-1]])
    for axis in range(3):
        out[:, axis, 3] = np.interp(inside, at[known], corrections[known, axis, 3])
    if len(known) > 1:
        out[:, :3, :3] = Slerp(at[known], Rotation.from_matrix(corrections[known, :3, :3]))(inside).as_matrix()
    else:
        out[:, :3, :3] = corrections[known[0], :3, :3]
    out[known] = corrections[known]
    return out


def _inconsistent_photos(
    bundle: AdjustedRig, shots: RigPhotos, matched: CornerTracks, corners: Sequence[PhotoCorners]
) -> tuple[int, ...]:
    """Photos of whose corners far fewer agree than is usual for their camera, or but where the ego cannot have been."""
    away = twists_of(bundle.rig.corrections)[shots.instant_of]
    elsewhere = np.linalg.norm(away[:, :3], axis=1) > TOO_FAR * POSE_SHIFT_M
    elsewhere |= np.degrees(np.linalg.norm(away[:, 3:], axis=1)) > TOO_FAR * POSE_TURN_DEG
    agree = np.bincount(matched.view_of, bundle.used, len(corners)) / np.maximum([len(c.at) for c in corners], 1)
    looked_at = np.array([len(c.at) for c in corners]) >= LEAST_CORNERS
    out = []
    for k in range(len(bundle.rig.lenses)):
        mine = np.flatnonzero((shots.camera_of == k) & looked_at)
        if len(mine):
            out += [int(row) for row in mine if elsewhere[row] or agree[row] < STRANGE * np.median(agree[mine])]
    return tuple(sorted(out))


def _three(row: Array) -> tuple[float, float, float]:
    return float(row[0]), float(row[1]), float(row[2])


# How high above the road a rig drove: at the right height of a plane its photos agree on what lies on it.
#
# Corners hardly ever lie on asphalt; its grain and paint still look alike in two photos where they are laid on the
# road.

HEIGHTS_M = np.arange(-1.2, 0.81, 0.06)  # of the road in the ego's frame: rear axle, ground, or a rig's own origin
ACROSS_M = 0.1
REACH_M = (3.0, 14.0)  # from a camera: nearer is the ego's own body, farther no grain is seen
WINDOW = 9  # cells of ACROSS_M that are compared
GRAIN = 1.0  # grey levels of deviation, below which a window says nothing
LEAST_WINDOWS = 500
LEAST_LIKENESS = 0.3  # correlation at the best height, below which none is right


def estimate_ground_height(photos: Sequence[Photo], world_from_ego: Array) -> float | None:
    """z [m] of the road in the frame of the ego, poses (V, 4, 4) of the photos; None where photos do not tell."""
    order = np.argsort([photo.time_s for photo in photos], kind="stable")
    times_s = np.array([photo.time_s for photo in photos])
    greys = [cv2.cvtColor(photo.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) for photo in photos]
    pairs: list[tuple[int, int]] = []
    for name in sorted({photo.camera for photo in photos}):
        mine = [int(i) for i in order if photos[i].camera == name]
        pairs += pairwise(mine)
    likeness = np.zeros(len(HEIGHTS_M))
    for k, height in enumerate(HEIGHTS_M):
        points = driven_roads(world_from_ego, times_s, float(height), ACROSS_M)
        across = round(2.0 * WIDE_M / ACROSS_M) + 1
        laid = [_rectify_on_road(photo, grey, points, across) for photo, grey in zip(photos, greys)]
        found = [_window_correlations(*laid[a], *laid[b]) for a, b in pairs]
        every = np.concatenate(found) if found else np.zeros(0)
        if len(every) >= LEAST_WINDOWS:
            likeness[k] = every.mean()
    best = int(likeness.argmax())
    if likeness[best] < LEAST_LIKENESS or not 0 < best < len(HEIGHTS_M) - 1:
        return None
    before, top, after = likeness[best - 1 : best + 2]  # between heights: where the parabola through three is highest
    part = 0.5 * (before - after) / (before - 2.0 * top + after)
    return float(HEIGHTS_M[best] + part * (HEIGHTS_M[1] - HEIGHTS_M[0]))


def _rectify_on_road(photo: Photo, grey: F32, points: Array, across: int) -> tuple[F32, Bools]:
    """The photo's grey (A, across) on the road's points, and where it shows them near enough."""
    camera_from_world = np.linalg.inv(photo.world_from_camera)
    x, y, z = photo.intrinsics @ (points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]).T
    ahead = np.maximum(z, 0.1)
    u, v = (x / ahead - 0.5).astype(np.float32), (y / ahead - 0.5).astype(np.float32)
    height, width = grey.shape
    away = np.linalg.norm(points - photo.world_from_camera[:3, 3], axis=1)
    seen = (z > 0.5) & (u > 0) & (v > 0) & (u < width - 1) & (v < height - 1)
    seen &= (away > REACH_M[0]) & (away < REACH_M[1])
    picture = cv2.remap(grey, u.reshape(-1, across), v.reshape(-1, across), cv2.INTER_LINEAR)
    return np.asarray(picture, np.float32), seen.reshape(-1, across)


def _window_correlations(a: F32, in_a: Bools, b: F32, in_b: Bools) -> Array:
    """(M,) of the windows that both show and that have grain in both."""
    both = in_a & in_b
    rows = np.flatnonzero(both.any(axis=1))
    if len(rows) == 0:
        return np.zeros(0)
    part = slice(rows[0], rows[-1] + 1)
    whole = uniform_filter(both[part].astype(np.float64), WINDOW, mode="constant") > 0.999
    one, other = a[part].astype(np.float64), b[part].astype(np.float64)
    means = uniform_filter(one, WINDOW), uniform_filter(other, WINDOW)
    variances = [uniform_filter(x * x, WINDOW) - m * m for x, m in zip((one, other), means)]
    use = whole & (variances[0] > GRAIN**2) & (variances[1] > GRAIN**2)
    shared = uniform_filter(one * other, WINDOW) - means[0] * means[1]
    return np.asarray(shared[use] / np.sqrt(variances[0][use] * variances[1][use]))


# What of a photo is not matched: boxes of what can move, and the own body.

WIDTH = 240  # pixels of the mask
LARGER_M = 0.6  # than the box: calibration and poses are what is not known yet


def movable_mask(
    agents: AgentTracks | None, camera: Camera, file: SensorFile, own_body: Bools | None = None
) -> Bools | None:
    """(h, w) pixels where something movable may be, or of the `own_body` (H, W); None where nothing is."""
    boxes, there = Tracks(agents, np.zeros(3)).at(file.time_s)
    if not there.any():
        return own_body
    small = camera.resized(WIDTH, round(WIDTH * camera.height / camera.width))
    pose = file.world_from_ego @ camera.ego_from_camera
    eye = np.ascontiguousarray(pose[:3, 3])
    rays = pixel_directions(small.intrinsics, pose, small.width, small.height)
    larger = boxes[there] + np.array([0.0, 0.0, 0.0, 0.0, LARGER_M, LARGER_M, LARGER_M])
    hidden = behind_boxes((rays * FAR_M).reshape(-1, 3) + eye, eye, larger)
    hidden = np.asarray(hidden.reshape(small.height, small.width))
    if own_body is None:
        return hidden
    size = (small.width, small.height)
    return hidden | np.asarray(cv2.resize(own_body.astype(np.uint8), size, interpolation=cv2.INTER_AREA), bool)

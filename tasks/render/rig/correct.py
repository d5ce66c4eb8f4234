"""The rig and the drive of a block as its photos say they are, and what that changed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tasks.render.rig.adjust import Bundle, Matched, adjusted, offsets, read_after_s, triangulated, without
from tasks.render.rig.corners import Corners
from tasks.render.rig.late import delays, with_stamps
from tasks.render.rig.matching import matched_corners, pairs
from tasks.render.rig.normal import N_CAMERA
from tasks.render.rig.rig import Rig, Shots, camera_of_rig, given_rig, twists_of
from tasks.render.rig.settings import RigSettings
from tasks.world.arrays import Array
from tasks.world.camera import Camera, SensorFile

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
    late_s: float  # photos were taken so much later than their stamps say
    before_px: float  # median distance of a corner from its point, in pixels of the photo as taken
    after_px: float


@dataclass(frozen=True)
class Correction:
    """A block's cameras and photos after correction, in the order they came in."""

    cameras: tuple[Camera, ...]
    files: tuple[SensorFile, ...]  # with the poses corrected
    points: Array  # (P, 3) world, that corners of two photos or more show
    changes: tuple[CameraChange, ...]
    ego_shift_m: float  # root mean square over the instants
    ego_turn_deg: float
    strangers: tuple[int, ...] = ()  # rows of files that do not show what those before and after and beside them do


def corrected(
    cameras: Sequence[Camera], files: Sequence[SensorFile], corners: Sequence[Corners], settings: RigSettings
) -> Correction | None:
    """Cameras and poses that make the photos' corners meet; None where too few do to say anything.

    `corners` of the files' photos, in their order; a file without any takes the correction of the times around it.
    """
    rig, shots = given_rig(cameras, files)
    shift = shots.world_from_ego[0, :3, 3].round()
    local = shots.world_from_ego.copy()
    local[:, :3, 3] -= shift
    shots = replace(shots, world_from_ego=local)
    matched = matched_corners(rig, shots, corners, pairs(rig, shots, cameras, settings.partners))
    if len(matched.starts) <= LEAST_POINTS:
        return None
    readouts_s, heights = (np.array([getattr(c, name) for c in cameras]) for name in ("readout_s", "height"))
    matched = replace(matched, after_s=read_after_s(matched, shots, readouts_s, heights))
    sigmas = sigmas_of(cameras, len(rig.corrections), settings)
    bundle = adjusted(rig, shots, matched, sigmas)
    strangers = _strangers(bundle, shots, matched, corners, settings)
    if strangers:
        matched = without(matched, np.array(strangers))
        if len(matched.starts) <= LEAST_POINTS:
            return None
        bundle = adjusted(rig, shots, matched, sigmas)
    if settings.stamp_s > 0.0:
        believed = delays(rig, shots, matched, bundle, sigmas, settings.stamp_s).believed
        if believed.any():
            bundle = adjusted(rig, shots, matched, with_stamps(sigmas, believed, settings.stamp_s))
    points = bundle.points[np.bincount(matched.point_of, bundle.used, len(bundle.points)) > 0]
    if len(points) < LEAST_POINTS:
        return None
    times = np.array([file.time_s for file in files])
    end = replace(bundle.rig, corrections=_between(bundle, shots, matched, times))
    poses = end.ego_poses(shots)
    start = replace(end, corrections=rig.corrections).ego_poses(shots)
    middle, scale = poses[:, :3, 3].mean(axis=0), _scale(poses[:, :3, 3], start[:, :3, 3])
    mounts = end.ego_from_camera.copy()
    mounts[:, :3, 3] *= scale
    end = replace(end, ego_from_camera=mounts)
    poses[:, :3, 3] = middle + scale * (poses[:, :3, 3] - middle)
    points = middle + scale * (points - middle)
    of_pose = twists_of(np.linalg.inv(start) @ poses)
    of_camera = end.away_from(rig)[6 * len(rig.corrections) :].reshape(-1, N_CAMERA)
    poses[:, :3, 3] += shift
    before, after = _before_and_after(rig, bundle, shots, matched)
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
                float(row[15]),
                float(np.median(before[mine])) if mine.any() else float("nan"),
                float(np.median(after[mine])) if mine.any() else float("nan"),
            )
        )
    return Correction(
        tuple(camera_of_rig(camera, end, k) for k, camera in enumerate(cameras)),
        tuple(
            replace(file, world_from_ego=pose, late_s=float(late))
            for file, pose, late in zip(files, poses, end.stamps[shots.camera_of])
        ),
        points + shift,
        tuple(changes),
        float(np.sqrt((of_pose[:, :3] ** 2).sum(axis=1).mean())),
        float(np.degrees(np.sqrt((of_pose[:, 3:] ** 2).sum(axis=1).mean()))),
        strangers,
    )


def _scale(places: Array, given: Array) -> float:
    """By what places (V, 3) spread less than those given: photos tell no scale, the drive as logged does."""
    off, wanted = places - places.mean(axis=0), given - given.mean(axis=0)
    spread = float((off * off).sum())
    return float((off * wanted).sum()) / spread if spread > 1.0 else 1.0


def sigmas_of(cameras: Sequence[Camera], n_instants: int, settings: RigSettings) -> Array:
    """(n,) what each parameter of a rig may be off by, in the order of `Rig.away_from`; stamps: nothing."""
    of_instant = np.repeat([settings.pose_shift_m, np.radians(settings.pose_turn_deg)], 3)
    # Poses are off together, bit by bit along the drive: all of them weigh as much as one camera does.
    rows = [np.tile(of_instant * np.sqrt(n_instants), n_instants)]
    for camera in cameras:
        mount = [settings.shift_m] * 3 + [np.radians(settings.turn_deg)] * 3
        pinhole = [settings.focal * camera.intrinsics[0, 0]] * 2 + [settings.centre * camera.width] * 2
        lens = settings.lens * np.array([1.0, 1.0, 0.1, 0.1, 1.0])
        rows += [np.array(mount), np.array(pinhole), lens, np.zeros(1)]
    return np.concatenate(rows)


def _between(bundle: Bundle, shots: Shots, matched: Matched, times: Array) -> Array:
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


def _strangers(
    bundle: Bundle, shots: Shots, matched: Matched, corners: Sequence[Corners], settings: RigSettings
) -> tuple[int, ...]:
    """Photos of whose corners far fewer agree than is usual for their camera, or but where the ego cannot have been."""
    away = twists_of(bundle.rig.corrections)[shots.instant_of]
    elsewhere = np.linalg.norm(away[:, :3], axis=1) > TOO_FAR * settings.pose_shift_m
    elsewhere |= np.degrees(np.linalg.norm(away[:, 3:], axis=1)) > TOO_FAR * settings.pose_turn_deg
    agree = np.bincount(matched.view_of, bundle.used, len(corners)) / np.maximum([len(c.at) for c in corners], 1)
    looked_at = np.array([len(c.at) for c in corners]) >= LEAST_CORNERS
    out = []
    for k in range(len(bundle.rig.lenses)):
        mine = np.flatnonzero((shots.camera_of == k) & looked_at)
        if len(mine):
            out += [int(row) for row in mine if elsewhere[row] or agree[row] < STRANGE * np.median(agree[mine])]
    return tuple(sorted(out))


def _before_and_after(rig: Rig, bundle: Bundle, shots: Shots, matched: Matched) -> tuple[Array, Array]:
    """(N,) how far corners are from points triangulated from them, through the rig as given and as it is now."""
    out = []
    for one in (rig, bundle.rig):
        points, _ = triangulated(one, shots, matched, bundle.used)
        out.append(offsets(one, shots, matched, points) * matched.pixel)
    return out[0], out[1]


def _three(row: Array) -> tuple[float, float, float]:
    return float(row[0]), float(row[1]), float(row[2])

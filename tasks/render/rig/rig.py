"""A rig under adjustment: what of it may change, and what its photos were given as."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tasks.world.arrays import Array, Ints
from tasks.world.camera import Camera, SensorFile
from tasks.world.clip import DRIVES_APART_S

INSTANT_S = 0.05  # photos no further apart were taken at once, by one pose of the ego


@dataclass(frozen=True)
class Shots:
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
    stamps: Array  # (C,) [s] that a camera's photos were taken later than said
    corrections: Array  # (T, 4, 4) of each instant: world_from_ego @ correction is where the ego was

    def ego_poses(self, shots: Shots, after_s: Array | float = 0.0) -> Array:
        """(V, 4, 4) corrected world_from_ego of the photos, `after_s` (V,) after their middle row was read."""
        late = motions((self.stamps[shots.camera_of] + after_s)[:, None] * shots.twists)
        return np.asarray(shots.world_from_ego @ late @ self.corrections[shots.instant_of])

    def moved(self, step: Array) -> "Rig":
        """After a step (n,) of its parameters, in the order of `normal_equations`."""
        n = 6 * len(self.corrections)
        of_camera = step[n:].reshape(len(self.lenses), -1)
        return Rig(
            self.ego_from_camera @ motions(of_camera[:, :6]),
            self.lenses + of_camera[:, 6:15],
            self.stamps + of_camera[:, 15],
            self.corrections @ motions(step[:n].reshape(-1, 6)),
        )

    def away_from(self, given: "Rig") -> Array:
        """(n,) how far each parameter is from that of another, in the same order."""
        mounts = twists_of(np.linalg.inv(given.ego_from_camera) @ self.ego_from_camera)
        lenses, stamps = self.lenses - given.lenses, self.stamps - given.stamps
        of_camera = np.column_stack([mounts, lenses, stamps])
        of_instant = twists_of(np.linalg.inv(given.corrections) @ self.corrections)
        return np.concatenate([of_instant.ravel(), of_camera.ravel()])


def given_rig(cameras: Sequence[Camera], files: Sequence[SensorFile]) -> tuple[Rig, Shots]:
    """The rig as it is said to be. The files are of these cameras."""
    row = {camera.name: i for i, camera in enumerate(cameras)}
    camera_of = np.array([row[file.sensor] for file in files])
    instant_of = _instants(files)
    k = np.stack([camera.intrinsics for camera in cameras])
    terms = np.stack([camera.distortion for camera in cameras])
    rig = Rig(
        np.stack([camera.ego_from_camera for camera in cameras]),
        np.column_stack([k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2], terms]),
        np.zeros(len(cameras)),
        np.tile(np.eye(4), (instant_of.max() + 1, 1, 1)),
    )
    poses = np.stack([file.world_from_ego for file in files])
    return rig, Shots(camera_of, instant_of, poses, _twists(poses, np.array([file.time_s for file in files])))


def camera_of_rig(camera: Camera, rig: Rig, row: int) -> Camera:
    """The camera as the rig has it."""
    fx, fy, cx, cy = rig.lenses[row, :4]
    intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return replace(
        camera, intrinsics=intrinsics, distortion=rig.lenses[row, 4:], ego_from_camera=rig.ego_from_camera[row]
    )


def motions(twists: Array) -> Array:
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

"""What moves in an Argoverse 2 sensor log: ego poses and annotated boxes, resampled to steps of 0.1 s.

Step k stands 0.1 k seconds after the first annotated frame. The rules are those of docs/reward.md 6, found to
reproduce its recorded states: linear interpolation between poses, boxes placed by the ego pose of their frame,
velocities by least squares. File format: that of argoverse/av2-api.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from factory.datasets.av2.folders import ANNOTATIONS, POSES
from factory.readers.base import BadClip
from factory.readers.points import read_feather
from tasks.world.arrays import Array, Bools, Indices, Ints
from tasks.world.clip import MOVING_KINDS, STEP_S, AgentKind, AgentTracks
from tasks.world.frames import AX, AY, EGO_STATE_SIZE, HEADING, VX, VY, X, Y, wrap_angle

POSE_COLUMNS = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
SIZE_COLUMNS = ("length_m", "width_m", "height_m")

# Poses closer than this to the one before are left out: camera and lidar stamps fall together to the microsecond
# there, and would count twice in the fit.
MIN_POSE_SPACING_S = 1e-3
EGO_FIT_HALF_WINDOW_S = 0.3
VELOCITY_HALF_WINDOW_S = 0.55
STANDING_SPEED_MPS = 0.1  # slower is standing: velocity (and the ego's acceleration) exactly 0
SAME_FRAME_S = STEP_S / 2  # a step sees the annotated frame that is at most this far away
ROUNDING_S = 1e-9
MAX_LOG_S = 86_400.0  # longer is a broken stamp, and would ask for any amount of steps

_CATEGORIES = {
    AgentKind.VEHICLE: "REGULAR_VEHICLE LARGE_VEHICLE BUS ARTICULATED_BUS SCHOOL_BUS BOX_TRUCK TRUCK TRUCK_CAB "
    "VEHICULAR_TRAILER MESSAGE_BOARD_TRAILER TRAFFIC_LIGHT_TRAILER RAILED_VEHICLE",
    AgentKind.PEDESTRIAN: "PEDESTRIAN OFFICIAL_SIGNALER STROLLER WHEELCHAIR",
    AgentKind.BICYCLE: "BICYCLE BICYCLIST MOTORCYCLE MOTORCYCLIST WHEELED_DEVICE WHEELED_RIDER",
    AgentKind.BARRIER: "BOLLARD",
    AgentKind.TRAFFIC_CONE: "CONSTRUCTION_BARREL CONSTRUCTION_CONE",
    AgentKind.CZONE_SIGN: "SIGN STOP_SIGN MOBILE_PEDESTRIAN_SIGN MOBILE_PEDESTRIAN_CROSSING_SIGN",
    AgentKind.GENERIC_OBJECT: "DOG ANIMAL",
}
KIND_OF_CATEGORY = {name: kind for kind, names in _CATEGORIES.items() for name in names.split()}


@dataclass(frozen=True)
class BoxTrack:
    """One annotated object over the n frames that show it, city frame."""

    track_id: str
    kind: AgentKind
    times_s: Array  # (n,) increasing, since the log's first annotated frame
    centers: Array  # (n, 3) [m]
    headings: Array  # (n,) unwrapped [rad]
    sizes: Array  # (n, 3) length, width, height [m]


@dataclass(frozen=True)
class LogMotion:
    """Ego poses and annotated tracks of one log, at their own stamps."""

    folder: Path
    start_ns: int  # stamp of the first annotated frame, zero of all times below
    frame_times_s: Array  # (F,) annotated frames
    pose_times_s: Array  # (P,) increasing by more than 1 ms
    positions: Array  # (P, 3) rear axle, city frame [m]
    rotations: Rotation  # P rotations, city from ego
    yaws: Array  # (P,) unwrapped [rad]
    tracks: tuple[BoxTrack, ...]  # ordered by track id
    fill_s: float = 0.0  # two frames of a track at most this far apart hold the steps between them too

    @property
    def n_steps(self) -> int:
        """Steps of 0.1 s that have an annotated frame and a pose at their end. Raises BadClip beyond MAX_LOG_S."""
        last = min(self.frame_times_s[-1] + SAME_FRAME_S, self.pose_times_s[-1] + MIN_POSE_SPACING_S)
        if last > MAX_LOG_S:
            raise BadClip(str(self.folder), "timestamps", f"a log of {last / 3600:.0f} h")
        return int(np.floor(last / STEP_S)) + 1

    def seconds(self, stamps_ns: Ints) -> Array:
        """Stamps as seconds since the first annotated frame."""
        return seconds_since(self.start_ns, stamps_ns)


def seconds_since(start_ns: int, stamps_ns: Ints) -> Array:
    """Seconds from start_ns to each stamp; the difference is taken in integers."""
    return np.asarray((stamps_ns - start_ns) / 1e9, np.float64)


def step_times(start: int, stop: int) -> Array:
    """Seconds since the log's first annotated frame at steps start..stop-1."""
    return np.asarray(np.arange(start, stop) * STEP_S, np.float64)


def numbers(path: Path, table: Mapping[str, NDArray[np.generic]], columns: tuple[str, ...]) -> Array:
    """The named columns side by side, (n, len(columns)). Raises BadClip where one is not numeric."""
    for name in columns:
        if table[name].dtype.kind not in "iuf":
            raise BadClip(str(path), name, f"expected numbers, found {table[name].dtype}")
    return np.stack([table[name].astype(np.float64) for name in columns], axis=1)


def stamps(path: Path, table: Mapping[str, NDArray[np.generic]]) -> Ints:
    """The column timestamp_ns. Raises BadClip where it holds no integers."""
    if table["timestamp_ns"].dtype.kind not in "iu":
        raise BadClip(str(path), "timestamp_ns", f"expected integers, found {table['timestamp_ns'].dtype}")
    return table["timestamp_ns"].astype(np.int64)


def rotations(path: Path, poses: Array) -> Rotation:
    """Rotations of poses (n, 7) = qw, qx, qy, qz, ...; raises BadClip where a quaternion is not of unit length."""
    if np.abs(np.linalg.norm(poses[:, :4], axis=1) - 1.0).max() > 1e-3:
        raise BadClip(str(path), "qw qx qy qz", "a quaternion is not of unit length")
    return Rotation.from_quat(poses[:, [1, 2, 3, 0]])


def read_motion(folder: Path) -> LogMotion:
    """Poses and annotations of the log in `folder`. Raises BadClip."""
    path, pose_path = folder / ANNOTATIONS, folder / POSES
    boxes = read_feather(path, ("timestamp_ns", "track_uuid", "category", *SIZE_COLUMNS, *POSE_COLUMNS))
    box_stamps = stamps(path, boxes)
    start_ns = int(box_stamps.min())
    poses = read_feather(pose_path, ("timestamp_ns", *POSE_COLUMNS))
    pose_stamps = stamps(pose_path, poses)
    if (np.diff(pose_stamps) < 0).any():
        raise BadClip(str(pose_path), "timestamp_ns", "time runs backwards")
    keep = spaced(seconds_since(start_ns, pose_stamps))
    pose_values = numbers(pose_path, poses, POSE_COLUMNS)[keep]
    pose_times = seconds_since(start_ns, pose_stamps[keep])
    frame_times = seconds_since(start_ns, np.unique(box_stamps))
    if pose_times[0] > MIN_POSE_SPACING_S or pose_times[-1] < frame_times[-1] - SAME_FRAME_S:
        raise BadClip(str(pose_path), "timestamp_ns", "the poses do not span the annotated frames")
    city_from_ego = rotations(pose_path, pose_values)
    return LogMotion(
        folder=folder,
        start_ns=start_ns,
        frame_times_s=frame_times,
        pose_times_s=pose_times,
        positions=pose_values[:, 4:],
        rotations=city_from_ego,
        yaws=np.unwrap(yaw_of(city_from_ego)),
        tracks=_tracks(path, boxes, seconds_since(start_ns, box_stamps), pose_times, pose_values[:, 4:], city_from_ego),
    )


def ego_states_at(motion: LogMotion, times_s: Array) -> Array:
    """Ego states (S, 11) at times (S,): pose by linear interpolation, velocity and acceleration by a quadratic fit.

    The fit takes the poses within +-0.3 s; steering and rates are 0; slower than 0.1 m/s is standing. Raises BadClip
    where the poses are too sparse to fit.
    """
    states = np.zeros((len(times_s), EGO_STATE_SIZE))
    for column, known in ((X, motion.positions[:, 0]), (Y, motion.positions[:, 1]), (HEADING, motion.yaws)):
        states[:, column] = np.interp(times_s, motion.pose_times_s, known)
    states[:, HEADING] = wrap_angle(states[:, HEADING])
    for state, time in zip(states, times_s):
        offset = motion.pose_times_s - time
        near = np.abs(offset) <= EGO_FIT_HALF_WINDOW_S + ROUNDING_S
        if near.sum() < 4:
            raise BadClip(str(motion.folder / POSES), "timestamp_ns", f"fewer than 4 poses around {time:.1f} s")
        basis = np.vander(offset[near], 3, increasing=True)
        fit = np.linalg.lstsq(basis, motion.positions[near, :2] - state[[X, Y]], rcond=None)[0]
        velocity, acceleration = fit[1], 2.0 * fit[2]
        if np.hypot(*velocity) >= STANDING_SPEED_MPS:
            c, s = np.cos(state[HEADING]), np.sin(state[HEADING])
            ego_from_city = np.array([[c, s], [-s, c]])
            state[[VX, VY]] = ego_from_city @ velocity
            state[[AX, AY]] = ego_from_city @ acceleration
    return states


def world_from_ego_at(motion: LogMotion, times_s: Array) -> Array:
    """Ego poses (S, 4, 4) at times (S,) within the log: linear in position, spherical in rotation."""
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    within = np.clip(times_s, motion.pose_times_s[0], motion.pose_times_s[-1])
    poses[:, :3, :3] = Slerp(motion.pose_times_s, motion.rotations)(within).as_matrix()
    poses[:, :3, 3] = np.stack([np.interp(within, motion.pose_times_s, axis) for axis in motion.positions.T], axis=1)
    return poses


def observed_at(motion: LogMotion, times_s: Array) -> Bools:
    """(S,) whether an annotated frame stands within 50 ms of each time, or two enclose it that are filled in."""
    return seen_at(motion.frame_times_s, times_s, motion.fill_s)


def agents_at(motion: LogMotion, times_s: Array) -> AgentTracks:
    """All tracks of the log at times (S,): present where `observed_at` holds for their frames, linear in between."""
    valid = np.zeros((len(times_s), len(motion.tracks)), dtype=bool)
    boxes, velocities, center_z = (np.full((*valid.shape, *columns), np.nan) for columns in ((5,), (2,), ()))
    for i, track in enumerate(motion.tracks):
        here = valid[:, i] = seen_at(track.times_s, times_s, motion.fill_s)
        known = np.column_stack([track.centers[:, :2], track.headings, track.sizes[:, :2]])
        for column in range(5):
            boxes[here, i, column] = np.interp(times_s[here], track.times_s, known[:, column])
        boxes[here, i, 2] = wrap_angle(boxes[here, i, 2])
        center_z[here, i] = np.interp(times_s[here], track.times_s, track.centers[:, 2])
        for column, speeds in enumerate(_track_velocities(track, max(VELOCITY_HALF_WINDOW_S, motion.fill_s)).T):
            velocities[here, i, column] = np.interp(times_s[here], track.times_s, speeds)
    return AgentTracks(
        track_ids=tuple(track.track_id for track in motion.tracks),
        kinds=tuple(track.kind for track in motion.tracks),
        boxes=boxes,
        velocities=velocities,
        valid=valid,
        center_z=center_z,
        heights=np.array([track.sizes[0, 2] for track in motion.tracks]),
    )


def spaced(times_s: Array) -> Indices:
    """Indices of the times kept when each must stand more than 1 ms after the last one kept."""
    keep = [0]
    for i in range(1, len(times_s)):
        if times_s[i] - times_s[keep[-1]] > MIN_POSE_SPACING_S:
            keep.append(i)
    return np.array(keep)


def yaw_of(rotation: Rotation) -> Array:
    """(n,) heading [rad] of n rotations: of their x axis, seen from above."""
    matrix = rotation.as_matrix()
    return np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0])


def _nearest(sorted_times: Array, times_s: Array) -> Indices:
    """(S,) index of the nearest of the sorted times."""
    right = np.clip(np.searchsorted(sorted_times, times_s), 1, max(len(sorted_times) - 1, 1))
    right = np.minimum(right, len(sorted_times) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(times_s - sorted_times[left]) <= np.abs(sorted_times[right] - times_s), left, right)


def seen_at(sorted_times: Array, times_s: Array, fill_s: float) -> Bools:
    """(S,) whether one of the sorted times is less than 50 ms away, or two enclose it that are at most fill_s apart."""
    near = np.abs(sorted_times[_nearest(sorted_times, times_s)] - times_s) < SAME_FRAME_S
    gaps = np.concatenate([[np.inf], np.diff(sorted_times), [np.inf]])  # before each of them, and after the last
    return np.asarray(near | (gaps[np.searchsorted(sorted_times, times_s)] <= fill_s + ROUNDING_S))


def _tracks(
    path: Path,
    table: Mapping[str, NDArray[np.generic]],
    times_s: Array,
    pose_times_s: Array,
    positions: Array,
    city_from_ego: Rotation,
) -> tuple[BoxTrack, ...]:
    """Annotated boxes, given in the ego frame of their stamp, as tracks in the city frame."""
    unknown = set(table["category"].astype(str).tolist()) - KIND_OF_CATEGORY.keys()
    if unknown:
        raise BadClip(str(path), "category", f"unknown class {sorted(unknown)}")
    sizes = numbers(path, table, SIZE_COLUMNS)
    if (sizes <= 0.0).any():
        raise BadClip(str(path), " ".join(SIZE_COLUMNS), "a box has a size that is not positive")
    poses = numbers(path, table, POSE_COLUMNS)
    ego = _nearest(pose_times_s, times_s)
    centers = city_from_ego[ego].apply(poses[:, 4:]) + positions[ego]
    headings = yaw_of(city_from_ego[ego] * rotations(path, poses))

    kinds = [KIND_OF_CATEGORY[str(name)] for name in table["category"]]
    return tracks_of(path, "track_uuid", table["track_uuid"].astype(str), kinds, times_s, centers, headings, sizes)


def tracks_of(
    path: Path,
    field: str,
    ids: NDArray[np.str_],
    kinds: Sequence[AgentKind],
    times_s: Array,
    centers: Array,
    headings: Array,
    sizes: Array,
) -> tuple[BoxTrack, ...]:
    """n boxes, in any order, as tracks ordered by id; a track is of its first box's kind.

    ids: (n,), named `field` in errors; centers, sizes: (n, 3). Raises BadClip where a track stands twice in one frame.
    """
    if len(ids) == 0:
        return ()
    order = np.lexsort((times_s, ids))
    groups = np.split(order, np.flatnonzero(ids[order][1:] != ids[order][:-1]) + 1)
    tracks = []
    for rows in groups:
        track_id = str(ids[rows[0]])
        if not track_id.strip():
            raise BadClip(str(path), field, f"a box at {times_s[rows[0]]:.1f} s has an empty one")
        if (np.diff(times_s[rows]) <= 0.0).any():
            raise BadClip(str(path), field, f"track {track_id} stands twice in one frame")
        kind = kinds[rows[0]]
        tracks.append(BoxTrack(track_id, kind, times_s[rows], centers[rows], np.unwrap(headings[rows]), sizes[rows]))
    return tuple(tracks)


def _track_velocities(track: BoxTrack, half_window_s: float) -> Array:
    """(n, 2) velocity at each frame: least-squares slope over the window; 0 below 0.1 m/s and for things that stand."""
    n = len(track.times_s)
    if track.kind not in MOVING_KINDS or n < 2:
        return np.zeros((n, 2))
    offset = track.times_s[None, :] - track.times_s[:, None]  # (n, n)
    near = np.abs(offset) <= half_window_s + ROUNDING_S
    count = near.sum(axis=1)
    centered = np.where(near, offset - (np.where(near, offset, 0.0).sum(axis=1) / count)[:, None], 0.0)
    moved = track.centers[None, :, :2] - track.centers[:, None, :2]  # (n, n, 2)
    spread = (centered**2).sum(axis=1)
    slope = (centered[..., None] * moved).sum(axis=1) / np.where(spread > 0.0, spread, 1.0)[:, None]
    standing = np.hypot(*slope.T) < STANDING_SPEED_MPS
    return np.where(standing[:, None], 0.0, slope)

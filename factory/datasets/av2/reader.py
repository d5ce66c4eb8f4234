"""Reads Argoverse 2 sensor logs, and everything written in their layout, as clips.

A log may carry one file that Argoverse does not have: `traffic_lights.feather` (timestamp_ns, lane_id, state GREEN |
YELLOW | RED; a state holds until the lane's next row), which the synthetic town writes.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from factory.datasets.av2 import ANNOTATIONS, EXTRINSICS, INTRINSICS, POSES, log_folders
from factory.files import broken_link, is_named, matching, why_unread
from factory.readers.arrow import read_feather
from factory.readers.base import BadClip, ClipRef, folder_split, id_text, stamps_sign
from factory.readers.logs import (
    LoggedDrive,
    LogReader,
    WholeLog,
    WindowSensors,
    block_of_log,
    files_within,
    route_of_drive,
)
from factory.wording import shown
from tasks.world.arrays import Array, Bools, Indices, Ints
from tasks.world.clip import MOVING_KINDS, STEP_S, AgentKind, AgentTracks, Camera, SensorFile
from tasks.world.frames import AX, AY, EGO_STATE_SIZE, HEADING, VX, VY, X, Y, wrap_angle
from tasks.world.repair.records import LEFT_OUT, Repair
from tasks.world.repair.road import (
    LaneSides,
    crossing_between,
    left_out_lanes,
    lights_on_map,
    map_repair,
    simple_area,
    sound_lanes,
)
from tasks.world.repair.tracks import EGO, FILLED_S, MOST, clock_repairs, observed, repaired, whole_frames
from tasks.world.road_map import (
    Lane,
    LightState,
    MapLayer,
    MapPolygon,
    RoadMap,
    TrafficLights,
    centerline_from_boundaries,
    ring_from_boundaries,
    roadblocks_of,
)

# What moves in an Argoverse 2 sensor log: ego poses and annotated boxes, resampled to steps of 0.1 s.
#
# Step k stands 0.1 k seconds after the first annotated frame. The rules are those of docs/reward.md 6, found to
# reproduce its recorded states: linear interpolation between poses, boxes placed by the ego pose of their frame,
# velocities by least squares. File format: that of argoverse/av2-api.

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
UNIT_SLACK = 1e-3  # of a quaternion's length
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
    fill_s: float = FILLED_S  # two frames of the log at most this far apart hold the steps between them too
    repairs: tuple[Repair, ...] = ()

    @property
    def n_steps(self) -> int:
        """Steps of 0.1 s that have an annotated frame and a pose at their end. Raises BadClip beyond MAX_LOG_S."""
        last = min(self.frame_times_s[-1] + SAME_FRAME_S, self.pose_times_s[-1] + MIN_POSE_SPACING_S)
        if last > MAX_LOG_S:
            raise BadClip(str(self.folder), "timestamps", f"a log of {last / 3600:.0f} h")
        return int(np.floor(last / STEP_S)) + 1


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
    """The column timestamp_ns. Raises BadClip where it holds no integers, or another unit."""
    if table["timestamp_ns"].dtype.kind not in "iu":
        raise BadClip(str(path), "timestamp_ns", f"expected integers, found {table['timestamp_ns'].dtype}")
    if sign := stamps_sign(table["timestamp_ns"].astype(np.int64), "ns"):
        raise BadClip(str(path), "timestamp_ns", sign)
    return table["timestamp_ns"].astype(np.int64)


def rotations(path: Path, poses: Array) -> Rotation:
    """Rotations of poses (n, 7) = qw, qx, qy, qz, ...; raises BadClip where a quaternion is not of unit length."""
    if not is_rotation(poses).all():
        raise BadClip(str(path), "qw qx qy qz", "a quaternion is not of unit length")
    return Rotation.from_quat(poses[:, [1, 2, 3, 0]])


def headings_of(poses: Array, world_from_frame: Rotation | None = None) -> Array:
    """(n,) headings [rad] of poses (n, >= 4) = qw, qx, qy, qz, ... given in n frames; NaN where one is no rotation."""
    turned = is_rotation(poses)
    rotation = Rotation.from_quat(np.where(turned[:, None], poses[:, [1, 2, 3, 0]], [0.0, 0.0, 0.0, 1.0]))
    return np.where(turned, yaw_of(rotation if world_from_frame is None else world_from_frame * rotation), np.nan)


def read_motion(folder: Path) -> LogMotion:
    """Poses and annotations of the log in `folder`. Raises BadClip."""
    path, pose_path = folder / ANNOTATIONS, folder / POSES
    boxes = read_feather(path, ("timestamp_ns", "track_uuid", "category", *SIZE_COLUMNS, *POSE_COLUMNS), whole=False)
    poses = read_feather(pose_path, ("timestamp_ns", *POSE_COLUMNS), whole=False)
    box_stamps, pose_stamps = stamps(path, boxes), stamps(pose_path, poses)
    posed, stray_repairs = posed_frames(box_stamps, pose_stamps, SAME_FRAME_S)
    if posed.sum() <= MOST * len(posed):
        raise BadClip(str(pose_path), "timestamp_ns", "the poses do not span the annotated frames")
    boxes, box_stamps = {name: column[posed] for name, column in boxes.items()}, box_stamps[posed]
    start_ns = int(box_stamps.min())
    frame_times = seconds_since(start_ns, np.unique(box_stamps))
    pose_times, pose_values, ego_repairs = whole_poses(
        pose_path, seconds_since(start_ns, pose_stamps), numbers(pose_path, poses, POSE_COLUMNS)
    )
    city_from_ego = rotations(pose_path, pose_values)
    tracks, repairs = _tracks(
        path, boxes, seconds_since(start_ns, box_stamps), frame_times, pose_times, pose_values[:, 4:], city_from_ego
    )
    return LogMotion(
        folder=folder,
        start_ns=start_ns,
        frame_times_s=frame_times,
        pose_times_s=pose_times,
        positions=pose_values[:, 4:],
        rotations=city_from_ego,
        yaws=np.unwrap(yaw_of(city_from_ego)),
        tracks=tracks,
        repairs=(*clock_repairs(frame_times), *stray_repairs, *ego_repairs, *repairs),
    )


def posed_frames(frame_stamps: Ints, pose_stamps: Ints, before_s: float) -> tuple[Bools, tuple[Repair, ...]]:
    """(F,) which frames [ns] are at most before_s before the first of the ego's poses, or a frame behind the last.

    What is stamped farther than MAX_LOG_S from most poses is of no drive.
    """
    near = np.abs(pose_stamps - np.median(pose_stamps)) <= MAX_LOG_S * 1e9
    first, last = pose_stamps[near].min(), pose_stamps[near].max()
    posed = (frame_stamps >= first - before_s * 1e9) & (frame_stamps <= last + SAME_FRAME_S * 1e9)
    if posed.all():
        return posed, ()
    was = f"{len(np.unique(frame_stamps[~posed]))} frames at which the ego has no pose"
    return posed, (Repair("clock", "", np.nan, was, LEFT_OUT),)


def whole_poses(path: Path, times_s: Array, poses: Array) -> tuple[Array, Array, tuple[Repair, ...]]:
    """The ego's poses (P,), (P, 7) in time order, without those that cannot be or lie elsewhere, 1 ms apart or more.

    Raises BadClip where most of them cannot be.
    """
    done: list[Repair] = []
    near = np.abs(times_s - np.median(times_s)) <= MAX_LOG_S
    if not near.all():
        was = f"{(~near).sum()} poses stamped over a day from the others"
        done.append(Repair("clock", EGO, np.nan, was, LEFT_OUT))
        times_s, poses = times_s[near], poses[near]
    if (np.diff(times_s) < 0.0).any():
        late = times_s < np.maximum.accumulate(times_s)
        was = f"{late.sum()} poses out of order"
        first, last = float(times_s[late].min()), float(times_s[late].max())
        done.append(Repair("clock", EGO, first, was, "by their stamps", last))
        order = np.argsort(times_s, kind="stable")
        times_s, poses = times_s[order], poses[order]
    keep = [0]  # more than 1 ms after the last one kept
    for i in range(1, len(times_s)):
        if times_s[i] - times_s[keep[-1]] > MIN_POSE_SPACING_S:
            keep.append(i)
    times_s, poses = times_s[keep], poses[keep]
    boxes = np.ones((len(poses), 9))
    boxes[:, :3], boxes[:, 3] = poses[:, 4:], headings_of(poses)
    left, repairs = whole_frames(times_s, boxes)
    if left.sum() <= MOST * len(left):
        raise BadClip(str(path), " ".join(POSE_COLUMNS), f"most of {len(left)} poses are NaN, infinite or no rotations")
    return times_s[left], poses[left], (*done, *repairs)


def is_rotation(poses: Array) -> Bools:
    """(n,) of poses (n, 7) = qw, qx, qy, qz, ...: whether the quaternion is of unit length."""
    return np.asarray(np.abs(np.linalg.norm(poses[:, :4], axis=1) - 1.0) <= UNIT_SLACK)


def ego_states_at(motion: LogMotion, times_s: Array) -> Array:
    """Ego states (S, 11) at times (S,): pose by linear interpolation, velocity and acceleration by a quadratic fit.

    The fit takes the poses within +-0.3 s; steering and rates are 0; slower than 0.1 m/s is standing. NaN where there
    are fewer than four of them, and before the first pose.
    """
    states = np.zeros((len(times_s), EGO_STATE_SIZE))
    for column, known in ((X, motion.positions[:, 0]), (Y, motion.positions[:, 1]), (HEADING, motion.yaws)):
        states[:, column] = np.interp(times_s, motion.pose_times_s, known)
    states[:, HEADING] = wrap_angle(states[:, HEADING])
    for state, time in zip(states, times_s):
        offset = motion.pose_times_s - time
        near = np.abs(offset) <= EGO_FIT_HALF_WINDOW_S + ROUNDING_S
        if near.sum() < 4 or time < motion.pose_times_s[0] - MIN_POSE_SPACING_S:
            state[:] = np.nan
            continue
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
        here = valid[:, i] = seen_at(track.times_s, times_s, motion.fill_s, motion.frame_times_s)
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


def seen_at(sorted_times: Array, times_s: Array, fill_s: float, frame_times_s: Array | None = None) -> Bools:
    """(S,) whether one of the sorted times is less than 50 ms away, or two enclose it that are at most fill_s apart.

    frame_times_s: of the log, where the sorted times are those of one thing; frames that do not show it are its gap.
    """
    between = np.diff(sorted_times)
    if frame_times_s is not None:
        between[np.diff(np.searchsorted(frame_times_s, sorted_times)) > 1] = np.inf
    near = np.abs(sorted_times[_nearest(sorted_times, times_s)] - times_s) < SAME_FRAME_S
    gaps = np.concatenate([[np.inf], between, [np.inf]])  # before each of them, and after the last
    return np.asarray(near | (gaps[np.searchsorted(sorted_times, times_s)] <= fill_s + ROUNDING_S))


def _tracks(
    path: Path,
    table: Mapping[str, NDArray[np.generic]],
    times_s: Array,
    frame_times_s: Array,
    pose_times_s: Array,
    positions: Array,
    city_from_ego: Rotation,
) -> tuple[tuple[BoxTrack, ...], tuple[Repair, ...]]:
    """Annotated boxes, given in the ego frame of their stamp, as tracks in the city frame, repaired."""
    kinds = [KIND_OF_CATEGORY.get(str(name)) for name in table["category"]]
    unknown = {str(name) for name, kind in zip(table["category"], kinds) if kind is None}
    if kinds.count(None) > MOST * len(kinds):
        raise BadClip(str(path), "category", f"unknown class {sorted(unknown)}")
    poses = numbers(path, table, POSE_COLUMNS)
    turned, moved = poses_at(pose_times_s, city_from_ego, positions, times_s)
    boxes = np.zeros((len(times_s), 9))
    boxes[:, :3] = turned.apply(poses[:, 4:]) + moved
    boxes[:, 3] = headings_of(poses, turned)
    boxes[:, 4:7] = numbers(path, table, SIZE_COLUMNS)
    ids = [id_text(name) for name in table["track_uuid"].tolist()]
    turned, moved = poses_at(pose_times_s, city_from_ego, positions, frame_times_s)
    ego_poses = np.column_stack([moved[:, :2], yaw_of(turned)])
    return repaired_tracks(frame_times_s, times_s, ids, kinds, boxes, ego_poses)


def poses_at(pose_times_s: Array, rotations_: Rotation, positions: Array, times_s: Array) -> tuple[Rotation, Array]:
    """The poses of times (S,): that of the same instant, and one in between where that was left out."""
    at = _nearest(pose_times_s, times_s)
    far = np.abs(pose_times_s[at] - times_s) > MIN_POSE_SPACING_S
    if not far.any():
        return rotations_[at], positions[at]
    turned, moved = rotations_[at].as_quat(), positions[at]
    within = np.clip(times_s[far], pose_times_s[0], pose_times_s[-1])
    turned[far] = Slerp(pose_times_s, rotations_)(within).as_quat()
    moved[far] = np.stack([np.interp(within, pose_times_s, axis) for axis in positions.T], axis=1)
    return Rotation.from_quat(turned), moved


def repaired_tracks(
    frame_times_s: Array,
    times_s: Array,
    ids: Sequence[str | None],
    kinds: Sequence[AgentKind | None],
    boxes: Array,
    ego_poses: Array,
) -> tuple[tuple[BoxTrack, ...], tuple[Repair, ...]]:
    """n boxes as tracks ordered by id, and what was repaired; arguments as of tasks.world.repair.tracks.observed.

    ego_poses: (F, 3) at the frames.
    """
    seen, unnamed = observed(frame_times_s, times_s, ids, kinds, boxes)
    seen, repairs = repaired(seen, ego_poses)
    tracks = []
    for n, (track_id, kind) in enumerate(zip(seen.track_ids, seen.kinds)):
        frames = seen.frames(n)
        box = seen.boxes[frames, n]
        tracks.append(BoxTrack(track_id, kind, frame_times_s[frames], box[:, :3], np.unwrap(box[:, 3]), box[:, 4:7]))
    return tuple(tracks), (*unnamed, *repairs)


def _track_velocities(track: BoxTrack, half_window_s: float) -> Array:
    """(n, 2) velocity at each frame: least-squares slope over the window; 0 below 0.1 m/s and for things that stand."""
    n = len(track.times_s)
    if track.kind not in MOVING_KINDS or n < 2:
        return np.zeros((n, 2))
    offset = track.times_s[None, :] - track.times_s[:, None]  # (n, n)
    near = np.abs(offset) <= half_window_s + ROUNDING_S
    count = near.sum(axis=1)
    # Those near stand side by side, K at most. They are summed in order, so that no frame beyond them changes a digit.
    k = np.arange(count.max())
    here, at = k < count[:, None], np.minimum(np.argmax(near, axis=1)[:, None] + k, n - 1)  # (n, K)
    offset = np.where(here, np.take_along_axis(offset, at, axis=1), 0.0)
    centered = np.where(here, offset - (_sum_in_order(offset) / count)[:, None], 0.0)
    moved = track.centers[at, :2] - track.centers[:, None, :2]  # (n, K, 2)
    spread = _sum_in_order(centered**2)
    slope = _sum_in_order(centered[..., None] * moved) / np.where(spread > 0.0, spread, 1.0)[:, None]
    standing = np.hypot(*slope.T) < STANDING_SPEED_MPS
    return np.where(standing[:, None], 0.0, slope)


def _sum_in_order(values: Array) -> Array:
    """Over axis 1, one after the other; numpy's own sum goes by blocks whose bounds depend on the length."""
    return np.asarray(np.cumsum(values, axis=1)[:, -1])


# An Argoverse 2 vector map (log_map_archive_*.json) as a RoadMap. Format: Wilson et al. 2021, argoverse/av2-api.

CAR_LANE_TYPES = {"VEHICLE": True, "BUS": True, "BIKE": False}


def map_file(log_folder: Path) -> Path:
    """The one vector map of a log. Raises BadClip."""
    folder = log_folder / "map"
    found = matching(folder, "log_map_archive_*.json")
    if len(found) != 1:
        problem = broken_link(folder) or f"expected one vector map, found {len(found)}"
        raise BadClip(str(folder), "log_map_archive_*.json", problem)
    return found[0]


def read_map(path: Path) -> tuple[RoadMap, tuple[Repair, ...]]:
    """The log's map, lanes in file order, roadblocks named; and what is not as the file has it.

    Raises BadClip naming the lane at fault, and where no lane for cars is left.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        why = why_unread(path, error) if isinstance(error, OSError) else error
        raise BadClip(str(path), "json", f"cannot be read: {why}") from error
    segments = {str(key): value for key, value in _section(path, content, "lane_segments").items()}
    sides, repairs = sound_lanes({key: _sides(path, key, raw) for key, raw in segments.items()})
    lanes = {key: _lane(path, key, segments[key], lane) for key, lane in sides.items()}
    if not any(lane.drives_cars for lane in lanes.values()):
        raise BadClip(str(path), "lane_segments", f"the map has no VEHICLE or BUS lane{left_out_lanes(repairs)}")
    areas = {key: _area(key, raw) for key, raw in _section(path, content, "drivable_areas").items()}
    crossings = [_crossing(key, raw) for key, raw in _section(path, content, "pedestrian_crossings").items()]
    rings = {key: ring for key, (ring, _) in areas.items() if ring is not None}
    road_map = RoadMap(
        lanes=lanes,
        drivable_areas=tuple(MapPolygon(f"da_{key}", MapLayer.DRIVABLE_AREA, ring) for key, ring in rings.items()),
        crossings=tuple(ring for ring, _ in crossings if ring is not None),
        roadblock_of=roadblocks_of(lanes),
        location=path.stem.partition("____")[2],  # e.g. PIT_city_47896
    )
    return road_map, (*repairs, *chain(*(found for _, found in (*areas.values(), *crossings))))


def _section(path: Path, content: Any, name: str) -> dict[str, Any]:
    section = content.get(name) if isinstance(content, dict) else None
    if not isinstance(section, dict):
        raise BadClip(str(path), name, "missing or not an object")
    return section


def _sides(path: Path, key: str, raw: Any) -> LaneSides:
    """The boundaries and links of a lane segment, as they are listed."""
    field = f"lane_segments[{key}]"
    try:
        return LaneSides(
            _boundary(path, f"{field}.left_lane_boundary", raw["left_lane_boundary"]),
            _boundary(path, f"{field}.right_lane_boundary", raw["right_lane_boundary"]),
            tuple(lane for lane in map(id_text, raw["predecessors"]) if lane is not None),
            tuple(lane for lane in map(id_text, raw["successors"]) if lane is not None),
        )
    except KeyError as error:
        raise BadClip(str(path), field, f"missing key {error}") from error
    except TypeError as error:
        raise BadClip(str(path), field, str(error)) from error


def _boundary(path: Path, field: str, raw: Any) -> Array:
    try:
        return _points(raw)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BadClip(str(path), field, f"not a list of x, y, z points ({error})") from error


def _lane(path: Path, key: str, raw: Mapping[str, Any], sides: LaneSides) -> Lane:
    field = f"lane_segments[{key}]"
    try:
        beside = [id_text(raw["left_neighbor_id"]), id_text(raw["right_neighbor_id"])]
        return Lane(
            lane_id=key,
            ring=ring_from_boundaries(sides.left, sides.right),
            centerline=centerline_from_boundaries(sides.left, sides.right),
            is_intersection=bool(raw["is_intersection"]),
            drives_cars=CAR_LANE_TYPES[raw["lane_type"]],
            successors=sides.successors,
            predecessors=sides.predecessors,
            left_neighbor=beside[0],
            right_neighbor=beside[1],
            left_boundary=sides.left,
            right_boundary=sides.right,
            left_mark=str(raw["left_lane_mark_type"]),
            right_mark=str(raw["right_lane_mark_type"]),
        )
    except KeyError as error:
        raise BadClip(str(path), field, f"missing key or unknown lane type {error}") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise BadClip(str(path), field, str(error)) from error


def _points(raw: Any) -> Array:
    """(B, 3) x, y, z [m]. Raises KeyError, TypeError, ValueError, OverflowError where it is no list of points."""
    points = np.array([[point["x"], point["y"], point["z"]] for point in raw], dtype=np.float64)
    return points.reshape(-1, 3)


def _area(key: str, raw: Any) -> tuple[Array | None, tuple[Repair, ...]]:
    """The ring (M, 2) of a drivable area; None where it is left out."""
    try:
        outline = _points(raw["area_boundary"])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None, (map_repair("area", str(key), "no area_boundary of x, y, z points"),)
    return simple_area(outline[:, :2], str(key))


def _crossing(key: str, raw: Any) -> tuple[Array | None, tuple[Repair, ...]]:
    """The ring (M, 2) of a pedestrian crossing; None where it is left out."""
    try:
        edge1, edge2 = _points(raw["edge1"])[:, :2], _points(raw["edge2"])[:, :2]
    except (KeyError, TypeError, ValueError, OverflowError):
        return None, (map_repair("crossing", str(key), "no edge1 and edge2 of x, y, z points"),)
    return crossing_between(edge1, edge2, str(key))


LICENCE = "CC BY-NC-SA 4.0 (Argoverse 2)"
LIGHTS = "traffic_lights.feather"
BEFORE_CITY, AFTER_CITY = "____", "_city_"  # log_map_archive_<log>____PIT_city_57819.json


@dataclass(frozen=True)
class AV2Log(WholeLog):
    """One log, whole, with its rig and where its photos and sweeps lie."""

    motion: LogMotion
    cameras: tuple[Camera, ...]
    images: tuple[SensorFile, ...]  # timed since the first annotated frame
    sweeps: tuple[SensorFile, ...]


class Moved(NamedTuple):
    """What moved in a log, and where it was every 0.1 s, steps S."""

    motion: LogMotion
    ego_states: Array  # (S, 11)
    agents: AgentTracks


MOVED_KEPT = 32  # logs, some megabytes each at most; more are indexed by other processes


def moved_in(folder: Path) -> Moved:
    """Of the log in this folder. Raises BadClip."""
    motion = read_motion(folder)
    times_s = step_times(0, motion.n_steps)
    return Moved(motion, ego_states_at(motion, times_s), agents_at(motion, times_s))


class AV2Reader(LogReader[AV2Log]):
    """Clips of a folder of Argoverse 2 sensor logs, of one of its train/val/test folders, or of one log."""

    data_set = "av2"
    block_stride_steps = 100

    @cached_property
    def _folders(self) -> dict[str, Path]:
        return log_folders(self.root)

    def logs(self) -> dict[str, Path]:
        """Log id -> folder, listed once. Raises ValueError where the root holds no log."""
        return self._folders

    def drive(self, path: Path) -> LoggedDrive | str:
        """Ego and agents of the log in this folder. A log whose frames nobody annotated is skipped. Raises BadClip."""
        if not is_named(path / ANNOTATIONS):
            return f"no {ANNOTATIONS}"
        map_file(path)
        key = _as_it_lies(path)
        moved = moved_in(path)
        if len(self._moved) < MOVED_KEPT:
            self._moved[key] = moved
        times_s, states = step_times(0, moved.motion.n_steps), moved.ego_states
        segment = np.where(observed_at(moved.motion, times_s) & np.isfinite(states).all(axis=1), 0, -1)
        return LoggedDrive(states, moved.agents, segment)

    def load(self, path: Path) -> AV2Log:
        """The log in this folder. Raises BadClip."""
        return read_log(path, self._moved.pop(_as_it_lies(path), None))

    @cached_property
    def _moved(self) -> dict[tuple[object, ...], Moved]:
        """Of some of the logs that are indexed and not yet loaded; half of a log's time is reading it."""
        return {}

    def __getstate__(self) -> dict[str, Any]:
        held = super().__getstate__()
        held.pop("_moved", None)
        return held

    def digest(self, ref: ClipRef) -> str:
        """The clip's content digest, from the bytes of its log's files alone. Raises BadClip."""
        return self.digest_with_others(ref, self.log_digest(self.path_of(ref)))

    def log_digest(self, path: Path) -> str:
        """sha256 of the log in this folder, but for pixels and points. Raises BadClip."""
        return content_digest(path)

    def world(self, path: Path) -> str:
        """The city, as the name of the log's map has it. Raises BadClip."""
        return map_file(path).stem.partition(BEFORE_CITY)[2].partition(AFTER_CITY)[0]

    def block(self, ref: ClipRef) -> str | None:
        """The block that the clip is rendered from; None where the log has no photos."""
        if ref.log_id not in self._photographed and ref.log_id in self.logs():
            cameras = self.logs()[ref.log_id] / "sensors" / "cameras"
            self._photographed[ref.log_id] = cameras.is_dir()
        return self.block_name(ref) if self._photographed.get(ref.log_id) else None

    @cached_property
    def _photographed(self) -> dict[str, bool]:
        """Of the logs that were asked for: whether they have photos."""
        return {}

    def recorded(self, log: AV2Log, start: int, stop: int) -> WindowSensors:
        """Poses, rig, photos and sweeps of a window, and the block that it is rendered from."""
        poses = world_from_ego_at(log.motion, step_times(start, stop))
        sensed = files_within(log.images, start, stop), files_within(log.sweeps, start, stop)
        block = block_of_log(log, log.images, log.sweeps, self.block_steps(start)) if log.images else None
        return WindowSensors(poses, log.cameras, *sensed, block)


def _as_it_lies(folder: Path) -> tuple[object, ...]:
    """What changes with the files that `moved_in` reads."""
    files = [folder / name for name in (ANNOTATIONS, POSES)]
    return folder, *[(file.stat().st_mtime_ns, file.stat().st_size) if file.is_file() else None for file in files]


def read_log(folder: Path, moved: Moved | None = None) -> AV2Log:
    """The whole log, resampled to 0.1 s; moved: what moved in it, where that is known. Raises BadClip."""
    motion, ego_states, agents = moved or moved_in(folder)
    times_s = step_times(0, motion.n_steps)
    vector_map = map_file(folder)
    road_map, map_repairs = read_map(vector_map)
    every_light, state_repairs = read_lights(folder, motion, times_s)
    lights, light_repairs = lights_on_map(every_light, road_map.lanes)
    cameras, sensors, own = read_cameras(folder), folder / "sensors", folder / "LICENSE"
    lines = own.read_text(encoding="utf-8").splitlines() if own.is_file() else []
    return AV2Log(
        file=str(folder),
        motion=motion,
        ego_states=ego_states,
        agents=agents,
        road_map=road_map,
        route=route_of_drive(road_map, ego_states[np.isfinite(ego_states[:, X]), :3], str(vector_map), "lane_segments"),
        lights=lights,
        cameras=cameras,
        images=tuple(chain(*(_stamped(motion, c.name, sensors / "cameras" / c.name, ".jpg") for c in cameras))),
        sweeps=tuple(_stamped(motion, "lidar", sensors / "lidar", ".feather")),
        licence=lines[0].strip() if lines else LICENCE,
        content_digest=content_digest(folder),
        split=folder_split(folder),
        repairs=(*motion.repairs, *map_repairs, *state_repairs, *light_repairs),
    )


def read_cameras(folder: Path) -> tuple[Camera, ...]:
    """The calibrated cameras of a log, in file order; none where the log has no calibration. Raises BadClip.

    Argoverse releases photos without distortion: its own API projects by fx, fy, cx and cy alone (PinholeCamera of
    av2.geometry.camera). k1, k2 and k3 of the same file tell what the lens was like, and are not read.
    """
    path, pose_path = folder / INTRINSICS, folder / EXTRINSICS
    if not is_named(path) and not is_named(pose_path):
        return ()
    columns = ("fx_px", "fy_px", "cx_px", "cy_px", "height_px", "width_px")
    table = read_feather(path, ("sensor_name", *columns))
    mounts = read_feather(pose_path, ("sensor_name", *POSE_COLUMNS))
    poses = numbers(pose_path, mounts, POSE_COLUMNS)
    turned = rotations(pose_path, poses).as_matrix()
    mount_of = {str(name): i for i, name in enumerate(mounts["sensor_name"])}
    cameras = []
    for name, (fx, fy, cx, cy, height, width) in zip(map(str, table["sensor_name"]), numbers(path, table, columns)):
        if name not in mount_of:
            raise BadClip(str(pose_path), "sensor_name", f"no pose of camera {name}")
        mount, row = np.eye(4), mount_of[name]
        mount[:3, :3], mount[:3, 3] = turned[row], poses[row, 4:]
        intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        try:
            cameras.append(Camera(str(name), int(width), int(height), intrinsics, np.zeros(5), mount))
        except ValueError as error:
            raise BadClip(str(path), "calibration", str(error)) from error
    return tuple(cameras)


def read_lights(folder: Path, motion: LogMotion, times_s: Array) -> tuple[TrafficLights, tuple[Repair, ...]]:
    """Light phases at times (S,), of all lanes that are named; no lanes where the log has none.

    A state that is none is unknown, and told. Raises BadClip, also where most are none.
    """
    path = folder / LIGHTS
    if not is_named(path):
        return TrafficLights((), np.zeros((len(times_s), 0), np.int8)), ()
    table = read_feather(path, ("timestamp_ns", "lane_id", "state"))
    # As texts of one width each would be as long as the longest.
    lanes, names = (np.array([*map(str, table[name])], object) for name in ("lane_id", "state"))
    unknown = ~np.isin(names, list(LightState.__members__))
    if unknown.sum() > MOST * len(names):
        raise BadClip(str(path), "state", f"unknown state {sorted(set(names[unknown].tolist()))}")
    done: list[Repair] = []
    changed_at = seconds_since(motion.start_ns, stamps(path, table))
    lane_ids = tuple(sorted(set(lanes.tolist())))
    states = np.full((len(times_s), len(lane_ids)), LightState.UNKNOWN, np.int8)
    for column, lane_id in enumerate(lane_ids):
        rows = np.flatnonzero(lanes == lane_id)
        rows = rows[np.argsort(changed_at[rows], kind="stable")]
        phase = np.array([LightState.__members__.get(name, LightState.UNKNOWN) for name in names[rows]], np.int8)
        until = np.append(changed_at[rows][1:], np.inf)
        for k in np.flatnonzero(unknown[rows]):
            was = f"the state {shown(str(names[rows[k]]))}"
            done.append(Repair("light", lane_id, float(changed_at[rows[k]]), was, "unknown", float(until[k])))
        latest = np.searchsorted(changed_at[rows], times_s + SAME_FRAME_S) - 1
        states[latest >= 0, column] = phase[latest[latest >= 0]]
    return TrafficLights(lane_ids, states), tuple(done)


def content_digest(folder: Path) -> str:
    """sha256 over what a clip is computed from: poses, annotations, map, calibration, lights; not pixels and points."""
    digest = hashlib.sha256()
    for name in (ANNOTATIONS, POSES, str(map_file(folder).relative_to(folder)), INTRINSICS, EXTRINSICS, LIGHTS):
        if (folder / name).exists():
            content = (folder / name).read_bytes()
            digest.update(f"{name}\x1f{len(content)}\x1f".encode() + content)
    return digest.hexdigest()


def _stamped(motion: LogMotion, sensor: str, folder: Path, suffix: str) -> list[SensorFile]:
    """Files named <timestamp_ns><suffix>, in time order. Raises BadClip for any other name."""
    if broken := broken_link(folder):
        raise BadClip(str(folder), "folder", broken)
    files = matching(folder, f"*{suffix}")
    for before, path in zip((None, *files), files):
        if not path.stem.isdecimal():
            raise BadClip(str(path), "name", f"expected <timestamp_ns>{suffix}")
        if before is not None and before.stem == path.stem:
            raise BadClip(str(path), "name", f"a second file of this instant, beside {before.name}: remove one")
    stamps_ns = np.array([int(path.stem) for path in files], dtype=np.int64)
    if sign := stamps_sign(stamps_ns, "ns"):
        raise BadClip(str(folder), "names", sign)
    times_s = seconds_since(motion.start_ns, stamps_ns)
    order = np.argsort(times_s, kind="stable")
    poses = world_from_ego_at(motion, times_s[order]) if files else ()
    return [SensorFile(sensor, str(files[i]), float(times_s[i]), pose) for i, pose in zip(order, poses)]

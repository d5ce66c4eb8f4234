"""Reads what 123D converted as clips, without 123D: what moves, what the sensors recorded, whole logs."""

import hashlib
import logging
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from factory.datasets.av2.reader import (
    EGO_FIT_HALF_WINDOW_S,
    FILLED_S,
    MIN_POSE_SPACING_S,
    ROUNDING_S,
    SAME_FRAME_S,
    BoxTrack,
    LogMotion,
    agents_at,
    clock_repairs,
    ego_states_at,
    headings_of,
    observed_at,
    posed_frames,
    poses_at,
    repaired_tracks,
    rotations,
    seconds_since,
    seen_at,
    step_times,
    whole_poses,
    world_from_ego_at,
    yaw_of,
)
from factory.datasets.py123d import Py123dClips
from factory.datasets.py123d.arrow import (
    KINDS_OF_LABELS,
    SOURCES,
    US_NS,
    WITHOUT_LANES,
    ArrowFile,
    ConvertedSet,
    check_version,
    number_lists,
    open_file,
)
from factory.datasets.py123d.map import read_map
from factory.datasets.scenarionet.reader import FIT_STEPS, MAX_GAP_S, smooth_drive
from factory.files import broken_link, file_digest, is_named, matching, matching_below, named_once
from factory.readers.base import SPLITS, BadClip, ClipRef, id_text, stamps_sign
from factory.readers.logs import (
    LoggedDrive,
    LogReader,
    WholeLog,
    WindowSensors,
    block_of_log,
    files_within,
    route_of_drive,
)
from factory.readers.pictures import frame_uri
from factory.wording import shown
from tasks.world.arrays import Array, Indices
from tasks.world.clip import STEP_S, AgentKind, Camera, SensorFile
from tasks.world.frames import EGO_STATE_SIZE
from tasks.world.repair.records import Repair
from tasks.world.repair.road import lights_on_map
from tasks.world.repair.tracks import MOST
from tasks.world.road_map import LightState, TrafficLights

log = logging.getLogger(__name__)

# What moves in a log of 123D, at steps of 0.1 s: rear-axle poses, boxes, lights.
#
# The poses are the IMU's, and the file says where the rear axle is from there; boxes are in the world frame.
# Velocities stored beside them are not read: for some data sets they are zeros. Modalities come at rates of their
# own:
#
# * up to 0.15 s apart: the rules of Argoverse 2's logs (factory/datasets/av2/log.py);
# * keyframes further apart, 2 Hz as a rule: boxes linear between two that are not much further apart than usual, the
#   ego smoothed as ScenarioNet's (factory/datasets/scenarionet/tracks.py).

EGO, BOXES, LIGHTS = "ego_state_se3.arrow", "box_detections_se3.arrow", "traffic_light_detections.arrow"
DENSE_S = 0.15  # what comes at most this far apart are no keyframes
FILLED_SPACINGS = 1.3  # of the usual one: nuScenes' keyframes lie 0.4 to 0.6 s apart
SMOOTHING = 300.0  # as of nuScenes' drives through ScenarioNet
MIN_FIT_POSES, MIN_KEYFRAMES = 4, 3
STATES = (LightState.GREEN, LightState.YELLOW, LightState.RED, LightState.UNKNOWN, LightState.UNKNOWN)  # off, unknown


def read_motion(folder: Path) -> LogMotion:
    """Poses and boxes of the log in `folder`: of the frames that have a pose, from the first to the last with a box.

    Raises BadClip, also where there is none or frames lie too far apart for 10 Hz.
    """
    ego, boxes = open_file(folder / EGO), open_file(folder / BOXES)
    pose_stamps, frame_stamps = ego.stamps_ns(), boxes.stamps_ns()
    for file, stamps in ((ego, pose_stamps), (boxes, frame_stamps)):
        if len(stamps) == 0:
            raise BadClip(str(file.path), "timestamp_us", "holds no rows")
        if sign := stamps_sign(stamps // US_NS, "us"):
            raise BadClip(str(file.path), "timestamp_us", sign)
    row, values = boxes.lists("bounding_box_se3")
    posed, stray_repairs = posed_frames(frame_stamps, pose_stamps, MIN_POSE_SPACING_S)
    boxed = np.flatnonzero(posed[row])
    if len(boxed) == 0:
        raise BadClip(str(boxes.path), "bounding_box_se3", "no box in any frame that has a pose")
    start_ns = int(frame_stamps[row[boxed]].min())
    times_s = seconds_since(start_ns, frame_stamps)
    frames = np.unique(times_s[(times_s >= 0.0) & (times_s <= times_s[row[boxed]].max())])
    pose_times, world_from_rear, positions, ego_repairs = _rear_axle(ego, seconds_since(start_ns, pose_stamps))
    turned, moved = poses_at(pose_times, world_from_rear, positions, frames)
    ego_poses = np.column_stack([moved[:, :2], yaw_of(turned)])
    tracks, repairs = _tracks(boxes, row, values, boxed, times_s, frames, ego_poses)
    return LogMotion(
        folder=folder,
        start_ns=start_ns,
        frame_times_s=frames,
        pose_times_s=pose_times,
        positions=positions,
        rotations=world_from_rear,
        yaws=np.unwrap(yaw_of(world_from_rear)),
        tracks=tracks,
        fill_s=_max_filled_gap_s(boxes, frames),
        repairs=(*clock_repairs(frames), *stray_repairs, *ego_repairs, *repairs),
    )


def logged_drive(motion: LogMotion) -> LoggedDrive:
    """Ego and agents every 0.1 s; a segment ends where poses or frames are missing. Raises BadClip."""
    times_s = step_times(0, motion.n_steps)
    states = resampled_ego_states(motion, times_s)
    here = np.isfinite(states).all(axis=1) & observed_at(motion, times_s)
    begins = here & ~np.concatenate([[False], here[:-1]])
    return LoggedDrive(states, agents_at(motion, times_s), np.where(here, np.cumsum(begins) - 1, -1))


def resampled_ego_states(motion: LogMotion, times_s: Array) -> Array:
    """Ego states (S, 11) at the log's steps; NaN where poses are missing."""
    states = np.full((len(times_s), EGO_STATE_SIZE), np.nan)
    usual_s = float(np.median(np.diff(motion.pose_times_s))) if len(motion.pose_times_s) > 1 else np.inf
    if usual_s <= DENSE_S:
        reach = EGO_FIT_HALF_WINDOW_S + ROUNDING_S
        first, last = (np.searchsorted(motion.pose_times_s, times_s + offset) for offset in (-reach, reach))
        enough = last - first >= MIN_FIT_POSES
        states[enough] = ego_states_at(motion, times_s[enough])
        return states
    place = [np.interp(times_s, motion.pose_times_s, column) for column in (*motion.positions[:, :2].T, motion.yaws)]
    nearest = np.rint(motion.pose_times_s / STEP_S).astype(np.int64)
    weight = np.isin(np.arange(len(times_s)), nearest).astype(np.float64)
    between = seen_at(motion.pose_times_s, times_s, FILLED_SPACINGS * min(usual_s, MAX_GAP_S))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], between, [False]])))
    for start, stop in pairwise(edges.tolist()):
        run = slice(start, stop)
        if between[start] and stop - start >= FIT_STEPS and weight[run].sum() >= MIN_KEYFRAMES:
            weight[[start, stop - 1]] = 1.0
            states[run] = smooth_drive(np.stack(place[:2], axis=1)[run], place[2][run], weight[run], SMOOTHING)
    return states


def lights_at(motion: LogMotion, times_s: Array) -> TrafficLights:
    """Phases at times (S,) of all lanes that are named: of the latest frame, where one is at most 0.55 s old.

    Two lights of one lane count as the more restrictive. No lanes where the log has no lights. Raises BadClip.
    """
    path = motion.folder / LIGHTS
    if not is_named(path):
        return TrafficLights((), np.zeros((len(times_s), 0), np.int8))
    file = open_file(path)
    changed_at = seconds_since(motion.start_ns, file.stamps_ns())
    (row, lane), (also_row, status) = file.lists("lane_id"), file.lists("status")
    if not np.array_equal(row, also_row) or lane.null_count or status.null_count:
        raise BadClip(str(path), "lane_id status", "not one status a lane")
    if len(status) and int(np.max(status)) >= len(STATES):
        raise BadClip(str(path), "status", f"unknown status {int(np.max(status))}")
    names = np.array([str(number) for number in lane.to_pylist()], dtype=np.str_)
    lane_ids, column = np.unique(names, return_inverse=True)
    states = np.full((len(changed_at) + 1, len(lane_ids)), LightState.UNKNOWN, np.int8)  # the last: of no frame
    np.maximum.at(states, (row, column), np.array(STATES, np.int8)[np.asarray(status, np.int64)])
    order = np.argsort(changed_at, kind="stable")
    changed_at, states[:-1] = changed_at[order], states[order]
    latest = np.searchsorted(changed_at, times_s + SAME_FRAME_S) - 1
    fresh = (latest >= 0) & (times_s - np.append(changed_at, np.inf)[latest] <= MAX_GAP_S)
    return TrafficLights(tuple(lane_ids.tolist()), states[np.where(fresh, latest, -1)])


def pose_matrices(path: Path, poses: Array) -> Array:
    """(n, 4, 4) of poses (n, 7) x, y, z, qw, qx, qy, qz. Raises BadClip for a quaternion that is no rotation."""
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    if len(poses):
        out[:, :3, :3], out[:, :3, 3] = rotations(path, poses[:, 3:]).as_matrix(), poses[:, :3]
    return out


def _rear_axle(ego: ArrowFile, times_s: Array) -> tuple[Array, Rotation, Array, tuple[Repair, ...]]:
    """Times (P,), rotations and positions (P, 3) of the rear axle from the IMU's, repaired. Raises BadClip."""
    poses, mount = ego.rows("imu_se3", 7, whole=False), ego.vector("rear_axle_to_imu_se3", 7)
    times_s, poses, repairs = whole_poses(ego.path, times_s, poses[:, [3, 4, 5, 6, 0, 1, 2]])
    world_from_imu = rotations(ego.path, poses)
    turned = rotations(ego.path, mount[None, 3:])[0]
    return times_s, world_from_imu * turned, world_from_imu.apply(mount[:3]) + poses[:, 4:], repairs


def _tracks(
    boxes: ArrowFile,
    row: Indices,
    values: pa.Array,
    boxed: Indices,
    times_s: Array,
    frame_times_s: Array,
    ego_poses: Array,
) -> tuple[tuple[BoxTrack, ...], tuple[Repair, ...]]:
    """Tracks of the boxes numbered `boxed`; row: (m,) the frame of each box, times_s: of the frames."""
    path = boxes.path
    (id_row, ids), (kind_row, labels) = boxes.lists("track_token"), boxes.lists("label")
    if not (np.array_equal(row, id_row) and np.array_equal(row, kind_row)):
        raise BadClip(str(path), "track_token label", "not one of each for every box")
    box = number_lists(path, "bounding_box_se3", values, 10, whole=False)[boxed]
    named = [id_text(token) for token in ids.to_pylist()]
    kinds = _kinds(boxes, labels)
    of_frames = np.zeros((len(boxed), 9))
    of_frames[:, :3], of_frames[:, 3], of_frames[:, 4:7] = box[:, :3], headings_of(box[:, 3:7]), box[:, 7:]
    chosen = [named[i] for i in boxed], [kinds[i] for i in boxed]
    return repaired_tracks(frame_times_s, times_s[row[boxed]], *chosen, of_frames, ego_poses)


def _kinds(boxes: ArrowFile, labels: pa.Array) -> list[AgentKind | None]:
    name = str(boxes.value("box_detection_label_class", str)).rpartition(".")[2]
    if name not in KINDS_OF_LABELS:
        known = ", ".join(KINDS_OF_LABELS)
        raise BadClip(str(boxes.path), "metadata.box_detection_label_class", f"unknown labels {name}; known: {known}")
    kinds = KINDS_OF_LABELS[name]
    found = [kinds[label] if label is not None and 0 <= label < len(kinds) else None for label in labels.to_pylist()]
    if found.count(None) > MOST * len(found):
        raise BadClip(str(boxes.path), "label", f"most are none of {name}, which ends at {len(kinds) - 1}")
    return found


def _max_filled_gap_s(boxes: ArrowFile, frames_s: Array) -> float:
    """The largest gap between two frames that is filled in."""
    usual_s = float(np.median(np.diff(frames_s))) if len(frames_s) > 1 else 0.0
    if usual_s > MAX_GAP_S:
        raise BadClip(
            str(boxes.path), "timestamp_us", f"frames {usual_s:.2f} s apart; over {MAX_GAP_S} s is too few for 10 Hz"
        )
    return FILLED_S if usual_s <= DENSE_S else max(FILLED_S, FILLED_SPACINGS * usual_s)


# Cameras and lidars of a log of 123D, and where what they took lies.
#
# 123D keeps a photo or a sweep by its path under the data set's own sensor root, or packed into its table (JPEG, PNG;
# LAZ, Arrow), or photos as a video beside the table. Files are taken where `sensor_root` says where they are.

CAMERAS, LIDARS = "camera.*.arrow", "lidar.*.arrow"


def recorded_photos(motion: LogMotion, rig: dict[Path, Camera], sensor_root: Path | None) -> tuple[SensorFile, ...]:
    """The log's photos, seconds since its first annotated frame, posed as their tables say.

    sensor_root: None: only those that are packed. Raises BadClip, also for a path that leads out of the root.
    """
    out: list[SensorFile] = []
    for path, camera in rig.items():
        file = open_file(path)
        if uris := _uris(file, sensor_root):
            times_s = seconds_since(motion.start_ns, file.stamps_ns())
            poses = _poses(file, camera, motion, times_s)
            for i in sorted(uris, key=times_s.__getitem__):
                out.append(SensorFile(camera.name, uris[i], float(times_s[i]), poses[i]))
    return tuple(out)


def recorded_sweeps(
    motion: LogMotion, source: ConvertedSet, sensor_root: Path | None, rear_from_imu: Array
) -> tuple[SensorFile, ...]:
    """The log's sweeps, timed and kept as its photos; files only of data sets whose own are read. Raises BadClip."""
    out: list[SensorFile] = []
    for path in matching(motion.folder, LIDARS):
        file = open_file(path)
        packed = not pa.types.is_string(_data_type(file))
        if not (uris := _uris(file, sensor_root if source.own_sweeps else None)):
            continue
        # packed points are in the IMU's frame
        mount = rear_from_imu @ _imu_from_lidar(file) if source.sweeps_of_sensor and not packed else rear_from_imu
        stamps = file.stamps_ns("end_timestamp_us" if source.sweeps_of_sensor else "timestamp_us")
        times_s = seconds_since(motion.start_ns, stamps)
        poses = world_from_ego_at(motion, times_s)
        for i in sorted(uris, key=times_s.__getitem__):
            if packed or uris[i].endswith(str(source.own_sweeps)):
                out.append(SensorFile(path.stem, uris[i], float(times_s[i]), poses[i], mount))
    return tuple(out)


def _imu_from_lidar(file: ArrowFile) -> Array:
    """(4, 4) of the only lidar of the table. Raises BadClip."""
    lidars = [one for one in file.metadata.values() if isinstance(one, dict)]  # by number, where they were merged
    if len(lidars) > 1:
        raise BadClip(str(file.path), "metadata", f"of {len(lidars)} lidars, one was expected")
    told = replace(file, metadata=lidars[0]) if lidars else file
    return pose_matrices(file.path, told.vector("lidar_to_imu_se3", 7)[None])[0]


def _uris(file: ArrowFile, sensor_root: Path | None) -> dict[int, str]:
    """Row -> where its photo or sweep is; none of files without a root. Raises BadClip."""
    kind, column = _data_type(file), file.table[f"{file.path.stem}.data"]
    rows = np.flatnonzero(np.asarray(column.is_valid())).tolist()
    if pa.types.is_binary(kind):
        return {row: frame_uri(file.path, row) for row in rows}
    if pa.types.is_int32(kind):
        return {row: frame_uri(file.path.with_suffix(".mp4"), column[row].as_py()) for row in rows}
    if not pa.types.is_string(kind):
        raise BadClip(str(file.path), "data", f"{kind} is neither a path nor packed")
    names = {row: column[row].as_py() for row in rows} if sensor_root else {}
    for name in names.values():
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise BadClip(str(file.path), "data", f"{shown(name)} is no path under the sensor root")
    return {row: f"{sensor_root}/{name}" for row, name in names.items()}


def _camera(file: ArrowFile, rear_from_imu: Array) -> Camera:
    fx, fy, cx, cy, skew = file.vector("intrinsics", 5)
    if skew:
        raise BadClip(str(file.path), "metadata.intrinsics", f"skew of {skew}, only cameras without are read")
    flat = file.value("is_undistorted", bool) or file.metadata.get("distortion") is None
    distortion = np.zeros(5) if flat else file.vector("distortion", 5)
    mount = rear_from_imu @ pose_matrices(file.path, file.vector("camera_to_imu_se3", 7)[None])[0]
    intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    size = file.value("width", int), file.value("height", int)
    try:
        return Camera(file.value("camera_name", str), *size, intrinsics, distortion, mount)
    except ValueError as error:
        raise BadClip(str(file.path), "metadata", str(error)) from error


def _data_type(file: ArrowFile) -> pa.DataType:
    name = f"{file.path.stem}.data"
    if name not in file.table.column_names:
        raise BadClip(str(file.path), name, "column is missing")
    return file.table.schema.field(name).type


def _poses(file: ArrowFile, camera: Camera, motion: LogMotion, times_s: Array) -> Array:
    """(n, 4, 4) world from ego at each photo: from the photo's own pose, the ego's where it has none."""
    poses = world_from_ego_at(motion, times_s)
    column = file.table[f"{file.path.stem}.camera_to_global_se3"].combine_chunks()
    posed = np.flatnonzero(np.asarray(column.is_valid()))
    if len(posed):
        own = pose_matrices(file.path, number_lists(file.path, "camera_to_global_se3", column.drop_null(), 7))
        poses[posed] = own @ np.linalg.inv(camera.ego_from_camera)
    return poses


SYNC, MAP = "sync.arrow", "map.arrow"


@dataclass(frozen=True)
class Py123dLog(WholeLog):
    """One log, whole, with its rig and where photos and sweeps lie; their times count from its first step."""

    motion: LogMotion
    cameras: tuple[Camera, ...]
    images: tuple[SensorFile, ...]
    sweeps: tuple[SensorFile, ...]


class Py123dReader(LogReader[Py123dLog]):
    """Clips of what 123D converted: of its data root, its `logs`, one split's folder, or one log.

    A log's id is its folder's name.
    """

    data_set = "py123d"
    block_stride_steps = 100

    def __init__(
        self,
        root: str | Path,
        maps_root: str | Path | None = Py123dClips.maps_root,
        sensor_root: str | Path | None = Py123dClips.sensor_root,
        **windows: Any,
    ) -> None:
        """maps_root: None: `maps` beside `logs`; sensor_root: of the data set itself, None: only what is packed.

        windows: as of LogReader. Raises ValueError.
        """
        super().__init__(root, **windows)
        self.maps_root, self.sensor_root = (
            None if folder is None else Path(folder).expanduser().absolute() for folder in (maps_root, sensor_root)
        )
        if self.sensor_root is not None and not self.sensor_root.is_dir():
            raise ValueError(
                f"clips.sensor_root={self.sensor_root}: {broken_link(self.sensor_root) or 'no such folder'}"
            )

    @cached_property
    def _folders(self) -> dict[str, Path]:
        return log_folders(self.root)

    def logs(self) -> dict[str, Path]:
        """Log id -> folder, listed once. Raises ValueError where the root holds no log, or one name twice."""
        return self._folders

    def drive(self, path: Path) -> LoggedDrive | str:
        """Ego and agents of the log in this folder; or what it lacks. Raises BadClip."""
        header = read_header(path)
        name = header.value("dataset", str)
        if name in WITHOUT_LANES:
            return f"123D writes {WITHOUT_LANES[name]} of {name}, and drives need lanes: convert another data set"
        converted_set_of(header)
        for name in (EGO, BOXES):
            if not is_named(path / name):
                return f"no {name}"
        self._map_file(header)
        return logged_drive(read_motion(path))

    def load(self, path: Path) -> Py123dLog:
        """The log in this folder, resampled to 0.1 s. Raises BadClip."""
        header = read_header(path)
        source, map_path = converted_set_of(header), self._map_file(header)
        motion = read_motion(path)
        drive = logged_drive(motion)
        driven = drive.ego_states[drive.segment >= 0, :3]
        if not len(driven):
            raise BadClip(str(path / EGO), "imu_se3", "no continuous drive")
        around = read_map(map_path, source, driven[:, :2])
        every_light = lights_at(motion, step_times(0, motion.n_steps))
        lights, light_repairs = lights_on_map(every_light, around.road_map.lanes, around.far_lanes)
        mount = open_file(path / EGO, rows=False).vector("rear_axle_to_imu_se3", 7)
        rear_from_imu = np.linalg.inv(pose_matrices(path / EGO, mount[None])[0])
        tables = {table: open_file(table, rows=False) for table in matching(path, CAMERAS)}
        models = {table: file.value("camera_model", str) for table, file in tables.items()}
        rig = {table: _camera(tables[table], rear_from_imu) for table, model in models.items() if model == "pinhole"}
        others = [f"{table.stem} ({model})" for table, model in models.items() if table not in rig]
        _warn_left_out(path, ", ".join(others))
        split = header.value("split", str).rpartition("_")[2]  # <data set>_<split>
        return Py123dLog(
            file=str(path),
            motion=motion,
            ego_states=drive.ego_states,
            agents=drive.agents,
            road_map=around.road_map,
            route=route_of_drive(around.road_map, driven, str(map_path), "lanes"),
            lights=lights,
            cameras=tuple(rig.values()),
            images=recorded_photos(motion, rig, self.sensor_root),
            sweeps=recorded_sweeps(motion, source, self.sensor_root, rear_from_imu),
            licence=source.licence,
            content_digest=content_digest(header, map_path),
            split=split if split in SPLITS else None,
            repairs=(*motion.repairs, *around.repairs, *light_repairs),
        )

    def digest(self, ref: ClipRef) -> str:
        """The clip's content digest, from the bytes of its log's files alone. Raises BadClip."""
        return self.digest_with_others(ref, self.log_digest(self.path_of(ref)))

    def log_digest(self, path: Path) -> str:
        """sha256 of the log in this folder, but for pixels and points. Raises BadClip."""
        header = read_header(path)
        return content_digest(header, self._map_file(header))

    def world(self, path: Path) -> str | None:
        """The map that the log shares with others; None where it has one of its own. Raises BadClip."""
        header = read_header(path)
        path = self._map_file(header)
        return None if path.parent == header.path.parent else path.stem

    def block(self, ref: ClipRef) -> str | None:
        """The block that the clip is rendered from; None where there are no photos."""
        kinds = (_data_type(open_file(path, rows=False)) for path in matching(self.path_of(ref), CAMERAS))
        return self.block_name(ref) if any(self.sensor_root or not pa.types.is_string(kind) for kind in kinds) else None

    def recorded(self, log: Py123dLog, start: int, stop: int) -> WindowSensors:
        """Poses, rig and photos of a window, and the block that it is rendered from."""
        poses = world_from_ego_at(log.motion, step_times(start, stop))
        sensed = files_within(log.images, start, stop), files_within(log.sweeps, start, stop)
        block = block_of_log(log, log.images, log.sweeps, self.block_steps(start)) if log.images else None
        return WindowSensors(poses, log.cameras, *sensed, block)

    def _map_file(self, header: ArrowFile) -> Path:
        """The log's map, in its folder or among the maps of its data set, as 123D itself looks. Raises BadClip."""
        folder, dataset, location = header.path.parent, header.value("dataset", str), header.metadata.get("location")
        paths = [folder / MAP]
        if isinstance(location, str):
            name = f"{dataset}_{location}.arrow"
            if Path(name).name != name:
                raise BadClip(str(header.path), "metadata.location", f"names an impossible file {shown(name)}")
            roots = [self.maps_root] if self.maps_root else [parent / "maps" for parent in folder.parents[1:4]]
            paths += [root / dataset / name for root in roots]
        found = next((path for path in paths if is_named(path)), None)
        if found is None:
            tried = " and ".join(map(str, paths[:2]))
            raise BadClip(str(folder), "map", f"missing, looked for {tried}: convert it too, or give clips.maps_root")
        return found


def log_folders(root: Path) -> dict[str, Path]:
    """Log id -> folder, sorted by id. Raises ValueError where the root holds no log of 123D, or one name twice."""
    if not root.is_dir():
        raise ValueError(f"{root}: {broken_link(root) or 'no such folder'}")
    above = root / "logs" if (root / "logs").is_dir() else root
    folders = named_once(root, ((found.parent.name, found.parent) for found in matching_below(above, SYNC)))
    if not folders:
        raise ValueError(f"{root}: no log of 123D here (a folder with {SYNC}); expected its data root, logs or a split")
    return folders


def read_header(folder: Path) -> ArrowFile:
    """What the log says of itself, its version checked. Raises BadClip."""
    header = open_file(folder / SYNC, rows=False)
    check_version(header)
    return header


def converted_set_of(header: ArrowFile) -> ConvertedSet:
    """The data set that was converted. Raises BadClip for one that is not read."""
    name = header.value("dataset", str)
    if name not in SOURCES:
        raise BadClip(str(header.path), "metadata.dataset", f"{shown(name)} is not read; {', '.join(SOURCES)} are")
    return SOURCES[name]


@cache
def _warn_left_out(folder: Path, cameras: str) -> None:
    if cameras:
        log.warning("%s: left out, only pinhole cameras are read: %s", folder, cameras)


def content_digest(header: ArrowFile, path: Path) -> str:
    """sha256 over what a clip is computed from: poses, boxes, lights, map, calibration; not pixels and points."""
    folder = header.path.parent
    digest = hashlib.sha256(repr(sorted(header.metadata.items())).encode())
    for file in (folder / EGO, folder / BOXES, folder / LIGHTS, path):
        if file.exists():
            digest.update(f"{file.name}\x1f{file_digest(file)}\x1f".encode())
    for file in (*matching(folder, CAMERAS), *matching(folder, LIDARS)):
        digest.update(f"{file.name}\x1f{sorted(open_file(file, rows=False).metadata.items())!r}\x1f".encode())
    return digest.hexdigest()

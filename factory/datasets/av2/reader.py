"""Reads Argoverse 2 sensor logs, and everything written in their layout, as clips.

A log may carry one file that Argoverse does not have: `traffic_lights.feather` (timestamp_ns, lane_id, state GREEN |
YELLOW | RED; a state holds until the lane's next row), which the synthetic town writes.
"""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from factory.datasets.av2.folders import ANNOTATIONS, EXTRINSICS, INTRINSICS, POSES, log_folders
from factory.datasets.av2.log import (
    POSE_COLUMNS,
    SAME_FRAME_S,
    LogMotion,
    agents_at,
    ego_states_at,
    numbers,
    observed_at,
    read_motion,
    rotations,
    stamps,
    step_times,
    world_from_ego_at,
)
from factory.files import matching
from factory.readers.base import BadClip, ClipRef, folder_split
from factory.readers.logs import STEP_MS, LoggedDrive, LogReader, Recorded, WholeLog, present, route_of_drive
from factory.readers.pickles import id_text
from factory.readers.points import read_feather
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S, Block, Camera, SensorFile
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
    valid_ring,
)

# An Argoverse 2 vector map (log_map_archive_*.json) as a RoadMap. Format: Wilson et al. 2021, argoverse/av2-api.

CAR_LANE_TYPES = {"VEHICLE": True, "BUS": True, "BIKE": False}


def map_file(log_folder: Path) -> Path:
    """The one vector map of a log. Raises BadClip."""
    found = matching(log_folder / "map", "log_map_archive_*.json")
    if len(found) != 1:
        raise BadClip(str(log_folder / "map"), "log_map_archive_*.json", f"expected one vector map, found {len(found)}")
    return found[0]


def read_map(path: Path) -> RoadMap:
    """The log's map, lanes in file order, roadblocks named. Raises BadClip naming the lane or area at fault."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadClip(str(path), "json", f"cannot be read: {error}") from error
    segments = _section(path, content, "lane_segments")
    lanes = {str(key): _lane(path, str(key), value) for key, value in segments.items()}
    if not any(lane.drives_cars for lane in lanes.values()):
        raise BadClip(str(path), "lane_segments", "the map has no VEHICLE or BUS lane")
    areas = tuple(
        MapPolygon(f"da_{key}", MapLayer.DRIVABLE_AREA, _area_ring(path, f"drivable_areas[{key}]", value))
        for key, value in _section(path, content, "drivable_areas").items()
    )
    crossings = tuple(
        _crossing_ring(path, f"pedestrian_crossings[{key}]", value)
        for key, value in _section(path, content, "pedestrian_crossings").items()
    )
    location = path.stem.partition("____")[2]  # e.g. PIT_city_47896
    return RoadMap(lanes, areas, crossings, roadblocks_of(lanes), location)


def _section(path: Path, content: Any, name: str) -> dict[str, Any]:
    section = content.get(name) if isinstance(content, dict) else None
    if not isinstance(section, dict):
        raise BadClip(str(path), name, "missing or not an object")
    return section


def _lane(path: Path, key: str, raw: Any) -> Lane:
    field = f"lane_segments[{key}]"
    try:
        beside = [id_text(raw["left_neighbor_id"]), id_text(raw["right_neighbor_id"])]
        left = _points(path, f"{field}.left_lane_boundary", raw["left_lane_boundary"])
        right = _points(path, f"{field}.right_lane_boundary", raw["right_lane_boundary"])
        return Lane(
            lane_id=key,
            ring=ring_from_boundaries(left, right),
            centerline=centerline_from_boundaries(left, right),
            is_intersection=bool(raw["is_intersection"]),
            drives_cars=CAR_LANE_TYPES[raw["lane_type"]],
            successors=tuple(lane for lane in map(id_text, raw["successors"]) if lane is not None),
            predecessors=tuple(lane for lane in map(id_text, raw["predecessors"]) if lane is not None),
            left_neighbor=beside[0],
            right_neighbor=beside[1],
            left_boundary=left,
            right_boundary=right,
            left_mark=str(raw["left_lane_mark_type"]),
            right_mark=str(raw["right_lane_mark_type"]),
        )
    except KeyError as error:
        raise BadClip(str(path), field, f"missing key or unknown lane type {error}") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise BadClip(str(path), field, str(error)) from error


def _points(path: Path, field: str, raw: Any) -> Array:
    """(B, 3) x, y, z [m], B >= 2."""
    try:
        points = np.array([[point["x"], point["y"], point["z"]] for point in raw], dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BadClip(str(path), field, f"not a list of x, y, z points ({error})") from error
    if len(points) < 2 or not np.isfinite(points).all():
        raise BadClip(str(path), field, "needs at least two finite points")
    return points


def _closed(points: Array) -> Array:
    return points if np.array_equal(points[0], points[-1]) else np.concatenate([points, points[:1]])


def _area_ring(path: Path, field: str, raw: Any) -> Array:
    try:
        return valid_ring(_closed(_points(path, f"{field}.area_boundary", raw["area_boundary"])[:, :2]))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BadClip(str(path), f"{field}.area_boundary", f"not a polygon ({error})") from error


def _crossing_ring(path: Path, field: str, raw: Any) -> Array:
    try:
        edges = [_points(path, f"{field}.{name}", raw[name])[:, :2] for name in ("edge1", "edge2")]
    except (KeyError, TypeError) as error:
        raise BadClip(str(path), field, f"needs edge1 and edge2 ({error})") from error
    return _closed(np.concatenate([edges[0], edges[1][::-1]]))


LICENCE = "CC BY-NC-SA 4.0 (Argoverse 2)"
LIGHTS = "traffic_lights.feather"
BLOCK_STEPS, BLOCK_STRIDE_STEPS = 200, 100  # of the stretches that are reconstructed
BEFORE_CITY, AFTER_CITY = "____", "_city_"  # log_map_archive_<log>____PIT_city_57819.json


@dataclass(frozen=True)
class AV2Log(WholeLog):
    """One log, whole, with its rig and where its photos and sweeps lie."""

    motion: LogMotion
    cameras: tuple[Camera, ...]
    images: tuple[tuple[str, Path, float], ...]  # camera, file, seconds since the first annotated frame
    sweeps: tuple[tuple[str, Path, float], ...]


class AV2Reader(LogReader[AV2Log]):
    """Clips of a folder of Argoverse 2 sensor logs, of one of its train/val/test folders, or of one log."""

    data_set = "av2"

    def logs(self) -> dict[str, Path]:
        """Log id -> folder. Raises ValueError where the root holds no log."""
        return log_folders(self.root)

    def drive(self, path: Path) -> LoggedDrive | str:
        """Ego and agents of the log in this folder. A log whose frames nobody annotated is skipped. Raises BadClip."""
        if not (path / ANNOTATIONS).is_file():
            return f"no {ANNOTATIONS}"
        map_file(path)
        motion = read_motion(path)
        times_s = step_times(0, motion.n_steps)
        segment = np.where(observed_at(motion, times_s), 0, -1)
        return LoggedDrive(ego_states_at(motion, times_s), agents_at(motion, times_s), segment)

    def load(self, path: Path) -> AV2Log:
        """The log in this folder. Raises BadClip."""
        return read_log(path)

    def digest(self, ref: ClipRef) -> str:
        """The clip's content digest, from the bytes of its log's files alone. Raises BadClip."""
        return self.digest_with_others(ref, self.log_digest(self.path_of(ref)))

    def log_digest(self, path: Path) -> str:
        """sha256 of the log in this folder, but for pixels and points. Raises BadClip."""
        return content_digest(path)

    def world(self, path: Path) -> str:
        """The city, as the name of the log's map has it. Raises BadClip."""
        return map_file(path).stem.partition(BEFORE_CITY)[2].partition(AFTER_CITY)[0]

    def block_steps(self, start: int) -> tuple[int, int]:
        """20 s that begin at a multiple of 10 s."""
        first = start // BLOCK_STRIDE_STEPS * BLOCK_STRIDE_STEPS
        return first, first + BLOCK_STEPS

    def block(self, ref: ClipRef) -> str | None:
        """Log and second at which the block begins that the clip is rendered from; None where the log has no photos."""
        if ref.log_id not in self._photographed:
            return None
        first = ref.start_ms // STEP_MS // BLOCK_STRIDE_STEPS * BLOCK_STRIDE_STEPS
        return f"{ref.log_id}@{first * STEP_S:g}s"

    @cached_property
    def _photographed(self) -> frozenset[str]:
        return frozenset(log_id for log_id, folder in self.logs().items() if (folder / "sensors" / "cameras").is_dir())

    def recorded(self, log: AV2Log, start: int, stop: int) -> Recorded:
        """Poses, rig, photos and sweeps of a window, and the block that it is rendered from."""
        poses = world_from_ego_at(log.motion, step_times(start, stop))
        return Recorded(poses, log.cameras, *_sensed(log, start, stop), _block(log, start) if log.images else None)


def read_log(folder: Path) -> AV2Log:
    """The whole log, resampled to 0.1 s. Raises BadClip."""
    motion = read_motion(folder)
    times_s = step_times(0, motion.n_steps)
    ego_states = ego_states_at(motion, times_s)
    vector_map = map_file(folder)
    road_map = read_map(vector_map)
    cameras, sensors = read_cameras(folder), folder / "sensors"
    return AV2Log(
        file=str(folder),
        motion=motion,
        ego_states=ego_states,
        agents=agents_at(motion, times_s),
        road_map=road_map,
        route=route_of_drive(road_map, ego_states[:, :3], str(vector_map), "lane_segments"),
        lights=read_lights(folder, road_map, motion, times_s),
        cameras=cameras,
        images=tuple(chain(*(_stamped(motion, c.name, sensors / "cameras" / c.name, ".jpg") for c in cameras))),
        sweeps=tuple(_stamped(motion, "lidar", sensors / "lidar", ".feather")),
        licence=_licence(folder),
        content_digest=content_digest(folder),
        split=folder_split(folder),
    )


def read_cameras(folder: Path) -> tuple[Camera, ...]:
    """The calibrated cameras of a log, in file order; none where the log has no calibration. Raises BadClip.

    Argoverse releases photos without distortion: its own API projects by fx, fy, cx and cy alone (PinholeCamera of
    av2.geometry.camera). k1, k2 and k3 of the same file tell what the lens was like, and are not read.
    """
    path, pose_path = folder / INTRINSICS, folder / EXTRINSICS
    if not path.exists() and not pose_path.exists():
        return ()
    columns = ("fx_px", "fy_px", "cx_px", "cy_px", "height_px", "width_px")
    table = read_feather(path, ("sensor_name", *columns))
    mounts = read_feather(pose_path, ("sensor_name", *POSE_COLUMNS))
    poses = numbers(pose_path, mounts, POSE_COLUMNS)
    turned = rotations(pose_path, poses).as_matrix()
    mount_of = {str(name): i for i, name in enumerate(mounts["sensor_name"])}
    cameras = []
    for name, (fx, fy, cx, cy, height, width) in zip(table["sensor_name"].astype(str), numbers(path, table, columns)):
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


def read_lights(folder: Path, road_map: RoadMap, motion: LogMotion, times_s: Array) -> TrafficLights:
    """Light phases at times (S,); no lanes where the log has none. Raises BadClip."""
    path = folder / LIGHTS
    if not path.exists():
        return TrafficLights((), np.zeros((len(times_s), 0), np.int8))
    table = read_feather(path, ("timestamp_ns", "lane_id", "state"))
    lanes, names = table["lane_id"].astype(str), table["state"].astype(str)
    strangers = set(lanes.tolist()) - road_map.lanes.keys()
    if strangers:
        raise BadClip(str(path), "lane_id", f"not on the map: {sorted(strangers)}")
    unknown = set(names.tolist()) - LightState.__members__.keys()
    if unknown:
        raise BadClip(str(path), "state", f"unknown state {sorted(unknown)}")
    changed_at = motion.seconds(stamps(path, table))
    lane_ids = tuple(sorted(set(lanes.tolist())))
    states = np.full((len(times_s), len(lane_ids)), LightState.UNKNOWN, np.int8)
    for column, lane_id in enumerate(lane_ids):
        rows = np.flatnonzero(lanes == lane_id)
        rows = rows[np.argsort(changed_at[rows], kind="stable")]
        phase = np.array([LightState[name] for name in names[rows]], np.int8)
        latest = np.searchsorted(changed_at[rows], times_s + SAME_FRAME_S) - 1
        states[latest >= 0, column] = phase[latest[latest >= 0]]
    return TrafficLights(lane_ids, states)


def content_digest(folder: Path) -> str:
    """sha256 over what a clip is computed from: poses, annotations, map, calibration, lights; not pixels and points."""
    digest = hashlib.sha256()
    for name in (ANNOTATIONS, POSES, str(map_file(folder).relative_to(folder)), INTRINSICS, EXTRINSICS, LIGHTS):
        if (folder / name).exists():
            content = (folder / name).read_bytes()
            digest.update(f"{name}\x1f{len(content)}\x1f".encode() + content)
    return digest.hexdigest()


def _licence(folder: Path) -> str:
    path = folder / "LICENSE"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return lines[0].strip() if lines else LICENCE


def _stamped(motion: LogMotion, sensor: str, folder: Path, suffix: str) -> list[tuple[str, Path, float]]:
    """Files named <timestamp_ns><suffix>, in time order. Raises BadClip for any other name."""
    files = matching(folder, f"*{suffix}")
    for path in files:
        if not path.stem.isdecimal():
            raise BadClip(str(path), "name", f"expected <timestamp_ns>{suffix}")
    times_s = motion.seconds(np.array([int(path.stem) for path in files], dtype=np.int64))
    return [(sensor, files[i], float(times_s[i])) for i in np.argsort(times_s, kind="stable")]


def _block(log: AV2Log, start: int) -> Block:
    """The block of the clip that starts at step `start`: 20 s that begin at a multiple of 10 s, so that it holds it."""
    first = start // BLOCK_STRIDE_STEPS * BLOCK_STRIDE_STEPS
    stop = min(first + BLOCK_STEPS, log.motion.n_steps)
    return Block(first * STEP_S, present(log.agents.window(first, stop)), *_sensed(log, first, stop))


def _sensed(log: AV2Log, start: int, stop: int) -> tuple[tuple[SensorFile, ...], tuple[SensorFile, ...]]:
    """Photos and sweeps of the steps start..stop-1."""
    return _within(log.motion, log.images, start, stop), _within(log.motion, log.sweeps, start, stop)


def _within(
    motion: LogMotion, files: tuple[tuple[str, Path, float], ...], start: int, stop: int
) -> tuple[SensorFile, ...]:
    first, last = start * STEP_S, (stop - 1) * STEP_S
    inside = [entry for entry in files if first - SAME_FRAME_S < entry[2] <= last + SAME_FRAME_S]
    if not inside:
        return ()
    poses = world_from_ego_at(motion, np.array([time_s for _, _, time_s in inside]))
    return tuple(
        SensorFile(sensor, str(path), time_s - first, pose) for (sensor, path, time_s), pose in zip(inside, poses)
    )

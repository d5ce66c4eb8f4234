"""Reads Argoverse 2 sensor logs, and everything written in their layout, as clips.

A log may carry one file that Argoverse does not have: `traffic_lights.feather` (timestamp_ns, lane_id, state GREEN |
YELLOW | RED; a state holds until the lane's next row), which the synthetic town writes.
"""

import hashlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factory.clips.av2_log import (
    ANNOTATIONS,
    POSE_COLUMNS,
    POSES,
    SAME_FRAME_S,
    LogMotion,
    agents_at,
    ego_states_at,
    numbers,
    observed_at,
    read_feather,
    read_motion,
    rotations,
    stamps,
    step_times,
    world_from_ego_at,
)
from factory.clips.av2_map import map_file, read_map
from factory.clips.reader import BadClip, ClipIndex, ClipRef, split_of
from factory.clips.validate import validate_clip
from factory.clips.windows import WindowSettings, drop_reason, window_starts
from tasks.world.agents import AgentTracks
from tasks.world.camera import Camera, SensorFile
from tasks.world.clip import CLIP_STEPS, NOW, STEP_S, Block, Clip
from tasks.world.lanes import LightState, RoadMap, Route, TrafficLights
from tasks.world.route import NoRoute, RouteFinder, route_of_log

Array = NDArray[np.float64]

LICENCE = "CC BY-NC-SA 4.0 (Argoverse 2)"
LIGHTS = "traffic_lights.feather"
INTRINSICS, EXTRINSICS = "calibration/intrinsics.feather", "calibration/egovehicle_SE3_sensor.feather"
SPLITS = ("train", "val", "test")
ROUTE_SAMPLE_STEPS = 2  # the route looks at the ego every 0.2 s
CACHED_LOGS = 2
BLOCK_STEPS, BLOCK_STRIDE_STEPS = 200, 100  # of the stretches that are reconstructed


@dataclass(frozen=True)
class AV2Log:
    """One log, whole: what its windows are cut from."""

    motion: LogMotion
    ego_states: Array  # (S, 11) every 0.1 s
    agents: AgentTracks  # S steps
    road_map: RoadMap
    route: Route
    finder: RouteFinder
    lights: TrafficLights  # S steps
    cameras: tuple[Camera, ...]
    images: tuple[tuple[str, Path, float], ...]  # camera, file, seconds since the first annotated frame
    sweeps: tuple[tuple[str, Path, float], ...]
    licence: str
    content_digest: str


class AV2Reader:
    """Clips of a folder of Argoverse 2 sensor logs, of one of its train/val/test folders, or of one log.

    Keeps the last two logs it read; workers get a reader without them.
    """

    def __init__(
        self,
        root: str | Path,
        stride_s: float = 1.0,
        name: str = "av2",
        min_top_speed_mps: float = 0.5,
    ) -> None:
        """name: the data set's name, part of every clip id. Raises ValueError for an impossible stride."""
        self.root = Path(root).expanduser().absolute()
        self.name = name
        self.windows = WindowSettings(stride_s=stride_s, min_top_speed_mps=min_top_speed_mps)
        self._stride_steps = self.windows.stride_steps
        self._logs: dict[str, AV2Log] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_logs": {}}

    def index(self) -> ClipIndex:
        """All windows of all logs, ordered by log id and time. Raises ValueError where the root holds no log."""
        refs: list[ClipRef] = []
        dropped: Counter[str] = Counter()
        skipped: dict[str, str] = {}
        broken: dict[ClipRef, str] = {}
        for log_id, folder in log_folders(self.root).items():
            if not (folder / ANNOTATIONS).is_file():
                skipped[log_id] = f"no {ANNOTATIONS}"
                continue
            try:
                map_file(folder)
                motion = read_motion(folder)
                times_s = step_times(0, motion.n_steps)
                ego_states, agents = ego_states_at(motion, times_s), agents_at(motion, times_s)
            except BadClip as error:
                broken[ClipRef(self.name, log_id, 0)] = str(error)
                continue
            observed = observed_at(motion, times_s)
            starts = window_starts(motion.n_steps, self.windows)
            if not starts:
                skipped[log_id] = f"{motion.n_steps * STEP_S:.1f} s long, a clip needs {CLIP_STEPS * STEP_S:.1f} s"
            for start in starts:
                stop = start + CLIP_STEPS
                window = agents.window(start, stop)
                reason = drop_reason(ego_states[start:stop], window, observed[start:stop], self.windows)
                if reason is None:
                    refs.append(ClipRef(self.name, log_id, round(start * STEP_S * 1000)))
                else:
                    dropped[reason] += 1
        return ClipIndex(tuple(refs), dict(dropped), skipped, broken)

    def read(self, ref: ClipRef) -> Clip:
        """The validated clip. Raises BadClip."""
        log = self._log(ref)
        start, rest = divmod(ref.start_ms, round(STEP_S * 1000))
        stop = start + CLIP_STEPS
        if rest or start < 0 or stop > log.motion.n_steps:
            raise BadClip(str(log.motion.folder), "start_ms", f"no window of {ref.window} starts at {ref.start_ms} ms")
        ego_states = log.ego_states[start:stop].copy()  # the log stays with the reader, the clip is the caller's
        clip = Clip(
            clip_id=ref.clip_id,
            dataset=self.name,
            log_id=ref.log_id,
            split=split_of(ref.log_id),
            start_s=start * STEP_S,
            ego_states=ego_states,
            world_from_ego=world_from_ego_at(log.motion, step_times(start, stop)),
            agents=_seen(log.agents.window(start, stop)),
            road_map=log.road_map,
            route=log.route,
            centerline=log.finder.centerline_from(ego_states[NOW, :3]),
            lights=TrafficLights(log.lights.lane_ids, log.lights.states[start:stop].copy()),
            cameras=log.cameras,
            images=_within(log.motion, log.images, start, CLIP_STEPS),
            sweeps=_within(log.motion, log.sweeps, start, CLIP_STEPS),
            block=_block(log, start) if log.images else None,
            licence=log.licence,
            content_digest=log.content_digest,
        )
        return validate_clip(clip, str(log.motion.folder))

    def _log(self, ref: ClipRef) -> AV2Log:
        if ref.log_id not in self._logs:
            folder = log_folders(self.root).get(ref.log_id)
            if folder is None or ref.dataset != self.name:
                raise BadClip(str(self.root), "log_id", f"no log {ref.log_id} of data set {ref.dataset} here")
            log = read_log(folder)
            while len(self._logs) >= CACHED_LOGS:
                del self._logs[next(iter(self._logs))]
            self._logs[ref.log_id] = log
        return self._logs[ref.log_id]


def log_folders(root: Path) -> dict[str, Path]:
    """Log id -> folder, sorted by id. Raises ValueError where the root is no Argoverse 2 folder."""
    if _is_log(root):
        return {root.name: root}
    if not root.is_dir():
        raise ValueError(f"{root}: no such folder")
    parents = [root / split for split in SPLITS if (root / split).is_dir()] or [root]
    folders = {folder.name: folder for parent in parents for folder in parent.iterdir() if _is_log(folder)}
    if not folders:
        raise ValueError(
            f"{root}: no Argoverse 2 sensor log here; expected .../sensor, its train, val or test folder, or one log"
        )
    return dict(sorted(folders.items()))


def read_log(folder: Path) -> AV2Log:
    """The whole log, resampled to 0.1 s. Raises BadClip."""
    motion = read_motion(folder)
    times_s = step_times(0, motion.n_steps)
    ego_states = ego_states_at(motion, times_s)
    vector_map = map_file(folder)
    road_map = read_map(vector_map)
    try:
        route = route_of_log(road_map, ego_states[::ROUTE_SAMPLE_STEPS, :3])
    except NoRoute as error:
        raise BadClip(str(vector_map), "lane_segments", str(error)) from error
    cameras = read_cameras(folder)
    return AV2Log(
        motion=motion,
        ego_states=ego_states,
        agents=agents_at(motion, times_s),
        road_map=road_map,
        route=route,
        finder=RouteFinder(road_map, route),
        lights=read_lights(folder, road_map, motion, times_s),
        cameras=cameras,
        images=tuple(
            stamped
            for camera in cameras
            for stamped in _stamped(motion, camera.name, folder / "sensors" / "cameras" / camera.name, ".jpg")
        ),
        sweeps=tuple(_stamped(motion, "lidar", folder / "sensors" / "lidar", ".feather")),
        licence=_licence(folder),
        content_digest=content_digest(folder),
    )


def read_cameras(folder: Path) -> tuple[Camera, ...]:
    """The calibrated cameras of a log, in file order; none where the log has no calibration. Raises BadClip."""
    path, pose_path = folder / INTRINSICS, folder / EXTRINSICS
    if not path.exists() and not pose_path.exists():
        return ()
    columns = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "height_px", "width_px")
    table = read_feather(path, ("sensor_name", *columns))
    mounts = read_feather(pose_path, ("sensor_name", *POSE_COLUMNS))
    poses = numbers(pose_path, mounts, POSE_COLUMNS)
    turned = rotations(pose_path, poses).as_matrix()
    mount_of = {str(name): i for i, name in enumerate(mounts["sensor_name"])}
    cameras = []
    for name, (fx, fy, cx, cy, *distortion, height, width) in zip(
        table["sensor_name"].astype(str), numbers(path, table, columns)
    ):
        if name not in mount_of:
            raise BadClip(str(pose_path), "sensor_name", f"no pose of camera {name}")
        ego_from_camera = np.eye(4)
        ego_from_camera[:3, :3] = turned[mount_of[name]]
        ego_from_camera[:3, 3] = poses[mount_of[name], 4:]
        intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        cameras.append(Camera(str(name), int(width), int(height), intrinsics, np.array(distortion), ego_from_camera))
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
    files = (ANNOTATIONS, POSES, str(map_file(folder).relative_to(folder)), INTRINSICS, EXTRINSICS, LIGHTS)
    for name in files:
        path = folder / name
        if path.exists():
            content = path.read_bytes()
            digest.update(f"{name}\x1f{len(content)}\x1f".encode())
            digest.update(content)
    return digest.hexdigest()


def _is_log(folder: Path) -> bool:
    return any((folder / name).exists() for name in (ANNOTATIONS, POSES))


def _licence(folder: Path) -> str:
    path = folder / "LICENSE"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return lines[0].strip() if lines else LICENCE


def _stamped(motion: LogMotion, sensor: str, folder: Path, suffix: str) -> list[tuple[str, Path, float]]:
    """Files named <timestamp_ns><suffix>, in time order. Raises BadClip for any other name."""
    files = sorted(folder.glob(f"*{suffix}"))
    for path in files:
        if not path.stem.isdecimal():
            raise BadClip(str(path), "name", f"expected <timestamp_ns>{suffix}")
    times_s = motion.seconds(np.array([int(path.stem) for path in files], dtype=np.int64))
    return [(sensor, files[i], float(times_s[i])) for i in np.argsort(times_s, kind="stable")]


def _block(log: AV2Log, start: int) -> Block:
    """The block of the clip that starts at step `start`: 20 s that begin at a multiple of 10 s, so that it holds it."""
    first = start // BLOCK_STRIDE_STEPS * BLOCK_STRIDE_STEPS
    n_steps = min(BLOCK_STEPS, log.motion.n_steps - first)
    return Block(
        start_s=first * STEP_S,
        agents=_seen(log.agents.window(first, first + n_steps)),
        images=_within(log.motion, log.images, first, n_steps),
        sweeps=_within(log.motion, log.sweeps, first, n_steps),
    )


def _within(
    motion: LogMotion, files: tuple[tuple[str, Path, float], ...], start: int, n_steps: int
) -> tuple[SensorFile, ...]:
    """The sensor files between the first and the last of `n_steps` steps from step `start` on."""
    first, last = start * STEP_S, (start + n_steps - 1) * STEP_S
    inside = [entry for entry in files if first - SAME_FRAME_S < entry[2] <= last + SAME_FRAME_S]
    if not inside:
        return ()
    poses = world_from_ego_at(motion, np.array([time_s for _, _, time_s in inside]))
    return tuple(
        SensorFile(sensor, str(path), time_s - first, pose) for (sensor, path, time_s), pose in zip(inside, poses)
    )


def _seen(agents: AgentTracks) -> AgentTracks:
    """Only the tracks that are present at one of the steps or more."""
    seen = np.flatnonzero(agents.valid.any(axis=0))
    return AgentTracks(
        track_ids=tuple(agents.track_ids[i] for i in seen),
        kinds=tuple(agents.kinds[i] for i in seen),
        boxes=agents.boxes[:, seen],
        velocities=agents.velocities[:, seen],
        valid=agents.valid[:, seen],
        center_z=agents.center_z[:, seen],
        heights=agents.heights[seen],
    )

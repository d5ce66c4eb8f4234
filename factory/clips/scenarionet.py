"""Reads ScenarioNet's scenario pickles (Li et al. 2023) as clips: nuScenes, Waymo and nuPlan conversions.

A scenario is a dict: `metadata` (dataset, ts, sdc_id, map), `length`, `tracks`, `map_features`, `dynamic_map_states`.
There are no cameras and no lidar in it. Lanes: scenarionet_lanes.py; map: scenarionet_map.py; motion:
scenarionet_tracks.py. A database folder lists its scenarios in `dataset_summary.pkl` (file name -> metadata) and
their folders in `dataset_mapping.pkl` (file name -> folder relative to the database).
"""

import hashlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factory.clips.reader import BadClip, ClipIndex, ClipRef, split_of
from factory.clips.restricted_pickle import MAX_FILE_BYTES, load_plain
from factory.clips.scenarionet_map import road_map, traffic_lights
from factory.clips.scenarionet_tracks import (
    SOURCES,
    Source,
    agent_tracks,
    ego_segments,
    frame_positions,
    ground_height,
    read_track,
    sample_times,
)
from factory.clips.validate import validate_clip
from factory.clips.windows import WindowSettings, drop_reason, window_starts
from tasks.world.agents import AgentTracks
from tasks.world.clip import CLIP_STEPS, NOW, STEP_S, Clip
from tasks.world.lanes import RoadMap, Route, TrafficLights
from tasks.world.route import NoRoute, RouteFinder, route_of_log
from tasks.world.vehicle import EGO_STATE_SIZE, HEADING, X, Y

Array = NDArray[np.float64]

SUMMARY, MAPPING = "dataset_summary.pkl", "dataset_mapping.pkl"
ROUTE_SAMPLE_STEPS = 2  # the route looks at the ego every 0.2 s
CACHED_LOGS = 2


@dataclass(frozen=True)
class Motion:
    """What moves in one log, every 0.1 s."""

    ego_states: Array  # (S, 11), NaN where the log has no continuous drive
    segment: NDArray[np.int64]  # (S,) number of the continuous drive a step belongs to, -1: none
    agents: AgentTracks  # S steps


@dataclass(frozen=True)
class ScenarioLog:
    """One log, whole: what its windows are cut from."""

    file: str
    motion: Motion
    road_map: RoadMap
    route: Route
    finder: RouteFinder
    lights: TrafficLights  # S steps
    licence: str
    content_digest: str


class ScenarioNetReader:
    """Clips of one scenario pickle, of a folder of them, or of a ScenarioNet database folder.

    A log's id is its file's name without the suffix. Keeps the last two logs it read; workers get a reader without.
    """

    def __init__(
        self,
        root: str | Path,
        stride_s: float = 1.0,
        name: str = "scenarionet",
        min_top_speed_mps: float = 0.5,
    ) -> None:
        """name: the data set's name, part of every clip id. Raises ValueError for an impossible stride."""
        self.root = Path(root).expanduser().absolute()
        self.name = name
        self.windows = WindowSettings(stride_s=stride_s, min_top_speed_mps=min_top_speed_mps)
        self._stride_steps = self.windows.stride_steps
        self._logs: dict[str, ScenarioLog] = {}
        self._files: dict[str, Path] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_logs": {}}

    def index(self) -> ClipIndex:
        """All windows of all logs, ordered by log id and time. Raises ValueError where the root holds no scenario."""
        refs: list[ClipRef] = []
        dropped: Counter[str] = Counter()
        skipped: dict[str, str] = {}
        broken: dict[ClipRef, str] = {}
        for log_id, path in self._scenario_files().items():
            try:
                scenario, _ = read_scenario(path)
                motion = read_motion(scenario, str(path))
            except BadClip as error:
                broken[ClipRef(self.name, log_id, 0)] = str(error)
                continue
            driven = np.flatnonzero(motion.segment >= 0)  # the first window begins where the ego's drive does
            first, n_steps = (int(driven[0]), int(driven[-1] - driven[0]) + 1) if len(driven) else (0, 0)
            starts = window_starts(n_steps, self.windows)
            if not starts:
                skipped[log_id] = f"{n_steps * STEP_S:.1f} s of driving, a clip needs {CLIP_STEPS * STEP_S:.1f} s"
            for start in (first + offset for offset in starts):
                window = slice(start, start + CLIP_STEPS)
                segment = motion.segment[window]
                reason = drop_reason(
                    motion.ego_states[window],
                    motion.agents.window(window.start, window.stop),
                    (segment >= 0) & (segment == segment[0]),
                    self.windows,
                )
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
        if rest or start < 0 or stop > len(log.motion.segment):
            raise BadClip(log.file, "start_ms", f"no window of {ref.window} starts at {ref.start_ms} ms")
        ego_states = log.motion.ego_states[start:stop]
        if not np.isfinite(ego_states).all():
            raise BadClip(log.file, "tracks[sdc]", f"the ego's drive is broken within the window at {ref.start_ms} ms")
        clip = Clip(
            clip_id=ref.clip_id,
            dataset=self.name,
            log_id=ref.log_id,
            split=split_of(ref.log_id),
            start_s=start * STEP_S,
            ego_states=ego_states,
            world_from_ego=_flat_poses(ego_states),
            agents=_seen(log.motion.agents.window(start, stop)),
            road_map=log.road_map,
            route=log.route,
            centerline=log.finder.centerline_from(ego_states[NOW, :3]),
            lights=TrafficLights(log.lights.lane_ids, log.lights.states[start:stop]),
            licence=log.licence,
            content_digest=log.content_digest,
        )
        return validate_clip(clip, log.file)

    def _scenario_files(self) -> dict[str, Path]:
        if self._files is None:
            self._files = scenario_files(self.root)
        return self._files

    def _log(self, ref: ClipRef) -> ScenarioLog:
        if ref.log_id not in self._logs:
            path = self._scenario_files().get(ref.log_id)
            if path is None or ref.dataset != self.name:
                raise BadClip(str(self.root), "log_id", f"no log {ref.log_id} of data set {ref.dataset} here")
            log = read_log(path)
            while len(self._logs) >= CACHED_LOGS:
                del self._logs[next(iter(self._logs))]
            self._logs[ref.log_id] = log
        return self._logs[ref.log_id]


def scenario_files(root: Path) -> dict[str, Path]:
    """Log id -> pickle, sorted by id. Raises ValueError where the root is neither a pickle nor a folder with some.

    A database's own list counts, with files that are missing; a plain folder is searched for sd_*.pkl in all depths.
    """
    if root.is_file() and root.suffix == ".pkl":
        return {root.stem: root}
    if not root.is_dir():
        raise ValueError(f"{root}: no such folder or .pkl file")
    if (root / SUMMARY).is_file():
        paths = _listed(root)
    else:
        paths = sorted(root.rglob("sd_*.pkl"))
    files: dict[str, Path] = {}
    for path in paths:
        if path.stem in files:
            raise ValueError(f"{root}: {path.name} stands in two folders, {files[path.stem].parent} and {path.parent}")
        files[path.stem] = path
    if not files:
        raise ValueError(f"{root}: no scenario here; expected sd_*.pkl files, a database with {SUMMARY}, or one .pkl")
    return dict(sorted(files.items()))


def _listed(root: Path) -> list[Path]:
    """The database's scenarios by its summary and mapping. Merged databases point to folders beside their own."""
    try:
        summary = load_plain((root / SUMMARY).read_bytes(), str(root / SUMMARY))
        mapped = root / MAPPING
        mapping = load_plain(mapped.read_bytes(), str(mapped)) if mapped.is_file() else {}
    except BadClip as error:
        raise ValueError(str(error)) from error
    if not isinstance(summary, Mapping) or not isinstance(mapping, Mapping):
        raise ValueError(f"{root}: {SUMMARY} and {MAPPING} must hold dicts of file names")
    paths = []
    for name in summary:
        folder = mapping.get(name, "")
        if not _is_pickle_name(name) or not isinstance(folder, str) or PurePosixPath(folder).is_absolute():
            raise ValueError(f"{root}: {SUMMARY} or {MAPPING} names an impossible file {name!r} in {folder!r}")
        paths.append(root / folder / name)
    return paths


def _is_pickle_name(name: object) -> bool:
    return isinstance(name, str) and name.endswith(".pkl") and PurePosixPath(name).name == name


def read_scenario(path: Path) -> tuple[dict[str, Any], str]:
    """The scenario dict and the sha256 of its file. Raises BadClip naming the field that is missing."""
    file = str(path)
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise BadClip(file, "size", f"more than {MAX_FILE_BYTES} bytes")
        data = path.read_bytes()
    except OSError as error:
        raise BadClip(file, "file", f"cannot be read: {error}") from error
    scenario = load_plain(data, file)
    if not isinstance(scenario, dict):
        raise BadClip(file, "scenario", f"holds a {type(scenario).__name__}, not a dict")
    for name in ("metadata", "tracks", "map_features", "dynamic_map_states"):
        if not isinstance(scenario.get(name), dict):
            raise BadClip(file, name, "missing or not a dict")
    if not isinstance(scenario.get("length"), int | np.integer):
        raise BadClip(file, "length", "missing or not a number of frames")
    return scenario, hashlib.sha256(data).hexdigest()


def _source(scenario: Mapping[str, Any], file: str) -> tuple[str, Source]:
    name = scenario["metadata"].get("dataset")
    if not isinstance(name, str) or name not in SOURCES:
        problem = f"{name!r} is not supported; conversions of {', '.join(SOURCES)} are"
        raise BadClip(file, "metadata.dataset", problem)
    return name, SOURCES[name]


def read_motion(scenario: Mapping[str, Any], file: str) -> Motion:
    """Ego and agents of a scenario every 0.1 s. Raises BadClip."""
    n_frames, tracks = int(scenario["length"]), scenario["tracks"]
    _, source = _source(scenario, file)
    sdc_id = scenario["metadata"].get("sdc_id")
    if not isinstance(sdc_id, str | int) or sdc_id not in tracks:
        raise BadClip(file, "metadata.sdc_id", f"missing, or names no track: {sdc_id!r}")
    at = frame_positions(sample_times(scenario["metadata"], n_frames, file))
    ego = read_track(tracks, sdc_id, n_frames, file)
    states, segments = ego_segments(ego, source, at)
    segment = np.full(len(at), -1, np.int64)
    for number, (start, stop) in enumerate(segments):
        segment[start:stop] = number
    ground = ground_height(ego, at, file)
    return Motion(states, segment, agent_tracks(tracks, str(sdc_id), at, n_frames, ground, file))


def read_log(path: Path) -> ScenarioLog:
    """The whole log: motion, map, route, lights. Raises BadClip."""
    scenario, digest = read_scenario(path)
    file = str(path)
    motion = read_motion(scenario, file)
    name, source = _source(scenario, file)
    n_frames, metadata = int(scenario["length"]), scenario["metadata"]
    lights = traffic_lights(scenario["dynamic_map_states"], n_frames, file)
    lanes = road_map(scenario["map_features"], lights.lane_ids, name, str(metadata.get("map", "")), file)
    poses = motion.ego_states[motion.segment >= 0, :3]
    try:
        route = route_of_log(lanes, poses[::ROUTE_SAMPLE_STEPS])
    except NoRoute as error:
        raise BadClip(file, "map_features", str(error)) from error
    frames = np.floor(frame_positions(sample_times(metadata, n_frames, file)) + 1e-9).astype(int)
    known = [column for column, lane_id in enumerate(lights.lane_ids) if lane_id in lanes.lanes]
    return ScenarioLog(
        file=file,
        motion=motion,
        road_map=lanes,
        route=route,
        finder=RouteFinder(lanes, route),
        lights=TrafficLights(tuple(lights.lane_ids[c] for c in known), lights.states[frames][:, known]),
        licence=source.licence,
        content_digest=digest,
    )


def _flat_poses(ego_states: Array) -> Array:
    """(S, 4, 4) rear-axle poses on the plane z = 0, the road: the format's ego has no roll or pitch."""
    assert ego_states.shape[1] == EGO_STATE_SIZE
    poses = np.tile(np.eye(4), (len(ego_states), 1, 1))
    c, s = np.cos(ego_states[:, HEADING]), np.sin(ego_states[:, HEADING])
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = c, -s, s, c
    poses[:, 0, 3], poses[:, 1, 3] = ego_states[:, X], ego_states[:, Y]
    return poses


def _seen(agents: AgentTracks) -> AgentTracks:
    """Only the tracks that are present at one of the steps or more."""
    seen = np.flatnonzero(agents.valid.any(axis=0))
    return replace(
        agents,
        track_ids=tuple(agents.track_ids[i] for i in seen),
        kinds=tuple(agents.kinds[i] for i in seen),
        boxes=agents.boxes[:, seen],
        velocities=agents.velocities[:, seen],
        valid=agents.valid[:, seen],
        center_z=agents.center_z[:, seen],
        heights=agents.heights[seen],
    )

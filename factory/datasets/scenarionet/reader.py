"""Reads ScenarioNet's scenario pickles (Li et al. 2023) as clips: nuScenes, Waymo and nuPlan conversions.

A scenario is a dict: `metadata` (dataset, ts, sdc_id, map), `length`, `tracks`, `map_features`, `dynamic_map_states`.
There are no cameras and no lidar in it: a sidecar brings them (photos.py). A database folder lists its scenarios in
`dataset_summary.pkl` (file name -> metadata) and their folders in `dataset_mapping.pkl` (file name -> folder relative
to the database).
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from factory.datasets.scenarionet.map import road_map, traffic_lights
from factory.datasets.scenarionet.photos import NO_PHOTOGRAPHS, Photographs, in_step, read_photographs
from factory.datasets.scenarionet.settings import ScenarioNetClips
from factory.datasets.scenarionet.sidecars import load_sidecar, sidecars_of
from factory.datasets.scenarionet.tracks import (
    SOURCES,
    Source,
    agent_tracks,
    ego_segments,
    frame_positions,
    ground_height,
    read_track,
    sample_times,
)
from factory.files import matching_below
from factory.readers.apart import Apart
from factory.readers.base import BadClip, ClipIndex, ClipRef, bytes_of, folder_split, nuscenes_split, waymo_split
from factory.readers.logs import STEP_MS, LoggedDrive, LogReader, Recorded, WholeLog, present, route_of_drive, within
from factory.readers.pickles import id_text, load_plain
from factory.wording import shown
from tasks.world.arrays import Array
from tasks.world.clip import CLIP_STEPS, STEP_S, Block
from tasks.world.frames import upright
from tasks.world.road_map import TrafficLights

SUMMARY, MAPPING = "dataset_summary.pkl", "dataset_mapping.pkl"
# Of the stretches that are reconstructed: 20 s, as far apart as any clip still lies in one, so that a scene of
# nuScenes, 20 s and no more, is one.
BLOCK_STEPS = 200
GROUND_M = 0.0  # of the ego's frame, in sidecars and in the plane of the log: it stands on the road
BLOCK_STRIDE_STEPS = BLOCK_STEPS - CLIP_STEPS


@dataclass(frozen=True)
class ScenarioLog(WholeLog):
    """One log, whole, with the segments of its drive and what its sidecar brings."""

    motion: LoggedDrive
    photographs: Photographs = NO_PHOTOGRAPHS


class ScenarioNetReader(LogReader[ScenarioLog]):
    """Clips of one scenario pickle, of a folder of them, or of a ScenarioNet database folder.

    A log's id is its file's name without the suffix.
    """

    data_set = "scenarionet"
    untrusted = True
    length_is = "of driving"

    def __init__(
        self,
        root: str | Path,
        cameras: str | Path | None = ScenarioNetClips.cameras,
        sensor_root: str | Path | None = ScenarioNetClips.sensor_root,
        **windows: Any,
    ) -> None:
        """cameras: a log's sidecar or a folder of such, None: no photos; sensor_root: of what they name, None: theirs.

        windows: as of LogReader. Raises ValueError.
        """
        super().__init__(root, **windows)
        self.cameras, self.sensor_root = (
            None if path is None else Path(path).expanduser().absolute() for path in (cameras, sensor_root)
        )
        if self.sensor_root is not None and not self.sensor_root.is_dir():
            raise ValueError(f"clips.sensor_root={self.sensor_root}: no such folder")
        if self.sensor_root is not None and self.cameras is None:
            raise ValueError("clips.sensor_root goes with clips.cameras, which says what the photos below it show")

    @cached_property
    def _sidecars(self) -> dict[Path, Path]:
        """Pickle -> sidecar, of the logs that have one."""
        if self.cameras is None:
            return {}
        chosen = self._chosen()
        return {chosen[log_id]: path for log_id, path in sidecars_of(self.cameras, chosen).items()}

    @cached_property
    def _files(self) -> dict[str, Path]:
        return scenario_files(self.root)

    def logs(self) -> dict[str, Path]:
        """Log id -> pickle, listed once. Raises ValueError where the root holds no scenario."""
        return self._files

    def index(self) -> ClipIndex:
        """As of LogReader; sidecars are looked for before a scenario is opened, and once for all of them."""
        _ = self._sidecars
        return super().index()

    def drive(self, path: Path) -> LoggedDrive:
        """Ego and agents of the scenario in this file. Raises BadClip."""
        sidecars = self._sidecars
        scenario, _ = read_scenario(path)
        drive = read_motion(scenario, str(path))
        if path not in sidecars:
            return drive
        found = self._photographs(path, drive.ego_states)  # told here, once, what would fail each of its clips
        first = int(np.argmax(drive.segment >= 0))
        return replace(drive, earliest=in_step(found, first, len(drive.segment)))

    def load(self, path: Path) -> ScenarioLog:
        """The scenario in this file, with its photos. Raises BadClip."""
        log = read_log(path)
        if path not in self._sidecars:
            return log
        found = self._photographs(path, log.ego_states)
        return replace(log, photographs=found, content_digest=_digest(log.content_digest, found.data))

    def digest(self, ref: ClipRef) -> str:
        """The clip's content digest, from the bytes of its log's file and sidecar alone. Raises BadClip."""
        path = self.path_of(ref)
        digest = hashlib.sha256(bytes_of(path)).hexdigest()
        return _digest(digest, load_sidecar(self._sidecars[path])[1]) if path in self._sidecars else digest

    def block(self, ref: ClipRef) -> str | None:
        """Log and second at which the block begins that the clip is rendered from; None where the log has no photos."""
        if self.path_of(ref) not in self._sidecars:
            return None
        return f"{ref.log_id}@{_block_start(ref.start_ms // STEP_MS) * STEP_S:g}s"

    def recorded(self, log: ScenarioLog, start: int, stop: int) -> Recorded:
        """The ego's poses, photos and sweeps of a window. Raises BadClip where the ego's drive is broken."""
        ego_states = log.motion.ego_states[start:stop]
        if not np.isfinite(ego_states).all():
            raise BadClip(log.file, "tracks[sdc]", f"the ego's drive is broken in the window at {start * STEP_MS} ms")
        poses = upright(ego_states)  # the format's ego has no roll or pitch, its road is at z = 0
        found = log.photographs
        if not found.images:
            return Recorded(poses)
        sensed = within(found.images, start, stop), within(found.sweeps, start, stop)
        return Recorded(poses, found.cameras, *sensed, _block(log, start))

    def _photographs(self, path: Path, ego_states: Array) -> Photographs:
        sidecar = self._sidecars[path]
        return read_photographs(sidecar, self.sensor_root or sidecar.parent, ego_states)


def _block_start(start: int) -> int:
    """The step at which the block begins that a clip from step `start` on lies in."""
    return start // BLOCK_STRIDE_STEPS * BLOCK_STRIDE_STEPS


def _block(log: ScenarioLog, start: int) -> Block:
    first = _block_start(start)
    stop = min(first + BLOCK_STEPS, len(log.ego_states))
    sensed = within(log.photographs.images, first, stop), within(log.photographs.sweeps, first, stop)
    return Block(first * STEP_S, present(log.agents.window(first, stop)), *sensed, GROUND_M)


def _digest(scenario: str, sidecar: bytes) -> str:
    return hashlib.sha256(f"{scenario}\x1f{len(sidecar)}\x1f".encode() + sidecar).hexdigest()


def scenario_files(root: Path) -> dict[str, Path]:
    """Log id -> pickle, sorted by id. Raises ValueError where the root is neither a pickle nor a folder with some.

    A database's own list counts, with files that are missing; a plain folder is searched for sd_*.pkl in all depths.
    """
    if root.is_file() and root.suffix == ".pkl":
        return {root.stem: root}
    if not root.is_dir():
        raise ValueError(f"{root}: no such folder or .pkl file")
    files: dict[str, Path] = {}
    for path in _listed(root) if (root / SUMMARY).is_file() else matching_below(root, "sd_*.pkl"):
        if path.stem in files:
            raise ValueError(f"{root}: {path.name} stands in two folders, {files[path.stem].parent} and {path.parent}")
        files[path.stem] = path
    if not files:
        raise ValueError(f"{root}: no scenario here; expected sd_*.pkl files, a database with {SUMMARY}, or one .pkl")
    return dict(sorted(files.items()))


def _listed(root: Path) -> list[Path]:
    """The database's scenarios by its summary and mapping. Merged databases point to folders beside their own.

    Both are read as logs are, in another process: they are as much a stranger's.
    """
    summary, mapped = root / SUMMARY, root / MAPPING
    try:
        names = Apart(_names)(summary, str(summary))
        folders = Apart(_folders)(mapped, str(mapped)) if mapped.is_file() else {}
    except BadClip as error:
        raise ValueError(str(error)) from error
    return [root / folders.get(name, "") / name for name in names]


def _names(path: Path) -> list[str]:
    """File names that a summary describes. Raises BadClip."""
    names = _dict_in(path)
    for name in names:
        if not isinstance(name, str) or not name.endswith(".pkl") or PurePosixPath(name).name != name:
            raise BadClip(str(path), "name", f"an impossible file {shown(name)}")
    return list(names)


def _folders(path: Path) -> dict[str, str]:
    """File name -> its folder, by a mapping. Raises BadClip."""
    folders = _dict_in(path)
    for name, folder in folders.items():
        if not isinstance(folder, str) or PurePosixPath(folder).is_absolute():
            raise BadClip(str(path), "folder", f"an impossible file {shown(name)} in {shown(folder)}")
    return folders


def _dict_in(path: Path) -> dict[Any, Any]:
    found = load_plain(bytes_of(path), str(path))
    if not isinstance(found, dict):
        raise BadClip(str(path), "pickle", f"holds a {type(found).__name__}, expected a dict by file name")
    return found


def read_scenario(path: Path) -> tuple[dict[str, Any], str]:
    """The scenario dict and the sha256 of its file. Raises BadClip naming the field that is missing."""
    file, data = str(path), bytes_of(path)
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
        raise BadClip(
            file, "metadata.dataset", f"{shown(name)} is not supported; conversions of {', '.join(SOURCES)} are"
        )
    return name, SOURCES[name]


def read_motion(scenario: Mapping[str, Any], file: str) -> LoggedDrive:
    """Ego and agents of a scenario every 0.1 s. Raises BadClip."""
    n_frames, tracks = int(scenario["length"]), scenario["tracks"]
    _, source = _source(scenario, file)
    sdc_id = scenario["metadata"].get("sdc_id")
    named = id_text(sdc_id)
    if named is None or sdc_id not in tracks:
        raise BadClip(file, "metadata.sdc_id", f"missing, or names no track: {shown(sdc_id)}")
    at = frame_positions(sample_times(scenario["metadata"], n_frames, file))
    ego = read_track(tracks, sdc_id, n_frames, file)
    states, segment = ego_segments(ego, source, at)
    ground = ground_height(ego, at, file)
    return LoggedDrive(states, agent_tracks(tracks, named, at, n_frames, ground, file), segment)


def read_log(path: Path) -> ScenarioLog:
    """The whole log: motion, map, route, lights. Raises BadClip."""
    scenario, digest = read_scenario(path)
    file = str(path)
    motion = read_motion(scenario, file)
    name, source = _source(scenario, file)
    n_frames, metadata = int(scenario["length"]), scenario["metadata"]
    lights = traffic_lights(scenario["dynamic_map_states"], n_frames, file)
    lanes = road_map(scenario["map_features"], lights.lane_ids, name, id_text(metadata.get("map")) or "", file)
    route = route_of_drive(lanes, motion.ego_states[motion.segment >= 0, :3], file, "map_features")
    frames = np.floor(frame_positions(sample_times(metadata, n_frames, file)) + 1e-9).astype(int)
    known = [column for column, lane_id in enumerate(lights.lane_ids) if lane_id in lanes.lanes]
    return ScenarioLog(
        file=file,
        motion=motion,
        ego_states=motion.ego_states,
        agents=motion.agents,
        road_map=lanes,
        route=route,
        lights=TrafficLights(tuple(lights.lane_ids[c] for c in known), lights.states[frames][:, known]),
        licence=source.licence,
        content_digest=digest,
        split=folder_split(path) or nuscenes_split(path.stem) or waymo_split(metadata.get("source_file")),
    )

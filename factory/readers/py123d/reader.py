"""Reads what 123D converted as clips, without 123D."""

import hashlib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from factory.files import matching_below
from factory.readers.av2.log import LogMotion, step_times, world_from_ego_at
from factory.readers.av2.reader import BLOCK_STEPS, BLOCK_STRIDE_STEPS
from factory.readers.base import SPLITS, BadClip, ClipRef
from factory.readers.logs import STEP_MS, LoggedDrive, LogReader, Recorded, WholeLog, present, route_of_drive, within
from factory.readers.py123d.arrow import ArrowFile, check_version, open_metadata
from factory.readers.py123d.log import BOXES, EGO, LIGHTS, drive_of, lights_of, read_motion
from factory.readers.py123d.map import read_map
from factory.readers.py123d.sensors import camera_files, has_photos, read_rig, recorded_photos, recorded_sweeps
from factory.readers.py123d.sources import SOURCES, ConvertedSet
from factory.readers.settings import Py123dClips
from factory.wording import shown
from tasks.world.camera import Camera, SensorFile
from tasks.world.clip import STEP_S, Block

SYNC, MAP = "sync.arrow", "map.arrow"


@dataclass(frozen=True)
class Py123dLog(WholeLog):
    """One log, whole, with its rig and where its photos and sweeps lie; their times count from its first step."""

    motion: LogMotion
    cameras: tuple[Camera, ...]
    images: tuple[SensorFile, ...]
    sweeps: tuple[SensorFile, ...]


class Py123dReader(LogReader[Py123dLog]):
    """Clips of what 123D converted: of its data root, its `logs`, one split's folder, or one log.

    A log's id is its folder's name.
    """

    data_set = "py123d"

    def __init__(
        self,
        root: str | Path,
        maps_root: str | Path | None = Py123dClips.maps_root,
        sensor_root: str | Path | None = Py123dClips.sensor_root,
        **windows: Any,
    ) -> None:
        """maps_root: None: `maps` beside `logs`; sensor_root: of the data set itself, None: no photos and sweeps.

        windows: as of LogReader. Raises ValueError.
        """
        super().__init__(root, **windows)
        self.maps_root, self.sensor_root = (
            None if folder is None else Path(folder).expanduser().absolute() for folder in (maps_root, sensor_root)
        )
        if self.sensor_root is not None and not self.sensor_root.is_dir():
            raise ValueError(f"clips.sensor_root={self.sensor_root}: no such folder")

    @cached_property
    def _folders(self) -> dict[str, Path]:
        return log_folders(self.root)

    def logs(self) -> dict[str, Path]:
        """Log id -> folder, listed once. Raises ValueError where the root holds no log, or one name twice."""
        return self._folders

    def drive(self, path: Path) -> LoggedDrive | str:
        """Ego and agents of the log in this folder; or what it lacks. Raises BadClip."""
        header = open_header(path)
        source = source_of(header)
        for name in (EGO, BOXES):
            if not (path / name).is_file():
                return f"no {name}"
        if not source.has_lanes:
            return "its data set's maps have no lanes"
        if header.metadata.get("map_metadata") is None:
            return "converted without a map"
        map_file(header, self.maps_root)
        return drive_of(read_motion(path))

    def load(self, path: Path) -> Py123dLog:
        """The log in this folder. Raises BadClip."""
        return read_log(path, self.maps_root, self.sensor_root)

    def digest(self, ref: ClipRef) -> str:
        """The clip's content digest, from the bytes of its log's files alone. Raises BadClip."""
        return self.digest_with_others(ref, self.log_digest(self.path_of(ref)))

    def log_digest(self, path: Path) -> str:
        """sha256 of the log in this folder, but for pixels and points. Raises BadClip."""
        header = open_header(path)
        return content_digest(header, map_file(header, self.maps_root))

    def world(self, path: Path) -> str | None:
        """The map that the log shares with others; None where it has one of its own. Raises BadClip."""
        header = open_header(path)
        shares = not header.metadata["map_metadata"].get("map_is_per_log")
        return map_file(header, self.maps_root).stem if shares else None

    def block_steps(self, start: int) -> tuple[int, int]:
        """20 s that begin at a multiple of 10 s."""
        first = start // BLOCK_STRIDE_STEPS * BLOCK_STRIDE_STEPS
        return first, first + BLOCK_STEPS

    def block(self, ref: ClipRef) -> str | None:
        """Log and second at which the block begins that the clip is rendered from; None where there are no photos."""
        if self.sensor_root is None or not has_photos(self.path_of(ref)):
            return None
        first = ref.start_ms // STEP_MS // BLOCK_STRIDE_STEPS * BLOCK_STRIDE_STEPS
        return f"{ref.log_id}@{first * STEP_S:g}s"

    def recorded(self, log: Py123dLog, start: int, stop: int) -> Recorded:
        """Poses, rig, photos and sweeps of a window, and the block that it is rendered from."""
        poses = world_from_ego_at(log.motion, step_times(start, stop))
        sensed = within(log.images, start, stop), within(log.sweeps, start, stop)
        return Recorded(poses, log.cameras, *sensed, _block(log, start) if log.images else None)


def log_folders(root: Path) -> dict[str, Path]:
    """Log id -> folder, sorted by id. Raises ValueError where the root holds no log of 123D, or one name twice."""
    if not root.is_dir():
        raise ValueError(f"{root}: no such folder")
    above = root / "logs" if (root / "logs").is_dir() else root
    folders: dict[str, Path] = {}
    for folder in sorted(found.parent for found in matching_below(above, SYNC)):
        if folder.name in folders:
            raise ValueError(
                f"{root}: log {folder.name} stands in {folders[folder.name].parent.name} and {folder.parent.name}: "
                "give one split's folder as clips.root"
            )
        folders[folder.name] = folder
    if not folders:
        raise ValueError(f"{root}: no log of 123D here (a folder with {SYNC}); expected its data root, logs or a split")
    return dict(sorted(folders.items()))


def open_header(folder: Path) -> ArrowFile:
    """What the log says of itself, its version checked. Raises BadClip."""
    header = open_metadata(folder / SYNC)
    check_version(header)
    return header


def source_of(header: ArrowFile) -> ConvertedSet:
    """The data set that was converted. Raises BadClip for one that is not read."""
    name = header.value("dataset", str)
    if name not in SOURCES:
        raise BadClip(str(header.path), "metadata.dataset", f"{shown(name)} is not read; {', '.join(SOURCES)} are")
    return SOURCES[name]


def map_file(header: ArrowFile, maps_root: Path | None) -> Path:
    """The log's map, in its folder or among the maps of its data set. Raises BadClip where it is not there."""
    folder = header.path.parent
    told = header.metadata.get("map_metadata")
    if not isinstance(told, dict) or not isinstance(told.get("dataset"), str):
        raise BadClip(str(header.path), "metadata.map_metadata", "missing, or names no data set")
    if told.get("map_is_per_log"):
        paths = [folder / MAP]
    else:
        name = f"{told['dataset']}_{told.get('location')}.arrow"
        if Path(name).name != name:
            raise BadClip(str(header.path), "metadata.map_metadata", f"names an impossible file {shown(name)}")
        roots = [maps_root] if maps_root else [parent / "maps" for parent in folder.parents[1:4]]
        paths = [root / told["dataset"] / name for root in roots]
    found = next((path for path in paths if path.is_file()), None)
    if found is None:
        raise BadClip(str(paths[0]), "file", "the log's map is missing: convert it too, or give clips.maps_root")
    return found


def read_log(folder: Path, maps_root: Path | None = None, sensor_root: Path | None = None) -> Py123dLog:
    """The whole log, resampled to 0.1 s. Raises BadClip."""
    header = open_header(folder)
    source, path = source_of(header), map_file(header, maps_root)
    motion = read_motion(folder)
    drive = drive_of(motion)
    driven = drive.ego_states[drive.segment >= 0, :3]
    if not len(driven):
        raise BadClip(str(folder / EGO), "imu_se3", "no continuous drive")
    road_map = read_map(path, source, driven[:, :2])
    rig = read_rig(folder)
    return Py123dLog(
        file=str(folder),
        motion=motion,
        ego_states=drive.ego_states,
        agents=drive.agents,
        road_map=road_map,
        route=route_of_drive(road_map, driven, str(path), "lanes"),
        lights=lights_of(motion, road_map, step_times(0, motion.n_steps)),
        cameras=tuple(rig.values()),
        images=recorded_photos(motion, rig, sensor_root) if sensor_root else (),
        sweeps=recorded_sweeps(motion, sensor_root) if sensor_root else (),
        licence=source.licence,
        content_digest=content_digest(header, path),
        split=split_named(header.value("split", str)),
    )


def split_named(name: str) -> str | None:
    """train, val or test of 123D's `<data set>_<split>`; None for any other."""
    split = name.rpartition("_")[2]
    return split if split in SPLITS else None


def content_digest(header: ArrowFile, path: Path) -> str:
    """sha256 over what a clip is computed from: poses, boxes, lights, map, calibration; not pixels and points."""
    folder = header.path.parent
    digest = hashlib.sha256(repr(sorted(header.metadata.items())).encode())
    for file in (folder / EGO, folder / BOXES, folder / LIGHTS, path):
        if file.exists():
            stat = file.stat()
            digest.update(f"{file.name}\x1f{_digest_of(file, stat.st_size, stat.st_mtime_ns)}\x1f".encode())
    for file in camera_files(folder):
        digest.update(f"{file.name}\x1f{sorted(open_metadata(file).metadata.items())!r}\x1f".encode())
    return digest.hexdigest()


@lru_cache(maxsize=64)
def _digest_of(file: Path, _size: int, _mtime_ns: int) -> str:
    """sha256 of a file, computed once: clips of a log share its files, logs a city's map."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _block(log: Py123dLog, start: int) -> Block:
    """The block of the clip that starts at step `start`: 20 s that begin at a multiple of 10 s, so that it holds it."""
    first = start // BLOCK_STRIDE_STEPS * BLOCK_STRIDE_STEPS
    stop = min(first + BLOCK_STEPS, log.motion.n_steps)
    sensed = within(log.images, first, stop), within(log.sweeps, first, stop)
    return Block(first * STEP_S, present(log.agents.window(first, stop)), *sensed)

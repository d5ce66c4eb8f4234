"""Reads NAVSIM's logs (OpenScene: nuPlan at 2 Hz) with nuPlan's maps as clips.

A clip is 20 frames of a log, of which the fourth is T: 1.5 s before it and 8 s after. NAVSIM's scenes are named by T's
token too, but end 4 or 5 s after it. A scene filter only names windows of a log, so a clip takes the frames after its
scene's end from the log; where the log ends earlier, or has a gap, there is no clip, and the plan counts it.
"""

import hashlib
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from factory.datasets.navsim.filters import (
    ABSENT,
    Choice,
    FrameTable,
    Selection,
    kept_table,
    make_table,
    read_selection,
    table_of,
    usable,
    wanted_windows,
)
from factory.datasets.navsim.log import LogFrames, frames_of
from factory.datasets.navsim.maps import DOWNLOAD, file_digest, map_file
from factory.datasets.navsim.road import blobs_of, rig_of, road_around
from factory.datasets.navsim.tracks import (
    FRAMES_BEFORE,
    HORIZON_FRAMES,
    WINDOW_FRAMES,
    ego_states,
    lights,
    stretch_agents,
    window_agents,
    world_from_ego,
)
from factory.files import matching
from factory.readers.apart import Apart
from factory.readers.base import SPLITS, BadClip, ClipIndex, ClipRef, bytes_of, failing_as, split_of
from factory.readers.logs import (
    CACHED_LOGS,
    STEP_MS,
    DrivenPath,
    OtherDrive,
    Traversal,
    digest_with,
    joined,
    traversals,
)
from factory.readers.pickles import load_plain
from factory.readers.settings import NavsimClips
from factory.readers.validate import validate_clip
from factory.wording import time_text
from tasks.caches import user_cache
from tasks.world.clip import NOW, Block, Camera, Clip, SensorFile

LICENCE = "CC BY-NC-SA 4.0 (nuPlan via OpenScene)"
BLOCK_FRAMES, BLOCK_STRIDE_FRAMES = 40, 20  # of the stretches that are reconstructed
SPLIT_OF = {  # by how the name of the filter, or of the logs' folder, begins; others: by the hash of the log's id
    "navtrain": "train",
    "synthetic_reaction": "train",  # SimScale's, made of navtrain
    "navtest": "test",
    "navhard": "test",
    "navsafe": "test",
    "warmup": "test",
    "private_test": "test",
    "test": "test",
}
TELL_AFTER_S = 2.0  # how long opening logs may take before it is told


@dataclass(frozen=True)
class OpenLog:
    """One log, and what its clips share."""

    log: LogFrames
    table: FrameTable
    content_digest: str


class NavsimReader:
    """Clips of a folder of OpenScene logs: a `factory.readers.base.ClipReader`."""

    untrusted: ClassVar[bool] = True  # pickles: as of a LogReader

    def __init__(
        self,
        root: str | Path,
        maps: str | Path,
        sensors: str | Path | None = NavsimClips.sensors,
        scene_filter: str | None = NavsimClips.scene_filter,
        scene_filters: str | Path | None = NavsimClips.scene_filters,
        stride_s: float = NavsimClips.stride_s,
        name: str = "navsim",
        min_top_speed_mps: float = NavsimClips.min_top_speed_mps,
        first_window: int = NavsimClips.first_window,
        only: Sequence[str] = NavsimClips.only,
        split: str | None = NavsimClips.split,
        cache_dir: str | Path | None = NavsimClips.cache_dir,
        traversals: int = NavsimClips.traversals,
    ) -> None:
        """Arguments: see NavsimClips. Raises ValueError for what is no filter, stride or split."""
        if split is not None and split not in SPLITS:
            raise ValueError(f"clips.split={split} is none of {', '.join(SPLITS)}; null: by the filter and the folder")
        settings = NavsimClips(
            str(root), str(maps), stride_s=stride_s, first_window=first_window, traversals=traversals
        )
        self.traversals = settings.traversals
        self.root, self.maps = (Path(folder).expanduser().absolute() for folder in (root, maps))
        self.sensors = None if sensors is None else Path(sensors).expanduser().absolute()
        self.name, self.only, self.split = name, tuple(only), split
        self.selection: Selection | None = read_selection(scene_filter, scene_filters) if scene_filter else None
        self.choice = Choice(
            stride_frames=settings.stride_frames,
            first_frame=first_window * settings.stride_frames,
            min_top_speed_mps=min_top_speed_mps,
            scene_filter=self.selection.scene_filter if self.selection else None,
        )
        self.cache_dir = Path(cache_dir or user_cache() / "navsim").expanduser().absolute()
        self._logs: dict[str, OpenLog] = {}

    def __getstate__(self) -> dict[str, Any]:
        held = {**self.__dict__, "_logs": {}}
        held.pop("_paths", None)
        return held

    @cached_property
    def _paths(self) -> dict[str, Path]:
        return log_files(self.root)

    def logs(self) -> dict[str, Path]:
        """Log id -> pickle, of all under the root. Raises ValueError where there is none."""
        return self._paths

    def index(self) -> ClipIndex:
        """All windows that are clips, by log and time. Raises ValueError where the folders are not what they should."""
        if not self.maps.is_dir():
            raise ValueError(f"{self.maps}: no such folder; clips.maps has one folder a city: {DOWNLOAD}")
        if self.sensors is not None and not self.sensors.is_dir():
            raise ValueError(f"{self.sensors}: no such folder; clips.sensors=null reads clips without pictures")
        scenes = self.choice.scene_filter
        tokens = None if scenes is None or scenes.tokens is None else frozenset(scenes.tokens)
        if self.traversals:
            self._driven  # noqa: B018 - found once, before workers get the reader
        refs: list[ClipRef] = []
        dropped: Counter[str] = Counter()
        skipped: dict[str, str] = {}
        broken: dict[ClipRef, str] = {}
        found, found_tokens = 0, set[str]()
        cities: dict[str, BadClip | None] = {}  # what is wrong with the map of each
        for log_id, table in self._tables(self._chosen()):
            if isinstance(table, BadClip):
                broken[ClipRef(self.name, log_id, 0)] = str(table)
                continue
            wanted = wanted_windows(table, self.choice, tokens)
            if scenes is not None and scenes.max_scenes is not None:
                wanted = wanted[: max(scenes.max_scenes - found, 0)]
            if scenes is None and not wanted:
                skipped[log_id] = f"{len(table) * 0.5:.1f} s long, a clip needs {WINDOW_FRAMES * 0.5:.1f} s"
            found += len(wanted)
            found_tokens.update(table.tokens[wanted].tolist())
            if wanted and (no_map := self._no_map(table.location, cities)):
                broken[ClipRef(self.name, log_id, 0)] = str(no_map)
                continue
            kept, reasons = usable(table, wanted, self.choice)
            dropped += reasons
            start_ms = table.start_ms
            refs += [ClipRef(self.name, log_id, int(start_ms[now - FRAMES_BEFORE])) for now in kept]
        if cities and None not in cities.values():
            raise ValueError(" ".join(map(str, cities.values())))
        if tokens is not None and (absent := len(tokens - found_tokens)):
            if not found and not broken:
                raise ValueError(f"{self.root}: none of the scene filter's {len(tokens)} tokens is in the logs here")
            dropped[ABSENT] += absent
        return ClipIndex(tuple(refs), dict(dropped), skipped, broken)

    def read(self, ref: ClipRef) -> Clip:
        """The validated clip. Raises BadClip."""
        with failing_as(str(self._path_of(ref))):
            return self._read(ref)

    def _read(self, ref: ClipRef) -> Clip:
        opened = self._open(ref)
        frames, table = opened.log.frames, opened.table
        start = _frame_at(ref, table, opened.log.file)
        window, now = frames[start : start + WINDOW_FRAMES], start + FRAMES_BEFORE
        if any(frame.boxes is None for frame in window):
            raise BadClip(opened.log.file, f"frames[{start}].anns", "missing: nobody annotated the window")
        states = ego_states(window)
        road = road_around(self.maps, frames[now], states[:, :2], states[NOW, :3], opened.log.file, now)
        images: tuple[SensorFile, ...] = ()
        sweeps: tuple[SensorFile, ...] = ()
        cameras: tuple[Camera, ...] = ()
        block: Block | None = None
        if self.sensors is not None:
            blobs = blobs_of(window, self.sensors)
            if not blobs.images and not blobs.sweeps:
                problem = f"no picture of the frames {start} to {start + WINDOW_FRAMES - 1} of {ref.log_id} is here"
                raise BadClip(str(self.sensors), "blobs", f"{problem}; clips.sensors=null reads clips without pictures")
            images, sweeps = blobs.images, blobs.sweeps
            block = self._with_others(ref, self._block(opened, start))
            cameras = rig_of(frames[now], block.images, opened.log.file)
        clip = Clip(
            clip_id=ref.clip_id,
            dataset=self.name,
            log_id=ref.log_id,
            split=self.split_of(ref.log_id),
            start_s=ref.start_ms / 1000,
            ego_states=states,
            world_from_ego=world_from_ego(window),
            agents=window_agents(window),
            road_map=road.road_map,
            route=road.route,
            centerline=road.centerline,
            lights=lights(window, tuple(road.road_map.lanes)),
            cameras=cameras,
            images=images,
            sweeps=sweeps,
            block=block,
            licence=LICENCE,
            frame_tokens=(frames[now].token, frames[now + HORIZON_FRAMES].token),
            content_digest=digest_with(opened.content_digest, self._others(ref), self._log_digest),
        )
        return validate_clip(clip, opened.log.file)

    def digest(self, ref: ClipRef) -> str:
        """The clip's content digest, from the bytes of its log's file and of its city's map. Raises BadClip."""
        self._path_of(ref)
        return digest_with(self._log_digest(ref.log_id), self._others(ref), self._log_digest)

    def block(self, ref: ClipRef) -> str | None:
        """Log and second at which the block begins that the clip is rendered from; None without sensors."""
        if self.sensors is None:
            return None
        table, first, _ = self._block_of(ref)
        return f"{ref.log_id}@{table.start_ms[first] / 1000:g}s"

    def split_of(self, log_id: str) -> str:
        """train, val or test: as the settings say, else by the filter's name, the folder's, the log's hash."""
        if self.split is not None:
            return self.split
        folder = self.root.parent if self.root.suffix == ".pkl" else self.root
        names = [self.selection.name] if self.selection else []
        for name in (*names, folder.name):
            for begins, split in SPLIT_OF.items():
                if name.startswith(begins):
                    return split
        return split_of(log_id)

    def _chosen(self) -> dict[str, Path]:
        """The logs that the settings and the scene filter name. Raises ValueError where none of them is here."""
        logs = self.logs()
        if unknown := [log_id for log_id in self.only if log_id not in logs]:
            raise ValueError(f"clips.only: no log {', '.join(unknown)} under {self.root}; there are {', '.join(logs)}")
        chosen = {log_id: logs[log_id] for log_id in logs if not self.only or log_id in self.only}
        named = self.choice.scene_filter.log_names if self.choice.scene_filter else None
        if named is None:
            return chosen
        wanted = frozenset(named)
        chosen = {log_id: path for log_id, path in chosen.items() if log_id in wanted}
        if not chosen:
            raise ValueError(f"{self.root}: none of the {len(wanted)} logs that the scene filter names is here")
        return chosen

    def _tables(self, logs: Mapping[str, Path]) -> Iterable[tuple[str, FrameTable | BadClip]]:
        """The table of each log, or what is wrong with it; what takes long is told on stderr."""
        began, made, told = time.monotonic(), 0, 0.0
        made_apart = Apart(partial(make_table, cache_dir=self.cache_dir))
        for i, (log_id, path) in enumerate(logs.items(), start=1):
            try:
                with failing_as(str(path)):
                    table = kept_table(path, self.cache_dir)
                    if table is None:
                        table = made_apart(path, str(path))
                        made += 1
            except BadClip as error:
                yield log_id, error
                continue
            took = time.monotonic() - began
            if made and took - told > TELL_AFTER_S:
                left = time_text(took / made * (len(logs) - i))
                print(f"navsim: log {i} of {len(logs)} listed, once for all runs  ETA {left}", file=sys.stderr)
                told = took
            yield log_id, table

    def _no_map(self, location: str, cities: dict[str, BadClip | None]) -> BadClip | None:
        """What is wrong with the place of a city's map, looked up once a plan; None: it is there."""
        if location not in cities:
            try:
                map_file(self.maps, location)
                cities[location] = None
            except BadClip as error:
                cities[location] = error
        return cities[location]

    def _path_of(self, ref: ClipRef) -> Path:
        path = self.logs().get(ref.log_id)
        if path is None or ref.dataset != self.name:
            raise BadClip(str(self.root), "log_id", f"no log {ref.log_id} of data set {ref.dataset} here")
        return path

    def _open(self, ref: ClipRef) -> OpenLog:
        if ref.log_id not in self._logs:
            path = self._path_of(ref)
            data = bytes_of(path)
            log = frames_of(load_plain(data, str(path)), path)
            table = table_of(log)
            opened = OpenLog(log, table, _digest(data, map_file(self.maps, table.location)))
            self._logs = dict([*self._logs.items(), (ref.log_id, opened)][-(CACHED_LOGS + self.traversals) :])
        return self._logs[ref.log_id]

    def _table(self, path: Path) -> FrameTable:
        return kept_table(path, self.cache_dir) or make_table(path, self.cache_dir)

    def _log_digest(self, log_id: str) -> str:
        path = self.logs()[log_id]
        return _digest(bytes_of(path), map_file(self.maps, self._table(path).location))

    def _block_of(self, ref: ClipRef) -> tuple[FrameTable, int, int]:
        """The log's table, and the frames first..stop-1 of the block that the clip is rendered from. Raises BadClip."""
        path = self._path_of(ref)
        table = self._table(path)
        return table, *_block_frames(table, _frame_at(ref, table, str(path)))

    @cached_property
    def _driven(self) -> dict[str, DrivenPath]:
        """Where the logs' egos were, of those that can be read."""
        tables = ((log_id, table) for log_id, table in self._tables(self._chosen()) if isinstance(table, FrameTable))
        return {
            log_id: DrivenPath(table.location, table.start_ms // STEP_MS, np.stack([table.x_m, table.y_m], axis=1))
            for log_id, table in tables
        }

    def _others(self, ref: ClipRef) -> tuple[Traversal, ...]:
        """The other drives that the block of a clip is made of as well."""
        if not self.traversals or self.sensors is None or ref.log_id not in self._driven:
            return ()
        table, first, stop = self._block_of(ref)
        steps = table.start_ms // STEP_MS
        return traversals(self._driven, ref.log_id, int(steps[first]), int(steps[stop - 1]) + 1, self.traversals)

    def _with_others(self, ref: ClipRef, block: Block) -> Block:
        assert self.sensors is not None
        others = []
        for other in self._others(ref):
            opened = self._open(replace(ref, log_id=other.log_id))
            steps, stretch = opened.table.start_ms // STEP_MS, opened.table.stretch
            inside = np.flatnonzero((steps >= other.start) & (steps < other.stop))
            inside = inside[stretch[inside] == stretch[inside[0]]]
            frames = opened.log.frames[inside[0] : inside[-1] + 1]
            blobs = blobs_of(frames, self.sensors)
            if blobs.images or blobs.sweeps:
                cameras = rig_of(frames[len(frames) // 2], blobs.images, opened.log.file)
                others.append(OtherDrive(other.log_id, stretch_agents(frames), cameras, blobs.images, blobs.sweeps))
        return joined(block, others) if others else block

    def _block(self, opened: OpenLog, start: int) -> Block:
        """Up to 20 s that begin at a multiple of 10 s of the stretch and hold the window."""
        assert self.sensors is not None
        first, stop = _block_frames(opened.table, start)
        frames = opened.log.frames[first:stop]
        blobs = blobs_of(frames, self.sensors)
        start_s = float(opened.table.start_ms[first]) / 1000
        return Block(start_s, stretch_agents(frames), blobs.images, blobs.sweeps)


def log_files(root: Path) -> dict[str, Path]:
    """Log id -> pickle, sorted by id: of one log, or of a folder of them. Raises ValueError where there is none."""
    if root.is_file() and root.suffix == ".pkl":
        return {root.stem: root}
    if not root.is_dir():
        raise ValueError(f"{root}: no such folder or .pkl file; clips.root is navsim_logs/<split>, or one log of it")
    files = {path.stem: path for path in matching(root, "*.pkl")}
    if not files:
        splits = [path.parent.name for path in matching(root, "*/*.pkl")]
        hint = f"; its folders {', '.join(dict.fromkeys(splits))} have some" if splits else ""
        raise ValueError(f"{root}: no log here; expected <log>.pkl files, as in navsim_logs/<split>{hint}")
    return files


def _digest(log: bytes, city: Path) -> str:
    return hashlib.sha256(hashlib.sha256(log).digest() + bytes.fromhex(file_digest(city))).hexdigest()


def _frame_at(ref: ClipRef, table: FrameTable, file: str) -> int:
    """The frame at which the clip begins. Raises BadClip where none begins there, or it would leave its stretch."""
    (found,) = np.nonzero(table.start_ms == ref.start_ms)
    start = int(found[0]) if len(found) else -1
    stretch = table.stretch
    if start < 0 or start + WINDOW_FRAMES > len(table) or stretch[start] != stretch[start + WINDOW_FRAMES - 1]:
        raise BadClip(file, "start_ms", f"no window of {ref.window} starts at {ref.start_ms} ms")
    return start


def _block_frames(table: FrameTable, start: int) -> tuple[int, int]:
    """The frames first..stop-1 of the block of the window that begins at frame `start`."""
    (stretch,) = np.nonzero(table.stretch == table.stretch[start])
    first = int(stretch[0]) + (start - int(stretch[0])) // BLOCK_STRIDE_FRAMES * BLOCK_STRIDE_FRAMES
    return first, min(first + BLOCK_FRAMES, int(stretch[-1]) + 1)

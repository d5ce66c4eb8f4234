"""Reads NAVSIM's logs (OpenScene: nuPlan at 2 Hz) with nuPlan's maps as clips.

A clip is 20 frames of a log, of which the fourth is T: 1.5 s before it and 8 s after. NAVSIM's scenes are named by T's
token too, but end 4 or 5 s after it. A scene filter only names windows of a log, so a clip takes the frames after its
scene's end from the log; where the log ends earlier, or has a gap, there is no clip, and the plan counts it.
"""

import hashlib
import io
import logging
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from factory.datasets.navsim.log import Frame, LogFrames, parse_frames, read_frames
from factory.datasets.navsim.maps import DOWNLOAD, map_file
from factory.datasets.navsim.settings import NavsimClips
from factory.datasets.navsim.window import (
    FRAMES_BEFORE,
    HORIZON_FRAMES,
    WINDOW_FRAMES,
    cameras_with_pictures,
    ego_states,
    repaired_frames,
    repairs_from,
    road_around,
    sensor_files,
    stretch_agents,
    traffic_lights,
    window_agents,
    world_from_ego,
)
from factory.files import broken_link, file_digest, matching, named_once, why_unread
from factory.readers.apart import ProcessFunction
from factory.readers.base import (
    SPLITS,
    BadClip,
    ClipIndex,
    ClipRef,
    bytes_of,
    failures_as_bad_clip,
    split_of,
    validate_clip,
)
from factory.readers.logs import (
    CACHED_LOGS,
    STEP_MS,
    DrivenPath,
    OtherDrive,
    Traversal,
    digest_with,
    traversals,
    with_other_drives,
)
from factory.readers.pickles import check_values, load_plain
from factory.wording import listed, shown, time_text
from tasks.caches import user_cache, with_checksum, without_checksum
from tasks.kernels.compiled import write_whole
from tasks.world.arrays import Array, Bools, Ints
from tasks.world.clip import NOW, Block, Camera, Clip, SensorFile
from tasks.world.repair.records import later
from tasks.world.repair.road import lights_on_map
from tasks.world.repair.tracks import Repairs, articulated

# NAVSIM's scene filters and splits: the YAML files that name which windows of which logs count.
#
# Fields and defaults are those of `SceneFilter` (autonomousvision/navsim @ 0a380a9, navsim/common/dataclasses.py); a
# key that it has not is refused, as there. YAML is data: no tag builds an object. Both kinds of file are found by
# path, or by name in a folder such as the public `config/common/train_test_split`.

MAX_YAML_BYTES = 64 << 20
TARGET = "navsim.common.dataclasses.SceneFilter"
SUBFOLDER = "scene_filter"  # of a folder of splits
_HYDRA_KEYS = frozenset({"_target_", "_convert_"})
_SPLIT_KEYS = frozenset({"defaults", "data_split", "reactive_all_mapping", "two_stage_mapping"})
_COUNTS = {"num_history_frames": 1, "num_future_frames": 0, "frame_interval": 1, "max_scenes": 0}  # the least of each
_FLAGS = ("has_route", "include_synthetic_scenes")


@dataclass(frozen=True)
class SceneFilter:
    """Which windows of 2 Hz frames are scenes."""

    num_history_frames: int = 4  # the current one among them
    num_future_frames: int = 10
    frame_interval: int | None = None  # between the starts of two windows; None: they do not overlap
    has_route: bool = True  # only where roadblock ids are known at the current frame
    max_scenes: int | None = None
    log_names: tuple[str, ...] | None = None  # None: every log
    tokens: tuple[str, ...] | None = None  # of current frames; None: every one
    include_synthetic_scenes: bool = False
    all_mapping: Any = None  # declared, read by nobody
    synthetic_scene_tokens: tuple[str, ...] | None = None  # initial tokens of scenes of the second stage
    reactive_synthetic_initial_tokens: tuple[str, ...] | None = None
    non_reactive_synthetic_initial_tokens: tuple[str, ...] | None = None

    @property
    def num_frames(self) -> int:
        """Of a window."""
        return self.num_history_frames + self.num_future_frames

    @property
    def stride_frames(self) -> int:
        """Between the starts of two windows."""
        return self.frame_interval or self.num_frames


@dataclass(frozen=True)
class Selection:
    """A scene filter, and what the split that names it says besides."""

    name: str  # of the file, without its suffix
    scene_filter: SceneFilter
    data_split: str | None = None  # folder of the logs, as in navsim_logs/<data_split>
    reactive_all_mapping: tuple[Any, ...] | None = None  # [now, previous, [[now, previous], ...]] of two-stage scenes


def read_selection(name: str, folder: str | Path | None = None) -> Selection:
    """The scene filter or split called `name`: a path of a .yaml file, or a name in `folder`.

    Raises ValueError where it is not there, or a key or value is wrong.
    """
    path = _find(name, folder)
    content = _mapping(path)
    if "data_split" not in content and "defaults" not in content:
        return Selection(path.stem, scene_filter_of(content, str(path)))
    _refuse_unknown(content, _SPLIT_KEYS, str(path))
    data_split, mapping = content.get("data_split"), content.get("reactive_all_mapping")
    if not isinstance(data_split, str):
        raise ValueError(f"{path}: data_split: expected the name of a folder of logs, not {shown(data_split)}")
    if mapping is not None and not isinstance(mapping, list):
        raise ValueError(f"{path}: reactive_all_mapping: expected a list, not a {type(mapping).__name__}")
    defaults = content.get("defaults")
    entries = [entry for entry in defaults if isinstance(entry, dict)] if isinstance(defaults, list) else []
    names = [entry[SUBFOLDER] for entry in entries if isinstance(entry.get(SUBFOLDER), str)]
    if len(names) != 1 or "/" in names[0]:
        raise ValueError(f"{path}: defaults: expected one entry `- scene_filter: <name>`")
    filter_path = path.parent / SUBFOLDER / f"{names[0]}.yaml"
    scene_filter = scene_filter_of(_mapping(filter_path), str(filter_path))
    return Selection(path.stem, scene_filter, data_split, None if mapping is None else tuple(mapping))


def scene_filter_of(content: Mapping[str, Any], file: str) -> SceneFilter:
    """A scene filter of what a YAML file held. Raises ValueError naming file and key."""
    known = frozenset(field.name for field in fields(SceneFilter))
    _refuse_unknown(content, known | _HYDRA_KEYS, file)
    if content.get("_target_", TARGET) != TARGET:
        raise ValueError(f"{file}: _target_: {shown(content['_target_'])} is no scene filter, expected {TARGET}")
    checked: dict[str, Any] = {}
    for key, value in content.items():
        if key in _HYDRA_KEYS or (value is None and key not in ("num_history_frames", "num_future_frames", *_FLAGS)):
            continue
        if key in _COUNTS:
            least, most = _COUNTS[key], 10**9
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                problem = f"expected a whole number from {least} to {most:,}, not {shown(value)}"
                raise ValueError(f"{file}: {key}: {problem}")
            checked[key] = value
        elif key in _FLAGS:
            if not isinstance(value, bool):
                raise ValueError(f"{file}: {key}: expected true or false, not {shown(value)}")
            checked[key] = value
        elif key == "all_mapping":
            checked[key] = value
        else:
            if not isinstance(value, list):
                raise ValueError(f"{file}: {key}: expected a list of text, not a {type(value).__name__}")
            if odd := [item for item in value if not isinstance(item, str)]:
                raise ValueError(f"{file}: {key}: {shown(odd[0])} is no text: put it in quotes")
            checked[key] = tuple(value)
    return SceneFilter(**checked)


def _find(name: str, folder: str | Path | None) -> Path:
    if name.endswith((".yaml", ".yml")):
        path = Path(name).expanduser()
        if not path.is_file():
            raise ValueError(f"{path}: no such file")
        return path
    if folder is None:
        raise ValueError(f"scene filter {name!r}: say in which folder it is, or give the path of its .yaml file")
    parent = Path(folder).expanduser()
    for path in (parent / f"{name}.yaml", parent / SUBFOLDER / f"{name}.yaml"):
        if path.is_file():
            return path
    there = sorted({path.stem for pattern in ("*.yaml", f"{SUBFOLDER}/*.yaml") for path in matching(parent, pattern)})
    raise ValueError(f"{parent}: no {name}.yaml here or in {SUBFOLDER}/; there are {', '.join(there) or 'none'}")


def _mapping(path: Path) -> dict[str, Any]:
    """What a YAML file holds, read as logs are, in another process. Raises ValueError."""
    try:
        return ProcessFunction(_read)(path, str(path))
    except BadClip as error:
        raise ValueError(str(error)) from error


def _read(path: Path) -> dict[str, Any]:
    """What a YAML file holds. Raises ValueError."""
    import yaml  # here alone: a filter is read by those who have one

    try:
        if path.stat().st_size > MAX_YAML_BYTES:
            raise ValueError(f"{path}: more than {MAX_YAML_BYTES} bytes")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: no text in UTF-8: {error}") from error
    base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same rules, ten times as fast

    class _TextKeysLoader(base):
        """Keys are texts: integers can share one hash, and merges (<<) of merges grow without end."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            if any(key.tag != "tag:yaml.org,2002:str" for key, _ in node.value):
                raise yaml.constructor.ConstructorError(None, None, "a key that is no text", node.start_mark)
            return super().construct_mapping(node, deep)

    try:
        content = yaml.load(text, _TextKeysLoader)  # noqa: S506 - a safe loader
    except (yaml.YAMLError, RecursionError, ValueError) as error:  # a date or a number that is none
        raise ValueError(f"{path}: no YAML of plain values: {' '.join(str(error).split())}") from error
    check_values(content, len(text), str(path), "YAML")
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ValueError(f"{path}: expected keys and values, found a {type(content).__name__}")
    return content


def _refuse_unknown(content: Mapping[str, Any], known: frozenset[str], file: str) -> None:
    if unknown := sorted(content.keys() - known):
        raise ValueError(f"{file}: unknown key {listed(unknown)}; known: {', '.join(sorted(known))}")


# Which windows of a folder of logs are clips, found without opening the logs again.
#
# A log of OpenScene takes a second to open, and navtrain names 1,192 of them. So what the choice needs is kept, a
# small table a log, in the user's cache; it is made again where the log's size or time of change is another.

TABLE_VERSION = 8  # of the tables kept
FRAME_S, SLACK_S = 0.5, 0.05  # between two frames; more or less is a gap
GAP, SHORT_HISTORY, SHORT_FUTURE = "gap_in_frames", "short_history", "short_future"
NO_ROUTE, NO_BOXES, STANDING, ABSENT = "no_route", "not_annotated", "ego_standing", "absent_token"
UNREADABLE = "unreadable_frame"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FrameTable:
    """What the choice of windows needs of the F frames of one log."""

    tokens: NDArray[np.str_]  # (F,)
    timestamps_us: Ints  # (F,)
    has_route: Bools  # (F,)
    annotated: Bools  # (F,)
    unreadable: NDArray[np.str_]  # (F,) why a frame cannot be read; empty: it can
    speeds: NDArray[np.float32]  # (F,) of the ego [m/s]
    locations: NDArray[np.str_]  # (F,) the city, the same in all frames
    x_m: Array  # (F,) of the rear axle on the city's map
    y_m: Array  # (F,)

    @property
    def location(self) -> str:
        """The city that the log drives in."""
        return str(self.locations[0])

    def __len__(self) -> int:
        return len(self.tokens)

    @property
    def stretch(self) -> Ints:
        """(F,) number of the unbroken stretch of frames 0.5 s apart that a frame belongs to."""
        return np.append(0, np.cumsum(np.abs(np.diff(self.timestamps_us) * 1e-6 - FRAME_S) > SLACK_S))

    @property
    def start_ms(self) -> Ints:
        """(F,) milliseconds since the log's first frame, on the clock of clips: 500 a frame within a stretch."""
        stretch, out = self.stretch, np.zeros(len(self), np.int64)
        for number in range(int(stretch[-1]) + 1):
            frames = np.flatnonzero(stretch == number)
            begins = round(float(self.timestamps_us[frames[0]] - self.timestamps_us[0]) / 1000)
            if number:
                begins = max(begins, int(out[frames[0] - 1]) + 501)  # never where the one before still is
            out[frames] = begins + 500 * np.arange(len(frames))
        return out


@dataclass(frozen=True)
class WindowChoice:
    """Which windows are wanted."""

    stride_frames: int = 1  # between two, where no scene filter names them
    first_frame: int = 0  # of each log; windows that begin before it are skipped
    min_top_speed_mps: float = 0.0  # an ego that never reaches it stands
    scene_filter: SceneFilter | None = None  # its scenes, whatever the stride and the speed


def frame_table(log: LogFrames) -> FrameTable:
    """The table of a log that is open."""
    frames = log.frames
    return FrameTable(
        tokens=np.array([frame.token for frame in frames]),
        timestamps_us=np.array([frame.timestamp_us for frame in frames], np.int64),
        has_route=np.array([bool(frame.roadblock_ids) for frame in frames]),
        annotated=np.array([frame.boxes is not None for frame in frames]),
        unreadable=np.array([frame.unreadable for frame in frames], np.str_),
        speeds=np.array([np.hypot(*frame.dynamic_state[:2]) for frame in frames], np.float32),
        locations=np.array([frame.map_location for frame in frames]),
        x_m=np.array([frame.pose[0] for frame in frames], np.float64),
        y_m=np.array([frame.pose[1] for frame in frames], np.float64),
    )


def cached_table(path: Path, cache_dir: Path) -> FrameTable | None:
    """The table of the log at `path`, if one was kept of just this file. Raises BadClip where there is no such file."""
    try:
        kept = _kept(path, cache_dir)
        data = without_checksum(kept.read_bytes(), kept.name)
        rows = np.load(io.BytesIO(data), allow_pickle=False)
        return FrameTable(*(rows[column.name] for column in fields(FrameTable)))
    except FileNotFoundError:
        return None
    except (ValueError, OSError, IndexError) as error:  # Damaged among them
        log.warning("%s: %s; made again of %s", _kept(path, cache_dir), error, path)
        return None


def cached_or_read_table(path: Path) -> FrameTable:
    """The table of the log at `path`; one that was not kept is made in another process. Raises BadClip."""
    cache_dir = user_cache() / "navsim"
    made_apart = ProcessFunction(partial(read_and_cache_table, cache_dir=cache_dir))
    return cached_table(path, cache_dir) or made_apart(path, str(path))


def read_and_cache_table(path: Path, cache_dir: Path) -> FrameTable:
    """The table of the log at `path`, read and kept. Raises BadClip."""
    table = frame_table(read_frames(path, whole=False))
    cache_table(table, path, cache_dir)
    return table


def cache_table(table: FrameTable, path: Path, cache_dir: Path) -> None:
    """Keeps the table of the log at `path`, for as long as that file is as it is. Raises BadClip, OSError."""
    columns: dict[str, NDArray[Any]] = {**vars(table)}
    rows = np.zeros(len(table), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    data = io.BytesIO()
    np.save(data, rows, allow_pickle=False)
    cache_dir.mkdir(parents=True, exist_ok=True)
    kept = _kept(path, cache_dir)
    write_whole(kept, with_checksum(data.getvalue(), kept.name))


def _kept(path: Path, cache_dir: Path) -> Path:
    try:
        stat = path.stat()
    except OSError as error:
        raise BadClip(str(path), "file", f"cannot be read: {why_unread(path, error)}") from error
    key = f"{TABLE_VERSION}\x1f{path}\x1f{stat.st_size}\x1f{stat.st_mtime_ns}"
    return cache_dir / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npy"


def wanted_windows(table: FrameTable, choice: WindowChoice, tokens: Collection[str] | None) -> list[int]:
    """The frame T of every window that is wanted, in order, whether or not it can be a clip.

    tokens: of the scene filter, as a set; None: it names none. A window of a scene filter is the public loader's
    (navsim/common/dataloader.py:24-73): it fits the log, it has a route if it must, and gaps do not matter to it.
    """
    scenes = choice.scene_filter
    if scenes is None:
        starts = range(choice.first_frame, len(table) - WINDOW_FRAMES + 1, choice.stride_frames)
        return [start + FRAMES_BEFORE for start in starts]
    starts = range(0, len(table) - scenes.num_frames + 1, scenes.stride_frames)
    now = np.array(starts, np.int64) + scenes.num_history_frames - 1
    if scenes.has_route:
        now = now[table.has_route[now]]
    if tokens is not None:
        now = now[[str(token) in tokens for token in table.tokens[now]]]
    return [int(frame) for frame in now]


def scene_frames(chosen: SceneFilter, logs: Mapping[str, Path]) -> Iterator[tuple[Path, FrameTable, list[int]]]:
    """Log by log of those that the filter names: its table, and the frames T of the scenes there. Raises BadClip."""
    tokens, left = None if chosen.tokens is None else frozenset(chosen.tokens), chosen.max_scenes
    for name, path in logs.items():
        if chosen.log_names is None or name in chosen.log_names:
            table = cached_or_read_table(path)
            frames = wanted_windows(table, WindowChoice(scene_filter=chosen), tokens)[:left]
            left = None if left is None else left - len(frames)
            yield path, table, frames


def usable_windows(table: FrameTable, windows: list[int], choice: WindowChoice) -> tuple[list[int], Counter[str]]:
    """Those windows that are clips, and how many are not, by reason."""
    kept: list[int] = []
    dropped: Counter[str] = Counter()
    stretch = table.stretch
    for now in windows:
        first, stop = now - FRAMES_BEFORE, now - FRAMES_BEFORE + WINDOW_FRAMES
        if first < 0:
            dropped[SHORT_HISTORY] += 1
        elif stop > len(table):
            dropped[SHORT_FUTURE] += 1
        elif stretch[first] != stretch[stop - 1]:
            dropped[GAP] += 1
        elif (table.unreadable[first:stop] != "").any():
            dropped[UNREADABLE] += 1
        elif not table.has_route[now]:
            dropped[NO_ROUTE] += 1
        elif not table.annotated[first:stop].all():
            dropped[NO_BOXES] += 1
        elif choice.scene_filter is None and table.speeds[first:stop].max() < choice.min_top_speed_mps:
            dropped[STANDING] += 1
        else:
            kept.append(now)
    return kept, dropped


LICENCE = "CC BY-NC-SA 4.0 (nuPlan via OpenScene)"
BLOCK_FRAMES, BLOCK_STRIDE_FRAMES = 40, 20  # of the stretches that are reconstructed
FRAMES_AROUND = 4  # of a block: as many tell a thing's usual speed, and what lies elsewhere for a frame or two
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
    blocks: dict[int, tuple[tuple[Frame, ...], Repairs]] = field(default_factory=dict)  # repaired, by their first frame

    def repaired(self, first: int, stop: int) -> tuple[tuple[Frame, ...], Repairs]:
        """The frames first..stop-1 as of `repaired_frames`, seen with those around them."""
        (stretch,) = np.nonzero(self.table.stretch == self.table.stretch[first])
        begin = max(first - FRAMES_AROUND, int(stretch[0]))
        end = min(stop + FRAMES_AROUND, int(stretch[-1]) + 1)
        return repaired_frames(self.log.frames[begin:end], first - begin, stop - begin)

    def repaired_block(self, start: int) -> tuple[int, tuple[Frame, ...], Repairs]:
        """First frame, frames and repairs of the block of the window that begins at frame `start`, repaired once."""
        first, stop = _block_frames(self.table, start)
        if first not in self.blocks:
            self.blocks[first] = self.repaired(first, stop)
        return first, *self.blocks[first]


class NavsimReader:
    """Clips of a folder of OpenScene logs: a `factory.readers.base.ClipReader`."""

    untrusted: ClassVar[bool] = True  # pickles: as of a LogReader

    def __init__(self, root: str | Path, maps: str | Path, name: str = "navsim", **settings: Any) -> None:
        """settings: the others of NavsimClips. Raises ValueError for what is no filter, stride or split."""
        given = NavsimClips(str(root), str(maps), **settings)
        if given.split is not None and given.split not in SPLITS:
            known = ", ".join(SPLITS)
            raise ValueError(f"clips.split={given.split} is none of {known}; null: by the filter and the folder")
        self.name, self.only, self.split, self.traversals = name, tuple(given.only), given.split, given.traversals
        self.root, self.maps = (Path(folder).expanduser().absolute() for folder in (root, maps))
        self.sensors = None if given.sensors is None else Path(given.sensors).expanduser().absolute()
        self.filter_name = f"the scene filter {given.scene_filter}"
        self.selection = read_selection(given.scene_filter, given.scene_filters) if given.scene_filter else None
        self.choice = WindowChoice(
            stride_frames=given.stride_frames,
            first_frame=given.first_window * given.stride_frames,
            min_top_speed_mps=given.min_top_speed_mps,
            scene_filter=self.selection.scene_filter if self.selection else None,
        )
        self.cache_dir = Path(given.cache_dir or user_cache() / "navsim").expanduser().absolute()
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
            missing = broken_link(self.maps) or "no such folder"
            raise ValueError(f"{self.maps}: {missing}; clips.maps has one folder a city: {DOWNLOAD}")
        if self.sensors is not None and not self.sensors.is_dir():
            missing = broken_link(self.sensors) or "no such folder"
            raise ValueError(f"{self.sensors}: {missing}; clips.sensors=null reads clips without pictures")
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
            kept, reasons = usable_windows(table, wanted, self.choice)
            dropped += reasons
            if reasons[UNREADABLE]:
                why = table.unreadable[table.unreadable != ""]
                log.warning("%s (%d such frames, which cost %d windows)", why[0], len(why), reasons[UNREADABLE])
            start_ms = table.start_ms
            refs += [ClipRef(self.name, log_id, int(start_ms[now - FRAMES_BEFORE])) for now in kept]
        if cities and None not in cities.values():
            raise ValueError(" ".join(map(str, cities.values())))
        if tokens is not None and (absent := len(tokens - found_tokens)):
            if not found and not broken:
                raise ValueError(f"{self.root}: none of the {len(tokens)} tokens of {self.filter_name} is in the logs")
            dropped[ABSENT] += absent
        return ClipIndex(tuple(refs), dict(dropped), skipped, broken)

    def read(self, ref: ClipRef) -> Clip:
        """The validated clip. Raises BadClip."""
        with failures_as_bad_clip(str(self._path_of(ref))):
            return self._read(ref)

    def _read(self, ref: ClipRef) -> Clip:
        opened = self._open(ref)
        frames, table = opened.log.frames, opened.table
        start = _frame_at(ref, table, opened.log.file)
        window, now = frames[start : start + WINDOW_FRAMES], start + FRAMES_BEFORE
        if any(frame.boxes is None for frame in window):
            raise BadClip(opened.log.file, f"frames[{start}].anns", "missing: nobody annotated the window")
        first, block_frames, block_repairs = opened.repaired_block(start)
        window = block_frames[start - first :][:WINDOW_FRAMES]
        repairs = repairs_from(block_repairs, FRAME_S * (start - first), FRAME_S * (start - first + WINDOW_FRAMES - 1))
        states = ego_states(window)
        road = road_around(self.maps, frames[now], states[:, :2], states[NOW, :3], opened.log.file, now)
        lights, light_repairs = lights_on_map(traffic_lights(window), road.road_map.lanes, road.city_lanes)
        agents = window_agents(window)
        images: tuple[SensorFile, ...] = ()
        sweeps: tuple[SensorFile, ...] = ()
        cameras: tuple[Camera, ...] = ()
        block: Block | None = None
        if self.sensors is not None:
            images, sweeps = sensor_files(window, self.sensors)
            if not images and not sweeps:
                problem = f"no picture of the frames {start} to {start + WINDOW_FRAMES - 1} of {ref.log_id} is here"
                raise BadClip(str(self.sensors), "blobs", f"{problem}; clips.sensors=null reads clips without pictures")
            block = self._with_others(ref, self._block(opened, start))
            cameras = cameras_with_pictures(frames[now], block.images, opened.log.file)
        clip = Clip(
            clip_id=ref.clip_id,
            dataset=self.name,
            log_id=ref.log_id,
            split=self.split_of(ref.log_id),
            start_s=ref.start_ms / 1000,
            ego_states=states,
            world_from_ego=world_from_ego(window),
            agents=agents,
            road_map=road.road_map,
            route=road.route,
            centerline=road.centerline,
            lights=lights,
            cameras=cameras,
            images=images,
            sweeps=sweeps,
            block=block,
            licence=LICENCE,
            frame_tokens=(frames[now].token, frames[now + HORIZON_FRAMES].token),
            content_digest=digest_with(opened.content_digest, self._others(ref), self._log_digest),
            repairs=(
                *road.repairs,
                *light_repairs,
                *(later(repair, ref.start_ms / 1000) for repair in repairs),
                *articulated(agents),
            ),
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
        """train, val or test: as the settings say, else by the name of the filter, of the folder, of the one that links
        lead to; else by the log's hash.
        """
        if self.split is not None:
            return self.split
        places = self.root, self.root.resolve()
        folders = [place.parent if place.suffix.lower() == ".pkl" else place for place in places]
        names = [self.selection.name] if self.selection else []
        for name in (*names, *(folder.name for folder in folders)):
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
            raise ValueError(f"{self.root}: none of the {len(wanted)} logs that {self.filter_name} names is here")
        return chosen

    def _tables(self, logs: Mapping[str, Path]) -> Iterable[tuple[str, FrameTable | BadClip]]:
        """The table of each log, or what is wrong with it; what takes long is told on stderr."""
        began, made, told = time.monotonic(), 0, 0.0
        made_apart = ProcessFunction(partial(read_and_cache_table, cache_dir=self.cache_dir))
        for i, (log_id, path) in enumerate(logs.items(), start=1):
            try:
                with failures_as_bad_clip(str(path)):
                    table = cached_table(path, self.cache_dir)
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
            log = parse_frames(load_plain(data, str(path)), path, whole=False)
            table = frame_table(log)
            opened = OpenLog(log, table, _digest(data, map_file(self.maps, table.location)))
            self._logs = dict([*self._logs.items(), (ref.log_id, opened)][-(CACHED_LOGS + self.traversals) :])
        return self._logs[ref.log_id]

    def _table(self, path: Path) -> FrameTable:
        return cached_table(path, self.cache_dir) or read_and_cache_table(path, self.cache_dir)

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
            images, sweeps = sensor_files(frames, self.sensors)
            if images or sweeps:
                cameras = cameras_with_pictures(frames[len(frames) // 2], images, opened.log.file)
                agents = stretch_agents(opened.repaired(int(inside[0]), int(inside[-1]) + 1)[0])
                others.append(OtherDrive(other.log_id, agents, cameras, images, sweeps))
        return with_other_drives(block, others) if others else block

    def _block(self, opened: OpenLog, start: int) -> Block:
        """Up to 20 s that begin at a multiple of 10 s of the stretch and hold the window."""
        assert self.sensors is not None
        first, frames, _ = opened.repaired_block(start)
        images, sweeps = sensor_files(frames, self.sensors)
        return Block(float(opened.table.start_ms[first]) / 1000, stretch_agents(frames), images, sweeps)


def log_files(root: Path) -> dict[str, Path]:
    """Log id -> pickle, sorted by id: of one log, or of a folder of them. Raises ValueError where there is none."""
    if root.is_file() and root.suffix.lower() == ".pkl":
        return {root.stem: root}
    if not root.is_dir():
        missing = broken_link(root) or "no such folder or .pkl file"
        raise ValueError(f"{root}: {missing}; clips.root is navsim_logs/<split>, or one log of it")
    files = named_once(root, ((path.stem, path) for path in matching(root, "*.pkl")))
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

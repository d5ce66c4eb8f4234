"""NAVSIM's scene filters and splits: the YAML files that name which windows of which logs count.

Fields and defaults are those of `SceneFilter` (autonomousvision/navsim @ 0a380a9, navsim/common/dataclasses.py); a key
that it has not is refused, as there. YAML is data: no tag builds an object. Both kinds of file are found by path, or by
name in a folder such as the public `config/common/train_test_split`.
"""

import hashlib
import io
import logging
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factory.datasets.navsim.log import LogFrames, read_frames
from factory.datasets.navsim.tracks import FRAMES_BEFORE, WINDOW_FRAMES
from factory.files import matching
from factory.readers.apart import Apart
from factory.readers.base import BadClip
from factory.readers.pickles import check_values
from factory.wording import shown
from tasks.caches import sealed, unsealed
from tasks.kernels.compiled import write_whole
from tasks.world.arrays import Array, Bools, Ints

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
    filter_path = path.parent / SUBFOLDER / f"{_filter_name(content, path)}.yaml"
    scene_filter = scene_filter_of(_mapping(filter_path), str(filter_path))
    return Selection(path.stem, scene_filter, data_split, None if mapping is None else tuple(mapping))


def read_scene_filter(path: Path) -> SceneFilter:
    """The scene filter in this file. Raises ValueError."""
    return scene_filter_of(_mapping(path), str(path))


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
            if isinstance(value, bool) or not isinstance(value, int) or value < _COUNTS[key]:
                raise ValueError(f"{file}: {key}: expected a whole number from {_COUNTS[key]} on, not {shown(value)}")
            checked[key] = value
        elif key in _FLAGS:
            if not isinstance(value, bool):
                raise ValueError(f"{file}: {key}: expected true or false, not {shown(value)}")
            checked[key] = value
        elif key == "all_mapping":
            checked[key] = value
        else:
            checked[key] = _texts(value, f"{file}: {key}")
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


def _filter_name(content: Mapping[str, Any], path: Path) -> str:
    """Of the one entry `scene_filter: <name>` among a split's defaults."""
    defaults = content.get("defaults")
    entries = [entry for entry in defaults if isinstance(entry, dict)] if isinstance(defaults, list) else []
    names = [entry[SUBFOLDER] for entry in entries if isinstance(entry.get(SUBFOLDER), str)]
    if len(names) != 1 or "/" in names[0]:
        raise ValueError(f"{path}: defaults: expected one entry `- scene_filter: <name>`")
    return str(names[0])


def _mapping(path: Path) -> dict[str, Any]:
    """What a YAML file holds, read as logs are, in another process. Raises ValueError."""
    try:
        return Apart(_read)(path, str(path))
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
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same rules, ten times as fast
    try:
        content = yaml.load(text, loader)  # noqa: S506 - both loaders are safe
    except (yaml.YAMLError, RecursionError, ValueError) as error:  # a date or a number that is none
        raise ValueError(f"{path}: no YAML of plain values: {' '.join(str(error).split())}") from error
    check_values(content, len(text), str(path), "YAML")
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ValueError(f"{path}: expected keys and values, found a {type(content).__name__}")
    return content


def _refuse_unknown(content: Mapping[str, Any], known: frozenset[str], file: str) -> None:
    if unknown := sorted(content.keys() - known):
        raise ValueError(f"{file}: unknown key {', '.join(unknown)}; known: {', '.join(sorted(known))}")


def _texts(value: object, where: str) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise ValueError(f"{where}: expected a list of text, not a {type(value).__name__}")
    for item in value:
        if not isinstance(item, str):
            raise ValueError(f"{where}: {shown(item)} is no text: put it in quotes")
    return tuple(value)


# Which windows of a folder of logs are clips, found without opening the logs again.
#
# A log of OpenScene takes a second to open, and navtrain names 1,192 of them. So what the choice needs is kept, a
# small table a log, in the user's cache; it is made again where the log's size or time of change is another.

TABLE_VERSION = 4  # of the tables kept
FRAME_S, SLACK_S = 0.5, 0.05  # between two frames; more or less is a gap
GAP, SHORT_HISTORY, SHORT_FUTURE = "gap_in_frames", "short_history", "short_future"
NO_ROUTE, NO_BOXES, STANDING, ABSENT = "no_route", "not_annotated", "ego_standing", "absent_token"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FrameTable:
    """What the choice of windows needs of the F frames of one log."""

    tokens: NDArray[np.str_]  # (F,)
    timestamps_us: Ints  # (F,)
    has_route: Bools  # (F,)
    annotated: Bools  # (F,)
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
class Choice:
    """Which windows are wanted."""

    stride_frames: int  # between two, where no scene filter names them
    first_frame: int  # of each log; windows that begin before it are skipped
    min_top_speed_mps: float  # an ego that never reaches it stands
    scene_filter: SceneFilter | None = None  # its scenes, whatever the stride and the speed


def table_of(log: LogFrames) -> FrameTable:
    """The table of a log that is open."""
    frames = log.frames
    return FrameTable(
        tokens=np.array([frame.token for frame in frames]),
        timestamps_us=np.array([frame.timestamp_us for frame in frames], np.int64),
        has_route=np.array([bool(frame.roadblock_ids) for frame in frames]),
        annotated=np.array([frame.boxes is not None for frame in frames]),
        speeds=np.array([np.hypot(*frame.dynamic_state[:2]) for frame in frames], np.float32),
        locations=np.array([frame.map_location for frame in frames]),
        x_m=np.array([frame.pose[0] for frame in frames], np.float64),
        y_m=np.array([frame.pose[1] for frame in frames], np.float64),
    )


def kept_table(path: Path, cache_dir: Path) -> FrameTable | None:
    """The table of the log at `path`, if one was kept of just this file. Raises BadClip where there is no such file."""
    try:
        kept = _kept(path, cache_dir)
        data = unsealed(kept.read_bytes(), kept.name)
        rows = np.load(io.BytesIO(data), allow_pickle=False)
        return FrameTable(*(rows[column.name] for column in fields(FrameTable)))
    except FileNotFoundError:
        return None
    except (ValueError, OSError, IndexError) as error:  # Damaged among them
        log.warning("%s: %s; made again of %s", _kept(path, cache_dir), error, path)
        return None


def table_at(path: Path, cache_dir: Path) -> FrameTable:
    """The table of the log at `path`; one that was not kept is made in another process. Raises BadClip."""
    return kept_table(path, cache_dir) or Apart(partial(make_table, cache_dir=cache_dir))(path, str(path))


def make_table(path: Path, cache_dir: Path) -> FrameTable:
    """The table of the log at `path`, read and kept. Raises BadClip."""
    table = table_of(read_frames(path))
    keep_table(table, path, cache_dir)
    return table


def keep_table(table: FrameTable, path: Path, cache_dir: Path) -> None:
    """Keeps the table of the log at `path`, for as long as that file is as it is. Raises BadClip, OSError."""
    columns: dict[str, NDArray[Any]] = {**vars(table)}
    rows = np.zeros(len(table), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    data = io.BytesIO()
    np.save(data, rows, allow_pickle=False)
    cache_dir.mkdir(parents=True, exist_ok=True)
    kept = _kept(path, cache_dir)
    write_whole(kept, sealed(data.getvalue(), kept.name))


def _kept(path: Path, cache_dir: Path) -> Path:
    try:
        stat = path.stat()
    except OSError as error:
        raise BadClip(str(path), "file", f"cannot be read: {error.strerror}") from error
    key = f"{TABLE_VERSION}\x1f{path}\x1f{stat.st_size}\x1f{stat.st_mtime_ns}"
    return cache_dir / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npy"


def wanted_windows(table: FrameTable, choice: Choice, tokens: Collection[str] | None) -> list[int]:
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


def usable(table: FrameTable, windows: list[int], choice: Choice) -> tuple[list[int], Counter[str]]:
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
        elif not table.has_route[now]:
            dropped[NO_ROUTE] += 1
        elif not table.annotated[first:stop].all():
            dropped[NO_BOXES] += 1
        elif choice.scene_filter is None and table.speeds[first:stop].max() < choice.min_top_speed_mps:
            dropped[STANDING] += 1
        else:
            kept.append(now)
    return kept, dropped

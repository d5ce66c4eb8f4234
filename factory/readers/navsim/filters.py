"""NAVSIM's scene filters and splits: the YAML files that name which windows of which logs count.

Fields and defaults are those of `SceneFilter` (autonomousvision/navsim @ 0a380a9, navsim/common/dataclasses.py); a key
that it has not is refused, as there. YAML is data: no tag builds an object. Both kinds of file are found by path, or by
name in a folder such as the public `config/common/train_test_split`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from factory.files import matching
from factory.readers.apart import Apart
from factory.readers.base import BadClip
from factory.readers.plain_values import check_values
from factory.wording import shown

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

"""Prepared clips on disk, so that a later run goes on without a perturb task, and the scenes of a benchmark.

A file is a plain zip of arrays (npz, no pickle) plus one JSON tree that says how frozen dataclasses, tuples, dicts and
arrays nest. Reading it builds only dataclasses and enums of this distribution, by their fields, and nothing else.
A seal (tasks.sealed) stands behind the zip; a damaged or foreign file counts as missing, with the reason.
"""

import dataclasses
import enum
import importlib
import io
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from factory.store.location import Location
from tasks.sealed import Damaged, sealed, unsealed

if TYPE_CHECKING:
    from tasks.hard_scenes import BenchmarkClip, GivenScenes, OneStageClip

FORMAT = 1
PACKAGES = ("tasks.", "factory.")  # whose dataclasses and enums a file may name
_AGAIN = "the command that made it writes it again"
_PLAIN = (str, int, float, bool, type(None))


class BadCacheFile(ValueError):
    """A cache file is damaged or not one of ours."""


def encode(value: object) -> bytes:
    """A tree of dataclasses, enums, dicts, tuples, lists, frozensets, numpy arrays and plain scalars as bytes.

    Raises TypeError naming the type of anything else.
    """
    arrays = _Arrays()
    tree = json.dumps({"format": FORMAT, "root": _encode(value, arrays)})
    sink = io.BytesIO()
    np.savez_compressed(sink, allow_pickle=False, tree=np.frombuffer(tree.encode(), np.uint8), **arrays.by_name)
    return sink.getvalue()


def decode(data: bytes) -> Any:
    """The opposite. Raises BadCacheFile."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            tree = json.loads(stored["tree"].tobytes())
            if tree["format"] != FORMAT:
                raise BadCacheFile(f"format {tree['format']}, this version reads {FORMAT}")
            return _decode(tree["root"], {name: stored[name] for name in stored.files})
    except Exception as error:  # whatever a zip, an array's header or a class makes of bytes that are none of ours
        raise BadCacheFile(str(error) or type(error).__name__) from error


class ClipCache:
    """Prepared clips by key, under the store."""

    def __init__(self, location: Location) -> None:
        self.location = location

    def load(self, key: str) -> object | None:
        """The stored value, None where there is none. Raises BadCacheFile."""
        data = self.location.read(f"{key}.npz")
        return None if data is None else decode(_whole(data, key))

    def store(self, key: str, value: object) -> None:
        """Whole or not at all."""
        self.location.write(f"{key}.npz", sealed(encode(value), key))


@dataclasses.dataclass(frozen=True)
class SceneFiles:
    """The folder `scenes` of a store: one file a clip, from which planners are driven without the raw logs."""

    location: Location

    def store(self, scenes: "BenchmarkClip | GivenScenes | OneStageClip") -> None:
        """Whole or not at all; in place of an older one."""
        self.location.write(f"{scenes.clip.clip_id}.npz", sealed(encode(scenes)))

    def load(self, clip_id: str) -> "BenchmarkClip | GivenScenes | OneStageClip":
        """Raises FileNotFoundError where the clip has none, BadCacheFile, naming it, for a damaged or foreign file."""
        from tasks.hard_scenes import BenchmarkClip, GivenScenes, OneStageClip

        data, path = self.location.read(f"{clip_id}.npz"), f"{self.location.uri}/{clip_id}.npz"
        if data is None:
            raise FileNotFoundError(f"{path}: no scenes of this clip; run the factory again")
        try:
            scenes = decode(_whole(data))
        except BadCacheFile as error:
            raise BadCacheFile(f"{path}: {error}; remove it, {_AGAIN}") from error
        if not isinstance(scenes, BenchmarkClip | GivenScenes | OneStageClip):
            raise BadCacheFile(f"{path} holds {type(scenes).__name__}, not a clip's scenes")
        if scenes.clip.clip_id != clip_id:
            raise BadCacheFile(f"{path} holds clip {scenes.clip.clip_id}; remove it, {_AGAIN}")
        return scenes

    def clip_ids(self) -> list[str]:
        """Of all clips that have scenes, sorted."""
        return [name.removesuffix(".npz") for name in self.location.names() if name.endswith(".npz")]


def check_prepared(data: bytes, key: str) -> None:
    """Hold the file of a prepared clip against its seal. Raises BadCacheFile."""
    try:
        unsealed(data, key)
    except Damaged as error:
        raise BadCacheFile(f"{error}; the next run makes it again") from error


def _whole(data: bytes, key: str = "") -> bytes:
    try:
        return unsealed(data, key)
    except Damaged as error:
        raise BadCacheFile(str(error)) from error


class _Arrays:
    """Names arrays; one that stands twice in the tree is stored once."""

    def __init__(self) -> None:
        self.by_name: dict[str, NDArray[np.generic]] = {}
        self._name_of: dict[int, str] = {}

    def name(self, array: NDArray[np.generic]) -> str:
        if id(array) not in self._name_of:
            self._name_of[id(array)] = f"a{len(self.by_name)}"
            self.by_name[self._name_of[id(array)]] = array  # also keeps its id taken
        return self._name_of[id(array)]


def _encode(value: Any, arrays: _Arrays) -> Any:
    if isinstance(value, enum.Enum):
        return {"enum": _name(type(value)), "value": value.value}
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError("an array of objects cannot be cached")
        return {"array": arrays.name(value)}
    if isinstance(value, np.generic):
        return {"scalar": arrays.name(np.asarray(value))}
    if isinstance(value, _PLAIN):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        members = {f.name: _encode(getattr(value, f.name), arrays) for f in dataclasses.fields(value) if f.init}
        return {"class": _name(type(value)), "members": members}
    if isinstance(value, Mapping):
        return {"dict": [[_encode(k, arrays), _encode(v, arrays)] for k, v in value.items()]}
    for kind in (tuple, list):
        if type(value) is kind:
            return {kind.__name__: [_encode(v, arrays) for v in value]}
    if isinstance(value, frozenset):
        return {"frozenset": [_encode(v, arrays) for v in sorted(value)]}
    raise TypeError(f"{_name(type(value))} cannot be cached; allowed: dataclasses of {PACKAGES}, arrays, containers")


def _decode(node: Any, arrays: Mapping[str, NDArray[np.generic]]) -> Any:
    if not isinstance(node, dict):
        return node
    if "array" in node:
        return arrays[node["array"]]
    if "scalar" in node:
        return arrays[node["scalar"]][()]
    if "class" in node:
        kind = _class(node["class"])
        if not dataclasses.is_dataclass(kind):
            raise BadCacheFile(f"{node['class']} is no dataclass")
        build: Any = kind
        return build(**{name: _decode(child, arrays) for name, child in node["members"].items()})
    if "enum" in node:
        kind = _class(node["enum"])
        if not issubclass(kind, enum.Enum):
            raise BadCacheFile(f"{node['enum']} is no enum")
        return kind(node["value"])
    if "dict" in node:
        return {_decode(k, arrays): _decode(v, arrays) for k, v in node["dict"]}
    if "tuple" in node:
        return tuple(_decode(child, arrays) for child in node["tuple"])
    if "frozenset" in node:
        return frozenset(_decode(child, arrays) for child in node["frozenset"])
    return [_decode(child, arrays) for child in node["list"]]


def _name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(name: str) -> Any:
    module, _, qualname = name.partition(":")
    if not module.startswith(PACKAGES) or "." in qualname:
        raise BadCacheFile(f"{name} is not a class a cache file may name")
    found = getattr(importlib.import_module(module), qualname)
    if not isinstance(found, type) or found.__module__ != module:
        raise BadCacheFile(f"{name} is not a class of {module}")
    return found

"""`benchmark=navhard` and `benchmark=navtest`: NAVSIM's benchmarks, made of NAVSIM's own folders.

The benchmark is `python -m factory import`'s, in a folder of its own. It is used again while it is whole and the files
that it was made of are as they were; what is not whole goes on.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from factory.config.compose import ConfigError
from factory.exits import INTERRUPTED
from factory.files import matching
from factory.imports.navhard import NavsimFolders, import_navhard
from factory.imports.navtest import import_navtest
from factory.readers.navsim.filters import Selection, read_selection
from factory.stages.benchmark import BENCHMARK_FILE
from factory.store.location import Location
from factory.store.samples import Store
from factory.store.usable import why_unusable
from planners.command import Stopped

SPLITS: Mapping[str, str] = {"navhard": "navhard_two_stage", "navtest": "navtest"}  # name -> its split's file
DATA, MAPS, DEVKIT = "OPENSCENE_DATA_ROOT", "NUPLAN_MAPS_ROOT", "NAVSIM_DEVKIT_ROOT"  # NAVSIM's own variables
IN_DEVKIT = "navsim/planning/script/config/common/train_test_split"
MADE_FROM = "made_from.json"


@dataclass(frozen=True)
class NavsimData:
    """Where NAVSIM's files lie; None: where its own variables say."""

    data: str | None = None  # OPENSCENE_DATA_ROOT: navsim_logs, sensor_blobs, navhard_two_stage
    maps: str | None = None  # NUPLAN_MAPS_ROOT, or `maps` in data
    split: str | None = None  # the split's .yaml, or that of the checkout in NAVSIM_DEVKIT_ROOT
    pictures: bool = True


def benchmark_by_name(name: str, given: NavsimData, made: str) -> str:
    """The folder of a benchmark of SPLITS, `<made>/<name>`, made first where it is not there whole.

    Raises ConfigError for a folder that is missing, or a benchmark there that was made of other files, and Stopped.
    """
    data = _there(name, "data", given.data, DATA, "the folder of navsim_logs and sensor_blobs")
    split = _split(name, given.split)
    try:
        selection = read_selection(str(split))
    except ValueError as error:
        raise ConfigError(f"benchmark={name}: {error}") from error
    places = _places(name, data, _maps(name, given.maps, data), selection, given.pictures)
    out = f"{made.rstrip('/')}/{name}"
    store = Location.parse(out)
    source = {"benchmark": name, "pictures": given.pictures, "files": _digest(name, places, split)}
    kept = store.read(MADE_FROM)
    whole = kept is not None and _is_whole(store)
    if not whole and (unusable := why_unusable(out)):
        raise ConfigError(f"benchmark={name}: {unusable}")
    if kept is None:
        store.write(MADE_FROM, json.dumps(source, indent=1).encode())
    elif other := [key for key, value in json.loads(kept).items() if source[key] != value]:
        raise ConfigError(
            f"benchmark={name}: {out} was made of other {other[0]} than these: remove it, or choose another made="
        )
    elif whole:
        return out
    _import(name, Store(store), selection, places)
    return out


def _import(name: str, store: Store, selection: Selection, places: NavsimFolders) -> None:
    try:
        if name == "navhard":
            summary, told = import_navhard(store, selection, places)
        else:
            summary, told = import_navtest(store, selection, places.logs, places.sensors, places.maps)
    except ValueError as error:
        raise ConfigError(f"benchmark={name}: {error}") from error
    print(told)
    if summary.counts["failed"]:
        print(f"{summary.counts['failed']} frames failed: python -m factory failed out={store.location.uri}")
    if summary.exit_code == INTERRUPTED:
        raise Stopped(summary.message)


def _is_whole(store: Location) -> bool:
    document = store.read(BENCHMARK_FILE)
    return document is not None and not json.loads(document)["left_out"]


def _places(name: str, data: Path, maps: Path, selection: Selection, pictures: bool) -> NavsimFolders:
    part = selection.data_split or "test"
    logs, sensors, scenes = data / "navsim_logs" / part, data / "sensor_blobs" / part, data / SPLITS["navhard"]
    needed = {"its logs": logs}
    needed |= {"the pictures of its logs (pictures=false goes without)": sensors} if pictures else {}
    if name == "navhard":
        needed["the scenes of its second stage"] = scenes / "synthetic_scene_pickles"
        needed |= {"their pictures (pictures=false goes without)": scenes / "sensor_blobs"} if pictures else {}
    for what, folder in needed.items():
        if not folder.is_dir():
            raise ConfigError(f"benchmark={name}: {folder} is missing: {what}")
    return NavsimFolders(logs, sensors if pictures else None, scenes, maps)


def _maps(name: str, given: str | None, data: Path) -> Path:
    if given is None and MAPS not in os.environ and (data / "maps").is_dir():
        return data / "maps"
    return _there(name, "maps", given, MAPS, "nuPlan's maps, with one folder a city")


def _split(name: str, given: str | None) -> Path:
    if given is not None:
        path = Path(given)
    else:
        path = _there(name, "split", None, DEVKIT, "a checkout of NAVSIM, or give the split's .yaml")
        path = path / IN_DEVKIT / f"{SPLITS[name]}.yaml"
    if not path.is_file():
        raise ConfigError(f"benchmark={name}: split {path} is missing")
    return path


def _there(name: str, setting: str, given: str | None, variable: str, what: str) -> Path:
    said = os.environ.get(variable) if given is None else given
    if not said:
        raise ConfigError(f"benchmark={name}: give {setting}=... or set {variable}: {what}")
    path = Path(said).expanduser()
    if not path.is_dir():
        raise ConfigError(f"benchmark={name}: {setting} {path} is missing: {what}")
    return path


def _digest(name: str, places: NavsimFolders, split: Path) -> str:
    """Of the split's files, and of the names, sizes and times of logs, maps and scenes; pictures are not looked at."""
    found = sha256(split.read_bytes())
    filters = matching(split.parent / "scene_filter", "*.yaml")
    for path in filters:
        found.update(path.read_bytes())
    folders = [(places.logs, "*.pkl"), (places.maps, "*/*/map.gpkg")]
    folders += [(places.scenes / "synthetic_scene_pickles", "*.pkl")] if name == "navhard" else []
    for folder, pattern in folders:
        for path in matching(folder, pattern):
            stat = path.stat()
            found.update(f"{path.relative_to(folder)}\x1f{stat.st_size}\x1f{stat.st_mtime_ns}\x1e".encode())
    return found.hexdigest()[:16]

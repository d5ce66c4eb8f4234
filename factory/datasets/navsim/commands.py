"""NAVSIM's part of the commands: imports, the export, and benchmarks by name, made of NAVSIM's own folders.

`benchmark=navhard` and `benchmark=navtest` of `python -m planners evaluate` are `python -m factory import`'s, in a
folder of their own. One is used again while it is whole and the files that it was made of are as they were; what is not
whole goes on.
"""

import json
import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from factory.config.arguments import Refused
from factory.config.words import ConfigError
from factory.datasets.navsim.benchmarks import NavsimFolders, import_navhard, import_navtest
from factory.datasets.navsim.export import Each, ExportSummary, export, scene_filter_yaml
from factory.datasets.navsim.frames import N_FUTURE, ExportSettings
from factory.datasets.navsim.import_rows import NO_PICTURES, import_identity, import_rows
from factory.datasets.navsim.reader import Selection, read_selection
from factory.datasets.navsim.simscale import RewardFiles, SimscaleFolder, SimscaleImport, simscale_folders
from factory.exits import INTERRUPTED, Stopped
from factory.files import matching, why_unusable
from factory.graph.execute import RunSummary
from factory.setup.vocabulary import load_vocabulary
from factory.stages.benchmark import BENCHMARK_FILE
from factory.store.location import Location
from factory.store.samples import Store
from factory.store.table import KeyedTable
from tasks.world.arrays import Array


def import_simscale(request: Any, store: Store) -> tuple[RunSummary, str]:
    """The rows of released folders, or exported ones. Raises Refused."""

    parts = simscale_folders(Path(request.root), request.only)
    rewards = None
    if request.rewards is not None and request.vocabulary is not None:
        rewards = RewardFiles(Path(request.rewards), load_vocabulary(request.vocabulary))
    settings = {
        "maps": request.maps is not None,
        "pictures": request.pictures,
        "labels": None if rewards is None else rewards.vocabulary.digest,
    }
    maps = _folder(request.maps)
    if maps is not None and not maps.is_dir():
        raise Refused(f"maps={request.maps}: no such folder")
    wanted = SimscaleImport(maps, request.pictures, rewards)
    summary = import_rows(store, import_identity(request.source, settings), wanted.entries(parts))
    return summary, "\n".join(_list_usable(store, parts))


def _list_usable(store: Store, parts: Sequence[SimscaleFolder]) -> Iterator[str]:
    """Write usable/<name>.yaml, a scene filter of the logs that were imported; a line of counts for each folder."""
    made: dict[tuple[str, int], list[tuple[str, str]]] = defaultdict(list)
    for row in store.samples.read(["expert", "candidate_index", "log_id", "frame_tokens"]).to_pylist():
        made[row["expert"], row["candidate_index"]].append((row["log_id"], row["frame_tokens"]))
    failed = store.outcomes.read(["attempt_id", "expert", "candidate_index", "error"]).to_pylist()
    lacking = Counter(
        (row["expert"], row["candidate_index"])
        for row in failed
        if NO_PICTURES in (row["error"] or "") and row["attempt_id"] not in store.samples
    )
    for part in parts:
        key, n_logs = (part.expert, part.candidate), len(matching(part.logs, "*.pkl"))
        scenes = [part.names_of(log_id, tokens) for log_id, tokens in sorted(made[key])]
        file = f"usable/{part.name}.yaml"
        store.location.write(file, scene_filter_yaml(scenes, N_FUTURE).encode())
        told = f"{n_logs:,} logs, {len(scenes):,} usable, {lacking[key]:,} without pictures"
        yield f"{part.name}: {told}; the usable ones: {store.location.uri}/{file}"


def import_two_stage_benchmark(request: Any, store: Store) -> tuple[RunSummary, str]:
    """The rows of navhard, and what is said of them."""

    logs, maps = _folder(request.logs), _folder(request.maps)
    assert logs is not None and maps is not None and request.split is not None
    places = NavsimFolders(logs, _folder(request.sensors), Path(request.root), maps)
    return import_navhard(store, read_selection(request.split), places)


def import_one_stage_benchmark(request: Any, store: Store) -> tuple[RunSummary, str]:
    """The rows of navtest, and what is said of them."""

    maps = _folder(request.maps)
    assert maps is not None and request.split is not None
    places = NavsimFolders(Path(request.root), _folder(request.sensors), None, maps)
    return import_navtest(store, read_selection(request.split), places)


def export_samples(request: Any, table: KeyedTable, to: Path, trajectories: Array | None, each: Each) -> ExportSummary:
    """All samples that the command asks for, as `factory.datasets.navsim.export.export`."""
    rounds = tuple(int(word) for word in request.round)
    named = {name: getattr(request, name) for name in ("tag", "resize", "missing", "map_location")}
    return export(
        table,
        to,
        ExportSettings(request.expert, rounds, request.split, **named, consumer=request.for_),
        trajectories,
        each,
    )


def _folder(path: str | None) -> Path | None:
    return None if path is None else Path(path)


SPLITS: Mapping[str, str] = {"navhard": "navhard_two_stage", "navtest": "navtest"}  # name -> its split's file
DATA, MAPS, DEVKIT = "OPENSCENE_DATA_ROOT", "NUPLAN_MAPS_ROOT", "NAVSIM_DEVKIT_ROOT"  # NAVSIM's own variables
IN_DEVKIT = "navsim/planning/script/config/common/train_test_split"
MADE_FROM = "made_from.json"


def find_or_make_benchmark(
    name: str, made: str, data: str | None, maps: str | None, split: str | None, pictures: bool
) -> str:
    """The folder of a benchmark of SPLITS, `<made>/<name>`, made first where it is not there whole.

    data: of navsim_logs, sensor_blobs and navhard_two_stage; maps: nuPlan's, also `maps` in data; split: its .yaml,
    also that of a checkout. What is None, one of NAVSIM's own variables says.
    Raises ConfigError for a folder that is missing, or a benchmark there that was made of other files, and Stopped.
    """
    root = _there(name, "data", data, DATA, "the folder of navsim_logs and sensor_blobs")
    listed = _split(name, split)
    try:
        selection = read_selection(str(listed))
    except ValueError as error:
        raise ConfigError(f"benchmark={name}: {error}") from error
    there = maps is None and MAPS not in os.environ and (root / "maps").is_dir()
    found = root / "maps" if there else _there(name, "maps", maps, MAPS, "nuPlan's maps, with one folder a city")
    places = _places(name, root, found, selection, pictures)
    out = f"{made.rstrip('/')}/{name}"
    store = Location.parse(out)
    source = {"benchmark": name, "pictures": pictures, "files": _digest(places, listed)}
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
        import_to = import_navhard if name == "navhard" else import_navtest
        summary, told = import_to(store, selection, places)
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
    return NavsimFolders(logs, sensors if pictures else None, scenes if name == "navhard" else None, maps)


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


def _digest(places: NavsimFolders, split: Path) -> str:
    """Of the split's files, and of the names, sizes and times of logs, maps and scenes; pictures are not looked at."""
    found = sha256(split.read_bytes())
    filters = matching(split.parent / "scene_filter", "*.yaml")
    for path in filters:
        found.update(path.read_bytes())
    folders = [(places.logs, "*.pkl"), (places.maps, "*/*/map.gpkg")]
    if places.scenes is not None:
        folders.append((places.scenes / "synthetic_scene_pickles", "*.pkl"))
    for folder, pattern in folders:
        for path in matching(folder, pattern):
            stat = path.stat()
            found.update(f"{path.relative_to(folder)}\x1f{stat.st_size}\x1f{stat.st_mtime_ns}\x1e".encode())
    return found.hexdigest()[:16]

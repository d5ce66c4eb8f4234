"""Where hostile files get in: data folders with an innocent log, and commands and functions that read one file."""

import json
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq

from factory.exits import COMPLETE
from factory.readers.base import BadClip
from tests.chaos.hostile_files import grammars
from tests.chaos.hostile_files.grammars import Crafted, Rng
from tests.factory.datasets.navsim.geopackage_writer import CITIES
from tests.factory.datasets.navsim.navsim_town import write_town
from tests.factory.datasets.py123d.py123d_logs import convert
from tests.factory.datasets.scenarionet.scenarionet_scenarios import nuscenes, save
from tests.writable import load_writable

CITY = next(iter(CITIES))
PLAIN = ("experts=[human]", "rounds=1", "render=none", "reward.labels=none", "executor=local", "vocabulary.k=16")


def write_innocents(folder: Path, doors: Collection[str]) -> None:
    """What stands beside the hostile files of these doors, or is what they are made like; what is there is kept."""
    from factory.datasets.town.reader import SyntheticReader
    from factory.datasets.town.settings import TownSettings
    from factory.run import main as run

    if not (folder / "scenarionet").exists():
        save(nuscenes(), folder / "scenarionet", "sd_innocent.pkl")
    if not (folder / "towns").exists() and any(door.startswith(("av2", "navsim", "py123d")) for door in doors):
        SyntheticReader(folder / "towns", 1, 0, TownSettings(("ring_front_center",), 64, 36, lidar_beams=0)).index()
        (town,) = (path for path in folder.glob("towns/*/*") if path.is_dir())
        shutil.copytree(town, folder / "av2" / "innocent")
        convert(town, folder / "py123d")
        write_town(folder / "navsim", "mini", town, CITY)
    if not (folder / "run").exists() and any(door.startswith(("table", "shard")) for door in doors):
        code = run(["clips=scenarionet", f"clips.root={folder / 'scenarionet'}", *PLAIN, f"out={folder / 'run'}"])
        assert code == COMPLETE, f"the innocent run ended with {code}"


# Data folders


@dataclass(frozen=True)
class Logs:
    """A folder of logs that a run reads, where many hostile ones lie beside an innocent one."""

    craft: Callable[[Path, Rng], Crafted]  # of write_innocents' folder
    put: Callable[[Path, Path, str, bytes], str]  # innocents, data folder, name, crafted: the log's id
    words: Callable[[Path, Path], Sequence[str]]  # innocents, data folder: of the run
    innocent: Callable[[Path, Path], str]  # puts it there: its id


def _as_pickle(place: str, innocents: Path, data: Path, name: str, crafted: bytes) -> str:
    path = data / place.format(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(crafted.replace(b"hostile", name.encode()))  # as a log's frames name it
    return path.stem


def _frames(innocents: Path, rng: Rng) -> Crafted:
    if rng.random() < 0.25:
        return grammars.program(rng)
    good = _good_frames(innocents)
    if rng.random() < 0.1:
        stamps = [
            frame | {"log_name": "hostile", "timestamp": frame["timestamp"] + k}
            for k in range(int(grammars.pick(rng, (400, 2000))))
            for frame in good[:10]
        ]
        return "frames: many", grammars.dumped(stamps, rng)
    name, what = grammars.value(rng)
    frames = [frame | {"log_name": "hostile"} for frame in good]
    return f"frames: {name}", grammars.dumped(grammars.planted(frames, rng, what, 0.9), rng)


@cache
def _good_frames(innocents: Path) -> list[dict[str, Any]]:
    return list(load_writable(_good_navsim(innocents)))


def _good_navsim(innocents: Path) -> Path:
    return next((innocents / "navsim/navsim_logs/mini").glob("*.pkl"))


AV2_FILES = ("annotations.feather", "city_SE3_egovehicle.feather", "calibration/intrinsics.feather", "map/*.json")


def _of_log(folder: str, patterns: Sequence[str], innocents: Path, rng: Rng) -> Crafted:
    """One file of a log in several; its name stands before the bytes."""
    log = _log(innocents / folder)
    path = next(log.glob(grammars.pick(rng, patterns)))
    if path.suffix == ".json":
        what, crafted = grammars.json_text(json.loads(path.read_bytes()), rng)
    elif path.suffix in (".jpg", ".png"):
        what, crafted = grammars.picture(rng)
    elif rng.random() < 0.1 and folder == "py123d":
        what, crafted = _packed(path, rng)
    else:
        what, crafted = grammars.arrow(pyarrow.feather.read_table(path, memory_map=False, use_threads=False), rng)
    return f"{path.name} {what}", str(path.relative_to(log)).encode() + b"\n" + crafted


def _packed(path: Path, rng: Rng) -> Crafted:
    """msgpack within Arrow's metadata."""
    good = pyarrow.feather.read_table(path, memory_map=False, use_threads=False)
    size, n = int(grammars.pick(rng, grammars.SIZES)), int(grammars.pick(rng, grammars.MANY))
    values: dict[str, Any] = {
        "array": {
            b"__ndarray__": True,
            b"dtype": grammars.pick(rng, ("f8", "O", "V99", "(9999,)f8")),
            b"shape": [size],
            b"data": b"x" * 8,
        },
        "deep": grammars.nested(400),
        "texts": {f"{k}{grammars.FORGED}": "x" for k in range(min(n, 9999))},
    }
    what = grammars.pick(rng, [*values, "length"])
    packed = b"\xdd" + (size & 0xFFFFFFFF).to_bytes(4, "big") if what == "length" else msgpack.packb(values[what])
    sink = pa.BufferOutputStream()
    pyarrow.feather.write_feather(good.replace_schema_metadata({b"metadata": packed}), sink)
    return f"msgpack: {what}", sink.getvalue().to_pybytes()


def _log(folder: Path) -> Path:
    """The one log below it: the folder with files in it."""
    return next(
        Path(here)
        for here, _, names in sorted(os.walk(folder))
        if any(n.endswith((".feather", ".arrow")) for n in names)
    )


def _as_folder(folder: str, innocents: Path, data: Path, name: str, crafted: bytes) -> str:
    """A log like the innocent one, by links, but for one file."""
    log = _log(innocents / folder)
    here = data / log.relative_to(innocents / folder).with_name(name)
    part, _, content = crafted.partition(b"\n")
    for path in (path for path in log.rglob("*") if path.is_file()):
        (to := here / path.relative_to(log)).parent.mkdir(parents=True, exist_ok=True)
        to.symlink_to(path.resolve())
    if part:
        (to := here / part.decode()).unlink()
        to.write_bytes(content)
    return name


def _maps(innocents: Path, data: Path) -> Sequence[str]:
    kept = f"clips.cache_dir={data.parent / 'kept'}"
    return ("clips=navsim", f"clips.root={data / 'navsim_logs/mini'}", f"clips.maps={innocents / 'navsim/maps'}", kept)


PHOTOS = ("render=map", "render.cameras=[ring_front_center]", "render.width=64", "render.height=36")


def _words(clips: str, more: Sequence[str], innocents: Path, data: Path) -> Sequence[str]:
    return (f"clips={clips}", f"clips.root={data}", *more)


def _copied(path: Path, to: Path) -> str:
    to.mkdir(parents=True, exist_ok=True)
    shutil.copy(path, to)
    return path.stem


def _folders(clips: str, patterns: Sequence[str], *more: str) -> Logs:
    return Logs(
        partial(_of_log, clips, patterns),
        partial(_as_folder, clips),
        partial(_words, clips, more),
        lambda innocents, data: _as_folder(clips, innocents, data, "innocent", b""),
    )


LOGS: Mapping[str, Logs] = {
    "scenarionet": Logs(
        lambda _, rng: grammars.scenario(rng),
        partial(_as_pickle, "sd_{}.pkl"),
        partial(_words, "scenarionet", ()),
        lambda innocents, data: _copied(innocents / "scenarionet/sd_innocent.pkl", data),
    ),
    "navsim": Logs(
        _frames,
        partial(_as_pickle, "navsim_logs/mini/{}.pkl"),
        _maps,
        lambda innocents, data: _copied(_good_navsim(innocents), data / "navsim_logs/mini"),
    ),
    "av2": _folders("av2", AV2_FILES),
    "av2 photos": _folders("av2", ("sensors/cameras/*/*",), *PHOTOS),
    "py123d": _folders("py123d", ("*.arrow",)),
}


# Single files


@dataclass(frozen=True)
class Single:
    """A file that a command of the product, or a public function of it, reads."""

    craft: Callable[[Path, Rng], Crafted]
    name: str  # of the file
    argv: tuple[str, ...] = ()  # factory or planners, and its words
    read: Callable[[Path], Any] | None = None  # the file
    refusals: tuple[type[Exception], ...] = (BadClip, ValueError)
    like: str = ""  # what of the innocents the file lies in a copy of
    named: str = ""  # what a refusal must name; the file


def _import(suffix: str, craft: Callable[[Rng], Crafted]) -> Single:
    return Single(
        lambda _, rng: craft(rng),
        f"hostile{suffix}",
        ("factory", "scene", "import", f"hostile{suffix}", "to=scene.safetensors"),
    )


def _function(craft: Callable[[Rng], Crafted], name: str, read: Callable[[Path], Any]) -> Single:
    return Single(lambda _, rng: craft(rng), name, read=read)


def _good_commit(innocents: Path, table: str) -> list[dict[str, Any]]:
    """All of a good log in one commit."""
    lines = [
        line
        for path in sorted((innocents / "run" / table / "_delta_log").glob("*.json"))
        for line in path.read_text().splitlines()
    ]
    return [action for action in map(json.loads, lines) if "commitInfo" not in action]


def _commit(innocents: Path, rng: Rng) -> Crafted:
    return grammars.commit(_good_commit(innocents, "samples"), rng)


def _shard(innocents: Path, rng: Rng) -> Crafted:
    (good,) = (innocents / "run/samples").glob("*/*/*.parquet")
    return grammars.parquet(pq.ParquetFile(good).read(use_threads=False), rng)


SHARD, COMMIT = "run/samples/round=0/expert=human/hostile.parquet", f"run/samples/_delta_log/{0:020}.json"
RUN_OF = ("factory", "run", "clips=scenarionet", "clips.root=scenarionet", *PLAIN, "out=out")


def _of_run(
    name: str, craft: Callable[[Path, Rng], Crafted], *argv: str, read: Callable[[Path], Any] | None = None
) -> Single:
    return Single(craft, name, argv, read, (Exception,), "run", "run")


def _read_image(path: Path) -> Any:
    from factory.stages.sensors import decode_image

    return decode_image(path.read_bytes(), str(path)).shape


def _read_batch(path: Path) -> Any:
    """By the decoder of a planner's batches."""
    from factory.readers.pictures import BadPicture, jpeg_size
    from planners.data.images import _decode_jpeg

    data = np.frombuffer(path.read_bytes(), np.uint8)
    try:
        width, height = jpeg_size(data)
        return _decode_jpeg(data, (height, width)).shape
    except (BadPicture, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def _read_episode(path: Path) -> Any:
    from factory.store.episodes import check_episode

    try:
        check_episode(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _read_table(path: Path) -> Any:
    from factory.setup.vocabulary import load_recovery_table

    return load_recovery_table(path)


def _read_sidecar(path: Path) -> Any:
    from factory.datasets.scenarionet.photos import cameras_in, load_sidecar, read_photographs
    from tasks.world.frames import EGO_STATE_SIZE

    cameras_in(load_sidecar(path)[0], str(path))
    return read_photographs(path, path.parent, np.zeros((121, EGO_STATE_SIZE)))


def _read_samples(path: Path) -> Any:
    """The run that the file lies in."""
    from factory.store.reader import SampleTable

    run = next(parent for parent in path.parents if parent.name == "run")
    table = SampleTable(run)
    return [len(table[k]) for k in range(len(table))]


SIDECAR = {
    "cameras": {
        "front": {
            "K": [[50.0, 0, 32], [0, 50, 18], [0, 0, 1]],
            "width": 64,
            "height": 36,
            "ego_from_camera": np.eye(4).tolist(),
        }
    },
    "frames": [{"camera": "front", "file": "a.jpg", "time_s": 0.1}],
}
SINGLES: Mapping[str, Single] = {
    "yaml filter": Single(
        lambda _, rng: grammars.yaml_text(rng),
        "hostile.yaml",
        (
            "factory",
            "run",
            "clips=navsim",
            "clips.root=.",
            "clips.maps=.",
            "clips.scene_filter=hostile.yaml",
            *PLAIN,
            "out=out",
        ),
    ),
    "vocabulary": Single(
        lambda _, rng: grammars.array_file(rng),
        "hostile.npy",
        (*RUN_OF, "vocabulary.file=hostile.npy"),
        like="scenarionet",
    ),
    "recovery table": _function(grammars.npz, "hostile.npz", _read_table),
    "scene ply": _import(".ply", grammars.ply),
    "scene spz": _import(".spz", grammars.spz),
    "scene checkpoint": _import(".ckpt", grammars.checkpoint),
    "scene file": Single(
        lambda _, rng: grammars.safetensors(rng),
        "hostile.safetensors",
        ("factory", "scene", "info", "hostile.safetensors"),
    ),
    "planner checkpoint": Single(
        lambda _, rng: grammars.checkpoint(rng),
        "hostile.ckpt",
        ("planners", "import", "hostile.ckpt", "planner=ltf_public", "out=planner"),
    ),
    "picture": _function(grammars.picture, "hostile.jpg", _read_image),
    "picture of a batch": _function(grammars.jpeg, "hostile.jpg", _read_batch),
    "episode": _function(grammars.mcap, "hostile.mcap", _read_episode),
    "sidecar": _function(lambda rng: grammars.json_text(SIDECAR, rng), "hostile.json", _read_sidecar),
    "table, status": _of_run(COMMIT, _commit, "factory", "status", "out=run"),
    "table, verify": _of_run(COMMIT, _commit, "factory", "verify", "run"),
    "table, read": _of_run(COMMIT, _commit, read=_read_samples),
    "shard, verify": _of_run(SHARD, _shard, "factory", "verify", "run"),
    "shard, read": _of_run(SHARD, _shard, read=_read_samples),
}


def put_single(single: Single, innocents: Path, folder: Path, crafted: bytes) -> Path:
    """The file in a folder of its own; a run's log is remade to be one commit that names a hostile shard."""
    if single.like:
        shutil.copytree(innocents / single.like, folder / single.like)
    path = folder / single.name
    path.parent.mkdir(parents=True, exist_ok=True)
    if single.name in (COMMIT, SHARD):
        shutil.rmtree(folder / "run/samples/_commits")  # a stranger's run has none, or made to match
        for old in (folder / "run/samples/_delta_log").iterdir():
            old.unlink()
    if single.name == SHARD:
        (folder / COMMIT).write_text("\n".join(map(json.dumps, _naming(innocents, len(crafted)))))
    path.write_bytes(crafted)
    return path


def _naming(innocents: Path, size: int) -> Iterator[dict[str, Any]]:
    for action in _good_commit(innocents, "samples"):
        yield (
            action | {"add": action["add"] | {"path": SHARD.partition("samples/")[2], "size": size}}
            if "add" in action
            else action
        )


DOORS = (*LOGS, *SINGLES)

"""Where hostile files get in: data folders with an innocent log, and commands and functions that read one file."""

import json
import pickle
import shutil
import struct
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq

from factory.datasets.scenarionet.photos import cameras_in, load_sidecar, read_photographs
from factory.exits import COMPLETE
from factory.readers.base import BadClip
from factory.readers.pictures import jpeg_size
from factory.setup.vocabulary import load_recovery_table
from factory.stages.sensors import decode_image, opened_photos
from factory.store.episodes import check_episode
from tasks.world.clip import Camera, SensorFile
from tasks.world.frames import EGO_STATE_SIZE
from tests.chaos.hostile_files import grammars
from tests.chaos.hostile_files.grammars import Crafted, Rng
from tests.factory.datasets.navsim.geopackage_writer import CITIES
from tests.factory.datasets.navsim.navsim_town import write_town
from tests.factory.datasets.py123d.py123d_logs import convert
from tests.factory.datasets.scenarionet.scenarionet_scenarios import nuscenes, save
from tests.writable import load_writable

PLAIN = ("experts=[human]", "rounds=1", "render=none", "reward.labels=none", "executor=local", "vocabulary.k=16")


def write_innocents(folder: Path, doors: Collection[str]) -> int:
    """What stands beside the hostile files of these doors, or is what they are made like; what is there is kept."""
    from factory.datasets.town.reader import SyntheticReader
    from factory.datasets.town.settings import TownSettings
    from factory.run import main as run

    if not (folder / "scenarionet").exists():
        save(nuscenes(), folder / "scenarionet", "sd_innocent.pkl")
    if not (folder / "towns").exists() and any(door.startswith(("av2", "navsim", "py123d", "yaml")) for door in doors):
        SyntheticReader(folder / "towns", 1, 0, TownSettings(("ring_front_center",), 64, 36, lidar_beams=0)).index()
        (town,) = (path for path in folder.glob("towns/*/*") if path.is_dir())
        shutil.copytree(town, folder / "av2" / "innocent")
        convert(town, folder / "py123d")
        write_town(folder / "navsim", "mini", town, next(iter(CITIES)))
    if not (folder / "run").exists() and any(door.startswith(("table", "shard")) for door in doors):
        return run(["clips=scenarionet", f"clips.root={folder / 'scenarionet'}", *PLAIN, f"out={folder / 'run'}"])
    return COMPLETE


@dataclass(frozen=True)
class Logs:
    """A folder of logs that a run reads, where many hostile ones lie beside an innocent one."""

    craft: Callable[[Path, Rng], Crafted]  # of write_innocents' folder
    put: Callable[[Path, Path, str, bytes | None], str]  # innocents, data, name, crafted or None, the innocent: its id
    words: str  # of the run


def _pickled(good: str, place: str, innocents: Path, data: Path, name: str, crafted: bytes | None) -> str:
    source, path = next(innocents.glob(good)), data / place.format(name)
    path = path if crafted is not None else path.with_name(source.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(source.read_bytes() if crafted is None else crafted.replace(b"hostile", name.encode()))
    return path.stem


SCENARIO, FRAMES = "scenarionet/*.pkl", "navsim/navsim_logs/mini/*.pkl"


def _frames(innocents: Path, rng: Rng) -> Crafted:
    if rng.random() < 0.25:
        return grammars.program(rng)
    frames = [frame | {"log_name": "hostile"} for frame in load_writable(next(innocents.glob(FRAMES)))]
    if rng.random() < 0.1:
        return "frames: many", pickle.dumps(frames * grammars.pick(rng, (100, 400)), int(rng.integers(2, 6)))
    name, what = grammars.valued("frames", rng)
    return name, pickle.dumps(grammars.planted(frames, rng, what, 0.9), int(rng.integers(2, 6)))


def _log(folder: Path) -> Path:
    """The one log below it: the folder with files in it."""
    return next(path for path in sorted(folder.rglob("*")) if path.suffix in (".feather", ".arrow")).parent


def _of_log(folder: str, patterns: Sequence[str], innocents: Path, rng: Rng) -> Crafted:
    """One file of a log in several; its name stands before the bytes."""
    log = _log(innocents / folder)
    path = grammars.pick(rng, sorted(log.glob(grammars.pick(rng, patterns))))
    if path.suffix == ".json":
        what, crafted = grammars.json_text(json.loads(path.read_bytes()), rng)
    else:
        packed = rng.random() < 0.1 and folder == "py123d"
        good = pyarrow.feather.read_table(path, memory_map=False, use_threads=False)
        what, crafted = (_packed if packed else grammars.arrow)(good, rng)
    return f"{path.name} {what}", str(path.relative_to(log)).encode() + b"\n" + crafted


def _packed(good: pa.Table, rng: Rng) -> Crafted:
    """msgpack within Arrow's metadata."""
    size, n = grammars.pick(rng, grammars.SIZES), min(grammars.pick(rng, grammars.MANY), 9999)
    kind = grammars.pick(rng, ("f8", "O", "V99", "(9999,)f8"))
    texts = {f"{k}{grammars.FORGED}": "x" for k in range(n)}
    values: dict[str, bytes] = {
        "array": msgpack.packb({b"__ndarray__": True, b"dtype": kind, b"shape": [size], b"data": b"x" * 8}),
        "deep": msgpack.packb(grammars.nested(400)),
        "texts": msgpack.packb(texts),
        "length": b"\xdd" + struct.pack(">I", size & 0xFFFFFFFF),
    }
    name, packed = grammars.one_of("msgpack", values, rng)
    pyarrow.feather.write_feather(good.replace_schema_metadata({b"metadata": packed}), sink := pa.BufferOutputStream())
    return name, sink.getvalue().to_pybytes()


def _linked(folder: str, innocents: Path, data: Path, name: str, crafted: bytes | None) -> str:
    """A log like the innocent one, by links, but for one file."""
    log = _log(innocents / folder)
    here = data / log.relative_to(innocents / folder).with_name(name)
    part, _, content = (crafted or b"").partition(b"\n")
    for path in (path for path in log.rglob("*") if path.is_file()):
        (to := here / path.relative_to(log)).parent.mkdir(parents=True, exist_ok=True)
        if to == here / part.decode():
            to.write_bytes(content)
        else:
            to.symlink_to(path.resolve())
    return name


AV2_FILES = ("annotations.feather", "city_SE3_egovehicle.feather", "calibration/intrinsics.feather", "map/*.json")
READ = "clips={} clips.root={{data}}"
MAPPED = (
    "clips=navsim clips.root={data}/navsim_logs/mini clips.maps={innocents}/navsim/maps clips.cache_dir={data}/kept"
)


def _folders(clips: str, *files: str) -> Logs:
    return Logs(partial(_of_log, clips, files), partial(_linked, clips), READ.format(clips))


LOGS: Mapping[str, Logs] = {
    "scenarionet": Logs(
        lambda _, rng: grammars.scenario(rng), partial(_pickled, SCENARIO, "sd_{}.pkl"), READ.format("scenarionet")
    ),
    "navsim": Logs(_frames, partial(_pickled, FRAMES, "navsim_logs/mini/{}.pkl"), MAPPED),
    "av2": _folders("av2", *AV2_FILES),
    "py123d": _folders("py123d", "*.arrow"),
}


@dataclass(frozen=True)
class Single:
    """A file that a command of the product, or a public function of it, reads."""

    craft: Callable[[Path, Rng], Crafted]
    name: str  # of the file
    reads: str | Callable[[Path], Any]  # a command, factory or planners, and its words; a function of the file
    refusals: tuple[type[Exception], ...] = (BadClip, ValueError)  # of the function
    like: str = ""  # what of the innocents the file lies in a copy of
    named: str | None = ""  # what a refusal must name; empty: the file; None: nothing, of a function of bytes alone


def _alone(craft: Callable[[Rng], Crafted], name: str, reads: str | Callable[[Path], Any], **more: Any) -> Single:
    return Single(lambda _, rng: craft(rng), name, reads.format(name) if isinstance(reads, str) else reads, **more)


def _good_commit(innocents: Path) -> list[dict[str, Any]]:
    """All of a good log in one commit."""
    files = sorted((innocents / "run/samples/_delta_log").glob("*.json"))
    actions = [json.loads(line) for path in files for line in path.read_text().splitlines()]
    return [action for action in actions if "commitInfo" not in action]


SHARD, COMMIT = "run/samples/round=0/expert=human/hostile.parquet", f"run/samples/_delta_log/{0:020}.json"


def _crafted_shard(innocents: Path, rng: Rng) -> Crafted:
    (good,) = (innocents / "run/samples").glob("*/*/*.parquet")
    return grammars.parquet(pq.ParquetFile(good).read(use_threads=False), rng)


def _of_run(name: str, reads: str | Callable[[Path], Any]) -> Single:
    craft = _crafted_shard if name == SHARD else lambda innocents, rng: grammars.commit(_good_commit(innocents), rng)
    named = Path(SHARD).name if name == SHARD and isinstance(reads, str) else "run"
    return Single(craft, name, reads, (Exception,), "run", named)


def _read_batch(path: Path) -> Any:
    """By the decoder of a planner's batches."""
    from planners.data.images import _decode_jpeg

    return _decode_jpeg(np.frombuffer(data := path.read_bytes(), np.uint8), jpeg_size(data)[::-1])


def _read_sidecar(path: Path) -> Any:
    cameras_in(load_sidecar(path)[0], str(path))
    return read_photographs(path, path.parent, np.zeros((121, EGO_STATE_SIZE)))


def _read_photo(path: Path) -> Any:
    camera = Camera("front", 64, 36, np.eye(3), np.zeros(5), np.eye(4))
    return list(opened_photos([SensorFile("front", str(path), 0.0, np.eye(4))], [camera]))


def _read_samples(path: Path) -> Any:
    """The run that the file lies in."""
    from factory.store.reader import SampleTable

    table = SampleTable(next(parent for parent in path.parents if parent.name == "run"))
    return [len(table[k]) for k in range(len(table))]


CAMERA: dict[str, Any] = {"width": 64, "height": 36, "ego_from_camera": np.eye(4).tolist()}
CAMERA |= {"K": [[50.0, 0, 32], [0, 50, 18], [0, 0, 1]]}
SIDECAR = {"cameras": {"front": CAMERA}, "frames": [{"camera": "front", "file": "a.jpg", "time_s": 0.1}]}
PICTURES = (grammars.png, grammars.jpeg, grammars.jpeg, grammars.other_picture)
RUN, IMPORT = f"factory run {' '.join(PLAIN)} out=out ", "factory scene import {} to=scene.safetensors"
FILTERED = RUN + "clips=navsim clips.root=navsim/navsim_logs/mini clips.maps=navsim/maps clips.scene_filter={}"
WITH_VOCABULARY = RUN + "clips=scenarionet clips.root=scenarionet vocabulary.file={}"
SINGLES: Mapping[str, Single] = {
    "yaml filter": _alone(grammars.yaml_text, "hostile.yaml", FILTERED, like="navsim"),
    "vocabulary": _alone(
        lambda rng: (grammars.npz if rng.random() < 0.2 else grammars.npy)(rng),
        "hostile.npy",
        WITH_VOCABULARY,
        like="scenarionet",
    ),
    "recovery table": _alone(grammars.npz, "hostile.npz", load_recovery_table),
    "scene ply": _alone(grammars.ply, "hostile.ply", IMPORT),
    "scene spz": _alone(grammars.spz, "hostile.spz", IMPORT),
    "scene checkpoint": _alone(grammars.checkpoint, "hostile.ckpt", IMPORT),
    "scene file": _alone(grammars.safetensors, "hostile.safetensors", "factory scene info {}"),
    "planner checkpoint": _alone(grammars.checkpoint, "h.ckpt", "planners import {} planner=ltf_public out=planner"),
    "picture": _alone(
        lambda rng: grammars.pick(rng, PICTURES)(rng), "h.jpg", lambda path: decode_image(path.read_bytes(), str(path))
    ),
    "photo": _alone(lambda rng: grammars.pick(rng, PICTURES)(rng), "hostile.jpg", _read_photo),
    "picture of a batch": _alone(grammars.jpeg, "hostile.jpg", _read_batch, named=None),
    "episode": _alone(grammars.mcap, "hostile.mcap", lambda path: check_episode(path.read_bytes()), named=None),
    "sidecar": _alone(partial(grammars.json_text, SIDECAR), "hostile.json", _read_sidecar),
    "table, status": _of_run(COMMIT, "factory status out=run"),
    "table, verify": _of_run(COMMIT, "factory verify run"),
    "table, read": _of_run(COMMIT, _read_samples),
    "shard, verify": _of_run(SHARD, "factory verify run"),
    "shard, read": _of_run(SHARD, _read_samples),
}


def put_single(single: Single, innocents: Path, folder: Path, crafted: bytes) -> Path:
    """The file in a folder of its own; a run's log is remade to be one commit, which names a hostile shard."""
    folder.mkdir()
    if single.like:
        shutil.copytree(innocents / single.like, folder / single.like)
    if single.like == "run":
        shutil.rmtree(folder / "run/samples/_commits")  # a stranger's run has none, or made to match
        for old in (folder / "run/samples/_delta_log").iterdir():
            old.unlink()
        told = {"path": SHARD.partition("samples/")[2], "size": len(crafted)}
        adds = [a | {"add": a["add"] | told} if "add" in a else a for a in _good_commit(innocents)]
        (folder / COMMIT).write_text("\n".join(map(json.dumps, adds)))
    (path := folder / single.name).write_bytes(crafted)
    return path


DOORS = (*LOGS, *SINGLES)

"""The kinds of files that are fuzzed: how each is written, and how it is read."""

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from google.protobuf.timestamp_pb2 import Timestamp

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.navsim.log import read_frames, read_scene_pickle
from factory.datasets.navsim.reader import frame_table, read_selection
from factory.datasets.py123d.reader import Py123dReader
from factory.datasets.scenarionet.reader import ScenarioNetReader
from factory.datasets.town.reader import SyntheticReader
from factory.datasets.town.settings import TownSettings
from factory.readers.base import BadClip
from factory.setup.vocabulary import load_recovery_table, load_vocabulary, save_recovery_table, save_vocabulary
from factory.stages.entries import tiny_clip
from factory.stages.scene_file import BadScene, read_scene, write_scene
from factory.stages.sensors import decode_image, load_sweeps
from factory.store.episodes import Message, check_episode, episode_bytes
from factory.store.location import BadCacheFile, decode_tree, encode_tree
from factory.views.scene_files import background_bytes, read_splats
from tasks.experts.recovery import RecoveryTable
from tasks.render.splatting.project import CLASSIC
from tasks.world.clip import SensorFile
from tasks.world.vocabulary import Vocabulary, kinematic_trajectories
from tests.chaos.damaged_files.mutants_of_files import Rng, of_bytes, of_json, of_pickle, of_text
from tests.factory.datasets.navsim import scene_pickles
from tests.factory.datasets.navsim.logs import NAME, frame
from tests.factory.datasets.navsim.openscene_writer import merged_pcd, write_frames
from tests.factory.datasets.navsim.test_filters import FILTER
from tests.factory.datasets.py123d.py123d_logs import convert
from tests.factory.datasets.scenarionet import scenarionet_scenarios
from tests.factory.stages.test_scene_file import scene

TOWN = TownSettings(cameras=("ring_front_center",), width=64, height=36, lidar_beams=4, lidar_azimuths=30)


@dataclass(frozen=True)
class Readable:
    """One file, whole, and the reader of it."""

    path: Path
    read: Callable[[], Any]
    refusals: tuple[type[Exception], ...] = (BadClip,)
    mutant: Callable[[bytes, Rng], bytes] = of_bytes
    is_sound: Callable[[Any], bool] = lambda value: True
    named: bool = True  # a refusal says which file


def write_all(folder: Path) -> None:
    """Every kind's file."""
    SyntheticReader(folder / "towns", 1, 0, TOWN).index()
    convert(next(path for path in sorted(folder.glob("towns/*/*")) if path.is_dir()), folder / "123d")
    scenarionet_scenarios.save(scenarionet_scenarios.nuscenes(), folder / "scenarionet")
    write_frames(folder, "mini", NAME, [frame(k) for k in range(24)])
    around = [frame(k) for k in range(20)]
    scene_pickles.write_scene(folder, scene_pickles.scene_of_log(around, 11, "0000000000005a00c", cameras=True))
    (folder / "filter.yaml").write_text(FILTER)
    save_vocabulary(folder / "vocabulary.npy", Vocabulary(kinematic_trajectories(9, 0)), {})
    save_recovery_table(folder / "table.npz", RecoveryTable(kinematic_trajectories(9, 0)), {})
    (folder / "kept.clip").write_bytes(encode_tree(replace(tiny_clip())))
    write_scene(folder / "scene.safetensors", scene())
    for suffix in (".ply", ".spz"):
        (folder / f"splats{suffix}").write_bytes(background_bytes(scene().background, suffix, np.zeros(3), CLASSIC))
    picture = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    for suffix in (".png", ".jpg"):
        (folder / f"picture{suffix}").write_bytes(cv2.imencode(suffix, cv2.blur(picture, (5, 5)))[1].tobytes())
    points = np.random.default_rng(0).normal(0.0, 20.0, (50, 4)) + 5.0
    (folder / "sweep.pcd").write_bytes(merged_pcd(points))
    messages = [Message("/a", k, Timestamp(seconds=k)) for k in range(20)]
    (folder / "episode.mcap").write_bytes(episode_bytes(messages, {"id": "a"}))


def _town(name: str, folder: Path) -> Readable:
    """A file of the town's log, through the reader of Argoverse 2: its windows, and a clip."""
    reader = AV2Reader(next((folder / "towns").glob("town-*")))
    (ref,), (log,) = reader.index().refs[:1], reader.logs().values()
    (path, *_) = sorted(log.glob(name))

    def read() -> Any:
        fresh = AV2Reader(reader.root)
        fresh.windows_of(log)
        return fresh.read(ref)

    mutant = of_json if path.suffix == ".json" else of_bytes
    return Readable(path, read, mutant=mutant, named=False)


def _converted(name: str, folder: Path) -> Readable:
    """A file of the same log as 123D has it."""
    reader = Py123dReader(folder / "123d")
    (log,) = reader.logs().values()
    ref = reader.index().refs[0]

    def read() -> Any:
        fresh = Py123dReader(reader.root)
        fresh.windows_of(log)
        return fresh.read(ref)

    return Readable(next(path for path in sorted(log.iterdir()) if path.name.startswith(name)), read, named=False)


def _scenario(folder: Path) -> Readable:
    (path,) = (folder / "scenarionet").glob("*.pkl")
    ref = ScenarioNetReader(path.parent).index().refs[0]

    def read() -> Any:
        fresh = ScenarioNetReader(path.parent)
        fresh.windows_of(path)
        return fresh.read(ref)

    return Readable(path, read, mutant=of_pickle)


def _log(folder: Path) -> Readable:
    (path,) = folder.glob(f"**/{NAME}.pkl")
    return Readable(path, lambda: frame_table(read_frames(path)), mutant=of_pickle)


def _scene_pickle(folder: Path) -> Readable:
    (path,) = (path for path in folder.glob("*.pkl") if path.stem != NAME)
    return Readable(path, lambda: read_scene_pickle(path))


def _sweep(path: Path) -> Readable:
    return Readable(path, lambda: load_sweeps([SensorFile("lidar", str(path), 0.0, np.eye(4))]))


def _vocabulary(folder: Path) -> Readable:
    path = folder / "vocabulary.npy"
    return Readable(path, lambda: load_vocabulary(path).digest, (ValueError,))


def _table(folder: Path) -> Readable:
    path = folder / "table.npz"
    golden = load_recovery_table(path).digest
    return Readable(path, lambda: load_recovery_table(path).digest, (ValueError,), is_sound=golden.__eq__)


def _kept_clip(folder: Path) -> Readable:
    path = folder / "kept.clip"
    golden = pickle.dumps(encode_tree(decode_tree(path.read_bytes())))
    same = lambda value: pickle.dumps(encode_tree(value)) == golden  # noqa: E731
    return Readable(path, lambda: decode_tree(path.read_bytes()), (BadCacheFile,), is_sound=same, named=False)


def _scene(folder: Path) -> Readable:
    path = folder / "scene.safetensors"
    golden = read_scene(path).digest
    return Readable(path, lambda: read_scene(path).digest, (BadScene,), is_sound=golden.__eq__)


def _splats(suffix: str, folder: Path) -> Readable:
    path = folder / f"splats{suffix}"
    return Readable(path, lambda: read_splats(path), (BadScene,))


def _picture(suffix: str, folder: Path) -> Readable:
    path = folder / f"picture{suffix}"
    is_picture = lambda value: value.ndim == 3 and value.dtype == np.uint8  # noqa: E731
    return Readable(path, lambda: decode_image(path.read_bytes(), str(path)), is_sound=is_picture)


def _filter(folder: Path) -> Readable:
    path = folder / "filter.yaml"
    return Readable(path, lambda: read_selection(str(path)), (ValueError,), of_text)


def _episode(folder: Path) -> Readable:
    path = folder / "episode.mcap"
    golden = path.read_bytes()
    read = lambda: check_episode(path.read_bytes()) or path.read_bytes()  # noqa: E731
    return Readable(path, read, (ValueError,), is_sound=golden.__eq__, named=False)


KINDS: Mapping[str, Callable[[Path], Readable]] = {
    "feather, agents": partial(_town, "annotations.feather"),
    "feather, poses": partial(_town, "city_SE3_egovehicle.feather"),
    "feather, intrinsics": partial(_town, "calibration/intrinsics.feather"),
    "feather, a sweep": lambda folder: _sweep(next(folder.glob("towns/*/*/sensors/lidar/*.feather"))),
    "arrow, 123D's agents": partial(_converted, "box_detections"),
    "arrow, 123D's map": partial(_converted, "map"),
    "json, a map": partial(_town, "map/log_map_archive*.json"),
    "pickle, ScenarioNet": _scenario,
    "pickle, OpenScene": _log,
    "pickle, a NAVSIM scene": _scene_pickle,
    "pcd, a sweep": lambda folder: _sweep(folder / "sweep.pcd"),
    "npy, a vocabulary": _vocabulary,
    "npz, a recovery table": _table,
    "a kept clip unsealed": _kept_clip,
    "safetensors": _scene,
    "ply": partial(_splats, ".ply"),
    "spz": partial(_splats, ".spz"),
    "png": partial(_picture, ".png"),
    "jpeg": partial(_picture, ".jpg"),
    "yaml, a scene filter": _filter,
    "mcap": _episode,
}

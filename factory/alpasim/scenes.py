"""The scenes that are served: a run's clips whose blocks have scenes, or one drive of which there are photos alone.

Stamps count from a scene's first instant, which is 0. `local` has the world's axes, its zero where the ego was then.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from hashlib import sha256
from pathlib import Path

import numpy as np

from factory.alpasim.wire import Fault
from factory.stages.scene_file import BadScene, read_scene, scene_files
from factory.store.samples import Store
from factory.views.rendered_again import scene_folder
from factory.views.scene_files import prepared_clip
from tasks.render.scene.asset import RenderAsset
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S, AgentTracks, Camera, Clip, PhotoDrive

KEPT = 4  # scenes in memory


@dataclass(frozen=True)
class ServedScene:
    """One scene, as a run draws it."""

    asset: RenderAsset  # its times are seconds since the first instant
    cameras: tuple[Camera, ...]
    origin: Array  # (3,) of `local` in the world [m]
    on_road: Array  # (P, 4, 4) poses of the ego that say how high the road is and how it leans, world
    agents: AgentTracks  # as logged, at 10 Hz from the first instant on, as high as they stand on the scene's road
    clip: Clip | None = None  # with the map; None: there is none
    first_s: float = 0.0  # of the first instant, since the block's

    def lifted(self, agents: AgentTracks, step: int) -> AgentTracks:
        """Tracks whose first step is at `step`, as high above the scene's road as they are above the log's."""
        return self.asset.lifted(agents, self.first_s + step * STEP_S)


def scene_of_clip(clip: Clip, asset: RenderAsset) -> ServedScene:
    """A run's: the clip's window of its block. Raises BadScene."""
    if asset.block is None:
        raise BadScene("the scene does not say which log it is of")
    first_s, measured = clip.start_s - asset.block.start_s, {view.camera for view in asset.views}
    cameras = tuple(camera for camera in clip.cameras if not measured or camera.name in measured)
    return ServedScene(
        asset.since(first_s),
        asset.as_corrected(cameras),
        clip.world_from_ego[0, :3, 3],
        asset.on_road(clip.world_from_ego),
        asset.lifted(clip.agents, first_s),
        clip,
        first_s,
    )


def scene_of_drive(drive: PhotoDrive, asset: RenderAsset) -> ServedScene:
    """One of photos alone, whose first instant is the block's."""
    first = min(drive.block.images, key=lambda file: file.time_s)
    logged = np.stack([file.world_from_ego for file in drive.block.images])
    agents = asset.settled(drive.block.agents, 0.0)
    origin = first.world_from_ego[:3, 3]
    return ServedScene(asset, asset.as_corrected(drive.cameras), origin, asset.on_road(logged), agents)


class Scenes:
    """All that are served, by their ids; read when they are first asked for."""

    def __init__(self, loaders: Mapping[str, Callable[[], ServedScene]], digest: str = "") -> None:
        """digest: of what the scenes are, where their ids do not say it."""
        self._loaders, self.digest = dict(loaders), digest
        self._load = lru_cache(KEPT)(lambda scene_id: self._loaders[scene_id]())

    @property
    def ids(self) -> list[str]:
        """In order."""
        return sorted(self._loaders)

    def find(self, name: str, scene_id: str) -> ServedScene:
        """The scene that a request's field `name` asks for. Raises Fault."""
        if scene_id not in self._loaders:
            raise Fault("NOT_FOUND", f"{name}={scene_id[:64]!r}: no such scene; get_available_scenes names them")
        try:
            return self._load(scene_id)
        except BadScene as error:
            raise Fault("DATA_LOSS", f"{name}={scene_id}: {error}") from error


def scenes_of_run(store: Store) -> Scenes:
    """Of prepared clips, by their ids: in the scene that their samples were drawn from, else in the only one that is
    kept of their log, as where no drive was accepted."""
    rows = store.samples.read(["clip_id", "asset_digest"]).to_pylist()
    kept = scene_files(scene_folder(store))
    of_log = defaultdict[tuple[str, str] | None, list[str]](list)
    for digest, scene in kept.items():
        of_log[scene.log].append(digest)
    drawn_from = {row["clip_id"]: [row["asset_digest"]] for row in rows if row["asset_digest"] in kept}
    loaders, made_of = dict[str, Callable[[], ServedScene]](), list[tuple[str, str]]()
    for row in store.candidates.read(["clip_id", "dataset", "log_id", "prepare_digest"]).to_pylist():
        name = row["clip_id"]
        scenes = drawn_from.get(name) or of_log[row["dataset"], row["log_id"]]
        if len(scenes) == 1:
            loaders[name] = partial(_load, store, name, row["prepare_digest"], kept[scenes[0]].path)
            made_of.append((name, scenes[0]))
    return Scenes(loaders, sha256(repr(sorted(made_of)).encode()).hexdigest()[:16])


def _load(store: Store, clip_id: str, prepare_digest: str, path: Path) -> ServedScene:
    clip = prepared_clip(store, clip_id, prepare_digest)
    if clip is None:
        raise BadScene(f"the prepared clip is no more in {store.cache.location.uri}; run again with the same command")
    asset = read_scene(path)
    if asset.block is not None and not asset.block.start_s <= clip.start_s + 1e-6 <= asset.block.end_s:
        raise BadScene(f"{path}: of another part of the log than the clip, whose scene is not kept")
    return scene_of_clip(clip, asset)

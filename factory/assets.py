"""The Gaussian scene of a clip's block: built once, kept on disk under the digest of what it is built from.

A block is a stretch of a log that several clips lie in (tasks.world.clip.Block). Whoever comes first on a machine
builds the scene while the others wait for it; the file appears by an atomic rename, so that a killed builder leaves
nothing half done.
"""

import fcntl
import hashlib
import json
import logging
import os
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factory.sensors import block_of, chosen_cameras, load_sensors, load_sweeps, taken_by
from tasks.render.gaussians import Gaussians
from tasks.render.lidar_only import lidar_asset
from tasks.render.scene import RenderAsset, build_asset
from tasks.render.settings import RenderSettings
from tasks.render.sky import SkyMap
from tasks.render.stereo import MAX_BASELINE_M, MIN_BASELINE_M
from tasks.world.camera import SensorFile
from tasks.world.clip import Clip

ASSET_VERSION = 2  # raised by hand when the same sensors give another scene
PARALLAX_SHARE = 0.9  # without lidar, a photo with no other in stereo reach shows sky alone; so few may be like that
log = logging.getLogger(__name__)


class Sensing(Enum):
    """What a clip's block was seen by."""

    PHOTOS = "photos"  # and lidar
    PHOTOS_ONLY = "photos_only"  # depth from parallax alone
    LIDAR_ONLY = "lidar_only"
    NOTHING = "nothing"


def sensing(clip: Clip, settings: RenderSettings) -> Sensing:
    """What the block can be made of; nothing without a rig to look through, or without lidar and parallax.

    Raises ValueError for a camera the rig does not have.
    """
    block, cameras = block_of(clip), chosen_cameras(clip.cameras, settings.cameras)
    photos = taken_by(cameras, block.images)
    if block.sweeps and cameras:
        return Sensing.PHOTOS if photos else Sensing.LIDAR_ONLY
    return Sensing.PHOTOS_ONLY if photos and _with_parallax(photos) >= PARALLAX_SHARE else Sensing.NOTHING


def _with_parallax(photos: Sequence[SensorFile]) -> float:
    """Share of the photos that another of the same camera lies at a useful distance from for depth by comparison."""
    places: dict[str, list[NDArray[np.float64]]] = {}
    for file in photos:
        places.setdefault(file.sensor, []).append(file.world_from_ego[:3, 3])
    found = 0
    for mine in places.values():
        apart = np.linalg.norm(np.stack(mine)[:, None] - np.stack(mine), axis=-1)
        found += int(((apart >= MIN_BASELINE_M) & (apart <= MAX_BASELINE_M)).any(axis=1).sum())
    return found / len(photos)


def asset_for(clip: Clip, settings: RenderSettings, cache_dir: str | Path) -> RenderAsset | None:
    """The scene of the clip's block with its digest; None where the clip has nothing to make one from.

    Made of photos and lidar, or of either alone (`sensing`).
    Raises BadClip where a sensor file is broken, ValueError for a camera the rig does not have.
    """
    block, cameras = block_of(clip), chosen_cameras(clip.cameras, settings.cameras)
    made_of = sensing(clip, settings)
    if made_of is Sensing.NOTHING:
        return None
    path = Path(cache_dir) / f"block-{block_id(clip, settings)}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    with only_builder(path):
        if path.exists():
            try:
                return read_asset(path)
            except (ValueError, KeyError, OSError, zipfile.BadZipFile) as error:
                log.warning("%s is damaged (%s) and is built again", path, error)
        if made_of is not Sensing.LIDAR_ONLY:
            data = load_sensors(block, cameras, settings.width, settings.height)
            asset = build_asset(data.photos, data.sweeps, block.agents, settings.asset)
        else:
            asset = lidar_asset(load_sweeps(block.sweeps, with_intensity=True), block.agents)
        asset = replace(asset, digest=asset_digest(asset))
        write_asset(path, asset)
    return asset


@contextmanager
def only_builder(path: Path) -> Iterator[None]:
    """Held by one process of the machine at a time; the kernel frees it when its holder dies."""
    with path.with_suffix(".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def block_id(clip: Clip, settings: RenderSettings) -> str:
    """16 hex digits of everything the scene depends on but the sensor files' content, known without opening them."""
    digest = hashlib.sha256()
    block = block_of(clip)
    made_of = (ASSET_VERSION, clip.dataset, clip.log_id, block.start_s, clip.content_digest)
    how = (settings.width, settings.height, sorted(settings.cameras), asdict(settings.asset))
    digest.update(json.dumps([made_of, how], sort_keys=True).encode())
    for file in (*block.images, *block.sweeps):
        digest.update(f"{file.sensor}\x1f{Path(file.uri).name}\x1f{file.time_s!r}".encode())
        digest.update(np.ascontiguousarray(file.world_from_ego).tobytes())
    return digest.hexdigest()[:16]


def asset_digest(asset: RenderAsset) -> str:
    """16 hex digits of the scene's content."""
    digest = hashlib.sha256()
    for name, array in sorted(_arrays(asset).items()):
        digest.update(f"{name}\x1f{array.dtype.str}\x1f{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def write_asset(path: Path, asset: RenderAsset) -> None:
    """Writes beside the path and renames."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".block-", suffix=".npz")
    try:
        with os.fdopen(handle, "wb") as file:
            arrays: dict[str, Any] = _arrays(asset) | {"digest": np.array(asset.digest)}
            np.savez(file, **arrays)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_asset(path: Path) -> RenderAsset:
    """The stored scene. Raises ValueError where its content is not what its digest says."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    names = [str(name) for name in arrays["node_ids"]]
    starts = np.concatenate([[0], np.cumsum(arrays["node_sizes"])])
    every = _gaussians(arrays, "node")
    asset = RenderAsset(
        origin=arrays["origin"],
        background=_gaussians(arrays, "background"),
        nodes={name: every.take(np.arange(a, b)) for name, a, b in zip(names, starts[:-1], starts[1:])},
        sky=SkyMap(arrays["sky"]),
        psnr_db=float(arrays["psnr_db"]),
        n_held_out=int(arrays["n_held_out"]),
        digest=str(arrays["digest"]),
    )
    if asset_digest(asset) != asset.digest:
        raise ValueError("the content does not match its digest")
    return asset


def _arrays(asset: RenderAsset) -> dict[str, NDArray[Any]]:
    nodes = list(asset.nodes.items())
    out: dict[str, NDArray[Any]] = {
        "origin": asset.origin,
        "sky": asset.sky.rgb,
        "psnr_db": np.array(asset.psnr_db),
        "n_held_out": np.array(asset.n_held_out),
        "node_ids": np.array([name for name, _ in nodes], dtype=np.str_),
        "node_sizes": np.array([len(node) for _, node in nodes], np.int64),
    }
    for field in fields(Gaussians):
        whole = getattr(asset.background, field.name)
        out[f"background_{field.name}"] = whole
        parts = [getattr(node, field.name) for _, node in nodes]
        out[f"node_{field.name}"] = np.concatenate(parts) if parts else whole[:0]
    return out


def _gaussians(arrays: dict[str, NDArray[Any]], prefix: str) -> Gaussians:
    return Gaussians(**{field.name: arrays[f"{prefix}_{field.name}"] for field in fields(Gaussians)})

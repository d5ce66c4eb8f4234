"""A block's scene in words, and its parts as the files of other programs."""

import json
import math
import pickle
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pyarrow as pa

from factory.graph.steps import cache_key
from factory.pipeline import CACHED_CLIP
from factory.readers.pickles import load_tensors
from factory.stages.scene_file import BadScene, read_dtype, read_scene, scene_header
from factory.store.location import CLIP_SUFFIX, BadCacheFile
from factory.wording import one_line
from tasks.render.scene.asset import BlockRange, RenderAsset, ViewQuality
from tasks.render.scene.dome import sky_gaussians
from tasks.render.scene.movers import world_from_boxes
from tasks.render.scene.sky import plain_sky
from tasks.render.splatting import sh
from tasks.render.splatting.classic import made_classic
from tasks.render.splatting.formats import (
    LoggedVehicle,
    SplatCheckpoint,
    from_checkpoint,
    from_ply,
    from_spz,
    to_ply,
    to_splatfacto,
    to_spz,
    to_worldengine,
)
from tasks.render.splatting.gaussians import Gaussians, moved, quats_of
from tasks.render.splatting.project import ANTIALIASED, CLASSIC, ScreenFilter
from tasks.world.arrays import Array
from tasks.world.clip import STEP_S, Camera, Clip, Pinhole
from tasks.world.frames import pose_on_ground

if TYPE_CHECKING:
    from factory.store.samples import Store


# Where a log had the vehicles of a scene, by the prepared clips of a run: a scene's file holds none of their poses.

SLACK_S = 0.5 * STEP_S


def logged_vehicles(store: "Store", asset: RenderAsset) -> tuple[list[LoggedVehicle], list[str]]:
    """The scene's vehicles with their poses as the log has them, on the scene's road; and the ids of those that no clip
    of the run shows within the scene's stretch of its log.

    Raises BadScene where the scene does not say which log it is of, where the run has no prepared clip of that, and
    where two ids make one token or a file of the cache is damaged.
    """
    if (block := asset.block) is None:
        raise BadScene("out=: the scene does not say which log it is of, so that no run has its vehicles' poses")
    seen: dict[str, dict[int, Array]] = {name: {} for name in asset.nodes}  # by time [ms] since the block's start
    found = False
    for clip in _prepared_clips_of_block(store, block):
        found = True
        _add_boxes(seen, clip, asset, block)
    if not found:
        stretch = f"{block.log_id}, {block.start_s:.1f} to {block.end_s:.1f} s"
        raise BadScene(f"{store.location.uri}: no prepared clip of log {stretch} in its cache")
    times_ms = sorted({time_ms for boxes in seen.values() for time_ms in boxes})
    known = [name for name, boxes in seen.items() if boxes]
    tokens = [re.sub(r"[^A-Za-z0-9-]", "-", name) for name in known]  # it cuts at underscores, and a point would nest
    if len(set(tokens)) < len(tokens):
        raise BadScene(f"track ids {', '.join(known)}: two of them make the same token")
    times_s = block.start_s + 1e-3 * np.array(times_ms)
    vehicles = [
        LoggedVehicle(token, asset.nodes[name], times_s, _poses_of_boxes(seen[name], times_ms))
        for name, token in zip(known, tokens)
    ]
    return vehicles, [name for name in seen if name not in known]


@dataclass(frozen=True)
class LoggedRig:
    """The cameras of a scene's log, and where its ego was, on the scene's road."""

    cameras: tuple[Camera, ...]
    times_s: Array  # (F,) since the log's first instant
    scene_from_ego: Array  # (F, 4, 4)

    def eyes(self) -> list[tuple[int, Pinhole]]:
        """Every camera at every EYE_STRIDE-th instant of the log, with the instant's row."""
        rows = range(0, len(self.times_s), EYE_STRIDE)
        poses = [(row, c, self.scene_from_ego[row] @ c.ego_from_camera) for row in rows for c in self.cameras]
        return [(row, Pinhole(c.intrinsics, pose, c.width, c.height)) for row, c, pose in poses]


EYE_STRIDE = 6  # of 0.1 s


def logged_rig(store: "Store", asset: RenderAsset) -> LoggedRig:
    """By the run's clips of the scene's stretch of its log. Raises BadScene as `logged_vehicles`."""
    assert asset.block is not None, "logged_vehicles comes first"
    cameras, poses = tuple[Camera, ...](), dict[int, Array]()
    for clip in _prepared_clips_of_block(store, asset.block):
        cameras = asset.as_corrected(clip.cameras)
        on_road = pose_on_ground(asset.on_road(clip.world_from_ego), clip.ego_states)
        on_road[:, :3, 3] -= asset.origin
        poses |= {round(1e3 * (clip.start_s + k * STEP_S)): pose for k, pose in enumerate(on_road)}
    if not cameras:
        raise BadScene(f"{store.location.uri}: the log {asset.block.log_id} has no cameras")
    times_ms = sorted(poses)
    return LoggedRig(cameras, 1e-3 * np.array(times_ms), np.stack([poses[time_ms] for time_ms in times_ms]))


def video_scene_dict(name: str, rig: LoggedRig) -> bytes:
    """What AlpaSim's MTGS server wants beside a checkpoint (NVlabs/alpasim 9177bd0, plugins/mtgs/server): cameras as
    they are mounted, and the ego's poses in the checkpoint's frame, from which it takes heights and tilts. Containers,
    numbers and text alone, which any reader of pickles takes."""
    cams = {
        camera.name: {
            "cam_intrinsic": camera.intrinsics.tolist(),
            "distortion": camera.distortion.tolist(),
            "sensor2ego_rotation": quats_of(camera.ego_from_camera[None, :3, :3])[0].tolist(),
            "sensor2ego_translation": camera.ego_from_camera[:3, 3].tolist(),
            "height": camera.height,
            "width": camera.width,
        }
        for camera in rig.cameras
    }
    frames = [
        {"cams": cams, "ego2global": pose.tolist(), "timestamp": round(1e6 * time_s)}
        for time_s, pose in zip(rig.times_s.tolist(), rig.scene_from_ego)
    ]
    return pickle.dumps({name: {"frame_infos": frames}}, protocol=4)


def classic_scene(
    asset: RenderAsset, vehicles: Sequence[LoggedVehicle], rig: LoggedRig
) -> tuple[RenderAsset, list[LoggedVehicle]]:
    """The scene and its vehicles with opacities for gsplat's `classic`, as it is driven through in its log."""
    eyes = rig.eyes()
    street = made_classic(asset.background, asset.screen, [eye for _, eye in eyes])
    out, made = [], {id(node): node for node in asset.nodes.values()}
    for vehicle in vehicles:
        near = []
        for row, eye in eyes:
            (there,) = np.nonzero(np.abs(vehicle.times_s - rig.times_s[row]) < SLACK_S)
            if len(there) and np.isfinite(pose := vehicle.scene_from_box[there[0]]).all():
                near.append(replace(eye, world_from_camera=np.linalg.inv(pose) @ eye.world_from_camera))
        made[id(vehicle.gaussians)] = made_classic(vehicle.gaussians, asset.screen, near)
        out.append(replace(vehicle, gaussians=made[id(vehicle.gaussians)]))
    nodes = {name: made[id(node)] for name, node in asset.nodes.items()}
    return replace(asset, background=street, nodes=nodes, screen=CLASSIC), out


def _prepared_clips_of_block(store: "Store", block: BlockRange) -> Iterator[Clip]:
    """Prepared clips of the block's log that overlap its stretch, as far as the cache has them still."""
    rows = store.candidates.read(["clip_id", "dataset", "log_id", "prepare_digest"]).to_pylist()
    for row in sorted(rows, key=lambda row: str(row["clip_id"])):
        if (row["dataset"], row["log_id"]) != (block.dataset, block.log_id):
            continue
        clip = prepared_clip(store, row["clip_id"], row["prepare_digest"])
        if clip is None:
            continue
        if clip.start_s < block.end_s and clip.start_s + clip.agents.n_steps * STEP_S > block.start_s:
            yield clip


def prepared_clip(store: "Store", clip_id: str, prepare_digest: str) -> Clip | None:
    """Without its sensor files; None where the cache has it no more. Raises BadScene for a damaged file."""
    key = cache_key(clip_id, prepare_digest)
    try:
        found = store.cache.load(key, within=CACHED_CLIP)
        return found if isinstance(found, Clip) else None
    except BadCacheFile as error:
        path = f"{store.cache.location.uri}/{key}{CLIP_SUFFIX}"
        raise BadScene(f"{path}: {error}; the next run makes it again") from error


def _add_boxes(seen: dict[str, dict[int, Array]], clip: Clip, asset: RenderAsset, block: BlockRange) -> None:
    """Of a clip's tracks those that are `seen` by now, their boxes (7,), within the block."""
    first_s, length_s = clip.start_s - block.start_s, block.end_s - block.start_s
    agents, origin = asset.settled(clip.agents, first_s), np.append(asset.origin, np.zeros(4))
    for j, name in enumerate(agents.track_ids):
        for k in np.flatnonzero(agents.valid[:, j]) if name in seen else ():
            time_s = first_s + k * STEP_S
            if -SLACK_S < time_s < length_s + SLACK_S:
                x, y, heading, length, width = agents.boxes[k, j]
                box = np.array([x, y, agents.center_z[k, j], heading, length, width, agents.heights[j]])
                seen[name][round(1e3 * time_s)] = box - origin


def _poses_of_boxes(boxes: dict[int, Array], times_ms: Sequence[int]) -> Array:
    """(F, 4, 4) of the boxes at these times; NaN where there is none."""
    poses = np.full((len(times_ms), 4, 4), np.nan)
    rows = [i for i, time_ms in enumerate(times_ms) if time_ms in boxes]
    poses[rows] = world_from_boxes(np.stack([boxes[times_ms[i]] for i in rows]))
    return poses


# How well scenes show photos they were not made of, camera by camera: for `factory scene` and the report.

MEANS = ("psnr_db", "ssim", "away_m")  # of views


@dataclass(frozen=True)
class CameraRow:
    """Means over a camera's photos that were held out; NaN where something was not measured."""

    camera: str
    photos: int
    psnr_db: float
    ssim: float
    away_m: float  # from the nearest photo that the scene was made of
    psnr_db_of: Mapping[str, float]  # by class: road, vehicles, rest

    @property
    def text(self) -> str:
        """In one line; what was not measured is left out."""
        said = [(self.psnr_db, f"{self.psnr_db:.2f} dB"), (self.ssim, f"SSIM {self.ssim:.3f}")]
        found = ", ".join(text for number, text in said if not math.isnan(number))
        away = "" if math.isnan(self.away_m) else f", {self.away_m:.1f} m from the nearest photo used"
        classes = ", ".join(f"{name} {value:.2f} dB" for name, value in self.psnr_db_of.items())
        return f"{found} over {self.photos} held-out photos{away}" + (f" ({classes})" if classes else "")


def camera_rows(views: Sequence[ViewQuality]) -> list[CameraRow]:
    """A row a camera, in the order of the views."""
    rows = []
    for camera in dict.fromkeys(view.camera for view in views if view.held_out):
        mine = [view for view in views if view.held_out and view.camera == camera]
        classes: dict[str, list[float]] = {}
        for part in (part for view in mine for part in view.classes):
            classes.setdefault(part.name, []).append(part.psnr_db)
        means = {name: _mean([getattr(view, name) for view in mine]) for name in MEANS}
        of = {name: _mean(values) for name, values in classes.items()}
        rows.append(CameraRow(camera=camera, photos=len(mine), psnr_db_of=of, **means))
    return rows


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


# Gaussians as files that other programs read and write: .ply, .spz, and checkpoints of torch.

CHECKPOINTS = (".ckpt", ".pt", ".pth")
SUFFIXES = (".ply", ".spz", *CHECKPOINTS)
NO_TORCH = "PyTorch is needed for checkpoints: pip install 'driving-data-factory[planners]'"


def read_splats(path: Path, traversal: int | None = None, transforms: Path | None = None) -> SplatCheckpoint:
    """A file by its name's end.

    traversal: whose colours points of an MTGS checkpoint have; None: the mean. transforms: nerfstudio's
    dataparser_transforms.json, which is taken back. Raises BadScene that names the file.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise BadScene(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    if suffix not in CHECKPOINTS and traversal is not None:
        raise BadScene(f"{path}: traversal= is of a checkpoint of MTGS")
    try:
        if suffix in CHECKPOINTS:
            found = from_checkpoint(_load_checkpoint(path), traversal)
        elif suffix == ".ply":
            found = SplatCheckpoint(from_ply(path.read_bytes()))
        else:
            gaussians, antialiased = from_spz(path.read_bytes(), decompress_zstd)
            found = SplatCheckpoint(gaussians, screen=ANTIALIASED if antialiased else None)
    except BadScene:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:  # of another's content
        raise BadScene(f"{path}: {one_line(error)}") from error
    if not len(found.background):
        raise BadScene(f"{path}: no Gaussian in it")
    if transforms is None:
        return found
    if found.nodes or found.origin is not None:
        raise BadScene(f"{path}: transforms= is of nerfstudio's own scenes, which have neither vehicles nor an origin")
    return replace(found, background=undo_transform(found.background, *read_nerfstudio_transform(transforms)))


def background_bytes(
    gaussians: Gaussians,
    suffix: str,
    origin: Array,
    screen: ScreenFilter,
    vehicles: Sequence[LoggedVehicle] = (),
    sky: Gaussians | None = None,
) -> bytes:
    """A street's file; a checkpoint is WorldEngine's, `origin` (3,) [m] in the world, and has its `vehicles` and sky.

    Raises ValueError.
    """
    if suffix in CHECKPOINTS:
        return _checkpoint_bytes(to_worldengine(gaussians, origin, vehicles, sky))
    return to_ply(gaussians) if suffix == ".ply" else to_spz(gaussians, screen.keeps_light)


def node_bytes(gaussians: Gaussians, suffix: str, screen: ScreenFilter) -> bytes:
    """A vehicle's file; a checkpoint is splatfacto's. Raises ValueError."""
    if suffix in CHECKPOINTS:
        return _checkpoint_bytes(to_splatfacto(gaussians))
    return background_bytes(gaussians, suffix, np.zeros(3), screen)


def read_nerfstudio_transform(path: Path) -> tuple[Array, float]:
    """Rigid (4, 4), and the scale after it, that led from the photos' frame to nerfstudio's. Raises BadScene."""
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        matrix, scale = np.array(told["transform"], np.float64), float(told["scale"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise BadScene(f"{path}: expected nerfstudio's 'transform' (3 x 4) and 'scale': {one_line(error)}") from error
    is_rigid = matrix.shape == (3, 4) and np.allclose(matrix[:, :3] @ matrix[:, :3].T, np.eye(3), atol=1e-4)
    if not is_rigid or not scale > 0.0:
        raise BadScene(f"{path}: 'transform' is no rigid 3 x 4 matrix, or 'scale' not above 0")
    return np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]]), scale


def undo_transform(gaussians: Gaussians, transform: Array, scale: float) -> Gaussians:
    """The Gaussians of a frame that x -> scale * (transform x) led to, in x's own."""
    grown = replace(
        gaussians,
        means=gaussians.means / np.float32(scale),
        log_scales=gaussians.log_scales - np.float32(np.log(scale)),
    )
    return moved(grown, np.asarray(np.linalg.inv(transform), np.float64))


def decompress_zstd(data: bytes, size: int) -> bytes:
    """What a stream of zstd holds, `size` bytes. Raises OSError."""
    return pa.decompress(data, size, codec="zstd", asbytes=True)


def _load_checkpoint(path: Path) -> object:
    """Of tensors, arrays and plain values alone; nothing of the file runs. Raises BadScene."""
    rebuilt: Any = np.zeros(0).__reduce__()[0]
    scalar: Any = np.float64(0.0).__reduce__()[0]
    kinds: list[Any] = [type(np.dtype(kind)) for kind in "fdilq?"]
    older = [(rebuilt, "numpy.core.multiarray._reconstruct"), (scalar, "numpy.core.multiarray.scalar")]  # numpy 1
    arrays = [np.ndarray, np.dtype, *kinds, rebuilt, scalar, *older]
    try:
        content = load_tensors(path, arrays)
    except ModuleNotFoundError as error:
        raise BadScene(f"{path}: {NO_TORCH}") from error
    except ValueError as error:
        raise BadScene(str(error)) from error
    return _as_arrays(content)


def _as_arrays(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _as_arrays(each) for name, each in value.items()}
    if not hasattr(value, "detach"):
        return value
    tensor = value.detach()
    return (tensor.float() if tensor.is_floating_point() else tensor).numpy()


def _checkpoint_bytes(content: Mapping[str, Any]) -> bytes:
    """The content as torch saves it, arrays as tensors. Raises ValueError without PyTorch."""
    import io

    try:
        import torch
    except ModuleNotFoundError as error:
        raise ValueError(NO_TORCH) from error

    def tensors(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: tensors(each) for name, each in value.items()}
        return torch.from_numpy(np.array(value)) if isinstance(value, np.ndarray) else value

    buffer = io.BytesIO()
    torch.save(tensors(content), buffer)
    return buffer.getvalue()


def info_text(path: Path, asset: RenderAsset) -> str:
    """What a scene holds, a few lines."""
    lines = [str(path), f"file        {read_dtype(path)}, {path.stat().st_size / 1e6:.1f} MB"]
    lines += [f"digest      {asset.digest}", f"origin      {', '.join(f'{v:.2f}' for v in asset.origin)} m"]
    if (block := asset.block) is not None:
        x, y = (f"{low:.1f} .. {high:.1f}" for low, high in zip(block.low, block.high))
        lines.append(f"block       {block.dataset} {block.log_id}, {block.start_s:.1f} to {block.end_s:.1f} s")
        lines.append(f"sensors at  x {x}, y {y} m")
    how = "antialiased" if asset.screen.keeps_light else "classic"
    lines.append(f"drawn       {how}, {asset.screen.dilation_px2:g} px2 wider")
    lines.append(f"background  {_gaussians_text(asset.background)}")
    lines += [f"node        {name}: {_gaussians_text(node)}" for name, node in asset.nodes.items()]
    held_out = f"{asset.psnr_db:.2f} dB over {asset.n_held_out} held-out photos"
    lines.append(f"psnr        {held_out if np.isfinite(asset.psnr_db) else 'not measured'}")
    lines += [f"camera      {row.camera}: {row.text}" for row in camera_rows(asset.views)]
    for body in asset.bodies:
        lines.append(f"own body    {body.camera}: {100.0 * (body.rgba[..., 3] > 0).mean():.1f} % of its picture")
    lines += [
        f"view        {view.camera} at {view.time_s:.2f} s: {view.psnr_db:.2f} dB, SSIM {view.ssim:.3f}"
        f"{', held out' if view.held_out else ''}"
        for view in asset.views
    ]
    return "\n".join([*lines, f"exposures   {len(asset.exposures)}"])


def export_scene(
    asset: RenderAsset,
    folder: Path,
    suffix: str = ".ply",
    vehicles: Sequence[LoggedVehicle] = (),
    rig: LoggedRig | None = None,
) -> list[Path]:
    """Writes the parts into a folder, Gaussians as `suffix` says; returns their paths.

    rig: of a checkpoint as WorldEngine and AlpaSim have it, `background/<folder's name>.ckpt` with its `vehicles` and a
    sky, and AlpaSim's `video_scene_dict.pkl`. Raises BadScene where a part cannot be written so.
    """
    folder.mkdir(parents=True, exist_ok=True)
    nodes = {f"node-{re.sub(r'[^A-Za-z0-9._-]', '_', name)}{suffix}": node for name, node in asset.nodes.items()}
    if len(nodes) < len(asset.nodes):
        raise BadScene(f"track ids {', '.join(asset.nodes)}: two of them make the same file name")
    street = partial(background_bytes, asset.background, suffix, asset.origin, asset.screen, vehicles)
    files: dict[str, Callable[[], bytes]] = {f"background{suffix}": street}
    if rig is not None:
        name = folder.resolve().name
        if name[-4:-3] == "-":
            raise BadScene(f"to={folder}: AlpaSim cuts {name[-4:]} off a scene's name; give it another")
        (folder / "background").mkdir(exist_ok=True)
        sky = sky_gaussians(asset.sky, rig.scene_from_ego[:, :3, 3].mean(axis=0))
        files = {f"background/{name}{suffix}": partial(street, sky)}
        files["video_scene_dict.pkl"] = partial(video_scene_dict, name, rig)
    files |= {name: partial(node_bytes, node, suffix, asset.screen) for name, node in nodes.items()}
    for name, written in files.items():
        try:
            (folder / name).write_bytes(written())
        except ValueError as error:
            raise BadScene(f"{name}: {error}") from error
    sky = np.rint(np.clip(asset.sky.rgb, 0.0, 1.0) * 255.0).astype(np.uint8)
    (folder / "sky.png").write_bytes(cv2.imencode(".png", cv2.cvtColor(sky, cv2.COLOR_RGB2BGR))[1].tobytes())
    described = scene_header(asset) | {"origin": asset.origin.tolist(), "digest": asset.digest, "files": list(files)}
    (folder / "scene.json").write_text(json.dumps(described, indent=1))
    return [folder / name for name in (*files, "sky.png", "scene.json")]


def scene_from_splats(
    found: SplatCheckpoint, like: str | None = None, origin: str | None = None, antialiased: bool | None = None
) -> RenderAsset:
    """What a file holds as a scene of unknown quality. Raises BadScene or ValueError.

    like: the scene that origin, sky, range and, where the file has none, vehicles are of. origin: x,y,z [m] of the
    file's zero in the world; where the file says it, that must not be given. antialiased: how it was made to be drawn;
    None: as the file says, else as the other scene, else not so.
    """
    screen = found.screen if antialiased is None else (ANTIALIASED if antialiased else CLASSIC)
    if found.origin is not None and origin is not None:
        raise ValueError("origin=: the file itself says where it lies in the world")
    place = _parse_origin(origin or "0,0,0") if found.origin is None else found.origin
    if like is None:
        return RenderAsset(place, found.background, found.nodes, plain_sky(), float("nan"), screen=screen or CLASSIC)
    other = read_scene(Path(like))
    return replace(
        other,
        origin=other.origin if found.origin is None else found.origin,
        background=found.background,
        screen=screen or other.screen,
        nodes=found.nodes or other.nodes,
        psnr_db=float("nan"),
        n_held_out=0,
        digest="",
        views=(),
    )


def _parse_origin(text: str) -> np.ndarray:
    try:
        place = np.array([float(number) for number in text.split(",")])
    except ValueError as error:
        raise ValueError(f"origin={text}: {error}") from error
    if place.shape != (3,) or not np.isfinite(place).all():
        raise ValueError(f"origin={text}: expected x,y,z in metres")
    return place


def _gaussians_text(part: Gaussians) -> str:
    return f"{len(part)} Gaussians, SH degree {sh.COUNTS.index(part.sh_rest.shape[1])}"

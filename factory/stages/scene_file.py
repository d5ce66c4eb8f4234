"""A block's scene as one file: tensors in safetensors, everything else as JSON in its header.

| tensor | shape | what |
|---|---|---|
| `origin` | (3,) float64 | world [m] of the local frame's zero |
| `background.<field>` | (N, ...) | the street: one tensor for each field of `Gaussians` |
| `nodes.<i>.<field>` | (N_i, ...) | the i-th track, in its box's frame |
| `sky` | (rows, columns, 3) | colours by direction |
| `taken` | (P, 4, 4) float64 | where the ego was at each photo, where the photos corrected that |
| `shifts` | (N, K, 4) | how far the tracks that the photos show were off their logged boxes, every 0.5 s |
| `bodies.<i>` | (H, W, 4) uint8 | what the i-th camera that sees one sees of the own body |
| `exposures` | (P, 3, 4) | what each photo made of the light, where they were aligned |

With `SceneDtype.FLOAT16` what Gaussians are made of, but for their places (`means`), and the sky are float16, and the
version is 2. Whoever reads gets float32 again, quaternions of length 1.

The header's entry `scene` holds the rest: format, the nodes' track ids and those of the shifts, quality photo by photo,
the photos of the exposures, the block's range, the cameras where they were corrected, the digest over all of it, and
the name that the file was written under. No code runs when a file is read.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from factory.files import atomic_file
from factory.store.schema import canonical_json
from factory.wording import shown
from tasks.render.scene.asset import BlockRange, ClassQuality, Exposure, OwnBody, PhotoPose, RenderAsset, ViewQuality
from tasks.render.scene.movers import NO_SHIFTS, BoxShifts
from tasks.render.scene.sky import SkyMap
from tasks.render.settings import SceneDtype
from tasks.render.splatting.gaussians import Gaussians
from tasks.render.splatting.project import ScreenFilter
from tasks.world.clip import Camera, Fisheye

FORMAT = "driving-data-factory scene"
VERSION_OF = {SceneDtype.FLOAT32: 1, SceneDtype.FLOAT16: 2}
IN_HALF = ("quats", "log_scales", "opacities", "colours", "sh_rest")  # of a Gaussian, where the file is of 16 bits
MOST_OPAQUE = np.float32(1.0 - 2.0**-11)  # of an opacity in 16 bits: below 1, so that its logit is finite
MEASURES = ("psnr_db", "ssim", "away_m")  # of views and their classes: NaN or infinite, maybe
KEY = "scene"  # one entry: safetensors writes several in no fixed order
SUFFIX = ".safetensors"
CALIBRATED = ("intrinsics", "distortion", "ego_from_camera")  # of a camera, arrays
Tensors = Mapping[str, NDArray[Any]]


class BadScene(ValueError):
    """The file is no scene, or damaged: says which file and what."""


def write_scene(path: Path, asset: RenderAsset, dtype: SceneDtype = SceneDtype.FLOAT32) -> RenderAsset:
    """Writes beside the path and renames; returns the scene as it is read back, with its digest.

    Raises ValueError for what 16 bits do not hold.
    """
    tensors, described = scene_tensors(asset, dtype), scene_header(asset, dtype)
    digest = scene_digest(tensors, described)
    header = described | {"digest": digest, "kept_as": path.stem}
    data = save(dict(tensors), metadata={KEY: canonical_json(header)})
    with atomic_file(path, len(data)) as draft:
        draft.write_bytes(data)
    return scene_from_parts(tensors, described, digest)


def read_scene(path: Path, kept_as: str = "") -> RenderAsset:
    """The stored scene. Raises BadScene that names the file, where it is no scene or not what its digest says.

    kept_as: the name that it was written under, where that matters.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            header = (file.metadata() or {}).get(KEY)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, OSError) as error:
        raise BadScene(f"{path}: cannot be read: {error}") from error
    if header is None:
        raise BadScene(f"{path}: no scene: its header has no entry {KEY!r}")
    try:
        described = json.loads(header)
        if described["format"] != FORMAT or described["version"] not in VERSION_OF.values():
            found = f"{shown(described['format'])} {shown(described['version'])}"
            raise BadScene(f"{path}: format {found}, this version reads {FORMAT!r} 1 and 2")
        stated, name = described.pop("digest"), described.pop("kept_as")
        if kept_as and name != kept_as:
            raise BadScene(f"{path}: it is of another block, written as {name}.safetensors")
        if scene_digest(tensors, described) != stated:
            raise BadScene(f"{path}: the content does not match its digest {stated}")
        return scene_from_parts(tensors, described, stated)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
        if isinstance(error, BadScene):
            raise
        raise BadScene(f"{path}: damaged: {type(error).__name__} {error}") from error


def find_scene(folder: Path, digest: str) -> RenderAsset | None:
    """The block's scene of that digest in a cache folder, by the headers alone; None where it is not there.

    Raises BadScene for a file whose header names the digest and whose content is another.
    """
    kept = scene_files(folder).get(digest)
    return None if kept is None else read_scene(kept.path)


@dataclass(frozen=True)
class KeptScene:
    """A block's scene in a cache folder, by its header alone."""

    path: Path
    log: tuple[str, str] | None  # data set and id of the log that it is of


def scene_files(folder: Path) -> dict[str, KeptScene]:
    """The blocks' scenes in a cache folder by the digests that their headers name."""
    found: dict[str, KeptScene] = {}
    for path in sorted(folder.glob(f"block-*{SUFFIX}")):
        try:
            with safe_open(path, framework="numpy") as file:
                header = json.loads((file.metadata() or {}).get(KEY, "{}"))
            digest, block = header.get("digest"), header.get("block")
            log = None if block is None else (str(block["dataset"]), str(block["log_id"]))
        except (SafetensorError, OSError, ValueError, AttributeError, TypeError, KeyError):
            continue  # of another scene, as far as anyone can tell: whoever needs that one builds it again
        found.setdefault(digest, KeptScene(path, log))
    return found


def read_dtype(path: Path) -> SceneDtype:
    """What a scene's file holds its Gaussians in, by its header alone. Raises BadScene where it has none."""
    try:
        with safe_open(path, framework="numpy") as file:
            version = json.loads((file.metadata() or {})[KEY])["version"]
        return next(dtype for dtype, known in VERSION_OF.items() if known == version)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, StopIteration) as error:
        raise BadScene(f"{path}: no scene: {type(error).__name__} {error}") from error


def scene_tensors(asset: RenderAsset, dtype: SceneDtype = SceneDtype.FLOAT32) -> dict[str, NDArray[Any]]:
    """The scene's arrays by their names in the file, contiguous. Raises ValueError for what 16 bits do not hold."""
    out: dict[str, NDArray[Any]] = {"origin": asset.origin, "sky": asset.sky.rgb}
    parts = {"background": asset.background} | {f"nodes.{i}": node for i, node in enumerate(asset.nodes.values())}
    for name, part in parts.items():
        out |= {f"{name}.{field.name}": getattr(part, field.name) for field in fields(Gaussians)}
    if dtype is SceneDtype.FLOAT16:
        out |= {
            name: _in_half(name, array)
            for name, array in out.items()
            if name == "sky" or name.rpartition(".")[2] in IN_HALF
        }
    if asset.exposures:
        out["exposures"] = np.stack([exposure.affine for exposure in asset.exposures])
    if asset.taken:
        out["taken"] = np.stack([photo.world_from_ego for photo in asset.taken])
    if asset.shifts.track_ids:
        out["shifts"] = asset.shifts.rows
    out |= {f"bodies.{i}": body.rgba for i, body in enumerate(asset.bodies)}
    return {name: np.ascontiguousarray(array) for name, array in out.items()}


def scene_header(asset: RenderAsset, dtype: SceneDtype = SceneDtype.FLOAT32) -> dict[str, Any]:
    """What of the scene is no array, as plain JSON values; NaN is null."""
    block = asset.block
    rig = [_camera_to_json(camera) for camera in asset.rig]
    taken = [[photo.camera, photo.time_s, photo.rise_m] for photo in asset.taken]
    bodies, shifts = [body.camera for body in asset.bodies], list(asset.shifts.track_ids)
    more = {"rig": rig, "taken": taken, "bodies": bodies, "shifts": shifts}
    return {
        "format": FORMAT,
        "version": VERSION_OF[dtype],
        "screen": list(asset.screen),
        "nodes": list(asset.nodes),
        "psnr_db": _number_to_json(asset.psnr_db),
        "n_held_out": asset.n_held_out,
        "views": [_view_to_json(asdict(view)) for view in asset.views],
        "exposures": [[exposure.camera, exposure.time_s] for exposure in asset.exposures],
        "block": None if block is None else asdict(block) | {"low": block.low.tolist(), "high": block.high.tolist()},
    } | {name: values for name, values in more.items() if values}


def scene_from_parts(tensors: Tensors, described: Mapping[str, Any], digest: str) -> RenderAsset:
    """The opposite of `scene_tensors` and `scene_header`. Raises KeyError, TypeError, ValueError where one lacks."""

    def part(name: str) -> Gaussians:
        return _in_float32({field.name: tensors[f"{name}.{field.name}"] for field in fields(Gaussians)})

    if tensors["origin"].shape != (3,):
        raise ValueError(f"origin of shape {tensors['origin'].shape}, expected (3,)")
    block = described["block"]
    if block is not None:
        block = BlockRange(**block | {side: np.array(block[side], np.float64) for side in ("low", "high")})
    return RenderAsset(
        origin=tensors["origin"],
        background=part("background"),
        nodes={name: part(f"nodes.{i}") for i, name in enumerate(described["nodes"])},
        sky=SkyMap(tensors["sky"].astype(np.float32)),
        psnr_db=_number_from_json(described["psnr_db"]),
        n_held_out=described["n_held_out"],
        digest=digest,
        screen=ScreenFilter(*described["screen"]),
        views=tuple(_view_from_json(view) for view in described["views"]),
        exposures=tuple(
            Exposure(camera, time_s, tensors["exposures"][i])
            for i, (camera, time_s) in enumerate(described["exposures"])
        ),
        block=block,
        rig=tuple(_camera_from_json(camera) for camera in described.get("rig", ())),
        taken=tuple(
            PhotoPose(camera, time_s, tensors["taken"][i], rise_m)
            for i, (camera, time_s, rise_m) in enumerate(described.get("taken", ()))
        ),
        shifts=BoxShifts(tuple(described["shifts"]), tensors["shifts"]) if "shifts" in described else NO_SHIFTS,
        bodies=tuple(OwnBody(camera, tensors[f"bodies.{i}"]) for i, camera in enumerate(described.get("bodies", ()))),
    )


def _in_half(name: str, array: NDArray[Any]) -> NDArray[np.float16]:
    """In 16 bits, rounded to the nearest. Raises ValueError where one is too large."""
    if name.endswith(".opacities"):
        array = np.minimum(array, MOST_OPAQUE)
    with np.errstate(over="ignore"):
        half = array.astype(np.float16)
    if (np.isinf(half) & np.isfinite(array)).any():
        raise ValueError(f"{name}: {np.abs(array).max():g} is more than 16 bits hold; keep the scene in float32")
    return half


def _in_float32(arrays: Mapping[str, NDArray[Any]]) -> Gaussians:
    """Gaussians of a file's arrays; what was in 16 bits is float32, its quaternions of length 1 again."""
    if arrays["quats"].dtype != np.float16:
        return Gaussians(**arrays)
    whole = {name: array.astype(np.float32) for name, array in arrays.items()}
    quats = whole["quats"].astype(np.float64)
    return Gaussians(**whole | {"quats": (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)})


def scene_digest(tensors: Tensors, described: Mapping[str, Any]) -> str:
    """16 hex digits of the scene's content."""
    digest = hashlib.sha256(canonical_json(described).encode())
    for name, array in sorted(tensors.items()):
        digest.update(f"\x1f{name}\x1f{array.dtype.str}\x1f{array.shape}\x1f".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def _view_to_json(values: Mapping[str, Any]) -> dict[str, Any]:
    """A view's fields as JSON has them, those of its classes as well."""
    numbers = {name: _number_to_json(value) for name, value in values.items() if isinstance(value, float)}
    parts = {
        name: [_view_to_json(part) for part in value] for name, value in values.items() if isinstance(value, tuple)
    }
    return dict(values) | numbers | parts


def _camera_to_json(camera: Camera) -> dict[str, Any]:
    plain = {name: getattr(camera, name) for name in ("name", "width", "height")}
    plain |= {name: getattr(camera, name).tolist() for name in CALIBRATED}
    lens = camera.fisheye
    if camera.readout_s:
        plain |= {"readout_s": camera.readout_s}
    return plain if lens is None else plain | {"fisheye": [lens.intrinsics.tolist(), lens.terms.tolist()]}


def _camera_from_json(plain: Mapping[str, Any]) -> Camera:
    arrays = {name: np.array(plain[name], np.float64) for name in CALIBRATED}
    lens = Fisheye(*(np.array(part, np.float64) for part in plain["fisheye"])) if "fisheye" in plain else None
    return Camera(**dict(plain) | arrays | {"fisheye": lens})


def _view_from_json(plain: Mapping[str, Any]) -> ViewQuality:
    """The opposite of `_view_to_json` for a view."""
    classes = tuple(ClassQuality(**_measures(part)) for part in plain["classes"])
    return ViewQuality(**_measures(plain) | {"classes": classes})


def _measures(plain: Mapping[str, Any]) -> dict[str, Any]:
    return dict(plain) | {name: _number_from_json(plain[name]) for name in MEASURES if name in plain}


def _number_to_json(value: float) -> float | str | None:
    """A number as JSON has it: NaN is null, infinity (a photo without a fault) a word."""
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else str(value)


def _number_from_json(value: float | str | None) -> float:
    return float("nan") if value is None else float(value)

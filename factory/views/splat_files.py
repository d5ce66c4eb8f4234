"""Gaussians as files that other programs read and write: .ply, .spz, and checkpoints of torch."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from factory.readers.torch_file import load_tensors
from factory.stages.scene_file import BadScene
from factory.wording import one_line
from tasks.render.splatting.formats import (
    LoggedVehicle,
    SplatCheckpoint,
    from_checkpoint,
    from_ply,
    from_spz,
    splatfacto,
    to_ply,
    to_spz,
    worldengine,
)
from tasks.render.splatting.gaussians import Gaussians, moved
from tasks.render.splatting.project import ANTIALIASED, ScreenFilter
from tasks.world.arrays import Array

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
            found = from_checkpoint(_loaded(path), traversal)
        else:
            data = path.read_bytes()
            found = SplatCheckpoint(from_ply(data)) if suffix == ".ply" else _of_spz(data)
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
    return replace(found, background=taken_back(found.background, *transform_of(transforms)))


def background_bytes(
    gaussians: Gaussians,
    suffix: str,
    origin: Array,
    screen: ScreenFilter,
    vehicles: Sequence[LoggedVehicle] = (),
) -> bytes:
    """A street's file; a checkpoint is WorldEngine's, `origin` (3,) [m] in the world, and has its `vehicles`.

    Raises ValueError.
    """
    if suffix in CHECKPOINTS:
        return _saved(worldengine(gaussians, origin, vehicles))
    return _bytes(gaussians, suffix, screen)


def node_bytes(gaussians: Gaussians, suffix: str, screen: ScreenFilter) -> bytes:
    """A vehicle's file; a checkpoint is splatfacto's. Raises ValueError."""
    return _saved(splatfacto(gaussians)) if suffix in CHECKPOINTS else _bytes(gaussians, suffix, screen)


def transform_of(path: Path) -> tuple[Array, float]:
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


def taken_back(gaussians: Gaussians, transform: Array, scale: float) -> Gaussians:
    """The Gaussians of a frame that x -> scale * (transform x) led to, in x's own."""
    grown = replace(
        gaussians,
        means=gaussians.means / np.float32(scale),
        log_scales=gaussians.log_scales - np.float32(np.log(scale)),
    )
    return moved(grown, np.asarray(np.linalg.inv(transform), np.float64))


def zstd(data: bytes, size: int) -> bytes:
    """What a stream of zstd holds, `size` bytes. Raises OSError."""
    return pa.decompress(data, size, codec="zstd", asbytes=True)


def _bytes(gaussians: Gaussians, suffix: str, screen: ScreenFilter) -> bytes:
    return to_ply(gaussians) if suffix == ".ply" else to_spz(gaussians, screen.keeps_light)


def _of_spz(data: bytes) -> SplatCheckpoint:
    found, antialiased = from_spz(data, zstd)
    return SplatCheckpoint(found, screen=ANTIALIASED if antialiased else None)


def _loaded(path: Path) -> object:
    """Of tensors, arrays and plain values alone; nothing of the file runs. Raises BadScene."""
    rebuilt: Any = np.zeros(0).__reduce__()[0]
    scalar: Any = np.float64(0.0).__reduce__()[0]
    kinds: list[Any] = [type(np.dtype(kind)) for kind in "fdilq?"]
    older = [(rebuilt, "numpy.core.multiarray._reconstruct"), (scalar, "numpy.core.multiarray.scalar")]  # numpy 1
    arrays = [np.ndarray, np.dtype, *kinds, rebuilt, scalar, *older]
    try:
        return _as_arrays(load_tensors(path, arrays))
    except ImportError as error:
        raise BadScene(f"{path}: {NO_TORCH}") from error
    except ValueError as error:
        raise BadScene(str(error)) from error


def _as_arrays(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _as_arrays(each) for name, each in value.items()}
    if not hasattr(value, "detach"):
        return value
    tensor = value.detach()
    return (tensor.float() if tensor.is_floating_point() else tensor).numpy()


def _saved(content: Mapping[str, Any]) -> bytes:
    """The content as torch saves it, arrays as tensors. Raises ValueError without PyTorch."""
    import io

    try:
        import torch
    except ImportError as error:
        raise ValueError(NO_TORCH) from error

    def tensors(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: tensors(each) for name, each in value.items()}
        return torch.from_numpy(np.array(value)) if isinstance(value, np.ndarray) else value

    buffer = io.BytesIO()
    torch.save(tensors(content), buffer)
    return buffer.getvalue()

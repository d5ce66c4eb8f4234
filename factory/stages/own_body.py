"""Masks of what a rig sees of the car that carries it: `<camera>.png` in a folder of the user's, white where it is."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np

from factory.files import matching
from factory.readers.pictures import BadPicture, decode_grey
from tasks.render.views import straightened, undistorted
from tasks.world.arrays import Bools
from tasks.world.camera import Camera

WHITE = 128  # grey level from which on a pixel is of the body
NO_MASKS: Mapping[str, Bools] = MappingProxyType({})


def read_masks(folder: str, cameras: Sequence[Camera]) -> Mapping[str, Bools]:
    """(H, W) of the photos as they were taken, by camera; a camera without a file sees nothing of the body.

    Raises ValueError for a folder without masks, and for a mask that is no picture of its camera's size.
    """
    if not folder:
        return NO_MASKS
    files = _files(folder)
    found = {}
    for camera in cameras:
        if camera.name not in files:
            continue
        path = files[camera.name]
        try:
            mask = decode_grey(path.read_bytes(), (camera.width, camera.height))
        except BadPicture as error:
            raise ValueError(f"render.own_body: {path} is {error}") from error
        found[camera.name] = np.asarray(mask >= WHITE)
    return found


def masks_digest(folder: str) -> str:
    """Of all masks' names and bytes; empty without a folder. Raises ValueError as `read_masks`."""
    if not folder:
        return ""
    digest = hashlib.sha256()
    for name, path in sorted(_files(folder).items()):
        digest.update(f"{name}\x1f".encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def refuse_unknown_masks(folder: str, rig: Sequence[Camera]) -> None:
    """Raises ValueError for a mask of a camera that the rig does not have, and as `read_masks`."""
    if not folder:
        return
    names = [camera.name for camera in rig]
    unknown = sorted(set(_files(folder)) - set(names))
    if unknown:
        raise ValueError(f"render.own_body: no camera {', '.join(unknown)}; this rig has {', '.join(names) or 'none'}")
    read_masks(folder, rig)


def resized_mask(mask: Bools, camera: Camera, width: int, height: int) -> Bools:
    """A mask (H, W) as its camera's photos are shown: without distortion, the middle, width x height."""
    left, top, w, h = camera.window(width, height)
    grey = mask.astype(np.uint8) * 255
    if camera.fisheye is not None:
        grey = straightened(grey, camera.fisheye)
    flat = undistorted(grey, camera)[top : top + h, left : left + w]
    return np.asarray(cv2.resize(flat, (width, height), interpolation=cv2.INTER_AREA) >= WHITE)


def _files(folder: str) -> dict[str, Path]:
    files = {path.stem: path for path in matching(Path(folder), "*.png")}
    if not files:
        raise ValueError(f"render.own_body: {folder} holds no <camera>.png")
    return files

"""A sample's pictures as files of eight cameras, and what the frames say of these cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from factory.datasets.navsim.frames import FRAME_S, N_FRAMES, N_HISTORY, NOW_FRAME, SampleNames, hex16
from factory.datasets.navsim.settings import PUBLIC_SIZE, CannotExport, ExportSettings
from factory.store.reader import decode_stored_image
from tasks.render.views import pinhole
from tasks.world.clip import Camera

# Which camera of a rig stands for which of the eight that NAVSIM knows.

# Where nuPlan's cameras look, degrees to the left of the ego's heading.
YAW_DEG = {
    "CAM_F0": 0.0,
    "CAM_L0": 55.0,
    "CAM_L1": 111.0,
    "CAM_L2": 141.0,
    "CAM_R0": -55.0,
    "CAM_R1": -111.0,
    "CAM_R2": -141.0,
    "CAM_B0": 180.0,
}
CAMERAS = tuple(YAW_DEG)
MOST_DEG = 30.0  # off the direction that a camera stands for
NOMINAL_VIEW_DEG = 63.7  # horizontal, of nuPlan's cameras: 1920 px at a focal length of 1545 px


def slots(cameras: Sequence[Camera]) -> Mapping[str, Camera]:
    """NAVSIM's name -> the rig's camera: by name where the rig has these names, else by viewing direction.

    Directions are paired so that their squared differences sum up to the least, and none differs by more than MOST_DEG.
    What is not paired is left out.
    """
    by_name = {camera.name.upper(): camera for camera in cameras}
    if by_name.keys() <= YAW_DEG.keys():
        return {name: by_name[name] for name in CAMERAS if name in by_name}
    looks = np.array([_yaw_deg(camera) for camera in cameras])
    off = np.abs((looks[:, None] - np.array(list(YAW_DEG.values())) + 180.0) % 360.0 - 180.0)
    cost = np.where(off <= MOST_DEG, off, 1e3) ** 2
    pairs = sorted((int(slot), int(i)) for i, slot in zip(*linear_sum_assignment(cost)) if off[i, slot] <= MOST_DEG)
    return {CAMERAS[slot]: cameras[i] for slot, i in pairs}


def nominal(name: str, size: tuple[int, int]) -> Camera:
    """A level camera that looks where the named one does, for one that a rig has not."""
    return pinhole(name, YAW_DEG[name], NOMINAL_VIEW_DEG, *size)


def _yaw_deg(camera: Camera) -> float:
    ahead = camera.ego_from_camera[:3, 2]
    return float(np.degrees(np.arctan2(ahead[1], ahead[0])))


JPEG_QUALITY = 95  # of resized pictures; others keep their bytes
NEAR_S = 0.1  # a photo belongs to a frame when it was taken this close to it
BLACK = "black.jpg"  # beside the folders of pictures


@dataclass(frozen=True)
class BlobPicture:
    """One file: where it lies below the pictures' folder, of which frame, its bytes."""

    data_path: str
    frame: int
    jpeg: bytes


@dataclass(frozen=True)
class RowPictures:
    """A sample's pictures."""

    pictures: tuple[BlobPicture, ...]
    cams: tuple[Mapping[str, Mapping[str, Any]], ...]  # (N_FRAMES,) the frames' `cams`
    absent: int  # of the history's 8 x 4
    left_out: tuple[str, ...]  # cameras of the rig that stand for none of the eight
    sizes: tuple[str, ...]  # width x height [px], as written
    distorted: bool  # as a lens makes them; else of pinholes


def shown(row: Mapping[str, Any], names: SampleNames, settings: ExportSettings) -> RowPictures:
    """The pictures of a row (columns cameras, images) under its names.

    Raises CannotExport where one of the history's is absent and settings.missing is "refuse".
    """
    rig = [_camera(camera) for camera in row["cameras"] or ()]
    chosen = slots(rig)
    stored = {name: _by_frame(row["images"] or (), camera.name) for name, camera in chosen.items()}
    absent = [(name, i) for name in CAMERAS for i in range(N_HISTORY) if i not in stored.get(name, {})]
    if absent and settings.missing == "refuse":
        raise CannotExport(_lacks(row, absent, chosen))
    written = {name: PUBLIC_SIZE if settings.resize else (c.width, c.height) for name, c in chosen.items()}
    cams: list[dict[str, Mapping[str, Any]]] = [{} for _ in range(N_FRAMES)]
    pictures = []
    for name in CAMERAS:
        camera = chosen.get(name)
        size = written.get(name, PUBLIC_SIZE)
        calibration = nominal(name, size) if camera is None else camera.resized(*size)
        for i, token in enumerate(names.tokens):
            path = f"{names.blobs}/{name}/{hex16(token.removesuffix(names.suffix), name)}{names.suffix}.jpg"
            image = stored.get(name, {}).get(i)
            if image is not None:
                assert camera is not None
                pictures.append(BlobPicture(path, i, _jpeg(image, camera, size)))
            elif settings.missing == "black" and i < N_HISTORY:
                path = BLACK
            cams[i][name] = _entry(path, calibration)
    left_out = tuple(sorted({camera.name for camera in rig} - {camera.name for camera in chosen.values()}))
    sizes = tuple(sorted({f"{width}x{height}" for width, height in written.values()}))
    distorted = any(camera.distortion.any() for camera in chosen.values())
    return RowPictures(tuple(pictures), tuple(cams), len(absent), left_out, sizes, distorted)


@cache
def black_picture() -> bytes:
    """What stands for a picture that there is none of, at PUBLIC_SIZE."""
    width, height = PUBLIC_SIZE
    return _encoded(np.zeros((height, width, 3), np.uint8))


def _camera(stored: Mapping[str, Any]) -> Camera:
    return Camera(
        str(stored["name"]),
        int(stored["width"]),
        int(stored["height"]),
        np.asarray(stored["intrinsics"]).reshape(3, 3),
        np.asarray(stored["distortion"]),
        np.asarray(stored["ego_from_camera"]).reshape(4, 4),
    )


def _by_frame(images: Sequence[Mapping[str, Any]], camera: str) -> Mapping[int, Mapping[str, Any]]:
    """Frame -> the camera's picture nearest to it."""
    found: dict[int, tuple[float, Mapping[str, Any]]] = {}
    for image in images:
        frame = round(image["time_s"] / FRAME_S) + NOW_FRAME
        off_s = abs(image["time_s"] - (frame - NOW_FRAME) * FRAME_S)
        if image["camera"] == camera and 0 <= frame < N_FRAMES and off_s <= min(NEAR_S, found.get(frame, (NEAR_S,))[0]):
            found[frame] = (off_s, image)
    return {frame: image for frame, (_, image) in found.items()}


def _jpeg(image: Mapping[str, Any], camera: Camera, size: tuple[int, int]) -> bytes:
    """The stored bytes, or the part of the picture that has the wanted shape, resized."""
    if (camera.width, camera.height) == size:
        return bytes(image["jpeg"])
    left, top, width, height = camera.window(*size)
    pixels = decode_stored_image(image)[top : top + height, left : left + width]
    shrinks = size[0] < width
    return _encoded(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))


def _encoded(pixels: Any) -> bytes:
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert done, "any array of bytes (H, W, 3) is a picture"
    return bytes(data.tobytes())


def _entry(path: str, camera: Camera) -> Mapping[str, Any]:
    return {
        "data_path": path,
        "sensor2lidar_rotation": camera.ego_from_camera[:3, :3].copy(),
        "sensor2lidar_translation": camera.ego_from_camera[:3, 3].copy(),
        "cam_intrinsic": camera.intrinsics.copy(),
        "distortion": camera.distortion.copy(),
    }


def _lacks(row: Mapping[str, Any], absent: Sequence[tuple[str, int]], chosen: Mapping[str, Camera]) -> str:
    nowhere = [name for name in CAMERAS if name not in chosen]
    of_rig = [name for name in chosen if any(camera == name for camera, _ in absent)]
    what = f"no camera stands for {', '.join(nowhere)}" if nowhere else f"{', '.join(of_rig)} lack earlier instants"
    return (
        f"sample {row['attempt_id']}: {what} (images from source {row['image_source']}). The released agents open "
        "eight cameras at four instants: render with eight cameras and render.frames=history or all, or export with "
        "missing=black (a black picture stands for what is not there) or missing=none (logs name files that are not "
        "there)"
    )

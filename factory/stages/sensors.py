"""Opens what a clip's sensor files point to: photos and lidar sweeps as arrays."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np

from factory.files import matching, why_unread
from factory.readers.arrow import packed_rows, read_feather
from factory.readers.base import BadClip
from factory.readers.pictures import (
    BadPicture,
    decode_grey,
    decode_rgb,
    file_and_frame,
    frame_uri,
    video_frames,
)
from factory.readers.points import read_packed_points, read_pcd, read_points
from tasks.render.rig.own_body import choose_photos, find_own_body, shrink
from tasks.render.scene.features import NOTHING_KNOWN, KnownPoints, driven_roads
from tasks.render.scene.sensed import Photo, Sweep, is_on_ego
from tasks.render.views import straightened, undistorted
from tasks.world.arrays import Array, Bools, Bytes
from tasks.world.clip import Block, Camera, Clip, PhotoDrive, SensorFile, own_name

# What a rig sees of the car that carries it: found in its photos, or masks `<camera>.png` in a folder of the user's,
# white where it is. All are of the photos as `opened_photos` gives them.

WHITE = 128  # grey level from which on a pixel is of the body
NOBODY = "none"  # in place of a folder: no camera sees anything of it
NO_MASKS: Mapping[str, Bools] = MappingProxyType({})


def own_body_masks(said: str, images: Sequence[SensorFile], cameras: Sequence[Camera]) -> Mapping[str, Bools]:
    """(H, W) of the photos by camera, of a folder that is `said`, none, or, where nothing is, found in `images`.

    Raises BadClip for a broken photo, ValueError as `read_masks`.
    """
    if said:
        return NO_MASKS if said == NOBODY else read_masks(said, cameras)
    files = sorted(files_of_cameras(cameras, images), key=lambda file: file.time_s)
    chosen: dict[str, list[SensorFile]] = {}
    for camera in cameras:
        mine = [file for file in files if file.sensor == camera.name]
        if mine:
            chosen[camera.name] = [mine[row] for row in choose_photos(ego_poses_of_files(mine)[0])]
    wanted = [file for mine in chosen.values() for file in mine]
    small = {(wanted[row].sensor, wanted[row].time_s): shrink(image) for row, image in opened_photos(wanted, cameras)}
    found = {}
    for camera in cameras:
        if mine := chosen.get(camera.name, []):
            pictures = [small[file.sensor, file.time_s] for file in mine]
            mask = find_own_body(pictures, camera, ego_poses_of_files(mine)[0])
            if mask is not None:
                found[camera.name] = mask
    return found


def read_masks(folder: str, cameras: Sequence[Camera]) -> Mapping[str, Bools]:
    """(H, W) of the photos by camera; a camera without a file sees nothing of the body.

    Raises ValueError for a folder without masks, and for a mask that is no picture of its camera's size.
    """
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
        seen = mask if camera.fisheye is None else straightened(mask, camera.fisheye)
        found[camera.name] = np.asarray(seen >= WHITE)
    return found


def masks_digest(folder: str) -> str:
    """Of all masks' names and bytes, else what stands in place of a folder. Raises ValueError as `read_masks`."""
    if folder in ("", NOBODY):
        return folder
    digest = hashlib.sha256()
    for name, path in sorted(_files(folder).items()):
        digest.update(f"{name}\x1f".encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def refuse_unknown_masks(folder: str, rig: Sequence[Camera]) -> None:
    """Raises ValueError for a mask of a camera that the rig does not have, and as `read_masks`."""
    if folder in ("", NOBODY):
        return
    names = [camera.name for camera in rig]
    unknown = sorted(set(_files(folder)) - set(names))
    if unknown:
        raise ValueError(f"render.own_body: no camera {', '.join(unknown)}; this rig has {', '.join(names) or 'none'}")
    read_masks(folder, rig)


def resized_mask(mask: Bools, camera: Camera, width: int, height: int) -> Bools:
    """A mask (H, W) as its camera's opened photos are shown: without distortion, the middle, width x height."""
    left, top, w, h = camera.window(width, height)
    flat = undistorted(mask.astype(np.uint8) * 255, camera)[top : top + h, left : left + w]
    return np.asarray(cv2.resize(flat, (width, height), interpolation=cv2.INTER_AREA) >= WHITE)


def _files(folder: str) -> dict[str, Path]:
    files = {path.stem: path for path in matching(Path(folder), "*.png")}
    if not files:
        raise ValueError(f"render.own_body: {folder} holds no <camera>.png")
    return files


XYZ = ("x", "y", "z")
NO_PICTURE = 1.0  # standard deviation [grey levels] that a photo has at least, at night too


@dataclass(frozen=True)
class SensorData:
    """What the sensors saw during a block, in file order."""

    photos: tuple[Photo, ...]  # without distortion, at the size asked for
    sweeps: tuple[Sweep, ...]
    known: KnownPoints = NOTHING_KNOWN  # of blocks without lidar, world


def block_of(clip: Clip | PhotoDrive) -> Block:
    """What the clip is rendered from: its block, else its own window."""
    if isinstance(clip, PhotoDrive):
        return clip.block
    return clip.block or Block(clip.start_s, clip.agents, clip.images, clip.sweeps)


def load_sensors(
    block: Block, cameras: Sequence[Camera], width: int, height: int, own_body: Mapping[str, Bools] = NO_MASKS
) -> SensorData:
    """All sweeps of the block and the photos its `cameras` took, resized to width x height, with their `own_body`.

    Raises BadClip where a file is missing, broken or not of its camera's size.
    """
    masks = {c.name: resized_mask(own_body[c.name], c, width, height) for c in cameras if c.name in own_body}
    taken = load_photos(block.images, cameras, width, height)
    photos = tuple(replace(photo, own_body=masks.get(photo.camera)) for photo in taken)
    if block.sweeps or block.ground_m is None or not block.images:
        return SensorData(photos, load_sweeps(block.sweeps))
    return SensorData(photos, (), KnownPoints(road=driven_roads(*ego_poses_of_files(block.images), block.ground_m)))


def load_photos(files: Sequence[SensorFile], cameras: Sequence[Camera], width: int, height: int) -> tuple[Photo, ...]:
    """The files that `cameras` took, without distortion, resized to width x height. Raises BadClip."""
    took = {camera.name: camera for camera in cameras}
    mine = files_of_cameras(cameras, files)
    opened = opened_photos(mine, cameras)
    photos = {row: _photo(mine[row], image, took[mine[row].sensor], width, height) for row, image in opened}
    return tuple(photos[row] for row in range(len(mine)))


def files_of_cameras(cameras: Sequence[Camera], files: Sequence[SensorFile]) -> tuple[SensorFile, ...]:
    """The files that one of the `cameras` took, in their order."""
    names = {camera.name for camera in cameras}
    return tuple(file for file in files if file.sensor in names)


def ego_poses_of_files(files: Sequence[SensorFile]) -> tuple[Array, Array]:
    """Where the ego was when each was taken: poses (F, 4, 4) and times (F,) [s]."""
    return np.stack([file.world_from_ego for file in files]), np.array([file.time_s for file in files])


def block_cameras(block: Block, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The `cameras` that are chosen of the block's own rig, and those of other logs' drives that have their names."""
    names = {camera.name for camera in cameras}
    others = (camera for camera in block.other_cameras if own_name(camera.name) in names)
    return (*cameras, *others)


def choose_cameras(rig: Sequence[Camera], names: Sequence[str] | None) -> tuple[Camera, ...]:
    """The named cameras in the order of `names`; the whole rig for none. Raises ValueError for an unknown name."""
    if not names:
        return tuple(rig)
    by_name = {camera.name: camera for camera in rig}
    unknown = [name for name in names if name not in by_name]
    if unknown:
        raise ValueError(f"render.cameras: no camera {', '.join(unknown)}; this rig has {', '.join(by_name) or 'none'}")
    return tuple(by_name[name] for name in names)


def decode_image(data: bytes, name: str, camera: Camera | None = None) -> Bytes:
    """Encoded bytes (JPEG or PNG) as rgb (H, W, 3). Raises BadClip that names `name`, also where it is not of the size
    that its `camera` takes.
    """
    try:
        return decode_rgb(data) if camera is None else decode_rgb(data, (camera.width, camera.height), camera.name)
    except BadPicture as error:
        raise BadClip(name, error.field, str(error)) from error


def opened_photos(files: Sequence[SensorFile], cameras: Sequence[Camera]) -> Iterator[tuple[int, Bytes]]:
    """Row and picture of each file of the `cameras`, one in memory at a time, as it was taken but for a fisheye's.

    A video or a table is gone through once. Raises BadClip.
    """
    took = {camera.name: camera for camera in cameras}
    for row, image in _opened(files, took):
        camera = took[files[row].sensor]
        yield row, image if camera.fisheye is None else straightened(image, camera.fisheye)


def _opened(files: Sequence[SensorFile], took: Mapping[str, Camera]) -> Iterator[tuple[int, Bytes]]:
    filmed: dict[tuple[Path, str], dict[int, int]] = {}  # video or table, and camera -> frame -> row
    for row, file in enumerate(files):
        path, frame = file_and_frame(file.uri)
        if frame is None:
            try:
                data = path.read_bytes()
            except OSError as error:
                raise BadClip(file.uri, "image", f"cannot be read: {why_unread(path, error)}") from error
            yield row, decode_image(data, file.uri, took[file.sensor])
        else:
            filmed.setdefault((path, file.sensor), {})[frame] = row
    for (path, sensor), rows in filmed.items():
        camera = took[sensor]
        if path.suffix == ".arrow":
            for frame, packed in packed_rows(path, rows):
                yield rows[frame], decode_image(packed.to_pybytes(), frame_uri(path, frame), camera)
        else:
            for frame, image in video_frames(path, rows, camera.width, camera.height):
                yield rows[frame], image


def _photo(file: SensorFile, image: Bytes, camera: Camera, width: int, height: int) -> Photo:
    left, top, w, h = camera.window(width, height)
    flat = undistorted(image, camera)[top : top + h, left : left + w]
    shrinks = width < w
    small = cv2.resize(flat, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    if small.std() < NO_PICTURE:
        raise BadClip(
            file.uri,
            "image",
            "one colour all over, no picture of a street: restore it, or leave the camera out by render.cameras=[...]",
        )
    pinhole = camera.resized(width, height)
    return Photo(
        camera=camera.name,
        time_s=file.time_s,
        rgb=np.asarray(small, np.uint8),
        intrinsics=pinhole.intrinsics,
        world_from_camera=file.world_from_ego @ pinhole.ego_from_camera,
    )


def load_sweeps(files: Sequence[SensorFile]) -> tuple[Sweep, ...]:
    """Sweeps of Argoverse 2 (.feather), OpenScene (.pcd), nuScenes (.bin), packed by 123D: points in the ego frame.

    Raises BadClip.
    """
    return tuple(_sweep(file) for file in files)


def _sweep(file: SensorFile) -> Sweep:
    path, row = file_and_frame(file.uri)
    if row is None:
        table = _READ_SWEEP.get(path.suffix, read_feather)(path, XYZ)
    else:
        table = read_packed_points(path, row, XYZ)
    points = np.stack([table[name] for name in XYZ], axis=1).astype(np.float32)
    if file.ego_from_sensor is not None:
        turn = file.ego_from_sensor
        points = (points @ turn[:3, :3].T + turn[:3, 3]).astype(np.float32)
    if is_on_ego(points).all():
        raise BadClip(file.uri, "x y z", f"none of the {len(points)} returns lies outside of the ego's own body")
    return Sweep(file.time_s, points, file.world_from_ego)


_READ_SWEEP = {".pcd": read_pcd, ".bin": read_points}

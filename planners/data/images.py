"""One wide picture of a sample: its front cameras at now, cut, decoded and resized side by side.

A JPEG is decoded at a half, a quarter or an eighth of its size where that is still as large as what is wanted of it. At
the paper's setting (three 1920 x 1080 pictures, 2048 x 512 wanted) the halves have the wanted size already. With
`decoding="full"` the picture is, there, that of the public code to the last bit: decoded in full, cut, joined and given
to cv2.resize (TransfuserFeatureBuilder), which averages four pixels into one. What either costs:
`python -m tests.bench.bench_decoding`.

libjpeg-turbo decodes by way of simplejpeg, whose pixels are OpenCV's and Pillow's in less than half of OpenCV's time:
OpenCV takes new memory for every picture, and half of its time goes into the system's handing it out.

With `data.pictures` decoded pictures are kept on a local disk, ready to be read into a batch:

    <folder>/<2 hex>/<62 hex>.rgb    one picture: its pixels, row by row, RGB uint8, and 4 bytes of checksum

The 64 digits are the digest of the JPEGs themselves, of how they are cut and decoded and of the decoder, so that an
entry that is found is the right one whatever became of the table; trainings and processes share a folder. An entry
appears whole, written by one of those who want it at a time, and whatever ends up broken is made again. At 2048 x 512
one takes 3.1 MB, 100,000 take 315 GB. The folder is bounded by 256 parts, each of which takes no more when it is full:
nothing is ever dropped, since a pass over all samples has no use for what was used last. It can be deleted while no
training runs.
"""

import hashlib
import logging
import math
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import local
from typing import Any

import cv2
import numpy as np
import simplejpeg

from factory.files import locked
from factory.readers.pictures import jpeg_size
from factory.store.reader import TIME_TOLERANCE_S, decode_stored_image
from planners.data.batch import ImageLayout
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import front_camera

SAME_YAW = math.radians(5.0)  # cameras of a stereo pair are no neighbours
FACTORS = (1, 2, 4, 8)  # by which a JPEG can be decoded smaller, without its finer waves
_THREAD = local()  # what each thread decodes into, so that memory is asked for once


def stitch_sample(sample: Mapping[str, Any], layout: ImageLayout) -> Bytes:
    """The picture (layout.height, layout.width, 3) uint8 RGB of a sample with the columns cameras and images.

    Raises ValueError where it has no cameras, no image of one of them at now, or a damaged one.
    """
    cameras = sample["cameras"] or ()
    axes = np.array([np.reshape(camera["ego_from_camera"], (4, 4))[:2, 2] for camera in cameras]).reshape(-1, 2)
    names = chosen_cameras([camera["name"] for camera in cameras], axes, layout)
    now = {
        image["camera"]: image["jpeg"] for image in sample["images"] or () if abs(image["time_s"]) <= TIME_TOLERANCE_S
    }
    missing = [name for name in names if name not in now]
    if missing:
        raise ValueError(f"no image of camera {', '.join(missing)} at now; there are {sorted(now)}")
    picture = np.empty((layout.height, layout.width, 3), np.uint8)
    stitch([np.frombuffer(now[name], np.uint8) for name in names], layout, picture)
    return picture


def chosen_cameras(names: Sequence[str], axes: Array, layout: ImageLayout) -> tuple[str, ...]:
    """The cameras of the picture, left to right: those of the layout, else the front one and its neighbours.

    The front camera is the one whose optical axis is nearest to ahead; its neighbours are the nearest by yaw, to the
    left and to the right, that look ahead at all. There may be none. axes: (C, 2) x, y of optical axes, ego frame.
    Raises ValueError where there is no camera, or none of a name that the layout has.
    """
    if layout.cameras:
        unknown = [name for name in layout.cameras if name not in names]
        if unknown:
            raise ValueError(f"no camera {', '.join(unknown)} (image.cameras); there are {sorted(names)}")
        return layout.cameras
    yaw = dict(zip(names, np.arctan2(axes[:, 1], axes[:, 0]).tolist()))
    ahead = {name: angle for name, angle in yaw.items() if abs(angle) < math.pi / 2}
    if (front := front_camera(names, axes)) is None:
        raise ValueError(f"no camera looks ahead; there are {sorted(names)}")
    left = {name: angle for name, angle in ahead.items() if angle > ahead[front] + SAME_YAW}
    right = {name: -angle for name, angle in ahead.items() if angle < ahead[front] - SAME_YAW}
    return (*_nearest(left), front, *_nearest(right))


def _nearest(angles: Mapping[str, float]) -> list[str]:
    return sorted(angles, key=lambda name: (angles[name], name))[:1]


def stitch(jpegs: Sequence[Bytes], layout: ImageLayout, out: Bytes) -> None:
    """Write the picture of JPEGs, left to right, into `out` (layout.height, layout.width, 3) as RGB.

    Every camera is brought to the same height, and together they are brought to the width.
    Raises ValueError for what is not a JPEG, or a damaged one.
    """
    sizes = tuple(jpeg_size(jpeg)[::-1] for jpeg in jpegs)
    for jpeg, part in zip(jpegs, _picture_parts(sizes, layout)):
        _draw_part(_decode_jpeg(jpeg, part.decoded), part, out)


def _decode_jpeg(jpeg: Bytes, size: tuple[int, int]) -> Bytes:
    """(rows, columns, 3) RGB until the thread decodes again. size: its own over one of FACTORS, rounded up."""
    rows, columns = size
    room: Bytes | None = getattr(_THREAD, "room", None)
    if room is None or len(room) < rows * columns * 3:
        room = _THREAD.room = np.empty(rows * columns * 3, np.uint8)
    try:
        pixels: Bytes = simplejpeg.decode_jpeg(jpeg, "RGB", min_height=rows, min_width=columns, buffer=room)
    except ValueError as error:
        raise ValueError(f"an image is not a JPEG that can be decoded: {error}") from error
    if pixels.shape[:2] != size:
        raise ValueError(f"an image of {columns} x {rows} was decoded to {pixels.shape[1]} x {pixels.shape[0]}")
    return pixels


def decode_alone(image: Mapping[str, Any]) -> Bytes:
    """The pixels (height, width, 3) of one of a sample's images, as `factory.store.reader.decode_stored_image` has
    them and raises; what this decoder does not take is left to that one."""
    try:
        jpeg_size(image["jpeg"])
        return np.asarray(simplejpeg.decode_jpeg(image["jpeg"], "RGB"), np.uint8)
    except ValueError:
        return decode_stored_image(image)


def stitch_pixels(images: Sequence[Bytes], layout: ImageLayout, out: Bytes) -> None:
    """The same of images (rows, columns, 3) uint8 RGB that someone else has decoded.

    What would have been decoded smaller is averaged to that size; the rest is equal to the last bit.
    """
    sizes = tuple((image.shape[0], image.shape[1]) for image in images)
    for image, part in zip(images, _picture_parts(sizes, layout)):
        whole = image if part.factor == 1 else cv2.resize(image, part.decoded[::-1], interpolation=cv2.INTER_AREA)
        _draw_part(np.asarray(whole, np.uint8), part, out)


def _draw_part(pixels: Bytes, part: "_Part", out: Bytes) -> None:
    pixels, into = pixels[part.rows, part.columns], out[:, part.into]
    if pixels.shape == into.shape:
        into[:] = pixels
    else:
        cv2.resize(pixels, into.shape[1::-1], dst=into, interpolation=part.interpolation)


@dataclass(frozen=True)
class _Part:
    """One camera's part of the picture."""

    factor: int  # by which it is decoded smaller
    decoded: tuple[int, int]  # rows, columns that come of it
    rows: slice  # of them those that are shown
    columns: slice
    into: slice  # columns of the picture
    interpolation: int


@lru_cache(maxsize=64)
def _picture_parts(sizes: tuple[tuple[int, int], ...], layout: ImageLayout) -> tuple[_Part, ...]:
    """Where images of these sizes (rows, columns) go. Raises ValueError where the layout cuts all of one away."""
    cuts = [(layout.rows_cut, 0.0 if 2 * i == len(sizes) - 1 else layout.sides_cut) for i in range(len(sizes))]
    shown = [tuple(_inside(n, share) for n, share in zip(size, cut)) for size, cut in zip(sizes, cuts)]
    lengths = [tuple(inside.stop - inside.start for inside in one) for one in shown]
    for size, (rows, columns) in zip(sizes, lengths):
        if rows < 1 or columns < 1:
            raise ValueError(f"rows_cut or sides_cut leave nothing of an image of {size[1]} x {size[0]}")
    widths = np.cumsum([0.0, *(columns / rows for rows, columns in lengths)])
    edges = np.round(widths / widths[-1] * layout.width).astype(int).tolist()
    parts = []
    for size, cut, (rows, columns), start, stop in zip(sizes, cuts, lengths, edges, edges[1:]):
        smaller = FACTORS if layout.decoding == "reduced" else (1,)
        factor = max(f for f in smaller if f == 1 or (rows // f >= layout.height and columns // f >= stop - start))
        decoded = -(-size[0] // factor), -(-size[1] // factor)
        shrinks = rows > 2 * factor * layout.height or columns > 2 * factor * (stop - start)
        how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        inside = _inside(decoded[0], cut[0]), _inside(decoded[1], cut[1])
        parts.append(_Part(factor, decoded, *inside, slice(start, stop), how))
    return tuple(parts)


def _inside(n: int, share: float) -> slice:
    """What is left of n rows or columns that lose a share at either end."""
    return slice(round(share * n), n - round(share * n))


PICTURE_FORMAT = 1
DECODER = f"simplejpeg {simplejpeg.__version__}, OpenCV {cv2.__version__}"
PARTS = 256
CHECKSUM_BYTES = 4
GB = 1e9
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PictureCache:
    """A folder of pictures, which need not be there yet."""

    folder: Path
    limit_gb: float  # of all its entries

    def stitch(self, jpegs: Sequence[Bytes], layout: ImageLayout, out: Bytes) -> None:
        """As planners.data.images.stitch, to the last bit: read where it is there, else decoded and kept.

        out: (layout.height, layout.width, 3), in one piece. Raises ValueError for a damaged JPEG, OSError where the
        folder cannot be written.
        """
        key = picture_key(jpegs, layout)
        path = self.folder / key[:2] / f"{key[2:]}.rgb"
        if not _read(path, key, out):
            stitch(jpegs, layout, out)
            self._keep(path, key, out)

    def held_bytes(self) -> int:
        """Of all entries that are there."""
        return sum(_bytes_held(part) for part in self.folder.glob("??"))

    def check(self, layout: ImageLayout) -> None:
        """Raises ValueError where the limit does not leave every part of the folder one picture."""
        least_gb = PARTS * (layout.height * layout.width * 3 + CHECKSUM_BYTES) / GB
        if self.limit_gb < least_gb:
            raise ValueError(
                f"data.pictures_gb={self.limit_gb:g}: pictures of {layout.width} x {layout.height} need at least "
                f"{least_gb:.2g}, {PARTS} of them"
            )

    def _keep(self, path: Path, key: str, picture: Bytes) -> None:
        """A draft that a killed process left is overwritten: its lock is gone with it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        size = picture.nbytes + CHECKSUM_BYTES
        with _locked(path.parent / "lock"):
            if _read(path, key, np.empty_like(picture)):  # another kept it meanwhile
                return
            path.unlink(missing_ok=True)
            if _bytes_held(path.parent) + size > self.limit_gb * GB / PARTS:
                return
            draft = path.parent / "draft"
            with draft.open("wb") as file:
                file.write(picture.data)
                file.write(_checksum(key, picture))
            draft.replace(path)


def picture_key(jpegs: Sequence[Bytes], layout: ImageLayout) -> str:
    """64 hex digits of everything that a picture's pixels depend on. Which cameras they are does not matter."""
    how = (PICTURE_FORMAT, DECODER, layout.width, layout.height, layout.rows_cut, layout.sides_cut, layout.decoding)
    sha = hashlib.sha256(repr((how, [len(jpeg) for jpeg in jpegs])).encode())
    for jpeg in jpegs:
        sha.update(jpeg.data)
    return sha.hexdigest()


def _read(path: Path, key: str, out: Bytes) -> bool:
    """Whether the picture is there, undamaged; it is in `out` then."""
    try:
        with path.open("rb") as file:
            n, checksum = file.readinto(out.data), file.read(CHECKSUM_BYTES + 1)
    except FileNotFoundError:
        return False
    whole = n == out.nbytes and checksum == _checksum(key, out)
    if not whole:
        log.warning("%s: damaged; it is made again", path)
    return whole


def _checksum(key: str, picture: Bytes) -> bytes:
    """Of pixels under a name: under another the same pixels are damaged."""
    return zlib.crc32(picture.data, zlib.crc32(key.encode())).to_bytes(CHECKSUM_BYTES, "little")


def _bytes_held(part: Path) -> int:
    with os.scandir(part) as entries:
        return sum(entry.stat().st_size for entry in entries if entry.name.endswith(".rgb"))


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Alone among threads and processes of this machine."""
    with path.open("ab") as file, locked(file):
        yield

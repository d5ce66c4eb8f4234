"""Decoded pictures on a local disk, ready to be read into a batch (`data.pictures`).

    <folder>/<2 hex>/<62 hex>.rgb    one picture: its pixels, row by row, RGB uint8, and 4 bytes of checksum

The 64 digits are the digest of the JPEGs themselves, of how they are cut and decoded and of the decoder, so that an
entry that is found is the right one whatever became of the table; trainings and processes share a folder. An entry
appears whole, written by one of those who want it at a time, and whatever ends up broken is made again. At 2048 x 512
one takes 3.1 MB, 100,000 take 315 GB.

The folder is bounded by 256 parts, each of which takes no more when it is full: nothing is ever dropped, since a pass
over all samples has no use for what was used last. It can be deleted while no training runs.
"""

import hashlib
import logging
import os
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from factory.locks import locked
from planners.data.batch import ImageLayout
from planners.data.feed import Feed
from planners.data.images import stitch
from tasks.world.arrays import Bytes

FORMAT = 1
DECODER = f"simplejpeg {simplejpeg.__version__}, OpenCV {cv2.__version__}"
PARTS = 256
CHECKSUM_BYTES = 4
GB = 1e9
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DecodedPictures:
    """A folder of pictures, which need not be there yet."""

    folder: Path
    limit_gb: float  # of all its entries

    def stitch(self, jpegs: Sequence[Bytes], layout: ImageLayout, out: Bytes) -> None:
        """As planners.data.images.stitch, to the last bit: read where it is there, else decoded and kept.

        out: (layout.height, layout.width, 3), in one piece. Raises ValueError for a damaged JPEG, OSError where the
        folder cannot be written.
        """
        key = key_of(jpegs, layout)
        path = self.folder / key[:2] / f"{key[2:]}.rgb"
        if not _read(path, key, out):
            stitch(jpegs, layout, out)
            self._keep(path, key, out)

    def held_bytes(self) -> int:
        """Of all entries that are there."""
        return sum(_held(part) for part in self.folder.glob("??"))

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
            if _held(path.parent) + size > self.limit_gb * GB / PARTS:
                return
            draft = path.parent / "draft"
            with draft.open("wb") as file:
                file.write(picture.data)
                file.write(_checksum(key, picture))
            draft.replace(path)


def pictures_of(feed: Feed) -> DecodedPictures | None:
    """Those of `data.pictures`, where there are pictures to be kept. Raises ValueError where too few can be."""
    settings, layout = feed.dataset.settings, feed.needs.image
    if settings.pictures is None or layout is None:
        return None
    kept = DecodedPictures(Path(settings.pictures).expanduser(), settings.pictures_gb)
    kept.check(layout)
    return kept


def key_of(jpegs: Sequence[Bytes], layout: ImageLayout) -> str:
    """64 hex digits of everything that a picture's pixels depend on. Which cameras they are does not matter."""
    how = (FORMAT, DECODER, layout.width, layout.height, layout.rows_cut, layout.sides_cut, layout.decoding)
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


def _held(part: Path) -> int:
    with os.scandir(part) as entries:
        return sum(entry.stat().st_size for entry in entries if entry.name.endswith(".rgb"))


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Alone among threads and processes of this machine."""
    with path.open("ab") as file, locked(file):
        yield

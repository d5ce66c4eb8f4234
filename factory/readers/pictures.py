"""Encoded pictures: what their header says, and their pixels as they are stored. All pictures are decoded here but for
those of a planner's batches, which a faster decoder reads after the same look at the header.

A kilobyte may declare 30,000 x 30,000 pixels, for which a decoder takes gigabytes: the header is looked at first. An
EXIF orientation is not followed, which OpenCV does by itself: intrinsics are of the pixels as they are stored.
"""

import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from factory.readers.base import BadClip
from tasks.world.arrays import Bytes

MAX_PIXELS = 1 << 26  # 8192 x 8192, 200 MB decoded; the largest driving cameras have an eighth of it
Size: TypeAlias = tuple[int, int]  # width, height [px]
JPEG, PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
OTHERS = {  # what a file of another format begins with
    b"BM": "BMP",
    b"GIF8": "GIF",
    b"II*\0": "TIFF",
    b"MM\0*": "TIFF",
    b"RIFF": "WebP",
    b"PF": "PFM",
    b"Pf": "PFM",
    b"#?": "Radiance HDR",
    b"v/1\x01": "OpenEXR",
}
SIZED = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # JPEG's segments that hold the picture's size
ALONE = frozenset((0x01, *range(0xD0, 0xD8)))  # markers without a segment
SCAN, APP1 = 0xDA, 0xE1  # where the pixels begin; Exif and XMP


class BadPicture(ValueError):
    """No picture that is decoded: says why; `field` is image or size."""

    def __init__(self, problem: str, field: str = "image") -> None:
        super().__init__(problem)
        self.field = field


def read_header(data: bytes | Bytes) -> tuple[str, Size]:
    """JPEG or PNG, and the size that the header declares, whatever it is. Raises BadPicture."""
    view = data.data if isinstance(data, np.ndarray) else memoryview(data)
    if view[:8] == PNG:
        name, size = "PNG", _png_size(view)
    elif view[:2] == JPEG:
        name, size = (
            "JPEG",
            next((_size(view[at:end]) for marker, at, end in _segments(view) if marker in SIZED), (0, 0)),
        )
    else:
        head = bytes(view[:8])
        names = [name for begin, name in OTHERS.items() if head.startswith(begin)]
        other = f"a {names[0]} file: convert it to" if names else "not"
        raise BadPicture(f"{other} a JPEG or PNG picture" if head else "the file is empty")
    if not (size[0] and size[1]):
        raise BadPicture(f"a {name} that is cut off")
    return name, size


def jpeg_size(data: bytes | Bytes) -> Size:
    """Of a JPEG alone, at most MAX_PIXELS. Raises BadPicture."""
    name, size = read_header(data)
    if name != "JPEG":
        raise BadPicture(f"a {name}, not a JPEG")
    check_size(size)
    return size


def check_size(size: Size, wanted: Size | None = None, camera: str = "its camera") -> None:
    """Raises BadPicture where a picture is not of its camera's size, or has more than MAX_PIXELS."""
    if wanted is not None and size != wanted:
        problem = f"but {camera} takes {_said(wanted)}: restore the picture, or correct the camera's size"
        raise BadPicture(f"{_said(size)}, {problem}", "size")
    if size[0] * size[1] > MAX_PIXELS:
        raise BadPicture(f"{_said(size)}, more than the {MAX_PIXELS} pixels that are decoded: store it smaller", "size")


def decode_rgb(data: bytes | Bytes, wanted: Size | None = None, camera: str = "its camera") -> Bytes:
    """A JPEG or PNG (H, W, 3), of the size `wanted` where one is; grey, CMYK and 16 bits become RGB of 8.

    Raises BadPicture, before anything is decoded where the header says so.
    """
    import cv2

    return np.asarray(cv2.cvtColor(_decoded(data, cv2.IMREAD_COLOR, wanted, camera), cv2.COLOR_BGR2RGB), np.uint8)


def decode_grey(data: bytes | Bytes, wanted: Size) -> Bytes:
    """The same in grey (H, W)."""
    import cv2

    return _decoded(data, cv2.IMREAD_GRAYSCALE, wanted, "its camera")


def without_exif(jpeg: bytes) -> bytes:
    """A JPEG without its Exif and XMP segments, byte for byte otherwise: nobody turns it by what these say.

    Raises BadPicture for what is no JPEG.
    """
    jpeg_size(jpeg)
    kept, rest = [], 0
    for marker, at, end in _segments(memoryview(jpeg)):
        if marker == APP1:
            kept.append(jpeg[rest:at])
            rest = end
    return b"".join((*kept, jpeg[rest:]))


def _decoded(data: bytes | Bytes, flags: int, wanted: Size | None, camera: str) -> Bytes:
    import cv2

    _, size = read_header(data)
    check_size(size, wanted, camera)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise BadPicture(f"not an image that can be decoded: {error.err}") from error
    if pixels is None:
        raise BadPicture("not an image that can be decoded")
    return np.asarray(pixels, np.uint8)


def _segments(jpeg: memoryview) -> Iterator[tuple[int, int, int]]:
    """Marker, beginning and end of each segment of a JPEG before its pixels, as far as they are whole.

    What stands between two segments is skipped, as decoders do.
    """
    at = 2
    while at + 4 <= len(jpeg):
        marker = jpeg[at + 1]
        if jpeg[at] != 0xFF or marker in (0x00, 0xFF):
            at += 1
        elif marker in ALONE:
            at += 2
        else:
            length = _number(jpeg[at + 2 : at + 4])
            end = at + 2 + length
            if length < 2 or end > len(jpeg) or marker == SCAN:
                return
            yield marker, at, end
            at = end


def _png_size(png: memoryview) -> Size:
    """0, 0 where a chunk is longer than the file: OpenCV takes as much memory as a chunk claims, up to 2 GB."""
    at, kind = len(PNG), b""
    while kind != b"IEND":
        kind = bytes(png[at + 4 : at + 8])
        at += 12 + _number(png[at : at + 4])
        if at > len(png):
            return 0, 0
    return (_number(png[16:20]), _number(png[20:24])) if png[12:16] == b"IHDR" else (0, 0)


def _size(segment: memoryview) -> Size:
    return _number(segment[7:9]), _number(segment[5:7])


def _number(value: memoryview) -> int:
    return int.from_bytes(value, "big")


def _said(size: Size) -> str:
    return f"{size[0]}x{size[1]}"


# Photos within videos: `<video>#frame=<k>` names one, k from 0 in the order in which a player shows them.

_NAMED = re.compile(r"(?s)(.+)#frame=(\d{1,6})")  # a million frames at most: at 12 Hz a day of driving


def frame_uri(video: Path, frame: int) -> str:
    """The name of one frame of a video."""
    return f"{video}#frame={frame}"


def file_and_frame(uri: str) -> tuple[Path, int | None]:
    """The file that a sensor file lies in, and which frame of it, None where it is all of the file."""
    named = _NAMED.fullmatch(uri)
    return (Path(uri), None) if named is None else (Path(named[1]), int(named[2]))


def video_frames(video: Path, frames: Collection[int], width: int, height: int) -> Iterator[tuple[int, Bytes]]:
    """The frames asked for, rgb (height, width, 3) each, in order and one at a time; what comes after is not decoded.

    Raises BadClip for what cannot be decoded, is of another size, or ends before the last of them.
    """
    import av
    from av.error import FFmpegError

    file, last, shown = str(video), max(frames, default=-1), 0
    try:
        with av.open(file) as container:
            if not container.streams.video:
                raise BadClip(file, "video", "holds no pictures")
            stream = container.streams.video[0]
            check_size((stream.width, stream.height), (width, height))
            stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}  # whatever the pictures themselves say
            for frame in container.decode(stream):
                if shown > last:
                    return
                check_size((frame.width, frame.height), (width, height))
                if shown in frames:
                    yield shown, np.asarray(frame.to_ndarray(format="rgb24", width=width, height=height), np.uint8)
                shown += 1
    except BadPicture as error:
        raise BadClip(file, error.field, str(error)) from error
    except (FFmpegError, OSError) as error:
        raise BadClip(file, "video", f"cannot be decoded after {shown} frames: {error}") from error
    if shown <= last:
        raise BadClip(file, "video", f"holds {shown} frames, frame {last} of it is asked for, counted from 0")

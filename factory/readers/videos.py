"""Photos within videos: `<video>#frame=<k>` names one, k from 0 in the order in which a player shows them."""

import re
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from factory.readers.base import BadClip
from factory.readers.pictures import MAX_PIXELS, BadPicture, refuse_size
from tasks.world.arrays import Bytes

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
            refuse_size((stream.width, stream.height), (width, height))
            stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}  # whatever the pictures themselves say
            for frame in container.decode(stream):
                if shown > last:
                    return
                refuse_size((frame.width, frame.height), (width, height))
                if shown in frames:
                    yield shown, np.asarray(frame.to_ndarray(format="rgb24", width=width, height=height), np.uint8)
                shown += 1
    except BadPicture as error:
        raise BadClip(file, error.field, str(error)) from error
    except (FFmpegError, OSError) as error:
        raise BadClip(file, "video", f"cannot be decoded after {shown} frames: {error}") from error
    if shown <= last:
        raise BadClip(file, "video", f"holds {shown} frames, frame {last} of it is asked for, counted from 0")

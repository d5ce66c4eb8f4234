"""Pictures to an H.264 file."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tasks.world.arrays import Bytes


def write_mp4(path: Path, frames: Iterable[Bytes], frames_per_s: int = 10) -> None:
    """RGB frames (height, width, 3), even sizes, as H.264 that browsers play. Raises ValueError without frames."""
    import av

    with av.open(str(path), "w") as container:
        stream = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream("libx264", rate=frames_per_s)
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.options = {"crf": "20", "movflags": "+faststart"}
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        if stream is None:
            raise ValueError(f"{path}: a film needs at least one frame")
        container.mux(stream.encode())

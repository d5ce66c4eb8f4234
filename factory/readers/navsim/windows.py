"""Which windows of a folder of logs are clips, found without opening the logs again.

A log of OpenScene takes a second to open, and navtrain names 1,192 of them. So what the choice needs is kept, a small
table a log, in the user's cache; it is made again where the log's size or time of change is another.
"""

import hashlib
import io
import logging
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factory.readers.apart import Apart
from factory.readers.base import BadClip
from factory.readers.navsim.filters import SceneFilter
from factory.readers.navsim.log import LogFrames, read_frames
from factory.readers.navsim.tracks import FRAMES_BEFORE, WINDOW_FRAMES
from tasks.kernels.compiled import write_whole
from tasks.sealed import sealed, unsealed
from tasks.world.arrays import Array, Bools, Ints

TABLE_VERSION = 4  # of the tables kept
FRAME_S, SLACK_S = 0.5, 0.05  # between two frames; more or less is a gap
GAP, SHORT_HISTORY, SHORT_FUTURE = "gap_in_frames", "short_history", "short_future"
NO_ROUTE, NO_BOXES, STANDING, ABSENT = "no_route", "not_annotated", "ego_standing", "absent_token"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FrameTable:
    """What the choice of windows needs of the F frames of one log."""

    tokens: NDArray[np.str_]  # (F,)
    timestamps_us: Ints  # (F,)
    has_route: Bools  # (F,)
    annotated: Bools  # (F,)
    speeds: NDArray[np.float32]  # (F,) of the ego [m/s]
    locations: NDArray[np.str_]  # (F,) the city, the same in all frames
    x_m: Array  # (F,) of the rear axle on the city's map
    y_m: Array  # (F,)

    @property
    def location(self) -> str:
        """The city that the log drives in."""
        return str(self.locations[0])

    def __len__(self) -> int:
        return len(self.tokens)

    @property
    def stretch(self) -> Ints:
        """(F,) number of the unbroken stretch of frames 0.5 s apart that a frame belongs to."""
        return np.append(0, np.cumsum(np.abs(np.diff(self.timestamps_us) * 1e-6 - FRAME_S) > SLACK_S))

    @property
    def start_ms(self) -> Ints:
        """(F,) milliseconds since the log's first frame, on the clock of clips: 500 a frame within a stretch."""
        stretch, out = self.stretch, np.zeros(len(self), np.int64)
        for number in range(int(stretch[-1]) + 1):
            frames = np.flatnonzero(stretch == number)
            begins = round(float(self.timestamps_us[frames[0]] - self.timestamps_us[0]) / 1000)
            if number:
                begins = max(begins, int(out[frames[0] - 1]) + 501)  # never where the one before still is
            out[frames] = begins + 500 * np.arange(len(frames))
        return out


@dataclass(frozen=True)
class Choice:
    """Which windows are wanted."""

    stride_frames: int  # between two, where no scene filter names them
    first_frame: int  # of each log; windows that begin before it are skipped
    min_top_speed_mps: float  # an ego that never reaches it stands
    scene_filter: SceneFilter | None = None  # its scenes, whatever the stride and the speed


def table_of(log: LogFrames) -> FrameTable:
    """The table of a log that is open."""
    frames = log.frames
    return FrameTable(
        tokens=np.array([frame.token for frame in frames]),
        timestamps_us=np.array([frame.timestamp_us for frame in frames], np.int64),
        has_route=np.array([bool(frame.roadblock_ids) for frame in frames]),
        annotated=np.array([frame.boxes is not None for frame in frames]),
        speeds=np.array([np.hypot(*frame.dynamic_state[:2]) for frame in frames], np.float32),
        locations=np.array([frame.map_location for frame in frames]),
        x_m=np.array([frame.pose[0] for frame in frames], np.float64),
        y_m=np.array([frame.pose[1] for frame in frames], np.float64),
    )


def kept_table(path: Path, cache_dir: Path) -> FrameTable | None:
    """The table of the log at `path`, if one was kept of just this file. Raises BadClip where there is no such file."""
    try:
        kept = _kept(path, cache_dir)
        data = unsealed(kept.read_bytes(), kept.name)
        rows = np.load(io.BytesIO(data), allow_pickle=False)
        return FrameTable(*(rows[column.name] for column in fields(FrameTable)))
    except FileNotFoundError:
        return None
    except (ValueError, OSError, IndexError) as error:  # Damaged among them
        log.warning("%s: %s; made again of %s", _kept(path, cache_dir), error, path)
        return None


def table_at(path: Path, cache_dir: Path) -> FrameTable:
    """The table of the log at `path`; one that was not kept is made in another process. Raises BadClip."""
    return kept_table(path, cache_dir) or Apart(partial(make_table, cache_dir=cache_dir))(path, str(path))


def make_table(path: Path, cache_dir: Path) -> FrameTable:
    """The table of the log at `path`, read and kept. Raises BadClip."""
    table = table_of(read_frames(path))
    keep_table(table, path, cache_dir)
    return table


def keep_table(table: FrameTable, path: Path, cache_dir: Path) -> None:
    """Keeps the table of the log at `path`, for as long as that file is as it is. Raises BadClip, OSError."""
    columns: dict[str, NDArray[Any]] = {**vars(table)}
    rows = np.zeros(len(table), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    data = io.BytesIO()
    np.save(data, rows, allow_pickle=False)
    cache_dir.mkdir(parents=True, exist_ok=True)
    kept = _kept(path, cache_dir)
    write_whole(kept, sealed(data.getvalue(), kept.name))


def _kept(path: Path, cache_dir: Path) -> Path:
    try:
        stat = path.stat()
    except OSError as error:
        raise BadClip(str(path), "file", f"cannot be read: {error.strerror}") from error
    key = f"{TABLE_VERSION}\x1f{path}\x1f{stat.st_size}\x1f{stat.st_mtime_ns}"
    return cache_dir / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npy"


def wanted_windows(table: FrameTable, choice: Choice, tokens: Collection[str] | None) -> list[int]:
    """The frame T of every window that is wanted, in order, whether or not it can be a clip.

    tokens: of the scene filter, as a set; None: it names none. A window of a scene filter is the public loader's
    (navsim/common/dataloader.py:24-73): it fits the log, it has a route if it must, and gaps do not matter to it.
    """
    scenes = choice.scene_filter
    if scenes is None:
        starts = range(choice.first_frame, len(table) - WINDOW_FRAMES + 1, choice.stride_frames)
        return [start + FRAMES_BEFORE for start in starts]
    starts = range(0, len(table) - scenes.num_frames + 1, scenes.stride_frames)
    now = np.array(starts, np.int64) + scenes.num_history_frames - 1
    if scenes.has_route:
        now = now[table.has_route[now]]
    if tokens is not None:
        now = now[[str(token) in tokens for token in table.tokens[now]]]
    return [int(frame) for frame in now]


def usable(table: FrameTable, windows: list[int], choice: Choice) -> tuple[list[int], Counter[str]]:
    """Those windows that are clips, and how many are not, by reason."""
    kept: list[int] = []
    dropped: Counter[str] = Counter()
    stretch = table.stretch
    for now in windows:
        first, stop = now - FRAMES_BEFORE, now - FRAMES_BEFORE + WINDOW_FRAMES
        if first < 0:
            dropped[SHORT_HISTORY] += 1
        elif stop > len(table):
            dropped[SHORT_FUTURE] += 1
        elif stretch[first] != stretch[stop - 1]:
            dropped[GAP] += 1
        elif not table.has_route[now]:
            dropped[NO_ROUTE] += 1
        elif not table.annotated[first:stop].all():
            dropped[NO_BOXES] += 1
        elif choice.scene_filter is None and table.speeds[first:stop].max() < choice.min_top_speed_mps:
            dropped[STANDING] += 1
        else:
            kept.append(now)
    return kept, dropped

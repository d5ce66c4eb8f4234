"""Which windows are clips: NAVSIM's scenes by token, ours by stride, and why the others are none."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from factory.datasets.navsim.reader import (
    GAP,
    NO_BOXES,
    NO_ROUTE,
    SHORT_FUTURE,
    SHORT_HISTORY,
    STANDING,
    FrameTable,
    SceneFilter,
    WindowChoice,
    cached_table,
    read_and_cache_table,
    usable_windows,
    wanted_windows,
)
from tests.factory.datasets.navsim.logs import NAME, frame
from tests.factory.datasets.navsim.openscene_writer import write_frames

EVERY = WindowChoice(stride_frames=1, first_frame=0, min_top_speed_mps=0.5)


def table(n: int, **other: np.ndarray) -> FrameTable:
    """n frames in order, of a log that has all that a clip wants."""
    return replace(
        FrameTable(
            tokens=np.array([f"t{k:02d}" for k in range(n)]),
            timestamps_us=1_600_000_000_000_000 + 500_000 * np.arange(n),
            has_route=np.ones(n, bool),
            annotated=np.ones(n, bool),
            unreadable=np.full(n, ""),
            speeds=np.full(n, 8.0, np.float32),
            locations=np.full(n, "us-ma-boston"),
            x_m=4.0 * np.arange(n),
            y_m=np.zeros(n),
        ),
        **other,
    )


def scenes(**fields: object) -> WindowChoice:
    return replace(EVERY, scene_filter=SceneFilter(frame_interval=1, **fields))  # type: ignore[arg-type]


def test_without_a_filter_every_window_of_20_frames_is_wanted_at_the_stride() -> None:
    assert wanted_windows(table(24), EVERY, None) == [3, 4, 5, 6, 7]
    assert wanted_windows(table(24), replace(EVERY, stride_frames=2, first_frame=2), None) == [5, 7]
    assert wanted_windows(table(19), EVERY, None) == []


def test_a_filter_s_windows_are_the_public_loader_s() -> None:
    """navsim/common/dataloader.py:24-73: frames[i:i + 14], none shorter, current frame at 3, its route if it must."""
    frames = table(20, has_route=np.arange(20) != 5)
    assert wanted_windows(frames, scenes(), None) == [3, 4, 6, 7, 8, 9]
    assert wanted_windows(frames, scenes(has_route=False), None) == [3, 4, 5, 6, 7, 8, 9]
    assert wanted_windows(frames, scenes(num_future_frames=8), None)[-1] == 11
    assert wanted_windows(frames, scenes(), {"t04", "t05", "t09", "t15"}) == [4, 9]
    assert wanted_windows(table(40), replace(EVERY, scene_filter=SceneFilter()), None) == [3, 17]


def test_a_window_that_cannot_be_a_clip_is_counted_by_its_reason() -> None:
    stamps = table(60).timestamps_us.copy()
    stamps[40:] += 500_000
    frames = table(
        60,
        timestamps_us=stamps,
        has_route=np.arange(60) != 6,
        annotated=np.arange(60) != 29,
        speeds=np.where(np.arange(60) < 28, 0.1, 8.0).astype(np.float32),
    )
    kept, dropped = usable_windows(frames, [2, 3, 6, 9, 12, 13, 30, 43, 44], EVERY)
    assert kept == [12, 43]
    assert dropped == {SHORT_HISTORY: 1, STANDING: 2, NO_ROUTE: 1, NO_BOXES: 1, GAP: 1, SHORT_FUTURE: 1}
    kept, _ = usable_windows(frames, [3], scenes())
    assert kept == [3], "a filter's scene may stand"


def test_clips_are_named_by_milliseconds_that_go_on_by_500_and_jump_at_gaps() -> None:
    stamps = table(12).timestamps_us + np.array([0, 3, -2, 1, 0, 2] * 2) * 1000
    stamps[6:] += 1_500_000
    frames = table(12, timestamps_us=stamps)
    assert frames.stretch.tolist() == [0] * 6 + [1] * 6
    assert frames.start_ms.tolist() == [500 * k for k in range(6)] + [4500 + 500 * k for k in range(6)]


def test_a_log_s_table_is_kept_until_its_file_changes(tmp_path: Path) -> None:
    log = write_frames(tmp_path, "mini", NAME, [frame(k) for k in range(3)])
    assert cached_table(log, tmp_path / "kept") is None
    made = read_and_cache_table(log, tmp_path / "kept")
    kept = cached_table(log, tmp_path / "kept")
    assert kept is not None
    for column, value in vars(made).items():
        assert (getattr(kept, column) == value).all()
    assert made.tokens.tolist() == [frame(k)["token"] for k in range(3)]
    (file,) = (tmp_path / "kept").iterdir()
    file.write_bytes(file.read_bytes()[:50])
    assert cached_table(log, tmp_path / "kept") is None, "what is cut off is made again"
    read_and_cache_table(log, tmp_path / "kept")
    write_frames(tmp_path, "mini", NAME, [frame(k) for k in range(4)])
    assert cached_table(log, tmp_path / "kept") is None

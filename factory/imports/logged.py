"""A frame of NAVSIM's logs as a sample and as a world to drive in: 1.5 s before it, 4 s after it."""

from pathlib import Path

from factory.imports.scenes import (
    HISTORY_FRAMES,
    SCENE_FRAMES,
    Origin,
    logged_label,
    pictures,
    scene_of,
    world_columns,
)
from factory.readers.base import BadClip
from factory.readers.navsim.log import LogFrames
from factory.readers.navsim.road import road_around
from factory.readers.navsim.tracks import ego_states
from factory.stages.imaging import NO_IMAGES
from tasks.render.settings import ImageSource
from tasks.world.clip import Scene


def logged_frame(
    log: LogFrames, token: str, maps: Path, sensors: Path | None, origin: Origin
) -> tuple[Scene, dict[str, object]]:
    """The scene at the token's frame, and the columns of its row; sensors: None for one without pictures.

    Raises BadClip where the log does not hold all of it.
    """
    at = next((i for i, frame in enumerate(log.frames) if frame.token == token), -1)
    first = at - HISTORY_FRAMES + 1
    if at < 0 or first < 0 or first + SCENE_FRAMES > len(log.frames):
        raise BadClip(log.file, f"token {token}", "not here with 1.5 s before and 4 s after it")
    frames = log.frames[first : first + SCENE_FRAMES]
    now = log.frames[at]
    road = road_around(maps, now, ego_states(frames)[:, :2], now.pose, log.file, at)
    scene = scene_of(frames, road, origin)
    seen: dict[str, object] = dict(NO_IMAGES)
    if sensors is not None:
        seen = pictures(frames[:HISTORY_FRAMES], sensors, ImageSource.PHOTO, log.file)
    return scene, {**world_columns(scene, now.command), **logged_label(scene), **seen}

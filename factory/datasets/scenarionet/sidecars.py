"""Where the photos of ScenarioNet's logs are said to be: `cameras.json`, one of each log. Format: docs/photos.md.

Light: which cameras there are is told from the JSON alone; numpy is loaded where they are read (photos.py).
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from factory.readers.base import BadClip

NAME = "cameras.json"
MAX_BYTES = 1 << 28  # an entry of 12 Hz takes some 500: half a million


def sidecars_of(cameras: Path, log_ids: Iterable[str]) -> dict[str, Path]:
    """Log id -> its sidecar, of the logs that have one.

    `cameras`: one sidecar or the folder it lies in, for the only log; or a folder with one in <log id>/ for each. A
    folder may also be named by what follows the id's last underscore, which is nuScenes' scene (scene-0103).
    Raises ValueError where it is none of these.
    """
    ids, said = list(log_ids), f"clips.cameras={cameras}"
    alone = cameras if cameras.is_file() else cameras / NAME
    if alone.is_file():
        if len(ids) != 1:
            raise ValueError(
                f"{said}: one log's sidecar, and {len(ids)} logs are read: name it by clips.only=[...], "
                f"or put each log's into <log id>/{NAME}"
            )
        return {ids[0]: alone}
    if not cameras.is_dir():
        raise ValueError(f"{said}: no such file or folder")
    found = {}
    for log_id in ids:
        places = (cameras / name / NAME for name in (log_id, log_id.rpartition("_")[2]))
        if there := [place for place in places if place.is_file()]:
            found[log_id] = there[0]
    if not found:
        raise ValueError(f"{said}: no {NAME} here, nor in <log id>/ of any log that is read: {', '.join(ids[:3])}")
    return found


def load_sidecar(path: Path) -> tuple[dict[str, Any], bytes]:
    """What stands in a sidecar, and its bytes. Raises BadClip."""
    file = str(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise BadClip(file, "size", f"more than {MAX_BYTES} bytes")
        data = path.read_bytes()
        content = json.loads(data)
    except OSError as error:
        raise BadClip(file, "file", f"cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise BadClip(file, "file", f"is no JSON: {error}") from error
    if not isinstance(content, dict):
        raise BadClip(file, "file", f"holds a {type(content).__name__}, expected an object with cameras and frames")
    return content, data


def cameras_in(content: Mapping[str, Any], file: str) -> dict[str, Mapping[str, Any]]:
    """Name -> the fields of each camera. Raises BadClip.

    A sidecar of one camera may have them at its top; the camera is then called as the folder of the first photo.
    """
    cameras = content.get("cameras")
    if cameras is None and "K" in content:
        frames = content.get("frames")
        first = frames[0] if isinstance(frames, list) and frames else None
        path = first.get("file") if isinstance(first, dict) else None
        return {Path(path).parent.name or "camera" if isinstance(path, str) else "camera": content}
    if not isinstance(cameras, dict) or not cameras or not all(isinstance(one, dict) for one in cameras.values()):
        raise BadClip(file, "cameras", "missing, or not an object of one object for each camera")
    return cameras


def rig_names(paths: Iterable[Path]) -> tuple[str, ...]:
    """The rig of the first sidecar that can be read; none where none can: what is wrong is told when they are read."""
    for path in paths:
        try:
            return tuple(cameras_in(load_sidecar(path)[0], str(path)))
        except BadClip:
            continue
    return ()

"""Argoverse 2 sensor logs: where they lie, and the names of their cameras. Numpy is loaded where one is opened."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from factory.files import broken_link, folders_in, is_named, named_once
from factory.readers.settings import LogClips, Split

READERS = {"AV2Reader": LogClips}
READS = "argoverse2", "clips=av2 clips.root=.../sensor/train (docs/tutorials/av2_cameras.md)"
POSES, ANNOTATIONS = "city_SE3_egovehicle.feather", "annotations.feather"
INTRINSICS, EXTRINSICS = "calibration/intrinsics.feather", "calibration/egovehicle_SE3_sensor.feather"


def log_folders(root: Path) -> dict[str, Path]:
    """Log id -> folder, sorted by id. Raises ValueError where the root is no Argoverse 2 folder."""
    if _is_log(root):
        return {root.name: root}
    if not root.is_dir():
        raise ValueError(f"{root}: {broken_link(root) or 'no such folder'}")
    there = folders_in(root)
    parents = [root / split for split in get_args(Split) if root / split in there] or [root]
    found = ((folder.name, folder) for parent in parents for folder in folders_in(parent) if _is_log(folder))
    folders = named_once(root, found)
    if not folders:
        raise ValueError(
            f"{root}: no Argoverse 2 sensor log here; expected .../sensor, its train, val or test folder, or one log"
        )
    return folders


def _is_log(folder: Path) -> bool:
    return any(is_named(folder / name) for name in (ANNOTATIONS, POSES))


def camera_names(clips: Mapping[str, Any]) -> tuple[str, ...]:
    """The rig of the first chosen log with a calibration that can be read, in file order; none where no log has one.

    What is wrong with the others is told when they are read. Raises ValueError for a root without logs.
    """
    folders = log_folders(Path(str(clips["root"])))
    from factory.readers.arrow import read_feather
    from factory.readers.base import BadClip

    for folder in (folder for log_id, folder in folders.items() if not clips["only"] or log_id in clips["only"]):
        try:
            return tuple(read_feather(folder / INTRINSICS, ("sensor_name",))["sensor_name"].tolist())
        except BadClip:
            continue
    return ()

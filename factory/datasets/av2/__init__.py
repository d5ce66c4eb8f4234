"""Argoverse 2 sensor logs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factory.readers.settings import LogClips

READERS = {"AV2Reader": LogClips}


def camera_names(clips: Mapping[str, Any]) -> tuple[str, ...]:
    """The rig of the chosen logs. Raises ValueError for a root without logs."""
    from factory.datasets.av2.folders import log_folders, rig_names

    folders = log_folders(Path(str(clips["root"])))
    return rig_names(folder for log_id, folder in folders.items() if not clips["only"] or log_id in clips["only"])

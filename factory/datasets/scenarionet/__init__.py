"""ScenarioNet databases: nuScenes, Waymo, nuPlan and others in one format."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from factory.datasets.scenarionet.settings import ScenarioNetClips

READERS = {"ScenarioNetReader": ScenarioNetClips}
READS = "nuscenes waymo nuplan", "clips=scenarionet clips.root=<ScenarioNet's conversion> (docs/tutorials/nuscenes.md)"
SIDECARS = {"nuscenes-cameras": "factory.datasets.scenarionet.nuscenes_cameras:import_cameras"}
DRIVES = {"photos": "factory.datasets.scenarionet.photos:read_photo_drive"}


def camera_names(clips: Mapping[str, Any]) -> tuple[str, ...]:
    """The rig of the first of the chosen logs' sidecars that can be read. Raises ValueError where there is none.

    What is wrong with the others is told when they are read.
    """
    if clips["cameras"] is None:
        return ()
    from factory.datasets.scenarionet.photos import cameras_in, load_sidecar, sidecars_of
    from factory.datasets.scenarionet.reader import scenario_files
    from factory.readers.base import BadClip

    log_ids = [log_id for log_id in scenario_files(Path(clips["root"])) if not clips["only"] or log_id in clips["only"]]
    for path in sidecars_of(Path(clips["cameras"]), log_ids).values():
        with suppress(BadClip):
            return tuple(cameras_in(load_sidecar(path)[0], str(path)))
    return ()

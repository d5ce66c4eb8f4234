"""ScenarioNet databases: nuScenes, Waymo, nuPlan and others in one format."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factory.datasets.scenarionet.settings import ScenarioNetClips

READERS = {"ScenarioNetReader": ScenarioNetClips}
SIDECARS = {"nuscenes-cameras": "factory.datasets.scenarionet.nuscenes_cameras:import_cameras"}


def camera_names(clips: Mapping[str, Any]) -> tuple[str, ...]:
    """The rig of the chosen logs' sidecars. Raises ValueError."""
    if clips["cameras"] is None:
        return ()
    from factory.datasets.scenarionet.photos import rig_names, sidecars_of
    from factory.datasets.scenarionet.reader import scenario_files

    log_ids = [log_id for log_id in scenario_files(Path(clips["root"])) if not clips["only"] or log_id in clips["only"]]
    return rig_names(sidecars_of(Path(clips["cameras"]), log_ids).values())

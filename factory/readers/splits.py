"""Which split a log belongs to by its data set's own word; None where the data set has none.

Only then does the hash of the log's id decide (`factory.readers.base.split_of`). A folder that is named after a split
wins over what is known of single logs: whoever sorted the logs said so.
"""

import re
from pathlib import Path, PurePosixPath

WAYMO = {"training": "train", "validation": "val", "testing": "test"}
FOLDERS = {"train": "train", "val": "val", "test": "test", **WAYMO}
# nuscenes-devkit @ d9de17a, python-sdk/nuscenes/utils/splits.py: the 150 scenes `val` of v1.0-trainval, whose other 700
# are `train`; `mini_val` of v1.0-mini; all of v1.0-test is `test`. The train scenes of the mini version are partly the
# whole data set's val scenes, so the version in a file's name decides.
_NUSCENES_VAL = (
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
    "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)
_NUSCENES_MINI_VAL = "103 916"


def _scenes(ranges: str) -> frozenset[int]:
    ends = [[int(number) for number in part.split("-")] for part in ranges.split()]
    return frozenset(scene for first, *last in ends for scene in range(first, (last or [first])[0] + 1))


NUSCENES_VAL = {"v1.0-trainval": _scenes(_NUSCENES_VAL), "v1.0-mini": _scenes(_NUSCENES_MINI_VAL)}


def folder_split(log: Path) -> str | None:
    """The split after which the folder of a log is named, as in Argoverse's `sensor/val/<log>`."""
    return FOLDERS.get(log.parent.name)


def nuscenes_split(scenario: str) -> str | None:
    """The split of a ScenarioNet file `sd_nuscenes_<version>_scene-<number>`, by nuScenes' own lists."""
    named = re.fullmatch(r"sd_nuscenes_(v1\.0-\w+)_scene-(\d{4})", scenario)
    if named is None:
        return None
    version, scene = named[1], int(named[2])
    if version == "v1.0-test":
        return "test"
    held_out = NUSCENES_VAL.get(version)
    return None if held_out is None else "val" if scene in held_out else "train"


def waymo_split(source_file: object) -> str | None:
    """The split of the record that a scenario was converted from: training*, validation*, testing*.tfrecord-*."""
    name = PurePosixPath(source_file).name if isinstance(source_file, str) else ""
    return next((split for word, split in WAYMO.items() if name.startswith(word)), None)

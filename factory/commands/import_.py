"""`python -m factory import simscale|navhard|navtest|nuscenes-cameras root=<folder> out=<...>`: others' data as ours.

    python -m factory import simscale root=SimScale_data out=runs/simscale maps=nuplan/maps
    python -m factory import simscale root=exported out=runs/back only=[synthetic_reaction_pdm_v1.0-0]
    python -m factory import simscale root=SimScale_data out=runs/simscale rewards=traj_pdm vocabulary=16384.npy

simscale: the released layout, moved into NAVSIM's folders or as unpacked, and what `export navsim` wrote, human samples
too. One row for each log, which `train`, `show`, `dashboard`, `report` and `export` take as any other
(`data.sim=[runs/simscale]`).
    maps=<folder>        nuPlan's, for lanes, route and lights of each row; without it these columns are empty
    rewards=<folder>     reward pickles, or one of them; with vocabulary=<.npy> they become the rows' labels
    pictures=false       rows without pictures
    only=[a,b]           these of the folders alone
navhard: NAVSIM's two-stage benchmark, which `python -m planners evaluate benchmark=<out>` takes.
    python -m factory import navhard root=navhard_two_stage logs=navsim_logs/test sensors=sensor_blobs/test \\
        maps=maps split=.../train_test_split/navhard_two_stage.yaml out=runs/navhard
    root=<folder>        synthetic_scene_pickles and sensor_blobs of the second stage
    logs=, sensors=      of the first stage; pictures=false needs no sensors
    split=<.yaml>        whose reactive_all_mapping says which scenes belong together
navtest: its one-stage benchmark, the frames that a scene filter or split names, for the same `evaluate`.
    python -m factory import navtest root=navsim_logs/test sensors=sensor_blobs/test maps=maps \\
        split=.../train_test_split/navtest.yaml out=runs/navtest
    root=<folder>        the logs; sensors=, pictures= and maps= as above
nuscenes-cameras: where nuScenes' photos and lidar are, as sidecars of ScenarioNet's logs (docs/photos.md), one file a
scene below out=, which `clips=scenarionet clips.cameras=<out> clips.sensor_root=<root>` takes.
    python -m factory import nuscenes-cameras root=/data/nuscenes version=v1.0-mini out=/data/photos
    root=<folder>        samples, sweeps, v1.0-*; nothing of it is copied
    version=v1.0-mini    of the tables; needed where several are there
    sweeps=false         keyframes alone: photos at 2 Hz instead of 12; lidar is always that of keyframes
    only=[scene-0103]    these scenes alone
The same command again goes on, and tries what failed once more. What is kept and what is lost: docs/navsim.md.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from factory.config.arguments import POSITIONAL, Refused
from factory.config.datasets import find_function
from factory.wording import one_line

CAMERAS = "nuscenes-cameras"


@dataclass(frozen=True)
class Request:
    """The command line."""

    source: Literal["simscale", "navhard", "navtest", "nuscenes-cameras"] = field(metadata=POSITIONAL)
    root: str
    out: str
    maps: str | None = None
    rewards: str | None = None
    vocabulary: str | None = None
    pictures: bool = True
    only: tuple[str, ...] = ()
    logs: str | None = None
    sensors: str | None = None
    split: str | None = None
    version: str | None = None
    sweeps: bool = True

    def __post_init__(self) -> None:
        if self.source == CAMERAS:
            return
        if self.version is not None or not self.sweeps:
            raise ValueError(f"version= and sweeps= are of import {CAMERAS}")
        if (self.rewards is None) != (self.vocabulary is None):
            raise ValueError("rewards= and vocabulary= go together: scores mean nothing without their trajectories")
        if self.source != "simscale":
            needed = ("logs", "maps", "split") if self.source == "navhard" else ("maps", "split")
            if missing := [name for name in needed if getattr(self, name) is None]:
                takes = ", ".join(f"{name}=" for name in needed)
                raise ValueError(f"{missing[0]}=... is missing: import {self.source} takes {takes}")
            if (self.sensors is None) == self.pictures:
                raise ValueError("sensors= and pictures=: give the folder of pictures, or pictures=false")


def main(request: Request) -> int:
    """Write the rows and say how it ended. Raises Refused."""
    if request.source == CAMERAS:
        return _cameras(request)
    from deltalake.exceptions import DeltaError

    from factory.files import why_unusable
    from factory.readers.base import BadClip
    from factory.store.location import Location
    from factory.store.samples import ChangedRun, Store
    from factory.store.table import AnotherWriter
    from factory.views.status import failed_line

    if unusable := why_unusable(request.out):
        raise Refused(unusable)
    try:
        store = Store(Location.parse(request.out))
        summary, said = find_function("IMPORTS", request.source)(request, store)
    except (BadClip, ChangedRun, AnotherWriter, ValueError, OSError, ImportError, DeltaError) as error:
        raise Refused(one_line(error)) from error
    counts = summary.counts
    print(f"{counts['accepted']:,} samples imported, {summary.executed.found_done:,} were there: {store.location.uri}")
    for line in filter(None, (summary.message, said, failed_line(store) if counts["failed"] else "")):
        print(line)
    return summary.exit_code


def _cameras(request: Request) -> int:
    """Write the sidecars and say what each holds. Raises Refused."""
    from factory.readers.base import BadClip

    root, out = Path(request.root), Path(request.out)
    photos = 0
    try:
        for done in find_function("SIDECARS", request.source)(root, out, request.version, request.only, request.sweeps):
            photos += done.photos
            where = f"{done.photos:,} photos of {done.cameras} cameras, {done.sweeps} sweeps: {done.path}"
            print(f"{done.scene}  {where if done.photos else 'no photo is there: no sidecar'}")
            if done.missing:
                print(f"  {len(done.missing):,} files of the tables are not there, such as {done.missing[0]}")
    except (BadClip, ValueError, OSError) as error:
        raise Refused(one_line(error)) from error
    if not photos:
        raise Refused(f"{root}: none of the photos that its tables name is there; unpack samples/ and sweeps/ into it")
    return 0

"""The synthetic town as a data set: written once into a cache folder, then read like any Argoverse 2 logs."""

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.town.draw import TownRenderer, build_rig, paint, world_from_ego
from factory.datasets.town.drive import TownDrive, TownTrack
from factory.datasets.town.settings import LOGS_PER_TOWN, TownClips, TownsClips, TownSettings
from factory.datasets.town.town import (
    Town,
    TownFolder,
    log_name,
    plan_log,
    repair_folder,
    write_logs,
    write_once,
    write_town,
    write_towns,
)
from factory.readers.base import ClipIndex, ClipRef
from tasks.caches import user_cache
from tasks.world.arrays import Array, Bytes
from tasks.world.clip import STEP_S, AgentTracks, Camera, Clip
from tasks.world.frames import HEADING, X, Y
from tasks.world.road_map import TrafficLights

# The synthetic town as its painter shows it, from wherever a simulation has come to: pictures without a scene.
#
# A log of the town is planned again from its name, as it was when it was written; who is painted is who the
# simulation has there, each as the log's own figure. The town's lights go on beyond the log.

_LOG = re.compile(r"town-(\d+)-(\d{4})-")  # log_name


def parse_town_log_id(log_id: str) -> tuple[int, int]:
    """Seed and number of a town's log. Raises ValueError for the log of another data set."""
    found = _LOG.match(log_id)
    if found is None or log_name(int(found[1]), int(found[2])) != log_id:
        raise ValueError(f"log {log_id} is not of the synthetic town: there is no painter of it")
    return int(found[1]), int(found[2])


class TownPainter:
    """The painter of the synthetic town (factory.readers.base.Painter). Raises ValueError for a clip of no town."""

    def rig(self, clip: Clip, width: int, height: int) -> tuple[Camera, ...]:
        """The clip's cameras, or the town's usual ones where it has none."""
        return clip.cameras or build_rig(TownSettings().cameras, width, height)

    def lights(self, clip: Clip, n_steps: int) -> TrafficLights:
        """The clip's lights over `n_steps` steps from its first one, beyond the log too."""
        town, drive = _planned(*parse_town_log_id(clip.log_id))
        times_s = _time_of(drive, clip, np.arange(n_steps))
        groups = [town.streets.lanes[int(lane_id)].light_group for lane_id in clip.lights.lane_ids]
        states = [[drive.signals.state(group, float(time_s)) for group in groups] for time_s in times_s]
        return replace(clip.lights, states=np.array(states, np.int8).reshape(n_steps, len(groups)))

    def pictures(
        self, clip: Clip, cameras: Sequence[Camera], agents: AgentTracks, step: int, state: Array
    ) -> tuple[Array, list[Bytes]]:
        """The pose (4, 4) of an ego in a state (11,), and what each camera sees from there at a step of the clip."""
        log = parse_town_log_id(clip.log_id)
        _, drive = _planned(*log)
        time_s = float(_time_of(drive, clip, np.array([step]))[0])
        lit = _renderer(*log).scene_among(_tracks(drive, agents), step, state[[X, Y]], time_s)
        pose = world_from_ego(state[: HEADING + 1])
        return pose, [paint(lit, camera, pose) for camera in cameras]


def _tracks(drive: TownDrive, agents: AgentTracks) -> list[TownTrack]:
    """The log's figures where the simulation has them."""
    figures = {track.track_id: track for track in drive.tracks}
    poses = np.where(agents.valid[..., None], agents.boxes[..., :3], np.nan)
    return [replace(figures[name], poses=poses[:, i]) for i, name in enumerate(agents.track_ids)]


def _time_of(drive: TownDrive, clip: Clip, steps: np.ndarray) -> np.ndarray:
    """Times of the town's clock at steps of a clip."""
    return float(drive.times_s[0]) + clip.start_s + steps * STEP_S


@lru_cache(maxsize=4)
def _planned(seed: int, number: int) -> tuple[Town, TownDrive]:
    return plan_log(seed, number)


@lru_cache(maxsize=1)
def _renderer(seed: int, number: int) -> TownRenderer:
    """Hundreds of megabytes, and seconds to build: pictures of one log come one after the other."""
    town, drive = _planned(seed, number)
    return TownRenderer(town.scenery, drive, town.sun_azimuth, town.sun_elevation, town.sky_seed)


TOWN_VERSION = 3  # raise by hand whenever the same seed gives other bytes


class TownLogReader(AV2Reader):
    """Towns' logs: a digest tells what the sensors record, too, pixels and points, which Argoverse's leaves out."""

    data_set = "synthetic"
    settings: TownSettings
    painter = TownPainter()

    def read(self, ref: ClipRef) -> Clip:
        """The validated clip. Raises BadClip."""
        clip = super().read(ref)
        return replace(clip, content_digest=self._sensed(clip.content_digest))

    def digest(self, ref: ClipRef) -> str:
        """The clip's content digest, without reading it. Raises BadClip."""
        return self._sensed(super().digest(ref))

    def world(self, path: Path) -> str:
        """The town; another seed's of the same name lies at the same places. Raises BadClip."""
        return f"{super().world(path)} of {path.name.split('-')[1]}"

    def _sensed(self, digest: str) -> str:
        return hashlib.sha256(f"{digest}{self.split or ''}{json.dumps(asdict(self.settings))}".encode()).hexdigest()


class SyntheticReader(TownLogReader):
    """Clips of a seed's town. It is test data and a first look, no replacement for real logs.

    The town is written on first use, into a folder named by everything that its bytes depend on, and moved there
    whole: parallel workers and killed processes never leave or see half a town. Who indexes it, once before a run's
    workers start, holds its files against their checksums.
    """

    def __init__(
        self,
        cache_dir: str | Path | None = None,
        n_clips: int = TownClips.n_clips,
        seed: int = TownClips.seed,
        settings: TownSettings | None = None,
        traversals: int = TownClips.traversals,
    ) -> None:
        """cache_dir: where towns are kept; None: in the user's cache. Raises ValueError for n_clips < 1."""
        clips = TownClips(n_clips=n_clips, seed=seed, settings=settings or TownSettings())
        self.n_clips, self.seed, self.settings = clips.n_clips, clips.seed, clips.settings
        super().__init__(town_folder(cache_dir, seed, [n_clips], self.settings), traversals=traversals)

    def logs(self) -> dict[str, Path]:
        """Log id -> folder; writes the town if it is missing."""
        write_once(self.root, self._write)
        return super().logs()

    def index(self) -> ClipIndex:
        """The first n_clips windows, in the order of the logs; a town that was damaged is mended."""
        if self.root.is_dir():
            repair_folder(self.root, self._write)
        index = super().index()
        return replace(index, refs=index.refs[: self.n_clips])

    def _write(self, folder: Path) -> None:
        write_town(folder, self.n_clips, self.seed, self.settings)


def town_folder(cache_dir: str | Path | None, seed: int, logs: list[object], settings: TownSettings) -> Path:
    """Where these logs of a seed's town lie, or will."""
    key = json.dumps([TOWN_VERSION, *logs, seed, asdict(settings)])
    name = f"town-{seed}-{hashlib.sha256(key.encode()).hexdigest()[:16]}"
    return Path(cache_dir or user_cache() / "towns").expanduser().absolute() / name


# Several towns as one data set: a few logs of each seed's town, for studies that split their clips by town.


class SyntheticTownsReader(TownLogReader):
    """Clips of the towns of several seeds; no seed's clips depend on which other seeds are read.

    A town has eighteen kinds of drives. Of each town the next `logs_per_town` are taken, so that a few towns hold every
    kind; `first_log` begins so many later. Each town is written on first use into a folder of its own and moved there
    whole: indexing mends and writes them all, before a run's workers start, and a reader elsewhere writes those it
    reads from.
    """

    def __init__(
        self,
        seeds: Sequence[int] | None = None,
        first_seed: int = TownsClips.first_seed,
        n_towns: int = TownsClips.n_towns,
        logs_per_town: int = TownsClips.logs_per_town,
        first_log: int = TownsClips.first_log,
        split: str = TownsClips.split,
        first_window: int = TownsClips.first_window,
        cache_dir: str | Path | None = None,
        settings: TownSettings | None = None,
        traversals: int = TownsClips.traversals,
    ) -> None:
        """seeds: None: `n_towns` of them from `first_seed` on; split: of every clip, whatever its log's hash says.

        Raises ValueError for repeated or no seeds, an unknown split, or more logs than a town has kinds of drives.
        """
        seeds = None if seeds is None else tuple(seeds)
        clips = TownsClips(seeds, first_seed, n_towns, logs_per_town, first_log)
        folder = cache_dir or user_cache() / "towns"
        super().__init__(folder, first_window=first_window, split=split, traversals=traversals)
        self.settings = settings or TownSettings()
        self.towns = tuple(self._town(seed, logs_per_town, first_log) for seed in clips.chosen)

    def logs(self) -> dict[str, Path]:
        """Of all towns, in the order of the seeds; writes the towns that are missing."""
        write_towns(self.towns, self.settings)
        return {name: folder for town in self.towns for name, folder in town.logs().items()}

    def index(self) -> ClipIndex:
        """All windows of all towns; a town that was damaged is mended."""
        for town in self.towns:
            if town.root.is_dir():
                again = partial(write_logs, indices=town.indices, seed=town.seed, settings=self.settings)
                repair_folder(town.root, again)
        return super().index()

    def path_of(self, ref: ClipRef) -> Path:
        """The folder of the clip's log; writes its town if it is missing. Raises BadClip where there is none."""
        for town in self.towns:
            if ref.log_id in town.logs() and ref.dataset == self.name:
                write_towns([town], self.settings)
                return town.logs()[ref.log_id]
        return super().path_of(ref)

    def _town(self, seed: int, n_logs: int, first: int) -> TownFolder:
        indices = tuple((seed * n_logs + first + i) % LOGS_PER_TOWN for i in range(n_logs))
        return TownFolder(seed, indices, town_folder(self.root, seed, ["logs", indices], self.settings))

"""The synthetic town as a data set: written once into a cache folder, then read like any Argoverse 2 logs."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from factory.datasets.av2.reader import AV2Reader
from factory.datasets.town.painter import TownPainter
from factory.datasets.town.settings import LOGS_PER_TOWN, TownClips, TownsClips, TownSettings
from factory.datasets.town.town import TownFolder, mend_all, write_all, write_town
from factory.readers.base import ClipIndex, ClipRef
from factory.readers.whole_folder import make_whole, mend
from tasks.caches import user_cache
from tasks.world.clip import Clip

TOWN_VERSION = 3  # raise by hand whenever the same seed gives other bytes


class SensedReader(AV2Reader):
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


class SyntheticReader(SensedReader):
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
        make_whole(self.root, self._write)
        return super().logs()

    def index(self) -> ClipIndex:
        """The first n_clips windows, in the order of the logs; a town that was damaged is mended."""
        if self.root.is_dir():
            mend(self.root, self._write)
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


class SyntheticTownsReader(SensedReader):
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
        write_all(self.towns, self.settings)
        return {name: folder for town in self.towns for name, folder in town.logs().items()}

    def index(self) -> ClipIndex:
        """All windows of all towns; a town that was damaged is mended."""
        mend_all(self.towns, self.settings)
        return super().index()

    def path_of(self, ref: ClipRef) -> Path:
        """The folder of the clip's log; writes its town if it is missing. Raises BadClip where there is none."""
        for town in self.towns:
            if ref.log_id in town.logs() and ref.dataset == self.name:
                write_all([town], self.settings)
                return town.logs()[ref.log_id]
        return super().path_of(ref)

    def _town(self, seed: int, n_logs: int, first: int) -> TownFolder:
        indices = tuple((seed * n_logs + first + i) % LOGS_PER_TOWN for i in range(n_logs))
        return TownFolder(seed, indices, town_folder(self.root, seed, ["logs", indices], self.settings))

"""The synthetic town as a data set: written once into a cache folder, then read like any Argoverse 2 logs."""

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path

from factory.readers.av2.reader import AV2Reader
from factory.readers.base import ClipIndex, ClipRef
from factory.readers.settings import TownClips, TownSettings
from factory.readers.town.write import write_town
from factory.readers.whole_folder import make_whole, mend
from tasks.caches import user_cache
from tasks.world.clip import Clip

TOWN_VERSION = 3  # raise by hand whenever the same seed gives other bytes


class SensedReader(AV2Reader):
    """Towns' logs: a digest tells what the sensors record, too, pixels and points, which Argoverse's leaves out."""

    data_set = "synthetic"
    settings: TownSettings

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

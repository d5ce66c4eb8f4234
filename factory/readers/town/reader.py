"""The synthetic town as a data set: written once into a cache folder, then read like any Argoverse 2 logs."""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

from factory.readers.av2.reader import AV2Reader
from factory.readers.base import ClipIndex, ClipRef
from factory.readers.settings import TownClips, TownSettings
from factory.readers.town.write import write_town
from tasks.caches import user_cache
from tasks.world.clip import Clip

TOWN_VERSION = 2  # raise by hand whenever the same seed gives other bytes


class SyntheticReader:
    """Clips of a seed's town. It is test data and a first look, no replacement for real logs.

    The town is written on first use, into a folder named by everything that its bytes depend on, and moved there
    whole: parallel workers and killed processes never leave or see half a town.
    """

    name = "synthetic"

    def __init__(
        self,
        cache_dir: str | Path | None = None,
        n_clips: int = TownClips.n_clips,
        seed: int = TownClips.seed,
        settings: TownSettings | None = None,
    ) -> None:
        """cache_dir: where towns are kept; None: in the user's cache. Raises ValueError for n_clips < 1."""
        clips = TownClips(n_clips=n_clips, seed=seed, settings=settings or TownSettings())
        self.cache_dir = Path(cache_dir or user_cache() / "towns").expanduser().absolute()
        self.n_clips, self.seed, self.settings = clips.n_clips, clips.seed, clips.settings
        self._logs: AV2Reader | None = None

    @property
    def root(self) -> Path:
        """Where this town's logs lie, or will."""
        key = json.dumps([TOWN_VERSION, self.n_clips, self.seed, asdict(self.settings)])
        return self.cache_dir / f"town-{self.seed}-{hashlib.sha256(key.encode()).hexdigest()[:16]}"

    def index(self) -> ClipIndex:
        """The first n_clips windows, in the order of the logs."""
        index = self._reader().index()
        return replace(index, refs=index.refs[: self.n_clips])

    def read(self, ref: ClipRef) -> Clip:
        """The validated clip. Raises BadClip."""
        clip = self._reader().read(ref)
        return replace(clip, content_digest=self._with_sensors(clip.content_digest))

    def digest(self, ref: ClipRef) -> str:
        """The clip's content digest, without reading it. Raises BadClip."""
        return self._with_sensors(self._reader().digest(ref))

    def block(self, ref: ClipRef) -> str | None:
        """Of the clip, as an Argoverse 2 log's."""
        return self._reader().block(ref)

    def _with_sensors(self, digest: str) -> str:
        return sensed_digest(digest, self.settings)

    def _reader(self) -> AV2Reader:
        if self._logs is None:
            make_whole(self.root, lambda folder: write_town(folder, self.n_clips, self.seed, self.settings))
            self._logs = AV2Reader(self.root, name=self.name)
        return self._logs


def sensed_digest(digest: str, settings: TownSettings) -> str:
    """A log's digest with what the sensors record: pixels and points, which Argoverse's digest leaves out."""
    return hashlib.sha256(f"{digest}{json.dumps(asdict(settings))}".encode()).hexdigest()


def make_whole(root: Path, write: Callable[[Path], object]) -> None:
    """The folder `root` with what `write` writes into it, unless it is there: whole or not at all."""
    if not root.is_dir():
        finish_whole(unfinished_folder(root), root, write)


def unfinished_folder(root: Path) -> Path:
    """A new empty folder beside `root`, to become it."""
    root.parent.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix=f".{root.name}-", dir=root.parent))


def finish_whole(unfinished: Path, root: Path, write: Callable[[Path], object]) -> None:
    """Has `unfinished` written and renames it to `root`; it is gone afterwards, whatever happened."""
    try:
        write(unfinished)
        try:
            os.rename(unfinished, root)
        except OSError:
            if not root.is_dir():  # else another worker was first, with the same bytes
                raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)

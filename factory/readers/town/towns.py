"""Several towns as one data set: a few logs of each seed's town, for studies that split their clips by town."""

from collections.abc import Sequence
from pathlib import Path

from factory.readers.base import ClipIndex, ClipRef
from factory.readers.settings import LOGS_PER_TOWN, TownsClips, TownSettings
from factory.readers.town.painters import TownFolder, mend_all, write_all
from factory.readers.town.reader import SensedReader, town_folder
from tasks.caches import user_cache


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

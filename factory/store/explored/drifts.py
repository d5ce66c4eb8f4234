"""The drifts that a run takes: whose they are, which clips have some, and those of one clip."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import pyarrow as pa
import pyarrow.compute as pc

from factory.readers.base import BadClip
from factory.store.explored.table import FACTS, explored_clips, open_explored
from factory.store.location import Location
from factory.store.table import KeyedTable
from tasks.drifts import Drift
from tasks.world.clip import Clip


@dataclass(frozen=True)
class Explored:
    """All of a table; what a clip has is read when it is perturbed."""

    location: Location
    planner: str
    planner_digest: str
    digests: Mapping[str, str] = field(repr=False)  # clip_id -> digest of its row
    n_drifts: int
    n_failing: int  # of them those where the planner then fails

    @cached_property
    def digest(self) -> str:
        """16 hex digits of every row."""
        rows = "\x1f".join(f"{clip_id} {digest}" for clip_id, digest in sorted(self.digests.items()))
        return hashlib.sha256(rows.encode()).hexdigest()[:16]

    def of(self, clip: Clip) -> tuple[Drift, ...]:
        """The clip's drifts by number; none where it was not explored.

        Raises BadClip where the clip is another than the planner drove in, and OSError where the row was changed since
        the run began.
        """
        if clip.clip_id not in self.digests:
            return ()
        options = tuple(sorted(self.location.options.items()))
        (row,) = explored_clips(_rows_of(_table(self.location.uri, options, self.digest), clip.clip_id))
        if row.digest != self.digests[clip.clip_id]:
            raise OSError(f"{self.location.uri}: clip {clip.clip_id} was explored anew since this run began")
        if row.content_digest != clip.content_digest:
            raise BadClip(
                f"log {clip.log_id}",
                "clip",
                f"content digest {clip.content_digest}, explored as {row.content_digest}: restore it or explore anew",
            )
        return tuple(one.as_drift() for one in row.drifts)


def explored_in(location: Location) -> Explored:
    """What a folder of `python -m planners explore` holds. Raises ValueError where there is none, or of several."""
    table = open_explored(location)
    rows = table.read(FACTS).to_pylist()
    if not rows:
        raise ValueError(
            f"no drifts in {location.uri}: python -m planners explore planner=<who> out=<folder> makes them"
        )
    made = {(row["planner_digest"], row["settings"]) for row in rows}
    if len(made) > 1:
        raise ValueError(f"{location.uri}: drifts of {len(made)} planners or settings in one table")
    digests = {row["clip_id"]: row["digest"] for row in rows}
    n_drifts, n_failing = (sum(row[name] for row in rows) for name in ("n_drifts", "n_failing"))
    planner = min(row["planner"] for row in rows)  # its folder may have moved meanwhile
    return Explored(location, planner, rows[0]["planner_digest"], digests, n_drifts, n_failing)


def _rows_of(table: KeyedTable, clip_id: str) -> pa.Table:
    path = table.path_of(clip_id)
    rows = table.read_file(path, table.live_files()[path])
    return rows.filter(pc.equal(rows["clip_id"], clip_id))


@lru_cache(maxsize=2)
def _table(uri: str, options: tuple[tuple[str, str], ...], digest: str) -> KeyedTable:
    """A worker's own, opened once for each state of it."""
    return open_explored(Location(uri, dict(options)))

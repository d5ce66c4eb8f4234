"""Which of a run's clips are drawn and how candidates are ordered, by what a planner showed in them (`sample=`)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factory.config.run import RunConfig
from factory.config.words import ConfigError
from factory.readers.base import ClipRef
from factory.store.explored.drifts import Explored, explored_in
from factory.store.explored.table import open_explored
from factory.store.location import Location
from tasks.perturb import grid_cells
from tasks.sampling import CellWeights, ClipFacts, cell_weights, clip_weights, drawn
from tasks.settings import PerturbSettings

COLUMNS = ("clip_id", "tags", "score", "fails", "ends", "fails_from")


@dataclass(frozen=True)
class Sampled:
    """How much clips and cells weigh."""

    clips: dict[str, float]  # clip_id -> weight
    cells: CellWeights | None  # None: candidates are tried as they are listed
    digest: str  # of the drives that it comes from; empty where candidates do not depend on them


def choose_sample(config: RunConfig) -> Sampled:
    """From the table that sample.scores, or explore, names. Raises ConfigError where one is needed and not there."""
    wanted, folder = config.sample, config.sample.scores or config.explore
    if not wanted.needs_scores:
        return Sampled({}, None, "")
    if folder is None:
        raise ConfigError("sample: give sample.scores=<out of python -m planners explore>, or explore=")
    location = Location.parse(folder, setting="sample.scores")
    try:
        explored = explored_in(location)
        rows = open_explored(location).read(COLUMNS).to_pylist()
        clips = clip_weights([_facts(row) for row in rows], wanted)
    except ValueError as error:
        raise ConfigError(f"sample.scores={folder}: {error}") from error
    if wanted.candidates == "listed":
        return Sampled(clips, None, "")
    return Sampled(clips, cell_weights([end for row in rows for end in _ends(row, config.perturb)]), _digest(explored))


def chosen_clips(config: RunConfig, refs: Sequence[ClipRef], sampled: Sampled) -> list[ClipRef]:
    """The clips of a run: the first `limit`, or so many drawn by lot, in the order of the index."""
    if not config.sample.drawn or config.limit is None:
        return list(refs[: config.limit])
    taken = set(drawn([ref.clip_id for ref in refs], sampled.clips, config.limit, config.seed))
    return [ref for ref in refs if ref.clip_id in taken]


def _digest(explored: Explored) -> str:
    return f"{explored.planner} {explored.planner_digest} {explored.digest}"


def _facts(row: dict[str, object]) -> ClipFacts:
    fails_from, tags = row["fails_from"], row["tags"]
    assert isinstance(fails_from, list) and isinstance(tags, list) and isinstance(row["score"], float)
    failing = [bool(row["fails"]), *map(bool, fails_from)]
    return ClipFacts(str(row["clip_id"]), tuple(tags), row["score"], len(failing), sum(failing))


def _ends(row: dict[str, object], settings: PerturbSettings) -> list[tuple[tuple[int, int], bool]]:
    fails_from = row["fails_from"]
    assert isinstance(fails_from, list)
    cells = grid_cells(np.array(row["ends"], dtype=np.float64).reshape(-1, 3), settings)
    return [((int(i), int(j)), bool(fails)) for (i, j), fails in zip(cells, fails_from, strict=True)]

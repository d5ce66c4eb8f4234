"""`python -m factory import simscale root=<folder> out=<folder or URL>`: others' samples as a table of ours.

    python -m factory import simscale root=SimScale_data out=runs/simscale maps=nuplan/maps
    python -m factory import simscale root=exported out=runs/back only=[synthetic_reaction_pdm_v1.0-0]
    python -m factory import simscale root=SimScale_data out=runs/simscale rewards=traj_pdm vocabulary=16384.npy

simscale: the released layout, moved into NAVSIM's folders or as unpacked. One row for each log, which `train`, `show`,
`dashboard`, `report` and `export` take as any other (`data.sim=[runs/simscale]`).
    maps=<folder>        nuPlan's, for lanes, route and lights of each row; without it these columns are empty
    rewards=<folder>     reward pickles, or one of them; with vocabulary=<.npy> they become the rows' labels
    pictures=false       rows without pictures
    only=[a,b]           these of the folders alone
The same command again goes on, and tries what failed once more. What is kept and what is lost: docs/navsim.md.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from factory.config.arguments import WORD, Refused
from factory.wording import one_line


@dataclass(frozen=True)
class Request:
    """The command line."""

    source: Literal["simscale"] = field(metadata=WORD)
    root: str
    out: str
    maps: str | None = None
    rewards: str | None = None
    vocabulary: str | None = None
    pictures: bool = True
    only: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if (self.rewards is None) != (self.vocabulary is None):
            raise ValueError("rewards= and vocabulary= go together: scores mean nothing without their trajectories")


def main(request: Request) -> int:
    """Write the rows and say how it ended. Raises Refused."""
    from deltalake.exceptions import DeltaError

    from factory.imports.scenes import no_road
    from factory.imports.simscale import Import, Rewards, parts_of
    from factory.imports.table import identity_of, import_rows
    from factory.setup.vocabulary import load_vocabulary
    from factory.store.location import Location
    from factory.store.samples import ChangedRun, Store
    from factory.store.table import AnotherWriter
    from factory.store.usable import why_unusable
    from factory.views.status import failed_line

    if unusable := why_unusable(request.out):
        raise Refused(unusable)
    root = Path(request.root).expanduser()
    try:
        parts = parts_of(root, request.only)
        rewards = None
        if request.rewards is not None and request.vocabulary is not None:
            rewards = Rewards(Path(request.rewards).expanduser(), load_vocabulary(request.vocabulary))
        settings = {
            "maps": request.maps is not None,
            "pictures": request.pictures,
            "labels": None if rewards is None else rewards.vocabulary.digest,
        }
        wanted = Import(lambda frames, now, file: no_road(frames[now]), request.pictures, rewards)
        store = Store(Location.parse(request.out))
        summary = import_rows(store, identity_of(request.source, settings), wanted.entries(parts))
    except (ChangedRun, AnotherWriter, ValueError, OSError, DeltaError) as error:
        raise Refused(one_line(error)) from error
    counts = summary.counts
    print(f"{counts['accepted']:,} samples imported, {summary.executed.found_done:,} were there: {store.location.uri}")
    if summary.message:
        print(summary.message)
    if counts["failed"]:
        print(failed_line(store))
    return summary.exit_code

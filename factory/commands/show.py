"""`python -m factory show out=<folder or URL> sample=<id>`: one sample: numbers, a picture, a film.

    python -m factory show out=runs/demo list=true        sample ids, one a line
    python -m factory show out=runs/demo sample=0         one sample: numbers, and a picture in the current folder
    python -m factory show 3fa9 out=runs/demo             the same by its id, or the beginning of it
    python -m factory show out=runs/demo sample=0 to=x.png    ... the picture there (a folder, or a file ending in .png)
    python -m factory show out=runs/demo sample=0 film=true   ... and a film of it beside the picture (.mp4)
    python -m factory show out=runs/av2 sample=0 vocabulary=human.npy   ... with every labelled trajectory by its score

The run as a whole: python -m factory status. Where the block's scene is still in the run's cache, a sample's picture
also shows the log's photos, the scene from the same poses, and the sample's now as seen from up to 2 m to either side.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from factory.config.arguments import POSITIONAL, Refused
from factory.views.show import (
    find,
    label_lines,
    labelled_trajectories,
    logged_drive,
    number_lines,
    open_samples,
)
from factory.views.status import open_store

if TYPE_CHECKING:
    from factory.store.reader import SampleTable
    from factory.store.samples import Store


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str
    sample: str | None = field(default=None, metadata=POSITIONAL)  # attempt_id, its beginning, or an ordinal
    list: bool = False  # the ids, one a line, and no sample
    to: str | None = None  # folder or .png of the picture
    film: bool = False  # beside the picture
    vocabulary: str | None = None  # .npy that the labels are of; without it the kinematic one, where they are of that

    def __post_init__(self) -> None:
        if (self.sample is not None) == self.list:
            raise ValueError("choose one of sample=<id> and list=true; python -m factory status shows the run")
        if self.list and (self.to is not None or self.film or self.vocabulary is not None):
            raise ValueError("to=, film= and vocabulary= are of sample=; give sample= too, without list=true")


def main(request: Request) -> None:
    """Print the lines as they come. Raises Refused where there is nothing to show."""
    store = open_store(request.out)
    table, which = open_samples(store), request.sample
    for line in table.attempt_ids if which is None else sample_lines(store, table, which, request):
        print(line, flush=True)


def sample_lines(store: "Store", table: "SampleTable", which: str, request: Request) -> Iterator[str]:
    """One sample's numbers; writes its picture and says where it is."""
    from factory.views.sample_picture import encoded, sample_sheet
    from factory.views.seen_again import again_sheet, digest_of, film, scene_of, stacked

    attempt_id = find(table, store, which)
    row = table[attempt_id]
    path = _picture_path(attempt_id, request.to)
    drawn = labelled_trajectories(row, request.vocabulary)
    yield from number_lines(row)
    yield from label_lines(row, drawn is not None)
    logged = logged_drive(store, row)
    sheets = [sample_sheet(row, logged, vocabulary=drawn)]
    digest = digest_of(store, row)
    scene = None if digest is None else scene_of(store, digest)
    if digest is not None and scene is None:
        yield f"              scene {digest} is not in the run's cache: nothing is rendered anew"
    if scene is not None and (again := again_sheet(store, row, scene)) is not None:
        sheets.append(again)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encoded(stacked(sheets), ".png"))
        yield f"picture       {path.resolve()}"
        if request.film:
            from factory.views.bev import write_mp4

            write_mp4(path.with_suffix(".mp4"), film(row, scene, logged))
            yield f"film          {path.with_suffix('.mp4').resolve()}"
    except OSError as error:
        raise Refused(f"to={request.to or '.'}: the picture cannot be written: {error}") from error


def _picture_path(attempt_id: str, to: str | None) -> Path:
    target = Path(to or ".")
    if target.suffix.lower() == ".png":
        return target
    if target.suffix and not target.is_dir():
        raise Refused(f"to={to}: the picture is a PNG; name a file ending in .png, or a folder")
    return target / f"sample_{attempt_id}.png"

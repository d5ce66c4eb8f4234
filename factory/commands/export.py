"""`python -m factory export mcap|mp4|navsim out=<folder or URL> ...`: samples as files for other tools.

    python -m factory export mcap out=runs/demo sample=0             one sample for Foxglove, Lichtblick or Rerun
    python -m factory export mcap out=runs/demo every=10 to=looks    every tenth sample, a file each
    python -m factory export mp4 out=runs/demo sample=3fa9           a drive as H.264, from above and from the cameras
    python -m factory export navsim out=runs/demo to=openscene       all samples in SimScale's layout, for its training

`sample` is an ordinal, an id or the beginning of one, `to` a folder (the current one) or, for one sample, a file.
`navsim` takes all samples, or those of expert=a,b round=0,1 split=train,val, and goes on where it was stopped:
    tag=<word>          behind the experts' names, so that splits of ours stand beside the released ones
    layout=released     as SimScale's archives unpack; moved (the default): as after its tools/move.sh
    resize=true         pictures of other sizes to 1920x1080, which the released agents take for granted
    missing=black|none  for pictures that a sample has not: a black one, or none; refuse is the default
    map_location=<one>  of NAVSIM's four, for logs whose map has another name
    vocabulary=<.npy>   the trajectories that the labels are of, to be written beside the rewards
    executor=ray        workers on Ray: the cluster of RAY_ADDRESS, whose nodes see `out` and `to` by the same paths, or
                        one of this machine's own; local (the default): processes
    workers=<n>         at once; else 1, on Ray every core
What is written: docs/navsim_format.md.
"""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from factory.config.arguments import POSITIONAL, Refused
from factory.config.datasets import find_function
from factory.exits import COMPLETE, INTERRUPTED
from factory.views.show import find, logged_drive, open_samples
from factory.views.status import open_store

if TYPE_CHECKING:
    from factory.store.samples import Store
    from tasks.world.arrays import Array

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Request:
    """The command line."""

    format: Literal["mcap", "mp4", "rerun", "navsim"] = field(metadata=POSITIONAL)
    format: Literal["mcap", "mp4", "navsim"] = field(metadata=WORD)
    out: str
    sample: str | None = None
    every: int | None = None
    to: str = "."
    expert: tuple[str, ...] = ()
    round: tuple[str, ...] = ()
    split: tuple[str, ...] = ()
    tag: str = ""
    layout: Literal["moved", "released"] = "moved"
    resize: bool = False
    missing: Literal["refuse", "black", "none"] = "refuse"
    map_location: str = ""
    vocabulary: str | None = None
    executor: Literal["local", "ray"] = "local"
    workers: int | None = None

    def __post_init__(self) -> None:
        if self.format == "navsim":
            self._check_all()
            return
        for name in [f.name for f in fields(self) if f.name not in EVERYWHERE]:
            if getattr(self, name) != getattr(type(self), name):
                raise ValueError(f"{name}=...: of export navsim alone; {self.format} takes sample= or every=, and to=")
        if (self.sample is None) == (self.every is None):
            raise ValueError("give either sample=<id> or every=<n>; see --help")
        if self.every == 0:
            raise ValueError("every=0: must be 1 or more")

    def _check_all(self) -> None:
        if self.sample is not None or self.every is not None:
            raise ValueError("sample= and every= are of single files; navsim takes expert=, round= and split=")
        if self.to == ".":
            raise ValueError("to=<folder> is missing: where logs, pictures, splits and rewards are written")
        if "://" in self.to:
            raise ValueError(f"to={self.to}: is written to a local folder; copy that")
        if self.workers == 0:
            raise ValueError("workers=0: must be 1 or more")
        if odd := [word for word in self.round if not (word.isascii() and word.isdecimal())]:
            raise ValueError(f"round={odd[0]}: must be a whole number, 0 or more")


EVERYWHERE = ("format", "out", "sample", "every", "to")


def main(request: Request) -> int:
    """Write the files and name them."""
    if request.format == "navsim":
        return _export_all(request)
    for path in export(request):
        print(path.resolve())
    return COMPLETE


def export(request: Request) -> Iterator[Path]:
    """Write the files; their paths as they are written. Raises Refused where there is nothing, or no file can be."""
    store, target = open_store(request.out), Path(request.to)
    table = open_samples(store)
    if request.sample is not None:
        chosen = [find(table, store, request.sample)]
    else:
        chosen = list(table.attempt_ids[:: request.every])
    suffix = f".{request.format}"
    is_file = target.suffix == suffix and not target.is_dir()
    if is_file and request.every is not None:
        raise Refused(f"to={request.to}: every=... writes a file for each sample; name a folder")
    try:
        for attempt_id in chosen:
            path = target if is_file else target / f"sample_{attempt_id}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            write(request.format, store, table[attempt_id], path)
            yield path
    except (OSError, ValueError) as error:  # no such folder, another schema version
        raise Refused(f"{store.location.uri}: {error}") from error


def _export_all(request: Request) -> int:
    """All samples in SimScale's layout; the exit code. Raises Refused."""
    from factory.config.compose import need_run_extra
    from factory.graph.parallel import WorkerDied, parallel_map
    from factory.graph.steps import TaskStopped
    from factory.store.location import Location
    from factory.store.reader import sample_table

    if request.executor == "ray":
        need_run_extra("ray")
    store = open_store(request.out)
    try:
        target = Location.parse(request.to, setting="to")
        dealt = partial(parallel_map, executor=request.executor, workers=request.workers, to=target)
        table = sample_table(store.location.uri, store.location.options)
        trajectories = _label_trajectories(store, request.vocabulary)
        done = find_function("EXPORTS", request.format)(request, table, Path(target.uri), trajectories, dealt)
    except (OSError, ValueError, WorkerDied) as error:  # no folder, a full disk, what cannot be written as asked
        raise Refused(str(error)) from error
    except (TaskStopped, KeyboardInterrupt) as error:
        at_once = "" if isinstance(error, TaskStopped) else " at once"
        print(f"interrupted{at_once}; run the same command again to go on", file=sys.stderr)
        return INTERRUPTED
    for note in done.notes:
        print(f"note: {note}")
    print(f"{done.written:,} logs written, {done.logs:,} in all, {done.n_bytes / 1e9:,.3f} GB: {target.uri}")
    return COMPLETE


def _label_trajectories(store: "Store", file: str | None) -> "Array | None":
    """(K, 40, 3) that the samples' labels are of; None where there are none, or of a file that was not named."""
    from factory.store.reader import SampleTable
    from factory.store.schema import LABEL_COLUMNS
    from factory.views.show import labelled_trajectories

    samples = SampleTable(store.location.uri, store.location.options)
    digests = samples.table(["label_vocabulary"])["label_vocabulary"].to_pylist()
    labelled = next((i for i, digest in enumerate(digests) if digest is not None), None)
    if labelled is None:
        return None
    return labelled_trajectories(samples.sample(labelled, ["attempt_id", *LABEL_COLUMNS]), file)


def write(format: str, store: "Store", row: Row, path: Path) -> None:
    """One sample as one file."""
    logged = logged_drive(store, dict(row))
    if format == "mcap":
        from factory.views.episode_messages import episode_of

        path.write_bytes(episode_of(row, logged))
    else:
        from factory.views.bev import write_mp4
        from factory.views.seen_again import digest_of, film, scene_of

        digest = digest_of(store, row)
        write_mp4(path, film(row, None if digest is None else scene_of(store, digest), logged))

"""`python -m factory export mcap|mp4|rerun out=<folder or URL> sample=<id>`: samples as files for other tools.

    python -m factory export mcap out=runs/demo sample=0             one sample for Foxglove, Lichtblick or Rerun
    python -m factory export mcap out=runs/demo every=10 to=looks    every tenth sample, a file each
    python -m factory export mp4 out=runs/demo sample=3fa9           a drive as H.264, from above and from the cameras
    python -m factory export rerun out=runs/demo sample=0            a .rrd, with Rerun's SDK (pip install rerun-sdk)

`sample` is an ordinal, an id or the beginning of one, `to` a folder (the current one) or, for one sample, a file.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from factory.config.arguments import WORD, Refused
from factory.views.show import find, logged_drive, sample_ids
from factory.views.status import open_store

if TYPE_CHECKING:
    from factory.store.samples import Store

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Request:
    """The command line."""

    format: Literal["mcap", "mp4", "rerun"] = field(metadata=WORD)
    out: str
    sample: str | None = None
    every: int | None = None
    to: str = "."

    def __post_init__(self) -> None:
        if (self.sample is None) == (self.every is None):
            raise ValueError("give either sample=<id> or every=<n>; see --help")
        if self.every == 0:
            raise ValueError("every=0: must be 1 or more")


def main(request: Request) -> None:
    """Write the files and name them."""
    for path in export(request):
        print(path.resolve())


def export(request: Request) -> Iterator[Path]:
    """Write the files; their paths as they are written. Raises Refused where there is nothing, or no file can be."""
    from factory.store.reader import SampleTable

    store, target = open_store(request.out), Path(request.to).expanduser()
    if request.sample is not None:
        chosen = [find(store, request.sample)]
    else:
        chosen = sample_ids(store)[:: request.every]
    suffix = ".rrd" if request.format == "rerun" else f".{request.format}"
    is_file = target.suffix == suffix and not target.is_dir()
    if is_file and request.every is not None:
        raise Refused(f"to={request.to}: every=... writes a file for each sample; name a folder")
    try:
        table = SampleTable(store.location.uri, store.location.options)
        for attempt_id in chosen:
            path = target if is_file else target / f"sample_{attempt_id}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            write(request.format, store, table[attempt_id], path)
            yield path
    except (OSError, ValueError, ImportError) as error:  # no such folder, another schema version, no SDK
        raise Refused(f"{store.location.uri}: {error}") from error


def write(format: str, store: "Store", row: Row, path: Path) -> None:
    """One sample as one file."""
    logged = logged_drive(store, dict(row))
    if format == "mcap":
        from factory.views.episode_messages import episode_of

        path.write_bytes(episode_of(row, logged))
    elif format == "rerun":
        from factory.views.rerun_log import write_recording

        write_recording(path, row, logged)
    else:
        from factory.views.bev import write_mp4
        from factory.views.seen_again import digest_of, film, scene_of

        digest = digest_of(store, row)
        write_mp4(path, film(row, None if digest is None else scene_of(store, digest), logged))

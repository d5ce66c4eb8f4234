"""`python -m factory export mcap|mp4|rerun out=<folder or URL> sample=<id>`: samples as files for other tools.

    python -m factory export mcap out=runs/demo sample=0             one sample for Foxglove, Lichtblick or Rerun
    python -m factory export mcap out=runs/demo every=10 to=looks    every tenth sample, a file each
    python -m factory export mp4 out=runs/demo sample=3fa9           a drive as H.264, from above and from the cameras
    python -m factory export rerun out=runs/demo sample=0            a .rrd, with Rerun's SDK (pip install rerun-sdk)

`sample` is an ordinal, an id or the beginning of one, `to` a folder (the current one) or, for one sample, a file.
Exit codes: 0 written, 2 bad arguments, or nothing there to export.
"""

import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factory.config.arguments import BAD_ARGUMENTS, Refused, parse
from factory.views.show import find, logged_drive, sample_ids
from factory.views.status import open_store

if TYPE_CHECKING:
    from factory.store.samples import Store

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Request:
    """The command line behind the format."""

    out: str
    sample: str | None = None
    every: int | None = None
    to: str = "."

    def __post_init__(self) -> None:
        if (self.sample is None) == (self.every is None):
            raise ValueError("give either sample=<id> or every=<n>; see --help")
        if self.every == 0:
            raise ValueError("every=0: must be 1 or more")


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    if {"-h", "--help"} & set(argv) or not argv:
        print(__doc__)
        return 0 if argv else BAD_ARGUMENTS
    try:
        if argv[0] not in FORMATS:
            raise Refused(f"{argv[0]!r}: the first word is one of {', '.join(FORMATS)}; see --help")
        for path in export(argv[0], parse(Request, argv[1:])):
            print(path.resolve())
    except Refused as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_ARGUMENTS
    return 0


def export(kind: str, request: Request) -> Iterator[Path]:
    """Write the files; their paths as they are written. Raises Refused where there is nothing, or no file can be."""
    from factory.store.reader import SampleTable

    store, target = open_store(request.out), Path(request.to).expanduser()
    if request.sample is not None:
        chosen = [find(store, request.sample)]
    else:
        chosen = sample_ids(store)[:: request.every]
    suffix = SUFFIXES.get(kind, f".{kind}")
    is_file = target.suffix == suffix and not target.is_dir()
    if is_file and request.every is not None:
        raise Refused(f"to={request.to}: every=... writes a file for each sample; name a folder")
    try:
        table = SampleTable(store.location.uri, store.location.options)
        for attempt_id in chosen:
            path = target if is_file else target / f"sample_{attempt_id}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            FORMATS[kind](store, table[attempt_id], path)
            yield path
    except (OSError, ValueError, ImportError) as error:  # no such folder, another schema version, no SDK
        raise Refused(f"{store.location.uri}: {error}") from error


def write_mcap(store: "Store", row: Row, path: Path) -> None:
    """The sample as an MCAP episode."""
    from factory.views.episode_messages import episode_of

    path.write_bytes(episode_of(row, logged_drive(store, dict(row))))


def write_film(store: "Store", row: Row, path: Path) -> None:
    """The sample's drive at 10 Hz."""
    from factory.views.seen_again import digest_of, film, scene_of
    from factory.views.video import write_mp4

    digest = digest_of(store, row)
    scene = None if digest is None else scene_of(store, digest)
    write_mp4(path, film(row, scene, logged_drive(store, dict(row))))


def write_rerun(store: "Store", row: Row, path: Path) -> None:
    """The sample as a Rerun recording."""
    from factory.views.rerun_log import write_recording

    write_recording(path, row, logged_drive(store, dict(row)))


SUFFIXES = {"rerun": ".rrd"}  # where they are not the format's name
FORMATS: Mapping[str, Callable[["Store", Row, Path], None]] = {
    "mcap": write_mcap,
    "mp4": write_film,
    "rerun": write_rerun,
}


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `... | head` ends quietly
    sys.exit(main(sys.argv[1:]))

"""Whether `out` can be written to, before anything else is done: a folder by a trial file and a link to it, a URL by a
trial object.

A client of an object store tries for minutes where credentials or the network are missing, so the trial of a URL is a
process of its own that is ended after TRIAL_S: `python -m factory.store.usable URL`.
"""

import errno
import os
import secrets
import subprocess
import sys
from pathlib import Path

from factory.store.disk import NotWritable, existing, needs_disk
from factory.wording import one_line

TRIAL_BYTES = 4 * 2**20  # a row group, the least that samples with pictures are written in
TRIAL_S = 20.0
CREDENTIALS = {  # what both clients read
    "s3": "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE, and AWS_REGION",
    "gs": "GOOGLE_APPLICATION_CREDENTIALS",
    "abfs": "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
    "abfss": "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
}


def why_unusable(out: str) -> str:
    """One line on why no run can write to `out`; nothing where it can. Leaves nothing behind."""
    if not out.strip():
        return "out= is empty: name a folder or a URL (a shell variable that is not set?)"
    scheme, is_url, _ = out.partition("://")
    if is_url and scheme != "file":
        return _why_not_remote(out, scheme) if scheme in CREDENTIALS else ""  # others are refused by Location
    path = Path(out.removeprefix("file://")).expanduser().absolute()
    above = existing(path)
    if not above.is_dir():
        return f"out={out}: {above} is not a folder"
    return _why_not_local(out, path, above)


def _why_not_local(out: str, path: Path, above: Path) -> str:
    created = [place for place in (path, *path.parents) if place != above and above in place.parents]
    trial = path / f".trial-{secrets.token_hex(8)}"
    try:
        path.mkdir(parents=True, exist_ok=True)
        with needs_disk(path, TRIAL_BYTES):
            try:
                with trial.open("wb") as file:
                    file.write(bytes(TRIAL_BYTES))
                    file.flush()
                    os.fsync(file.fileno())
            finally:  # before the free space is told
                trial.unlink(missing_ok=True)
        if no_links := why_no_links(path):
            return f"out={out}: {no_links}"
    except OSError as error:
        if isinstance(error, NotWritable):
            return f"out={out}: {str(error).removeprefix(f'{path}: ')}"
        if error.errno is None:  # DiskFull, which says it all
            return f"out={out}: {error}"
        why = "no file can be made there" if error.errno == errno.ENOENT else error.strerror or str(error)
        return f"out={out}: cannot be written: {why}"
    finally:
        for place in created:
            if place.is_dir():
                place.rmdir()
    return ""


def why_no_links(folder: Path) -> str:
    """One line on why no table can be committed to in a folder that is there; nothing where it can. Leaves nothing.

    A commit is a link that must not be there yet: so of two runs that want the same one alone makes it. Renaming, which
    replaces what is there, would lose commits. Raises OSError where no file can be made at all.
    """
    trial = folder / f".trial-{secrets.token_hex(8)}"
    link = trial.with_name(f"{trial.name}0")
    try:
        with needs_disk(folder, 0):
            trial.touch()
        os.link(trial, link)
    except OSError as error:
        if not trial.exists():
            raise
        why = error.strerror or str(error)
        return (
            f"{folder} is on a file system without hard links ({why}), by which commits keep two runs apart: "
            "choose a folder on another one, or the URL of a bucket (s3://, gs://, abfs://)"
        )
    finally:
        link.unlink(missing_ok=True)
        trial.unlink(missing_ok=True)
    return ""


def _why_not_remote(out: str, scheme: str) -> str:
    hint = f"; credentials are read from {CREDENTIALS[scheme]}"
    command = [sys.executable, "-m", "factory.store.usable", out]
    try:
        done = subprocess.run(  # noqa: S603  # our own interpreter; the URL is an argument, not a shell's word
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=TRIAL_S
        )
    except subprocess.TimeoutExpired:
        return f"out={out}: no answer in {TRIAL_S:.0f} s{hint}"
    if done.returncode == 0:
        return ""
    said = done.stdout.strip() or (done.stderr.strip().splitlines() or ["the trial ended without a word"])[-1]
    return f"out={out}: cannot be written: {said}{hint}"


def main(arguments: list[str]) -> int:
    """The trial of a URL: both clients, a small object written and removed; 0, or 1 and why not on standard output."""
    from deltalake import DeltaTable
    from deltalake.exceptions import DeltaError
    from pyarrow import ArrowException

    from factory.store.late_listing import listed
    from factory.store.location import BadLocation, Location

    try:
        location = Location.parse(arguments[0])
        name = f".trial-{secrets.token_hex(8)}"
        listed(lambda: DeltaTable.is_deltatable(location.child("samples").uri))
        location.write(name, b"")
        location.remove(name)
    except (OSError, ValueError, ArrowException, DeltaError, BadLocation) as error:
        print(one_line(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

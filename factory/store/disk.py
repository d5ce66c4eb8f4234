"""A disk that is full: told with the path and the bytes, wherever a run writes."""

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT)
SAID = tuple(f"(os error {number})" for number in FULL)  # how delta-rs says it, in an OSError without a number


class DiskFull(OSError):
    """The disk or the quota of a path is full; the message has the path, what is needed and what is free."""


@contextmanager
def needs_disk(path: str | os.PathLike[str], n_bytes: int) -> Iterator[None]:
    """For the writing of about `n_bytes` at a local path. Raises DiskFull where they find none."""
    try:
        yield
    except OSError as error:
        if isinstance(error, DiskFull) or (error.errno not in FULL and not any(said in str(error) for said in SAID)):
            raise
        free = shutil.disk_usage(existing(Path(path))).free
        raise DiskFull(f"{path}: the disk is full: {n_bytes:,} bytes are needed, {free:,} are free") from error


@contextmanager
def whole_file(path: Path, n_bytes: int) -> Iterator[Path]:
    """A draft to be filled with about `n_bytes`: then it is `path`, or there is none. Raises DiskFull."""
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    with needs_disk(path, n_bytes):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield draft
            draft.replace(path)
        except BaseException:
            draft.unlink(missing_ok=True)
            raise


def why_disk_full(error: BaseException) -> str:
    """What a full disk said, where that is behind the error; else nothing."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, DiskFull):
            return str(seen)
        if isinstance(seen, OSError) and seen.errno in FULL:
            return f"{seen.filename or 'a temporary file'}: the disk is full"
        seen = seen.__cause__ or seen.__context__
    return ""


def existing(path: Path) -> Path:
    """The path itself, or the nearest folder above it that is there."""
    return next(place for place in (path, *path.parents) if place.exists())

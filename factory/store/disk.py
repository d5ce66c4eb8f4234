"""A disk that is full, or not to be written: told with the path, wherever a run writes."""

import errno
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from factory.wording import one_line

FULL = (errno.ENOSPC, errno.EDQUOT)
REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS)
SAID = re.compile(r"\(os error (\d+)\)")  # how delta-rs says it, in an OSError without a number


class DiskFull(OSError):
    """The disk or the quota of a path is full; the message has the path, what is needed and what is free."""


class NotWritable(PermissionError):
    """Who runs this may not write at a path, or nobody may; the message has the path and the reason."""


def _number_of(error: BaseException) -> int | None:
    """The number of what the system said."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    said = SAID.search(str(error))
    return None if said is None else int(said[1])


@contextmanager
def needs_disk(path: str | os.PathLike[str], n_bytes: int) -> Iterator[None]:
    """For the writing of about `n_bytes` at a local path. Raises DiskFull where they find none, and NotWritable."""
    try:
        yield
    except OSError as error:
        number = _number_of(error)
        if isinstance(error, DiskFull | NotWritable) or number not in (*FULL, *REFUSED):
            raise
        if number in REFUSED:
            raise NotWritable(f"{path}: cannot be written: {os.strerror(number)}") from error
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


def why_not_written(error: BaseException) -> str:
    """What a disk said that is full or not to be written, and what helps, where that is behind the error."""
    seen: BaseException | None = error
    while seen is not None:
        number = _number_of(seen)
        if isinstance(seen, NotWritable) or number in REFUSED:
            return f"{one_line(seen)}; run it as a user who may write there, or on a copy"
        seen = seen.__cause__ or seen.__context__
    full = why_disk_full(error)
    return full and f"{full}; free disk space"


def existing(path: Path) -> Path:
    """The path itself, or the nearest folder above it that is there."""
    return next(place for place in (path, *path.parents) if place.exists())

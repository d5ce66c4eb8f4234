"""Illness of the machine, told apart from what is wrong with a clip: it never counts against one."""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from deltalake.exceptions import DeltaError

from factory.store.disk import DiskFull, NotWritable

NUMBERS = frozenset(
    getattr(errno, name)
    for name in (
        *("ENOSPC", "EDQUOT", "EIO", "EROFS", "EREMOTEIO", "ENXIO", "ENODEV"),  # a disk
        *("ENOMEM", "EMFILE", "ENFILE", "EAGAIN"),  # memory, open files, processes
        *("ESTALE", "ENOTCONN", "ENETDOWN", "ENETUNREACH", "EHOSTDOWN", "EHOSTUNREACH"),  # a share, a network
        *("ETIMEDOUT", "ECONNREFUSED", "ECONNRESET", "ECONNABORTED"),
    )
    if hasattr(errno, name)
)
# What object stores' clients say in an OSError without a number; a file that is not there is no illness.
STORE = re.compile(
    r"AWS Error (?!NO_SUCH|RESOURCE_NOT_FOUND)|Generic (?:S3|GCS|MicrosoftAzure) error|lacked the necessary privileges"
)
OS_ERROR = re.compile(r"\(os error (\d+)\)")
SHORT_OF_MEMORY = 0.1  # of it is left: then a MemoryError is the machine's, else of what was asked for


class PlaceRefused(OSError):
    """A place that the run itself writes to cannot be written."""


@contextmanager
def own_place(where: str | os.PathLike[str]) -> Iterator[None]:
    """Around what is written there by the run: whatever goes wrong with it is no clip's. Raises PlaceRefused."""
    try:
        yield
    except OSError as error:
        if why_ill(error):
            raise
        raise PlaceRefused(f"{os.fspath(where)} cannot be written: {error.strerror or error}") from error


def why_ill(error: BaseException) -> str:
    """What the machine said, where its illness is behind the error; else nothing."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, MemoryError) and _memory_left() < SHORT_OF_MEMORY:
            return f"out of memory: {seen}"
        if isinstance(seen, PlaceRefused | DiskFull | NotWritable | ConnectionError | TimeoutError) or _is_ill(seen):
            return str(seen)
        seen = seen.__cause__ or seen.__context__
    return ""


def _is_ill(error: BaseException) -> bool:
    if isinstance(error, DeltaError):
        return STORE.search(str(error)) is not None
    if not isinstance(error, OSError):
        return False
    if error.errno is not None:
        return error.errno in NUMBERS
    said = OS_ERROR.search(str(error))
    return STORE.search(str(error)) is not None or (said is not None and int(said[1]) in NUMBERS)


def _memory_left() -> float:
    """Share of this machine's memory that is free or can be freed; 1 where it does not say."""
    try:
        rows = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        left, all_of_it = (int(rows[name].split()[0]) for name in ("MemAvailable", "MemTotal"))
    except (OSError, KeyError):  # not Linux
        return 1.0
    return left / all_of_it

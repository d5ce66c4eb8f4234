"""This machine's files: what lies in a folder, who works on a file alone, where results lie, what a disk refuses.

Of folders of somebody's data this is the one place that looks, so that all that read see the same. Links are followed.
What systems and programs leave beside the files they copy is no data: it is passed over.
"""

import errno
import fcntl
import hashlib
import logging
import os
import re
import secrets
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from fnmatch import fnmatchcase
from functools import cache, lru_cache
from pathlib import Path
from typing import IO, Any

from factory.wording import one_line
from tasks.caches import private_folder

log = logging.getLogger(__name__)

LEFT_BY_MACOS = (".ds_store", ".appledouble", "__macosx")  # and AppleDouble's ._<name>
LEFT_BY_WINDOWS = ("desktop.ini", "thumbs.db", "$recycle.bin", "system volume information")
LEFT_BY_DISKS = ("@eadir", "#recycle", "#snapshot", "@recycle", "@recently-snapshot", "lost+found")  # of file servers
LEFT_BESIDE = frozenset((*LEFT_BY_MACOS, *LEFT_BY_WINDOWS, *LEFT_BY_DISKS))


def is_data(name: str) -> bool:
    """Whether a file or folder of this name in somebody's data is data.

    What is hidden is none: locks, drafts of rsync and NFS (`.<name>.<letters>`, `.nfs<digits>`), a server's snapshots
    and an editor's copies, which would be read as the same logs again. Unfinished downloads and backups (.part,
    .crdownload, ~) have other suffixes than what is looked for.
    """
    return not (name.startswith((".", "~$")) or name.lower() in LEFT_BESIDE)


def matching(folder: Path, pattern: str) -> list[Path]:
    """What matches a glob pattern without `**`, such as *.pkl or v1.0-*/scene.json, sorted; none in what is no folder.

    A suffix may be in upper case. A link that leads nowhere is among them: it is a file that cannot be read. A folder
    that cannot be entered is named in the log.
    """
    found = [folder]
    for part in pattern.split("/"):
        found = [place / entry.name for place in found for entry in _data_in(place) if _matches(entry.name, part)]
    return sorted(found)


def _matches(name: str, pattern: str) -> bool:
    stem, suffix = os.path.splitext(name)
    return fnmatchcase(stem + suffix.lower(), pattern)


def _data_in(folder: Path) -> list[os.DirEntry[str]]:
    try:
        return [entry for entry in os.scandir(folder) if is_data(entry.name)]
    except (FileNotFoundError, NotADirectoryError):
        if broken := broken_link(folder):
            _warn_skipped_once(folder, broken)
    except OSError as error:
        _warn_skipped_once(folder, error.strerror or str(error))
    return []


def broken_link(path: str | os.PathLike[str]) -> str:
    """Of a path that is not there: which link that it leads through leads nowhere; empty where none does."""
    path = Path(path)
    if not path.is_symlink() and path.parent.exists():  # the usual case, and looks above may be dear
        return ""
    link = next((place for place in (path, *path.parents) if place.is_symlink()), None)
    if link is None or os.path.exists(link):
        return ""
    named = "the link" if link == path else f"the link {link}"
    return f"{named} leads to {os.readlink(link)}, which is not there"


def is_named(path: str | os.PathLike[str]) -> bool:
    """Whether a file that need not be there is there, or a link says that it should be: reading it tells which."""
    return os.path.lexists(path) or broken_link(path) != ""


def why_unread(path: str | os.PathLike[str], error: OSError) -> str:
    """What the system said of a file that cannot be read, and which link to it is broken."""
    return broken_link(path) or error.strerror or str(error)


def matching_below(folder: Path, pattern: str) -> list[Path]:
    """What has a name such as sd_*.pkl in all depths, sorted.

    Every real folder is entered once, however many links lead to it, so that a loop of them ends: by its own path where
    it lies in the folder, else by the first link in the order of names. What cannot be entered is named in the log.
    """
    entered: set[tuple[int, int]] = set()
    found: list[Path] = []
    folders, links = [folder], list[Path]()
    while folders or links:
        here = folders.pop() if folders else links.pop(0)
        try:
            of = here.stat()
            if (of.st_dev, of.st_ino) in entered:
                continue
            entered.add((of.st_dev, of.st_ino))
        except OSError as error:
            _warn_skipped_once(here, error.strerror or str(error))
            continue
        for entry in _data_in(here):
            if matches := _matches(entry.name, pattern):
                found.append(here / entry.name)
            if entry.is_dir(follow_symlinks=False):
                folders.append(here / entry.name)
            elif _leads_to_folder(entry, warn=not matches):
                links.append(here / entry.name)
        links.sort()
    return sorted(found)


def folders_in(folder: Path) -> list[Path]:
    """The folders in a folder, sorted; none in what is none. A link that leads nowhere is named in the log."""
    return sorted(
        folder / entry.name
        for entry in _data_in(folder)
        if entry.is_dir(follow_symlinks=False) or _leads_to_folder(entry)
    )


def named_once(root: Path, found: Iterable[tuple[str, Path]]) -> dict[str, Path]:
    """Log id -> its file or folder, sorted by id. Raises ValueError where two have one id."""
    paths: dict[str, Path] = {}
    for name, path in found:
        if name in paths:
            raise ValueError(f"{root}: {name} stands twice, {paths[name]} and {path}: keep one of them")
        paths[name] = path
    return dict(sorted(paths.items()))


def _leads_to_folder(entry: os.DirEntry[str], warn: bool = True) -> bool:
    """Whether it is a link to a folder; warn: one that leads nowhere, or where nobody may look, is named in the log."""
    if not entry.is_symlink() or os.path.isdir(entry):
        return entry.is_symlink()
    if warn and (broken := broken_link(entry)):
        _warn_skipped_once(entry.path, broken)
    return False


@cache
def _warn_skipped_once(path: str | Path, why: str) -> None:
    """Once a process: a folder is looked at several times."""
    log.warning("%s is passed over: %s", path, why)


# Who works on a file alone, among the threads and processes of one machine.

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)  # what flock says where there are none


@contextmanager
def locked(file: IO[Any]) -> Iterator[None]:
    """Alone with an open file until it is left and closed; the kernel frees it when its holder dies.

    On a file system without locks, as mounts of object stores and some network shares are, a file of this machine's
    temporary folder stands for it. Raises OSError where that cannot be locked either.
    """
    with ExitStack() as held:
        try:
            fcntl.flock(file, fcntl.LOCK_EX)
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            stand_in = f"{hashlib.sha256(os.path.realpath(file.name).encode()).hexdigest()[:32]}.lock"
            fcntl.flock(held.enter_context((private_folder("locks") / stand_in).open("ab")), fcntl.LOCK_EX)
        yield


# What differs inside a submitted Ray job: the working directory is a copy that Ray throws away.

RUNS = "FACTORY_RUNS"  # environment variable: the folder or URL below which results lie that no `out` names


def in_submitted_job() -> bool:
    """This process is the driver of a `ray job submit`."""
    return "RAY_JOB_CONFIG_JSON_ENV_VAR" in os.environ  # Ray sets it for drivers of jobs alone


def default_runs_folder() -> str:
    """FACTORY_RUNS, else `runs` in the working directory, in a submitted job ~/driving-data-factory/runs."""
    if named := os.environ.get(RUNS):
        return named
    return str(Path.home() / "driving-data-factory" / "runs") if in_submitted_job() else "runs"


# What a disk, a store or a machine refuses, told with the path: full, not to be written, ill.
#
# Loads neither pyarrow nor deltalake, so that a command can ask for its `out` before anything else.

FULL = (errno.ENOSPC, errno.EDQUOT)
REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS)
AS_ANOTHER = "run it as a user who may, or on a copy"
DELTA_ERRNO = re.compile(r"\(os error (\d+)\)")  # how delta-rs says it, in an OSError without a number


class DamagedFile(OSError):
    """A file that a run wrote is missing or cannot be read; the message names it."""


class DiskFull(OSError):
    """The disk or the quota of a path is full; the message has the path, what is needed and what is free."""


class NotWritable(PermissionError):
    """Who runs this may not write at a path, or nobody may; the message has the path and the reason."""


def _number_of(error: BaseException) -> int | None:
    """The number of what the system said."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    said = DELTA_ERRNO.search(str(error))
    return None if said is None else int(said[1])


@contextmanager
def naming_disk_errors(path: str | os.PathLike[str], n_bytes: int) -> Iterator[None]:
    """For the writing of about `n_bytes` at a local path. Raises DiskFull where they find none, and NotWritable."""
    try:
        yield
    except Exception as error:  # also a library's own, such as of safetensors
        numbers = {_number_of(seen) for seen in _errors_behind(error)} & {*FULL, *REFUSED}
        if isinstance(error, DiskFull | NotWritable) or not numbers:
            raise
        number = numbers.pop()
        if number in REFUSED:
            raise NotWritable(f"{path}: cannot be written: {os.strerror(number)}") from error
        free = shutil.disk_usage(nearest_existing(Path(path))).free
        raise DiskFull(f"{path}: the disk is full: {n_bytes:,} bytes are needed, {free:,} are free") from error


@contextmanager
def atomic_file(path: Path, n_bytes: int) -> Iterator[Path]:
    """A draft to be filled with about `n_bytes`: then it is `path`, or there is none. Raises DiskFull."""
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    with naming_disk_errors(path, n_bytes):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield draft
            draft.replace(path)
        except BaseException:
            draft.unlink(missing_ok=True)
            raise


def _errors_behind(error: BaseException | None) -> Iterator[BaseException]:
    """The error and what it was raised of. An error that was kept and is raised again may stand behind itself."""
    seen = set[int]()
    while error is not None and id(error) not in seen:
        yield error
        seen.add(id(error))
        error = error.__cause__ or error.__context__


def why_disk_full(error: BaseException) -> str:
    """What a full disk said, where that is behind the error; else nothing."""
    for seen in _errors_behind(error):
        if isinstance(seen, DiskFull):
            return str(seen)
        if isinstance(seen, OSError) and seen.errno in FULL:
            return f"{seen.filename or 'a temporary file'}: the disk is full"
    return ""


def why_not_written(error: BaseException) -> tuple[str, str]:
    """What a disk said that is full or not to be written, and what helps, where that is behind the error."""
    for seen in _errors_behind(error):
        if isinstance(seen, NotWritable) or _number_of(seen) in REFUSED:
            return one_line(seen), AS_ANOTHER
    full = why_disk_full(error)
    return full, full and "free disk space"


def why_no_memory(error: BaseException) -> str:
    """What was said where memory was refused, also to a library or a thread, where that is behind the error."""
    for seen in _errors_behind(error):
        if isinstance(seen, MemoryError) or _number_of(seen) == errno.ENOMEM or NO_ROOM.search(str(seen)):
            return f"out of memory or threads: {one_line(seen)}"
    return ""


def nearest_existing(path: Path) -> Path:
    """The path itself, or the nearest folder above it that is there."""
    return next(place for place in (path, *path.parents) if place.exists())


# Illness of the machine, told apart from what is wrong with a clip: it never counts against one.

MACHINE_ERRNOS = frozenset(
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
STORE_FAULT = re.compile(
    r"AWS Error (?!NO_SUCH|RESOURCE_NOT_FOUND)|Generic (?:S3|GCS|MicrosoftAzure) error|lacked the necessary privileges"
)
NO_ROOM = re.compile(  # ld.so's words, Python's, PyTorch's
    r"failed to map segment from shared object(: Cannot allocate memory)?$|^can't start new thread$"
    r"|can't allocate memory",
    re.M,
)
SHORT_OF_MEMORY = 0.1  # of it is left: then a MemoryError is the machine's, else of what was asked for


class PlaceRefused(OSError):
    """A place that the run itself writes to cannot be written."""


@contextmanager
def raising_place_refused(where: str | os.PathLike[str]) -> Iterator[None]:
    """Around what is written there by the run: whatever goes wrong with it is no clip's. Raises PlaceRefused."""
    try:
        yield
    except OSError as error:
        if machine_fault_of(error):
            raise
        raise PlaceRefused(f"{os.fspath(where)} cannot be written: {error.strerror or error}") from error


def machine_fault_of(error: BaseException) -> str:
    """What the machine said, where its illness is behind the error; else nothing."""
    for seen in _errors_behind(error):
        if isinstance(seen, MemoryError) and _free_memory_share() < SHORT_OF_MEMORY:
            return f"out of memory: {seen}"
        if isinstance(seen, PlaceRefused | DiskFull | NotWritable | ConnectionError | TimeoutError) or _is_of_machine(
            seen
        ):
            return str(seen)
    return ""


def _is_of_machine(error: BaseException) -> bool:
    delta = sys.modules.get("deltalake.exceptions")  # who has not loaded it has none of its errors
    if delta is not None and isinstance(error, delta.DeltaError):
        return STORE_FAULT.search(str(error)) is not None
    if not isinstance(error, OSError):
        return False
    return _number_of(error) in MACHINE_ERRNOS or (error.errno is None and STORE_FAULT.search(str(error)) is not None)


def _free_memory_share() -> float:
    """Share of this machine's memory that is free or can be freed; 1 where it does not say."""
    try:
        rows = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        left, all_of_it = (int(rows[name].split()[0]) for name in ("MemAvailable", "MemTotal"))
    except (OSError, KeyError):  # not Linux
        return 1.0
    return left / all_of_it


# Whether `out` can be written to, before anything else is done: a folder by a trial file and a link to it, a URL by a
# trial object.
#
# A client of an object store tries for minutes where credentials or the network are missing, so the trial of a URL is a
# process of its own that is ended after TRIAL_S: `python -m factory.store.table URL`.

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
    path = Path(os.path.realpath(Path(out.removeprefix("file://")).expanduser()))  # new/.. is none to be made
    above = nearest_existing(path)
    if not above.is_dir():
        return f"out={out}: {above} is not a folder"
    return _why_not_local(out, path, above)


def _why_not_local(out: str, path: Path, above: Path) -> str:
    created = [place for place in (path, *path.parents) if place != above and above in place.parents]
    trial = path / f".trial-{secrets.token_hex(8)}"
    try:
        path.mkdir(parents=True, exist_ok=True)
        with naming_disk_errors(path, TRIAL_BYTES):
            try:
                with trial.open("wb") as file:
                    file.write(bytes(TRIAL_BYTES))
                    file.flush()
                    os.fsync(file.fileno())
            finally:  # before the free space is told
                trial.unlink(missing_ok=True)
        if no_links := why_no_hard_links(path):
            return f"out={out}: {no_links}"
    except OSError as error:
        if isinstance(error, NotWritable):
            return f"out={out}: {str(error).removeprefix(f'{path}: ')}; {AS_ANOTHER}, or with another out="
        if error.errno is None:  # DiskFull, which says it all
            return f"out={out}: {error}"
        why = "no file can be made there" if error.errno == errno.ENOENT else error.strerror or str(error)
        return f"out={out}: cannot be written: {why}; {AS_ANOTHER}, or with another out="
    finally:
        for place in created:
            if place.is_dir():
                place.rmdir()
    return ""


def why_no_hard_links(folder: Path) -> str:
    """One line on why no table can be committed to in a folder that is there; nothing where it can. Leaves nothing.

    A commit is a link that must not be there yet: so of two runs that want the same one alone makes it. Renaming, which
    replaces what is there, would lose commits. Raises OSError where no file can be made at all.
    """
    trial = folder / f".trial-{secrets.token_hex(8)}"
    link = trial.with_name(f"{trial.name}0")
    try:
        with naming_disk_errors(folder, 0):
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
    command = [sys.executable, "-m", "factory.store.table", out]
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


def file_digest(path: Path) -> str:
    """sha256 of a file, read once in a process and again where its size or time of change is another."""
    stat = path.stat()
    return _digest_of(path.resolve(), stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=64)
def _digest_of(path: Path, _size: int, _changed_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

"""Where a store lives: a folder or an object-store URL, with the few file operations the store needs."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from pyarrow import fs

from factory.files import is_data
from factory.job import in_submitted_job
from factory.store.disk import whole_file

REMOTE = ("s3", "gs", "abfs", "abfss", "file")  # what both Arrow and Delta write to


class BadLocation(ValueError):
    """The output path cannot be used as it stands."""


@dataclass(frozen=True)
class Location:
    """A folder: an absolute local path or a URL such as s3://bucket/prefix.

    `options` are deltalake's `storage_options` (AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID, ...); empty on local disk.
    """

    uri: str
    options: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def parse(
        out: str | os.PathLike[str], options: Mapping[str, str] | None = None, setting: str = "out"
    ) -> "Location":
        """Raises BadLocation for an unknown kind of URL, and for a relative path in a submitted Ray job's own copy.

        setting: what errors call it.
        """
        text = os.fspath(out)
        if "://" in text:
            if text.partition("://")[0] not in REMOTE:
                raise BadLocation(f"{setting}={text}: name a folder, or a URL of {', '.join(REMOTE)}://")
            return Location(text.rstrip("/"), dict(options or {}))
        path = Path(text).expanduser()
        if not path.is_absolute() and in_submitted_job():
            raise BadLocation(
                f"{setting}={text} is relative, and a submitted job runs in a copy: name an absolute path or a URL"
            )
        return Location(str(path.resolve()), dict(options or {}))

    @property
    def is_local(self) -> bool:
        return "://" not in self.uri

    @property
    def folder(self) -> Path | None:
        """On this machine's file systems; None where it is on an object store."""
        filesystem, base = self.filesystem()
        return Path(base) if isinstance(filesystem, fs.LocalFileSystem) else None

    def child(self, name: str) -> "Location":
        return Location(f"{self.uri}/{name}", self.options)

    def read(self, name: str) -> bytes | None:
        """The file's bytes; None where there is no such file."""
        filesystem, base = self.filesystem()
        try:
            with filesystem.open_input_stream(f"{base}/{name}", compression=None) as stream:
                return bytes(stream.read())
        except (FileNotFoundError, NotADirectoryError):  # the latter: below a file
            return None

    def has(self, name: str) -> bool:
        """There is such a file."""
        filesystem, base = self.filesystem()
        return bool(filesystem.get_file_info(f"{base}/{name}").type == fs.FileType.File)

    def write(self, name: str, data: bytes) -> None:
        """Whole file or no file: rename on local disk (flushed first), on an object store an upload that is completed.

        Raises DiskFull where the disk is full.
        """
        if not self.is_local:
            filesystem, base = self.filesystem()
            with filesystem.open_output_stream(f"{base}/{name}", compression=None) as stream:
                stream.write(data)
            return
        with whole_file(Path(self.uri, name), len(data)) as draft, draft.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())

    def remove(self, name: str) -> None:
        filesystem, base = self.filesystem()
        filesystem.delete_file(f"{base}/{name}")

    def names(self) -> list[str]:
        """Paths of all files below, relative to this folder, sorted."""
        return sorted(self._files())

    def ages_s(self, now_s: float) -> dict[str, float]:
        """Seconds since each file below, by its path relative to this folder, was last written."""
        return {name: now_s - (info.mtime_ns or 0) / 1e9 for name, info in self._files().items()}

    def _files(self) -> dict[str, fs.FileInfo]:
        """All files below."""
        filesystem, base = self.filesystem()
        if self.folder is not None:
            found = filesystem.get_file_info([os.fspath(path) for path in _local_files(self.folder)])
        else:
            found = filesystem.get_file_info(fs.FileSelector(base, recursive=True, allow_not_found=True))
        return {info.path[len(base) + 1 :]: info for info in found if info.type == fs.FileType.File}

    def filesystem(self) -> tuple[fs.FileSystem, str]:
        if self.is_local:
            return fs.LocalFileSystem(), self.uri
        return _remote(os.getpid(), self.uri, tuple(sorted(self.options.items())))


def _local_files(folder: Path) -> Iterator[Path]:
    """What is in a folder and is none. No link to a folder is followed, as what is listed may be removed.

    Other processes make and remove folders there: one that is gone before it is opened has no files.
    """
    try:
        entries = [entry for entry in os.scandir(folder) if is_data(entry.name)]
    except FileNotFoundError:
        return
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            yield from _local_files(folder / entry.name)
        else:
            yield folder / entry.name


@lru_cache(maxsize=64)
def _remote(process: int, uri: str, options: tuple[tuple[str, str], ...]) -> tuple[fs.FileSystem, str]:
    """A client that keeps its connections, which a forked `process` must not share, and the folder's path there."""
    if uri.startswith("s3://") and options:
        given = dict(options)
        scheme, _, host = given.get("AWS_ENDPOINT_URL", "").rpartition("://")
        client = fs.S3FileSystem(
            access_key=given.get("AWS_ACCESS_KEY_ID"),
            secret_key=given.get("AWS_SECRET_ACCESS_KEY"),
            session_token=given.get("AWS_SESSION_TOKEN"),
            region=given.get("AWS_REGION"),
            scheme=scheme or "https",
            endpoint_override=host or None,
        )
        return client, uri.removeprefix("s3://")
    client, base = fs.FileSystem.from_uri(uri)
    return client, base

"""What an export has written: a journal while it goes on, a manifest of the same lines when it is done.

The first line is a header with the settings, each further one a log with its files, or files of all logs. A log stands
in the journal once all its files are whole, so that a killed export goes on behind it.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from factory.datasets.navsim.frames import N_FUTURE, N_HISTORY, SplitNames
from factory.files import atomic_file, naming_disk_errors
from factory.store.schema import canonical_json

MANIFEST, JOURNAL = "manifest.jsonl", ".journal.jsonl"
FORMAT = "simscale-1"


@dataclass(frozen=True)
class File:
    """One file, by its path below the export's folder."""

    path: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Written:
    """A log that is whole."""

    folder: str  # of its split
    log: str
    token: str
    attempt_id: str
    made_of: str  # digest of what the row was made under; a row that was made again is written again
    data_split: str  # train, val or test
    has_route: bool  # else the public loader leaves it out
    image_source: str
    sizes: tuple[str, ...]  # of the pictures as written
    distorted: bool  # these are as a lens makes them
    absent_pictures: int  # of the history's 32
    left_out_cameras: tuple[str, ...]
    files: tuple[File, ...]  # the pickle last


def write_file(root: Path, path: str, data: bytes) -> File:
    """A whole file or none. Raises DiskFull."""
    with atomic_file(root / path, len(data)) as draft:
        draft.write_bytes(data)
    return File(path, len(data), hashlib.sha256(data).hexdigest())


def file_of(root: Path, path: str) -> File:
    """A file that is there, read through once."""
    with (root / path).open("rb") as file:
        digest = hashlib.file_digest(file, "sha256")
    return File(path, (root / path).stat().st_size, digest.hexdigest())


class Journal:
    """The lines of an export in its folder, begun or gone on with."""

    def __init__(self, root: Path, settings: Mapping[str, Any]) -> None:
        """Raises ValueError where the folder holds an export with other settings, OSError where it is no folder."""
        self.root, self.settings = root, json.loads(canonical_json(settings))
        self.logs: dict[tuple[str, str], Written] = {}  # by folder and log
        self.facts: dict[str, Any] = {}  # of a finished export: what its header says
        self.files: list[File] = []  # of a finished export: those of all logs
        root.mkdir(parents=True, exist_ok=True)
        self.interrupted = (root / JOURNAL).exists()
        for name in (MANIFEST, JOURNAL):
            self._read(root / name)

    def begin(self) -> None:
        """From here on what is written is noted. Raises DiskFull."""
        if not (self.root / JOURNAL).exists():
            self._append({"format": FORMAT, "settings": self.settings})

    def add(self, logs: Iterable[Written]) -> None:
        """Logs whose files are whole. Raises DiskFull."""
        for log in logs:
            self.logs[log.folder, log.log] = log
            self._append({"log": asdict(log)})

    def whole(self, file: File) -> bool:
        """Whether a file is still there, by its size."""
        path = self.root / file.path
        return path.exists() and path.stat().st_size == file.bytes

    def finish(self, facts: Mapping[str, Any], logs: Iterable[Written], files: Iterable[File]) -> File:
        """Replace the journal by the manifest, its lines in order."""
        header = {"format": FORMAT, "settings": self.settings, **facts}
        lines = [header, *({"log": asdict(log)} for log in logs), *({"file": asdict(file)} for file in files)]
        data = "".join(canonical_json(line) + "\n" for line in lines).encode()
        written = write_file(self.root, MANIFEST, data)
        (self.root / JOURNAL).unlink(missing_ok=True)
        return written

    def _read(self, path: Path) -> None:
        if not path.exists():
            return
        data = path.read_bytes()
        whole = data.rfind(b"\n") + 1  # behind it stands half a line of an export that was killed
        if whole < len(data):
            os.truncate(path, whole)
        if whole == 0:
            path.unlink()
            return
        header, *rest = (json.loads(line) for line in data[:whole].splitlines())
        if header["settings"] != self.settings:
            raise ValueError(f"{path}: is of an export with other settings, {header['settings']}: name another folder")
        self.facts |= header
        for entry in rest:
            if "log" in entry:
                log = _written(entry["log"])
                self.logs[log.folder, log.log] = log
            else:
                self.files.append(File(**entry["file"]))

    def _append(self, line: Mapping[str, Any]) -> None:
        path, data = self.root / JOURNAL, canonical_json(line) + "\n"
        with naming_disk_errors(path, len(data)), path.open("a") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())


def _written(stored: Mapping[str, Any]) -> Written:
    files = tuple(File(**file) for file in stored["files"])
    lists = {name: tuple(stored[name]) for name in ("sizes", "left_out_cameras")}
    return Written(**{**stored, **lists, "files": files})


# The YAML files that name a split's logs and tokens to the public code.

LISTS = {"test": "test_logs", "train": "train_logs", "val": "val_logs"}  # by a sample's split


def scene_filter(logs: Sequence[Written]) -> str:
    """Of navsim.common.dataclasses.SceneFilter; unknown keys would be refused (NS dataclasses.py:733-778)."""
    return "".join(
        (
            "_convert_: all\n_target_: navsim.common.dataclasses.SceneFilter\nframe_interval: 1\nhas_route: true\n",
            _list("log_names", (log.log for log in logs)),
            f"max_scenes: null\nnum_future_frames: {N_FUTURE}\nnum_history_frames: {N_HISTORY}\n",
            _list("tokens", (log.token for log in logs)),
        )
    )


def split(names: SplitNames) -> str:
    """What run_dataset_caching takes as train_test_split; data_split is the folder that the logs really lie in."""
    return f"data_split: {names.folder}\ndefaults:\n- scene_filter: {names.yaml}\n"


def log_split(logs: Sequence[Written]) -> str:
    """Which logs a training takes, and which it validates on (SS training/dataset.py:129-146)."""
    return "".join(_list(key, (log.log for log in logs if log.data_split == name)) for name, key in LISTS.items())


def _list(key: str, values: Iterable[str]) -> str:
    """In double quotes: a token of digits alone, or one with an e among them, would be read as a number."""
    listed = list(values)
    return f"{key}:\n" + "".join(f'- "{value}"\n' for value in listed) if listed else f"{key}: []\n"

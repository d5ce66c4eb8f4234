"""What lies in a folder of somebody's data: the one place that looks, so that all that read see the same.

Links are followed. What macOS and Windows leave beside the files they copy is no data: it is passed over.
"""

import logging
import os
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

log = logging.getLogger(__name__)

LEFT_BESIDE = frozenset({".ds_store", "__macosx", "desktop.ini", "thumbs.db"})  # and AppleDouble's ._<name>


def is_data(name: str) -> bool:
    """Whether a file or folder of this name is more than a companion of others."""
    return not name.startswith("._") and name.lower() not in LEFT_BESIDE


def matching(folder: Path, pattern: str) -> list[Path]:
    """What matches a glob pattern without `**`, such as *.pkl or v1.0-*/scene.json, sorted; none in what is no folder.

    A link that leads nowhere is among them: it is a file that cannot be read.
    """
    return sorted(path for path in folder.glob(pattern) if all(map(is_data, path.relative_to(folder).parts)))


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
            entries = [entry for entry in os.scandir(here) if is_data(entry.name)]
        except OSError as error:
            _pass_over(here, error.strerror or str(error))
            continue
        for entry in entries:
            if matches := fnmatchcase(entry.name, pattern):
                found.append(here / entry.name)
            if entry.is_dir(follow_symlinks=False):
                folders.append(here / entry.name)
            elif _leads_to_folder(entry, told=not matches):
                links.append(here / entry.name)
        links.sort()
    return sorted(found)


def folders_in(folder: Path) -> list[Path]:
    """The folders in a folder, sorted; none in what is none. A link that leads nowhere is named in the log."""
    entries = [entry for entry in os.scandir(folder) if is_data(entry.name)] if folder.is_dir() else []
    return sorted(
        folder / entry.name for entry in entries if entry.is_dir(follow_symlinks=False) or _leads_to_folder(entry)
    )


def _leads_to_folder(entry: os.DirEntry[str], told: bool = True) -> bool:
    """Whether it is a link to a folder; told: one that leads nowhere, or where nobody may look, is named in the log."""
    if not entry.is_symlink() or os.path.isdir(entry):
        return entry.is_symlink()
    if told and not os.path.exists(entry):
        _pass_over(entry.path, f"the link leads to {os.readlink(entry)}, which is not there")
    return False


@cache
def _pass_over(path: str | Path, why: str) -> None:
    """Once a process: a folder is looked at several times."""
    log.warning("%s is passed over: %s", path, why)

"""A folder of files that can be made again: it is there whole or not at all, and holds the checksums of its files.

What writes it must give the same bytes each time. Several processes may write one folder at once; the first wins.
"""

import hashlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from factory.files import matching_below
from tasks.caches import Damaged, sealed_json, unsealed_json

log = logging.getLogger(__name__)

SUMS = "checksums.json"

Write = Callable[[Path], object]  # fills an empty folder


def make_whole(root: Path, write: Write) -> None:
    """The folder `root` with what `write` writes into it, unless it is there: whole or not at all."""
    if not root.is_dir():
        finish_whole(unfinished_folder(root), root, write)


def unfinished_folder(root: Path) -> Path:
    """A new empty folder beside `root`, or beside what a link of that name leads to, to become it."""
    root = root.resolve()
    root.parent.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix=f".{root.name}-", dir=root.parent))


def finish_whole(unfinished: Path, root: Path, write: Write) -> None:
    """Has `unfinished` written and renames it to `root`; it is gone afterwards, whatever happened."""
    try:
        _fill(unfinished, write, root.name)
        try:
            os.rename(unfinished, root.resolve())
        except OSError:
            if not root.is_dir():  # else another worker was first, with the same bytes
                raise
    except OSError as error:
        error.filename = error.filename or str(root)  # Arrow and a flush name none
        raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def mend(root: Path, write: Write) -> None:
    """Holds a folder that is there against its checksums; where it is damaged its files are made again.

    They are moved into place one by one, so that who reads beside it finds every file, before or after; what is not of
    the folder goes. One line in the log says what was wrong.
    """
    if not (wrong := _wrong(root)):
        return
    log.warning("%s is damaged (%s); it is made again", root, wrong)
    anew = unfinished_folder(root)
    try:
        _fill(anew, write, root.name)
        own = [*_files(anew), SUMS]
        for name in own:
            there = root / name
            if not there.is_file() or _digest(there) != _digest(anew / name):
                there.parent.mkdir(parents=True, exist_ok=True)
                beside = Path(shutil.move(anew / name, tempfile.mkdtemp(prefix=".", dir=there.parent)))
                os.replace(beside, there)  # from the same disk, which a linked folder's need not be the root's
                beside.parent.rmdir()
        _remove_others(root, own)
    finally:
        shutil.rmtree(anew, ignore_errors=True)


def _remove_others(root: Path, own: Sequence[str]) -> None:
    """Leaves the files `own` alone. Of a link to a folder of none of them the link goes, never what it leads to."""
    for folder, below, files in os.walk(root, topdown=False):
        here = Path(folder)
        for path in (here / name for name in (*files, *below)):
            name = path.relative_to(root).as_posix()
            if path.is_dir() and not path.is_symlink():
                if not any(path.iterdir()):
                    path.rmdir()
            elif name not in own and not any(kept.startswith(f"{name}/") for kept in own):
                path.unlink()


def _fill(folder: Path, write: Write, named: str) -> None:
    write(folder)
    sums = {name: _digest(folder / name) for name in _files(folder)}
    (folder / SUMS).write_text(sealed_json({"folder": named, "files": sums}))


def _wrong(root: Path) -> str:
    """The first file that is not as it was written, and why; empty: all are."""
    try:
        told = unsealed_json((root / SUMS).read_bytes())
    except FileNotFoundError:
        return f"no {SUMS}"
    except Damaged as error:
        return f"{SUMS}: {error}"
    if told.get("folder") != root.name:
        return f"{SUMS} is of {told.get('folder')}"
    for name, digest in told["files"].items():
        if not (root / name).is_file():
            return f"{name} is missing"
        if _digest(root / name) != digest:
            return f"{name}: its checksum is another than when it was written"
    return ""


def _files(folder: Path) -> list[str]:
    """All but the checksums."""
    names = (path.relative_to(folder).as_posix() for path in matching_below(folder, "*") if path.is_file())
    return sorted(name for name in names if name != SUMS)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

"""A folder of data as systems and programs leave it: with companions of theirs, or with links in it."""

import os
import shutil
from pathlib import Path

APPLE_DOUBLE = b"\0\5\026\7\0\2\0\0Mac OS X        " + bytes(4)


IN_FOLDERS = (".DS_Store", "Thumbs.db", "desktop.ini", ".nfs0000000000c0ffee")
BESIDE_FILES = ("._{}", ".{}.aB3xYz", ".~lock.{}#", "~${}", "{}.part", "{}.crdownload", "{}~")
WITH_COPIES = (".snapshot", "#recycle", "$RECYCLE.BIN", ".ipynb_checkpoints", "@eaDir", ".AppleDouble")


def add_companions(root: Path) -> None:
    """Beside every file and folder what macOS leaves on exFAT and SMB, in every folder what Finder and Explorer do, a
    server's snapshots and bins with whole copies of the data, and what editors, rsync and browsers have begun.
    """
    data = [(Path(folder), folders, names) for folder, folders, names in os.walk(root)]
    for folder, folders, names in data:
        for name in (*folders, *names):
            for beside in BESIDE_FILES:
                (folder / beside.format(name)).write_bytes(APPLE_DOUBLE)
        for name in IN_FOLDERS:
            (folder / name).write_bytes(APPLE_DOUBLE)
    in_archives = root / "__MACOSX" / root.name  # a tree of the same names with companions alone
    shutil.copytree(root, in_archives, ignore=_all_but_companions)
    for folder, _, names in data:
        for copies in WITH_COPIES:
            for name in names:
                (folder / copies).mkdir(exist_ok=True)
                shutil.copy(folder / name, folder / copies / name)
    for copies in WITH_COPIES:
        for name in data[0][1]:
            shutil.copytree(root / name, root / copies / name)


def _all_but_companions(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if not name.startswith("._") and not Path(folder, name).is_dir()]


def put_behind_links(root: Path, elsewhere: Path) -> None:
    """Every folder and every file below the root lies elsewhere and is linked to; two links go round in a circle, and
    one leads nowhere."""
    for number, (folder, folders, names) in enumerate(list(os.walk(root, topdown=False))):
        for name in (*folders, *names):
            there = elsewhere / str(number) / name
            there.parent.mkdir(parents=True, exist_ok=True)
            Path(folder, name).rename(there)
            Path(folder, name).symlink_to(there)
    (root / "again").symlink_to(root)
    (elsewhere / "round").mkdir()
    (elsewhere / "round" / "back").symlink_to(root)
    (root / "round").symlink_to(elsewhere / "round")
    (root / "gone").symlink_to(elsewhere / "unmounted")

"""A folder of data as other systems leave it: with companions of macOS and Windows, or with links in it."""

import os
import shutil
from pathlib import Path

APPLE_DOUBLE = b"\0\5\026\7\0\2\0\0Mac OS X        " + bytes(4)


def add_companions(root: Path) -> None:
    """Beside every file and folder what macOS leaves on exFAT and SMB, in every folder what Finder and Explorer do."""
    for folder, folders, names in list(os.walk(root)):
        for name in (*folders, *names):
            Path(folder, f"._{name}").write_bytes(APPLE_DOUBLE)
        for name in (".DS_Store", "Thumbs.db"):
            Path(folder, name).write_bytes(APPLE_DOUBLE)
    in_archives = root / "__MACOSX" / root.name  # a tree of the same names with companions alone
    shutil.copytree(root, in_archives, ignore=_all_but_companions)


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

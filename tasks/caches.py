"""Where this user's caches lie, and cache files that carry a checksum: what was damaged on disk is found before use.

    <content> <SEAL> <sha256 of the content and of the file's key, 32 bytes>

The key is what a file is looked for by, such as its name: a whole file that stands under the key of another is damaged.
Files that have none are found by whoever names them. Formats that are read from their front, or that find their end
themselves, such as npz, stay readable with it. JSON carries its own in a member. A checksum finds damage; it does not
keep out who writes into the folder.
"""

import errno
import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)
NAME = "driving-data-factory"


def user_cache() -> Path:
    """The project's folder in the user's cache (XDG base directories); everything in it can be made again.

    Where none is named and the home folder cannot be written to, as in containers, it lies in the temporary folder.
    Raises PermissionError where another user has taken that place.
    """
    if named := os.environ.get("XDG_CACHE_HOME"):
        return Path(named) / NAME
    folder = Path(os.path.expanduser("~/.cache"), NAME)
    there = next((place for place in (folder, *folder.parents) if place.exists()), None)
    if folder.is_absolute() and there is not None and os.access(there, os.W_OK | os.X_OK):
        return folder
    instead = private_folder("cache")
    _warn_of_other_place(folder, instead)
    return instead


@cache
def _warn_of_other_place(folder: Path, instead: Path) -> None:
    log.warning("%s cannot be written to, so %s stands for it: name a folder in XDG_CACHE_HOME", folder, instead)


def private_folder(name: str) -> Path:
    """A folder of this user's own in the temporary one, to which others may write. Raises PermissionError."""
    folder = Path(tempfile.gettempdir(), f"{NAME}-{name}-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or folder.stat().st_uid != os.getuid():
        raise PermissionError(errno.EPERM, "belongs to another user", str(folder))
    return folder


SEAL = b"\nsha256\n"
SEAL_BYTES = len(SEAL) + 32
MEMBER = "sha256"  # of JSON
MOST_DIFFERENT = 8  # bytes in which a damaged file and its damaged copy differ: 256 ways to choose


class Damaged(ValueError):
    """A file is not as it was written: cut, or overwritten."""


def with_checksum(content: bytes, key: str = "") -> bytes:
    """What to write."""
    return content + SEAL + _keyed(hashlib.sha256(content), key)


def without_checksum(data: bytes, key: str = "") -> bytes:
    """The content of what was read under a key. Raises Damaged."""
    content = data[:-SEAL_BYTES]
    _compare(hashlib.sha256(content), data[-SEAL_BYTES:], key)
    return content


def whole_of_two(one: bytes, other: bytes, is_whole: Callable[[bytes], bool]) -> bytes | None:
    """What both were, where some bytes of one and others of the other are damaged; None where no choice is whole."""
    differ = [k for k, (a, b) in enumerate(zip(one, other)) if a != b]
    if len(one) != len(other) or len(differ) > MOST_DIFFERENT:
        return None
    for chosen in product((one, other), repeat=len(differ)):
        tried = bytearray(one)
        for k, source in zip(differ, chosen):
            tried[k] = source[k]
        if is_whole(bytes(tried)):
            return bytes(tried)
    return None


def append_checksum(path: Path, key: str = "") -> None:
    """Appends the seal to a file that is written."""
    with path.open("rb") as file:
        sha = hashlib.file_digest(file, "sha256")
    with path.open("ab") as file:
        file.write(SEAL + _keyed(sha, key))


def verify_checksum(path: Path, key: str = "") -> None:
    """Holds a large file against its seal without having it in memory. Raises Damaged, OSError."""
    left, sha = path.stat().st_size - SEAL_BYTES, hashlib.sha256()
    with path.open("rb") as file:
        while left > 0:
            block = file.read(min(left, 2**20))
            if not block:
                break
            sha.update(block)
            left -= len(block)
        _compare(sha, file.read(), key)


def json_with_checksum(members: Mapping[str, Any]) -> str:
    """As text for people too, the checksum last."""
    digest = hashlib.sha256(json.dumps(members).encode()).hexdigest()
    return json.dumps({**members, MEMBER: digest}, indent=1)


def parse_json_with_checksum(text: bytes) -> dict[str, Any]:
    """The opposite. Raises Damaged."""
    try:
        members: dict[str, Any] = json.loads(text)
        stated = members.pop(MEMBER)
        if json_with_checksum(members) != text.decode():  # its own words alone: a changed space is damage too
            raise Damaged(f"its checksum is not the stated {stated}")
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise error if isinstance(error, Damaged) else Damaged("no JSON with a checksum") from error
    return members


def _keyed(sha: "hashlib._Hash", key: str) -> bytes:
    if not key:
        return sha.digest()
    both = sha.copy()
    both.update(b"\x1f" + key.encode())
    return both.digest()


def _compare(sha: "hashlib._Hash", stated: bytes, key: str) -> None:
    if len(stated) < SEAL_BYTES or not stated.startswith(SEAL):
        raise Damaged("it does not end with a checksum")
    if stated != SEAL + _keyed(sha, key):
        raise Damaged(f"its checksum is another than when it was written{' under this name' if key else ''}")

"""Cache files that carry a checksum: what was damaged on disk is found before any of it is used.

    <content> <SEAL> <sha256 of the content, 32 bytes>

Formats that are read from their front, or that find their end themselves, such as npz, stay readable with it. JSON
carries its own in a member. A checksum finds damage; it does not keep out who writes into the folder.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SEAL = b"\nsha256\n"
SEAL_BYTES = len(SEAL) + 32
MEMBER = "sha256"  # of JSON


class Damaged(ValueError):
    """A file is not as it was written: cut, overwritten, or of a version that sealed none."""


def sealed(content: bytes) -> bytes:
    """What to write."""
    return content + SEAL + hashlib.sha256(content).digest()


def unsealed(data: bytes) -> bytes:
    """The content of what was read. Raises Damaged."""
    content = data[:-SEAL_BYTES]
    _compare(hashlib.sha256(content).digest(), data[-SEAL_BYTES:])
    return content


def seal(path: Path) -> None:
    """Appends the seal to a file that is written."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").digest()
    with path.open("ab") as file:
        file.write(SEAL + digest)


def check(path: Path) -> None:
    """Holds a large file against its seal without having it in memory. Raises Damaged, OSError."""
    left, sha = path.stat().st_size - SEAL_BYTES, hashlib.sha256()
    with path.open("rb") as file:
        while left > 0:
            block = file.read(min(left, 2**20))
            if not block:
                break
            sha.update(block)
            left -= len(block)
        _compare(sha.digest(), file.read())


def sealed_json(members: Mapping[str, Any]) -> str:
    """As text for people too, the checksum last."""
    return json.dumps({**members, MEMBER: _json_digest(members)}, indent=1)


def unsealed_json(text: bytes) -> dict[str, Any]:
    """The opposite. Raises Damaged."""
    try:
        members: dict[str, Any] = json.loads(text)
        stated = members.pop(MEMBER)
        if sealed_json(members) != text.decode():  # its own words alone: a changed space is damage too
            raise Damaged(f"its checksum is not the stated {stated}")
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise error if isinstance(error, Damaged) else Damaged("no JSON with a checksum") from error
    return members


def _json_digest(members: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(members).encode()).hexdigest()


def _compare(digest: bytes, stated: bytes) -> None:
    if len(stated) < SEAL_BYTES or not stated.startswith(SEAL):
        raise Damaged("it does not end with a checksum: it was cut, or an earlier version wrote it")
    if stated != SEAL + digest:
        raise Damaged("its checksum is another than when it was written")

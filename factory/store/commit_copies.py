"""A sealed copy of every file of a table's log, beside it: `_commits/<name>` for `_delta_log/<name>`.

Delta's log has no checksums, and a log whose last commit is gone is a whole log of an earlier time. The copies tell:
their newest number is the running count of commits, and what is damaged or gone is put back from them. A writer that is
killed between a commit and its copy leaves the copy to the next one.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass

from factory.store.location import Location
from tasks.sealed import Damaged, sealed, unsealed

LOG, COPIES = "_delta_log", "_commits"
LAST = "_last_checkpoint"  # where the newest checkpoint is; written over by each
NUMBERED = re.compile(r"(\d{20})\.(json|checkpoint\.parquet)")


@dataclass(frozen=True)
class LogDamage:
    """A file of the log, or of the copies, that is not what it was."""

    name: str  # relative to the table
    problem: str


class CommitCopies:
    """Of the table at a location."""

    def __init__(self, table: Location) -> None:
        self._log, self._copies = table.child(LOG), table.child(COPIES)

    def note(self, version: int) -> None:
        """Copy what the newest commit wrote, and what earlier ones did where a writer was killed before it could.

        The commit itself comes last, so that where its copy is there, that of its checkpoint is as well.
        """
        since = version
        if version and not self._copies.has(_json(version - 1)):
            have = set(self._copies.names())
            since = next((number for number in range(version, 0, -1) if _json(number - 1) in have), 0)
        for number in range(since, version + 1):
            if self._log.has(_checkpoint(number)):
                self._copy(_checkpoint(number))
                self._copy(LAST)
            self._copy(_json(number))

    def lost(self, version: int) -> int | None:
        """The number of a commit that was made and is newer than `version`, which the table says is its newest."""
        return version + 1 if self._copies.has(_json(version + 1)) else None

    def log_has(self, version: int, text: str = "") -> bool:
        """A commit of this number is in the log, whatever its listing says, and has a text in it."""
        found = self._log.read(_json(version))
        return found is not None and text.encode() in found

    def damage(self) -> list[LogDamage]:
        """What is not as it was. Of a table without copies nothing can be said."""
        copies, problems = self._unsealed()
        there = set(self._log.names())
        newest = max((name for name in there & copies.keys() if name.endswith(".parquet")), default="")
        for name in sorted(copies):
            data = self._log.read(name) if name in there else None
            if name == LAST:
                problem = self._last_problem(data, copies[name], there)
            elif data is None:  # commits before a checkpoint may be tidied away, and so may older checkpoints
                problem = "" if name[:20] <= newest[:20] else "is missing"
            else:
                problem = "" if data == copies[name] else "is not what was written"
            if problem:
                problems.append(LogDamage(f"{LOG}/{name}", problem))
        known = set(self._copies.names())
        last = max((name for name in known if name.endswith(".json")), default="")
        absent = (name for name in there if NUMBERED.fullmatch(name) and name < last and name not in known)
        return problems + [LogDamage(f"{COPIES}/{name}", "is missing") for name in sorted(absent)]

    def restore(self, found: LogDamage) -> None:
        """Put a file of the log back from its copy, or a copy from its file."""
        folder, _, name = found.name.partition("/")
        if folder == COPIES:
            if not self._copy(name):
                self._copies.remove(name)
            return
        self._log.write(name, self._copy_of(name))

    def _copy(self, name: str) -> bool:
        data = self._log.read(name)
        if data is not None:
            self._copies.write(name, sealed(data, name))
        return data is not None

    def _copy_of(self, name: str) -> bytes:
        """Raises Damaged."""
        return unsealed(self._copies.read(name) or b"", name)

    def _unsealed(self) -> tuple[Mapping[str, bytes], list[LogDamage]]:
        whole, problems = {}, []
        for name in self._copies.names():
            if name != LAST and not NUMBERED.fullmatch(name):  # a draft that a killed writer left
                continue
            try:
                whole[name] = self._copy_of(name)
            except Damaged as error:
                problems.append(LogDamage(f"{COPIES}/{name}", str(error)))
        return whole, problems

    def _last_problem(self, data: bytes | None, copy: bytes, there: set[str]) -> str:
        if data in (None, copy):  # without it the log is read from its list of files
            return ""
        try:
            version, copied = (int(json.loads(text)["version"]) for text in (data or b"", copy))
        except (ValueError, KeyError, TypeError):
            return "is not what was written"
        newer = version > copied and _checkpoint(version) in there  # a writer was killed before it could copy
        return "" if newer else "is not what was written"


def _json(version: int) -> str:
    return f"{version:020}.json"


def _checkpoint(version: int) -> str:
    return f"{version:020}.checkpoint.parquet"

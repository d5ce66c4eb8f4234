"""A sealed copy of every file of a table's log, beside it: `_commits/<name>` for `_delta_log/<name>`.

Delta's log has no checksums, and a log whose last commit is gone is a whole log of an earlier time. The copies tell:
their newest number is the running count of commits, and what is damaged or gone is put back from them. A writer that
is killed between a commit and its copy leaves the copy to the next one.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from operator import ne

from factory.store.location import Location
from tasks.caches import MOST_DIFFERENT, SEAL_BYTES, Damaged, whole_of_two, with_checksum, without_checksum

LOG, COPIES = "_delta_log", "_commits"
LAST = "_last_checkpoint"  # where the newest checkpoint is; written over by each
MOST_UNSEALED = 2  # bytes of a seal that may be damaged themselves; of what it does not fit nearly all 32 differ
NUMBERED = re.compile(r"(\d{20})\.(json|checkpoint\.parquet)")


@dataclass(frozen=True)
class DamagedPart:
    """One file that is not what it was."""

    name: str  # relative to the table, or of a verdict's to `out`
    problem: str

    def __str__(self) -> str:
        return f"{self.name}: {self.problem}"


class CommitCopies:
    """Of the table at a location."""

    def __init__(self, table: Location) -> None:
        self._log, self._copies = table.child(LOG), table.child(COPIES)

    def copy_commit(self, version: int) -> None:
        """Copy what the newest commit wrote, and what earlier ones did where a writer was killed before it could.

        The commit itself comes last, so that where its copy is there, that of its checkpoint is as well.
        """
        since = version
        if version and not self._copies.has(_commit_name(version - 1)):
            have = set(self._copies.names())
            since = next((number for number in range(version, 0, -1) if _commit_name(number - 1) in have), 0)
        for number in range(since, version + 1):
            if self._log.has(_checkpoint_name(number)):
                self._copy(_checkpoint_name(number))
                self._copy(LAST)
            self._copy(_commit_name(number))

    def lost_commit(self, version: int) -> int | None:
        """The number of a commit that was made and is newer than `version`, which the table says is its newest."""
        return version + 1 if self._copies.has(_commit_name(version + 1)) else None

    def log_has(self, version: int, text: str = "") -> bool:
        """A commit of this number is in the log, whatever its listing says, and has a text in it."""
        found = self._log.read(_commit_name(version))
        return found is not None and text.encode() in found

    def damage(self) -> list[DamagedPart]:
        """What is not as it was. Of a table without copies nothing can be said."""
        copies, problems = self._sealed()
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
                problems.append(DamagedPart(f"{LOG}/{name}", problem))
        known = set(self._copies.names())
        last = max((name for name in known if NUMBERED.fullmatch(name) and name.endswith(".json")), default="")
        absent = (name for name in there if NUMBERED.fullmatch(name) and name < last and name not in known)
        return problems + [DamagedPart(f"{COPIES}/{name}", "is missing") for name in sorted(absent)]

    def restore(self, found: DamagedPart) -> bool:
        """Put a file of the log back from its copy, or a copy from its file; whether either tells what was written."""
        folder, _, name = found.name.partition("/")
        whole = self._committed(name)
        if whole is None and (folder == LOG or self._log.has(name)):
            return False
        if whole is None:
            self._copies.remove(name)
        elif folder == LOG:
            self._log.write(name, whole)
        else:
            self._copies.write(name, with_checksum(whole, name))
        return True

    def _copy(self, name: str) -> None:
        data = self._log.read(name)
        if data is not None:
            self._copies.write(name, with_checksum(data, name))

    def _sealed(self) -> tuple[Mapping[str, bytes], list[DamagedPart]]:
        """What was committed, by name; and which copies are damaged."""
        found, problems = {}, []
        for name in self._copies.names():
            if name != LAST and not NUMBERED.fullmatch(name):  # a draft that a killed writer left
                continue
            try:
                without_checksum(self._copies.read(name) or b"", name)
            except Damaged as error:
                problems.append(DamagedPart(f"{COPIES}/{name}", str(error)))
            if (whole := self._committed(name)) is not None:
                found[name] = whole
        return found, problems

    def _committed(self, name: str) -> bytes | None:
        """What was written under this name, by the log's file, its sealed copy and their bytes where both are damaged.

        None where no choice between bytes that differ fits the seal. A copy that was cut, or is another file, says
        nothing: then the log is believed, as where there is no copy.
        """
        sealed, data = self._copies.read(name) or b"", self._log.read(name)
        try:
            return without_checksum(sealed, name)
        except Damaged:
            content, seal = sealed[:-SEAL_BYTES], sealed[-SEAL_BYTES:]
        if data is None or len(content) != len(data) or sum(map(ne, content, data)) > MOST_DIFFERENT:
            return data

        def fits(tried: bytes) -> bool:
            return sum(map(ne, with_checksum(tried, name)[-SEAL_BYTES:], seal)) <= MOST_UNSEALED

        return whole_of_two(content, data, fits)

    def _last_problem(self, data: bytes | None, copy: bytes, there: set[str]) -> str:
        if data in (None, copy):  # without it the log is read from its list of files
            return ""
        try:
            version, copied = (int(json.loads(text)["version"]) for text in (data or b"", copy))
        except (ValueError, KeyError, TypeError):
            return "is not what was written"
        newer = version > copied and _checkpoint_name(version) in there  # a writer was killed before it could copy
        return "" if newer else "is not what was written"


def _commit_name(version: int) -> str:
    return f"{version:020}.json"


def _checkpoint_name(version: int) -> str:
    return f"{version:020}.checkpoint.parquet"

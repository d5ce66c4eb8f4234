"""Mutants: small bugs made on purpose, each with the rule that it breaks and the tests that should notice.

They are kept as text, not as line numbers, so that edits elsewhere do not touch them: `old` stands exactly once in its
file, or first behind `after`, which does. One file of records for each room, in this folder.
"""

import ast
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(__file__).resolve().parent
PACKAGES = ("tasks", "factory", "planners")


class Stale(ValueError):
    """A record that does not fit the tree any more; the message says which, and what to do."""


@dataclass(frozen=True)
class Mutant:
    """One bug."""

    id: str  # unique
    rule: str  # what the program promises, which the bug breaks
    file: str  # of the product, from the root
    old: str  # text of the file
    new: str  # what stands there instead
    tests: tuple[str, ...]  # files or ids of pytest
    after: str = ""  # text of the file behind which `old` is looked for
    interpreted: bool = False  # kernels run as plain Python: their small tests are quicker than compiling
    limit_s: int = 240  # an endless test has noticed too

    @property
    def package(self) -> str:
        """The one that it is a bug of."""
        return self.file.split("/")[0]


def load(folder: Path = FOLDER) -> list[Mutant]:
    """All records, file by file. Raises Stale for one that is not written as a Mutant is, or whose id is taken."""
    found: dict[str, Mutant] = {}
    for path in sorted(folder.glob("*.toml")):
        for row in tomllib.loads(path.read_text())["mutant"]:
            mutant = _mutant(row, path)
            if mutant.id in found:
                raise Stale(f"{path.name}: two mutants are called {mutant.id}: rename one")
            found[mutant.id] = mutant
    return list(found.values())


def _mutant(row: dict[str, Any], path: Path) -> Mutant:
    known = {f.name for f in fields(Mutant)}
    needed = known - {"after", "interpreted", "limit_s"}
    if not needed <= row.keys() <= known:
        wrong = ", ".join(sorted((needed - row.keys()) | (row.keys() - known)))
        raise Stale(f"{path.name}: {row.get('id', 'a mutant without id')}: missing or unknown: {wrong}")
    return Mutant(**{**row, "tests": tuple(row["tests"])})


def chosen(mutants: Sequence[Mutant], only: str) -> list[Mutant]:
    """Those of a package, of a file or folder, or the one with this id; several with commas, all for an empty text.

    Raises Stale where one of these is nothing.
    """
    wanted: set[str] = set()
    for part in only.split(","):
        found = {m.id for m in mutants if part in (m.package, m.id) or m.file.startswith(part)}
        if not found:
            raise Stale(f"ONLY={part}: neither a package ({', '.join(PACKAGES)}), nor a file with mutants, nor an id")
        wanted |= found
    return [m for m in mutants if m.id in wanted]


def mutated(mutant: Mutant, root: Path = ROOT) -> str:
    """The file's text with the bug in it. Raises Stale where the record does not fit the file."""
    path = root / mutant.file
    if not path.is_file():
        raise Stale(f"mutant {mutant.id}: {mutant.file} is gone: move the record to where its code went, or drop it")
    text, start = path.read_text(), 0
    if mutant.after:
        _once(mutant, text, mutant.after)
        start = text.index(mutant.after) + len(mutant.after)
        if mutant.old not in text[start:]:
            raise Stale(_advice(mutant, mutant.old, "not there behind its `after`"))
    else:
        _once(mutant, text, mutant.old)
    made = text[:start] + text[start:].replace(mutant.old, mutant.new, 1)
    if made == text:
        raise Stale(f"mutant {mutant.id}: it changes nothing")
    try:
        ast.parse(made)
    except SyntaxError as error:
        raise Stale(f"mutant {mutant.id}: {mutant.file} would be no Python: {error}") from error
    return made


def _once(mutant: Mutant, text: str, part: str) -> None:
    if text.count(part) != 1:
        raise Stale(_advice(mutant, part, f"there {text.count(part)} times"))


def _advice(mutant: Mutant, part: str, problem: str) -> str:
    return (
        f"mutant {mutant.id}: in {mutant.file} this text is {problem}, and must be once:\n{part}\n"
        f"The code was edited: write the same bug for the new code in tests/mutants/*.toml ({mutant.rule})"
    )

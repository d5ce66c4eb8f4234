"""The pages of the project and the commands in them: fenced blocks line by line, and commands named in prose."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PAGES = sorted(
    str(path.relative_to(REPOSITORY))
    for folder, pattern in ((".", "*.md"), ("docs", "**/*.md"), ("deploy", "**/*.md"))
    for path in (REPOSITORY / folder).glob(pattern)
)
PROGRAMS = {"make", "python", ".venv/bin/python", "source", "ray", "torchrun"}
PROGRAMS |= {"kubectl", "prometheus", "rsync", "export", "echo", "git", "pip", ".venv/bin/pip"}
SAMPLE_OUTPUT = {  # first words of lines in unnamed blocks that are no commands
    "docs/concepts.md": {"reconstruct,", "clip"},  # the graph
    "docs/study.md": {"stage", "one_stage", "stage_one", "stage_two", "final"},  # what planners.agreement prints
    "docs/study_notes.md": {"105", "these:", "others:"},  # what the block above prints
}
FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)
IN_PROSE = re.compile(r"`((?:python -m|make|ray job|torchrun) [^`]+)`")


@dataclass(frozen=True)
class Command:
    """One command line as a page has it."""

    page: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}: {' '.join(self.words)}"


def blocks(page: str, language: str) -> list[str]:
    """The fenced blocks of that language ('' where none is named), in order."""
    return [body for named, body in FENCED.findall((REPOSITORY / page).read_text()) if named == language]


def commands(page: str) -> list[Command]:
    """Of the unnamed blocks: continued lines joined, comments left out, `NAME="..."` put in where $NAME stands.

    Raises ValueError for a line that begins with no known program and is not listed as a program's output.
    """
    found: list[Command] = []
    for block in blocks(page, ""):
        variables: dict[str, str] = {}
        for line in block.replace("\\\n", " ").splitlines():
            for name, value in variables.items():
                line = line.replace(f"${name}", value)
            assigned = re.match(r'([A-Z_]+)="([^"]*)"', line)
            if assigned:
                variables[assigned[1]] = assigned[2]
                continue
            first = line.split(maxsplit=1)[0] if line.strip() else "#"
            if first in SAMPLE_OUTPUT.get(page, ()) or first.startswith("#"):
                continue
            if first not in PROGRAMS:
                raise ValueError(f"{page}: {line!r} is no command of a program that is known here")
            found.append(Command(page, tuple(shlex.split(line, comments=True))))
    return found


def named_in_prose(page: str) -> list[Command]:
    """Commands in backticks outside of blocks, as far as they are shown: words like <file> and ... are left out."""
    prose = FENCED.sub("", (REPOSITORY / page).read_text())
    spans = (re.sub(r"\s+", " ", span) for span in IN_PROSE.findall(prose))
    return [Command(page, tuple(re.sub(r"\S*<[^>]*>\S*|\S*\.\.\.\S*", "", span).split())) for span in spans]

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
NO_COMMANDS = {"docs/concepts.md"}  # pages with an unnamed block that is a drawing, or output alone
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

    What a block shows after its commands is their output. Raises ValueError for a command after output, and for a
    block without a command on a page that is not in NO_COMMANDS.
    """
    found: list[Command] = []
    for block in blocks(page, ""):
        variables: dict[str, str] = {}
        shown, of_block = "", []
        for line in filter(None, map(str.strip, block.replace("\\\n", "").splitlines())):
            for name, value in variables.items():
                line = line.replace(f"${name}", value)
            assigned = re.match(r'([A-Z_]+)="([^"]*)"', line)
            if assigned:
                variables[assigned[1]] = assigned[2]
            elif line.startswith("#"):
                continue
            elif line.split(maxsplit=1)[0] not in PROGRAMS:
                shown = line
            elif shown:
                raise ValueError(f"{page}: {shown!r} is no command of a program that is known here")
            else:
                of_block.append(Command(page, tuple(shlex.split(line, comments=True))))
        if not of_block and page not in NO_COMMANDS:
            raise ValueError(f"{page}: no command of a program that is known here: {shown!r}")
        found += of_block
    return found


def named_in_prose(page: str) -> list[Command]:
    """Commands in backticks outside of blocks, as far as they are shown: words like <file> and ... are left out.

    Of the changelog only what is not released: older versions had the commands that they name.
    """
    text = (REPOSITORY / page).read_text()
    prose = FENCED.sub("", text.split("\n## 0.1.0")[0] if page == "CHANGELOG.md" else text)
    spans = (re.sub(r"\s+", " ", span) for span in IN_PROSE.findall(prose))
    return [Command(page, tuple(re.sub(r"\S*<[^>]*>\S*|\S*\.\.\.\S*", "", span).split())) for span in spans]

"""What an install of this project brings, worked out of pyproject.toml and the metadata of what is installed here."""

import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
SMALL = ""  # the install without an extra


def declared(extra: str) -> set[str]:
    """The distributions that pyproject.toml itself names for an install with that extra, those of SMALL included."""
    return {canonicalize_name(requirement.name) for requirement in _requirements(extra)}


def closure(extra: str) -> set[str]:
    """All distributions that an install with that extra brings on this platform.

    Raises PackageNotFoundError for one that is not installed here: what it needs in turn is unknown.
    """
    found: set[tuple[str, str]] = set()  # (distribution, its extra or "")
    waiting = list(_requirements(extra))
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        for wish in {"", *requirement.extras}:
            if (name, wish) not in found:
                found.add((name, wish))
                waiting += _needed(name, wish)
    return {name for name, _ in found}


def pins(lock: str) -> dict[str, tuple[Requirement, int]]:
    """Distribution -> its pin in that file of locks/ for this platform, and how many hashes it has."""
    found = {}
    for entry in re.split(r"\n(?=\S)", (REPOSITORY / "locks" / f"{lock}.lock").read_text().strip()):
        requirement = Requirement(re.split(r" \\$", entry, flags=re.M)[0])
        if requirement.marker is None or requirement.marker.evaluate():
            found[canonicalize_name(requirement.name)] = requirement, entry.count("--hash=sha256:")
    return found


def unpinned(extra: str, lock: str) -> list[str]:
    """What an install with that extra asks for, in pyproject.toml, that the file of locks/ does not pin so."""
    found = pins(lock)
    return [
        str(wanted)
        for wanted in _requirements(extra)
        if (name := canonicalize_name(wanted.name)) not in found
        or not wanted.specifier.contains(str(found[name][0].specifier).removeprefix("=="), prereleases=True)
    ]


def absent_modules(extra: str) -> frozenset[str]:
    """First words of all modules that are installed here and would not be with that extra alone."""
    brought = closure(extra) | {"driving-data-factory"}
    return frozenset(
        module
        for module, names in packages_distributions().items()
        if not brought & {canonicalize_name(name) for name in names}
    )


def as_if_installed(extra: str, folder: Path) -> Path:
    """A folder for PYTHONPATH under which Python does not find what an install with that extra would not bring."""
    folder.mkdir(exist_ok=True)
    (folder / "sitecustomize.py").write_text(
        "import sys\n"
        "from importlib.machinery import PathFinder\n"
        f"ABSENT = frozenset({sorted(absent_modules(extra))})\n"
        "class Installed(PathFinder):\n"
        "    @classmethod\n"
        "    def find_spec(cls, name, path=None, target=None):\n"
        "        return None if name.partition('.')[0] in ABSENT else PathFinder.find_spec(name, path, target)\n"
        "sys.meta_path[sys.meta_path.index(PathFinder)] = Installed\n"
    )
    return folder


def link_closure(extra: str, site: Path) -> None:
    """All files that an install with that extra brings into site-packages, as links to those installed here."""
    for name in closure(extra):
        for file in distribution(name).files or ():
            link = site / file
            if ".." not in file.parts and not link.exists():  # a program's script; two distributions' file
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(file.locate())


def _requirements(extra: str) -> Iterator[Requirement]:
    """Those of pyproject.toml; an extra that asks for another of this project is followed."""
    own = PROJECT["optional-dependencies"][extra] if extra else []
    for text in (*PROJECT["dependencies"], *own):
        requirement = Requirement(text)
        if requirement.name == PROJECT["name"]:
            for other in requirement.extras:
                yield from _requirements(other)
        else:
            yield requirement


def _needed(name: str, wish: str) -> Iterator[Requirement]:
    """What an installed distribution asks for on this platform with that extra of its own."""
    try:
        requires = distribution(name).requires or []
    except PackageNotFoundError as error:
        raise PackageNotFoundError(f"{name}: not installed here") from error
    for text in requires:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": wish}):
            yield requirement

"""The words of a command line as Hydra's overrides, and what is wrong with one in the user's own terms.

A setting is `key=value`. Text that Hydra's grammar does not read, such as a path with brackets, is taken as it stands.
Of Hydra's options two are kept: `--cfg` shows the settings, `--config-dir` adds a folder of one's own groups.
"""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

SHOW = ("--cfg", "-c")
FOLDER = ("--config-dir", "-cd")
SEVERAL = ("--multirun", "-m")
HOME = re.compile(r"(?<=[\[{,: ])~[^\s,:\[\]{}'\"]*")  # a path in a list or mapping, which Hydra reads in quotes alone
FILES = (  # last words of the keys that name files and folders
    "--config-dir -cd a anchors b bank benchmark cache cache_dir cameras check checkpoint data drives file files "
    "inference_vocabulary init_from label_vocabulary like logs made maps maps_root masks navsim_python out own_body "
    "pictures planner planners pretrained real renderer rewards root scene_filter scene_filters sensor_root sensors "
    "sim split starts table to transforms usdz val vocabularies vocabulary"
)
PATHS = frozenset(FILES.split())
FREE = ("clips.", "expert.", "planner.settings.")  # groups whose keys may be a plug-in's
NEEDS_READING = "[{'\""  # a value that begins so is a list, a mapping or quoted text, never plain text


class ConfigError(ValueError):
    """The command line or a configuration file asks for something that does not exist or does not fit."""


class SettingsShown(Exception):
    """The command line asks for the settings alone: these, as YAML, are printed, and nothing else is done.

    Raised by what reads the settings of a command, so that none can go on with what was only to be shown.
    """


@dataclass(frozen=True)
class CommandLine:
    """What a command line asks for."""

    overrides: tuple[str, ...]
    folders: tuple[Path, ...] = ()  # of groups beside those of conf/
    shows: bool = False  # only the settings

    @property
    def words(self) -> list[str]:
        """The same command line, every option one word."""
        show = [SHOW[0]] if self.shows else []
        return [*show, *(f"--config-dir={folder}" for folder in self.folders), *self.overrides]


def split_off_cfg(words: Sequence[str]) -> tuple[list[str], bool]:
    """The words without --cfg, and whether it was among them. Raises ConfigError where it asks for other settings."""
    others: list[str] = []
    shows = False
    rest = list(words)
    while rest:
        word = rest.pop(0)
        option, equals, value = word.partition("=")
        if option not in SHOW:
            others.append(word)
            continue
        shows = True
        what = value if equals else rest.pop(0) if rest and rest[0] in ("job", "hydra", "all") else "job"
        if what != "job":
            raise ConfigError(f"{option} {what}: the settings of the run alone are shown: {option}")
    return others, shows


def parse_command_line(words: Sequence[str]) -> CommandLine:
    """The words sorted into settings and options. Raises ConfigError for a word that is neither."""
    overrides: list[str] = []
    folders: list[Path] = []
    rest, shows = split_off_cfg(words)
    while rest:
        word = rest.pop(0)
        option, equals, value = word.partition("=")
        if option in FOLDER:
            if not equals:
                value = rest.pop(0) if rest else ""
            folder = Path(expand_home(value, option))
            if not value or not folder.is_dir():
                raise ConfigError(f"{option} {value}: there is no such folder".replace("  ", " "))
            folders.append(folder.resolve())
        elif word.startswith("-"):
            key = option.lstrip("-")
            if not equals:
                value = rest.pop(0) if rest and "=" not in rest[0] and not rest[0].startswith("-") else "..."
            raise ConfigError(f"{word}: settings have no dashes: {key}={value}; see --help")
        elif not equals or word.startswith("~"):
            raise ConfigError(f"{word!r}: expected key=value; see --help")
        else:
            overrides.append(word)
    return CommandLine(tuple(overrides), tuple(folders), shows)


def as_hydra_override(word: str) -> str:
    """An override that Hydra reads. Raises ConfigError for a list without its end, and for several values."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    key, _, value = word.partition("=")
    try:
        parsed = OverridesParser.create().parse_override(word)
    except HydraException as error:
        if not key or not all(letter.isalnum() or letter in "_.@/+~-" for letter in key):
            raise ConfigError(f"{word!r}: expected key=value; see --help") from error
        if value[:1] and value[0] in NEEDS_READING:
            if (quoted := HOME.sub(r"'\g<0>'", value)) != value:
                return as_hydra_override(f"{key}={quoted}")
            raise ConfigError(
                f"{word}: cannot be read; a list is {key}=[a,b], all of it in quotes for the shell"
            ) from (error)
        return f"{key}={_quoted(value)}"
    if parsed.is_sweep_override():
        if key.rpartition(".")[2] in PATHS and os.path.exists(os.path.expanduser(value)):  # a name with commas
            return f"{key}={_quoted(value)}"
        raise ConfigError(f"{word}: one value, or a list: {key}=[{value}]; several runs are several commands")
    return word


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


def expand_home(value: Any, key: str) -> Any:
    """A value whose texts that begin with `~` or `~user`, in lists and mappings too, are paths in those home folders.

    So of keys that are PATHS; of those that a plug-in may have, `~/` alone. Everything else is text as it stands.
    Raises ConfigError naming the key where there is no such home.
    """
    if isinstance(value, Mapping):
        return {name: expand_home(inner, f"{key}.{name}" if key else str(name)) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(expand_home(inner, key) for inner in value)
    if not isinstance(value, str) or not value.startswith("~"):
        return value
    is_path = key.rpartition(".")[2] in PATHS
    if not is_path and not (key.startswith(FREE) and value.startswith("~/")):
        return value
    path = os.path.expanduser(value)  # a Path would raise, and lose a slash at the end
    if path.startswith("~"):
        home = value.partition("/")[0]
        raise ConfigError(f"{key}={value}: there is no home folder {home}; a file that is called so here is ./{value}")
    return path


def unknown_choice_text(missing: str, choices: Sequence[str] | None, instead: Sequence[str] = ()) -> str:
    """`missing`: group/choice as Hydra names it; instead: choices that do what is meant, each with what it needs."""
    group, _, choice = missing.rpartition("/")
    if instead:
        return f"{group}={choice}: give {'; or '.join(instead)}"
    known = sorted(choices or ())
    meant = did_you_mean(choice, known).replace("mean ", f"mean {group}=")
    return f"{group}={choice}: there is {', '.join(known) or 'no choice'}{meant}"


def did_you_mean(word: str, known: Sequence[str], cutoff: float = 0.6) -> str:
    """`; did you mean x?` where one is near, else nothing. cutoff: 0..1, the likeness that counts as near."""
    names = {name.lower(): name for name in known}
    found = get_close_matches(word.lower(), [*names], n=1, cutoff=cutoff)
    return f"; did you mean {names[found[0]]}?" if found else ""

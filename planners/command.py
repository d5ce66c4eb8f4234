"""What all commands of `python -m planners` do alike: help, exit codes, one line for what is wrong."""

import sys
from collections.abc import Callable, Sequence
from functools import wraps
from inspect import get_annotations
from typing import Any

from factory.config.compose import conf_dir
from factory.config.shapes import defaults_of, described, merged
from factory.config.words import SettingsShown
from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED


class Failed(Exception):
    """A part ended with an error; what else was to be done is done."""


class Stopped(Exception):
    """Interrupted or out of minutes; what is done is kept, and the same command goes on."""


def command(answer: Callable[[Sequence[str]], None], keys: type[Any] | None = None) -> Callable[[Sequence[str]], int]:
    """The command that answers its arguments so: --help, and what is raised as one line and an exit code.

    keys: the dataclass of its keys, told by --help. ValueError and OSError are settings or files that do not fit.
    """

    @wraps(answer)
    def main(argv: Sequence[str]) -> int:
        if {"-h", "--help"} & set(argv):
            print(help_of(answer.__module__, keys))
            return COMPLETE
        try:
            answer(argv)
        except SettingsShown as settings:
            print(settings)
        except (ValueError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            return BAD_CONFIG
        except Failed as error:
            print(f"error: {error}", file=sys.stderr)
            return COMPLETE_WITH_FAILURES
        except Stopped as stopped:
            print(stopped, file=sys.stderr)
            return INTERRUPTED
        return COMPLETE

    return main


def help_of(module: str, shape: type[Any] | None = None) -> str:
    """What the module says of itself, and the keys of its file in conf/ where it has one, with those of `shape`."""
    about, path = sys.modules[module].__doc__ or "", conf_dir() / f"{module.rpartition('.')[2]}.yaml"
    if shape is None:
        return "\n".join([about, *([path.read_text(encoding="utf-8")] if path.is_file() else [])])
    from omegaconf import OmegaConf

    said = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    assert isinstance(said, dict)
    values = merged(defaults_of(shape), {str(key): value for key, value in said.items()})
    own_first = dict.fromkeys(name for cls in shape.__mro__ for name in get_annotations(cls) if name in values)
    return "\n".join([about, *described({name: values[name] for name in own_first}, shape, {})])

"""What all commands of `python -m planners` do alike: help, exit codes, one line for what is wrong."""

import sys
from collections.abc import Callable, Sequence
from functools import wraps

from factory.config.compose import conf_dir
from factory.exits import BAD_CONFIG, COMPLETE, COMPLETE_WITH_FAILURES, INTERRUPTED


class Failed(Exception):
    """A part ended with an error; what else was to be done is done."""


class Stopped(Exception):
    """Interrupted or out of minutes; what is done is kept, and the same command goes on."""


def command(answer: Callable[[Sequence[str]], None]) -> Callable[[Sequence[str]], int]:
    """The command that answers its arguments so: --help, and what is raised as one line and an exit code.

    ValueError and OSError are settings or files that do not fit.
    """

    @wraps(answer)
    def main(argv: Sequence[str]) -> int:
        if {"-h", "--help"} & set(argv):
            print(help_of(answer.__module__))
            return COMPLETE
        try:
            answer(argv)
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


def help_of(module: str) -> str:
    """What the module says of itself, and the keys of its file in conf/ where it has one."""
    keys = conf_dir() / f"{module.rpartition('.')[2]}.yaml"
    return "\n".join([sys.modules[module].__doc__ or "", *([keys.read_text()] if keys.is_file() else [])])

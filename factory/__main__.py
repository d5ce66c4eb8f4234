"""`python -m factory <command> ...`: one door to everything the factory does.

python -m factory run preset=demo out=runs/demo
python -m factory status out=runs/demo
python -m factory <command> --help
python -m factory --version
"""

import signal
import sys
from collections.abc import Sequence

from factory import __version__
from factory.arguments import BAD_ARGUMENTS
from factory.commands import COMMANDS, nearest


def help_text() -> str:
    """Every command in one line."""
    lines = "\n".join(f"  {name:<12}{command.about}" for name, command in COMMANDS.items())
    return f"{__doc__}\ncommands\n{lines}\n\nExit codes: docs/configuration.md. Arguments are key=value."


def main(argv: Sequence[str]) -> int:
    """Hand the arguments to the command that is named first; its exit code, 2 where there is none."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(help_text())
        return 0 if argv else BAD_ARGUMENTS
    if argv[0] in ("-V", "--version"):
        print(f"driving-data-factory {__version__}")
        return 0
    name, *rest = argv
    if name == "complete":  # what the shell's completion asks
        from factory.completion import complete

        return complete(rest)
    if name not in COMMANDS:
        print(f"error: there is no command {name}; see --help{nearest(name, list(COMMANDS))}", file=sys.stderr)
        return BAD_ARGUMENTS
    return COMMANDS[name].load()(rest)


def program() -> None:
    """The installed program `factory`."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `... | head` ends quietly
    sys.exit(main(sys.argv[1:]))


if __name__ == "__main__":
    program()

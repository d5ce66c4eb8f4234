"""`python -m factory <command> ...`: one door to everything the factory does.

python -m factory run preset=demo out=runs/demo
python -m factory status out=runs/demo
python -m factory <command> --help
python -m factory --version
"""

from collections.abc import Sequence

from factory.commands.table import COMMANDS, PLANNERS, command_list, dispatch
from factory.exits import run_program


def help_text() -> str:
    """Every command in one line."""
    return (
        f"{__doc__}\ncommands\n{command_list(COMMANDS)}\n\n"
        f"planners: python -m planners <command>\n{command_list(PLANNERS)}\n\n"
        "Exit codes: docs/configuration.md. Arguments are key=value."
    )


def main(argv: Sequence[str]) -> int:
    """Hand the arguments to the command that is named first; its exit code, 2 where there is none."""
    if argv and argv[0] == "complete":  # what the shell's completion asks
        from factory.commands.completion import complete

        return complete(argv[1:])
    return dispatch(argv, COMMANDS, help_text())


def program() -> None:
    """The installed program `factory`."""
    run_program(main)


if __name__ == "__main__":
    program()

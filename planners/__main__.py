"""`python -m planners <command> ...`: one door to training and evaluation.

python -m planners train planner=ltf data.real=[runs/town] data.sim=[runs/town] out=runs/ltf
python -m planners evaluate benchmark=runs/hard planner=runs/ltf
python -m planners <command> --help

Exit codes of all: 0 complete, 2 settings or files that do not fit, 3 a part of a sweep failed, 4 interrupted or out of
minutes, and the same command goes on. What is wrong is told in one line.
"""

from collections.abc import Sequence

from factory.commands.table import PLANNERS, command_list, dispatch
from factory.exits import run_program


def main(argv: Sequence[str]) -> int:
    """Hand the arguments to the command that is named first; its exit code, 2 where there is none."""
    return dispatch(argv, PLANNERS, f"{__doc__}\ncommands\n{command_list(PLANNERS)}\n\nMore: docs/training.md.")


def program() -> None:
    """The installed program `planners`."""
    run_program(main)


if __name__ == "__main__":
    program()

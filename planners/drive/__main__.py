"""`python -m planners.drive ...`: the same as `python -m planners drive ...`."""

from factory.commands.table import PLANNERS
from factory.exits import run_program

if __name__ == "__main__":
    run_program(lambda argv: PLANNERS["drive"].load()(argv))

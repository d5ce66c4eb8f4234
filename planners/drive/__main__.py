"""`python -m planners.drive ...`: the same as `python -m planners drive ...`."""

from factory.commands.table import PLANNERS
from factory.exits import as_program

if __name__ == "__main__":
    as_program(lambda argv: PLANNERS["drive"].load()(argv))

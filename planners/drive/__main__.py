"""`python -m planners.drive ...`: the same as `python -m planners drive ...`."""

from factory.exits import as_program
from planners.drive.drive import main

if __name__ == "__main__":
    as_program(main)

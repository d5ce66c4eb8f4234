"""`python -m planners <command> ...`: one door to training and evaluation.

python -m planners train planner=ltf data.real=[runs/town] data.sim=[runs/town] out=runs/ltf
python -m planners evaluate benchmark=runs/hard planner=runs/ltf
python -m planners <command> --help
"""

import signal
import sys
from collections.abc import Sequence

from factory.commands.table import PLANNERS, dispatch, listed


def main(argv: Sequence[str]) -> int:
    """Hand the arguments to the command that is named first; its exit code, 2 where there is none."""
    return dispatch(argv, PLANNERS, f"{__doc__}\ncommands\n{listed(PLANNERS)}\n\nMore: docs/training.md.")


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `... | head` ends quietly
    sys.exit(main(sys.argv[1:]))

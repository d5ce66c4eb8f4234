"""Which expert's labels teach a planner most; README.md beside this file.

    python -m experiments.labels.labels                   all of it: data, trainings, benchmark, drives, tables
    python -m experiments.labels.labels minutes=25        a part: what is done stays done, the same command goes on
    python -m experiments.labels.labels minutes=0         the tables of what is done, again

A planner that sees the map from above learns for equally many optimiser steps from real samples alone, and from these
and equally many samples of one expert each: what the run's gates accept from perturbed states of the same clips. A
control are the log's own labels from such states, ungated. How they are scored and what is written:
experiments.sceptic.experiment.
"""

import sys
from collections.abc import Sequence

from experiments.sceptic.experiment import experiment
from factory.config.arguments import INPUT_ERRORS, run_command


def labels(argv: Sequence[str]) -> None:
    """The experiment of labels.yaml. Raises ConfigError, Stopped, Failed."""
    experiment(__file__, argv)


if __name__ == "__main__":
    sys.exit(run_command(sys.argv[1:], labels, lambda: __doc__, INPUT_ERRORS))

"""`python -m planners labels`: which expert's labels teach a planner most; docs/experts.md.

    python -m planners labels                   all of it: data, trainings, benchmark, tables
    python -m planners labels minutes=25        a part of it: what is done stays done, and the same command goes on
    python -m planners labels minutes=0         the tables of what is done, again

A planner that sees the map from above learns for equally many optimiser steps from real samples alone, and from these
and equally many samples of one expert each: what the run's gates accept from perturbed states of the same clips. A
control are the log's own labels from such states, ungated. How they are scored and what is written:
planners.study.experiment.
"""

from collections.abc import Sequence

from planners.command import command
from planners.study.experiment import ExperimentSettings, experiment


def labels(argv: Sequence[str]) -> None:
    """The experiment of conf/labels.yaml. Raises ConfigError, Stopped, Failed."""
    experiment("labels", argv)


main = command(labels, ExperimentSettings)

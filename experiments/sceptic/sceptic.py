"""What simulated samples are worth beside other additions; README.md beside this file.

    python -m experiments.sceptic.sceptic                  all of it: data, trainings, benchmark, drives, tables
    python -m experiments.sceptic.sceptic minutes=25       a part: what is done stays done, the same command goes on
    python -m experiments.sceptic.sceptic minutes=0        the tables of what is done, again

Planners learn for equally many optimiser steps from real samples alone, and from these and as many added ones:

    more         real samples of other logs of the same towns
    redrawn      renderings at logged poses, with the log's own label: the pictures alone are another's
    logged       renderings from perturbed states, with the log's own label
    pdm_closed   renderings from perturbed states, with the pseudo-expert's

How they are scored and what is written: experiments.sceptic.experiment.
"""

import sys
from collections.abc import Sequence

from experiments.sceptic.experiment import experiment
from factory.config.arguments import INPUT_ERRORS, run_command


def sceptic(argv: Sequence[str]) -> None:
    """The experiment of sceptic.yaml. Raises ConfigError, Stopped, Failed."""
    experiment(__file__, argv)


if __name__ == "__main__":
    sys.exit(run_command(sys.argv[1:], sceptic, lambda: __doc__, INPUT_ERRORS))

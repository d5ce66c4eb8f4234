"""`python -m planners sceptic`: what simulated samples are worth beside other additions; docs/study/sceptic.md.

    python -m planners sceptic                  all of it: data, trainings, benchmark, drives, tables
    python -m planners sceptic minutes=25       a part of it: what is done stays done, and the same command goes on
    python -m planners sceptic minutes=0        the tables of what is done, again

Planners learn for equally many optimiser steps from real samples alone, and from these and as many added ones:

    more         real samples of other logs of the same towns
    redrawn      renderings at logged poses, with the log's own label: the pictures alone are another's
    logged       renderings from perturbed states, with the log's own label
    pdm_closed   renderings from perturbed states, with the pseudo-expert's

How they are scored and what is written: planners.study.experiment.
"""

from collections.abc import Sequence

from planners.command import command
from planners.study.experiment import ExperimentSettings, experiment


def sceptic(argv: Sequence[str]) -> None:
    """The experiment of conf/sceptic.yaml. Raises ConfigError, Stopped, Failed."""
    experiment("sceptic", argv)


main = command(sceptic, ExperimentSettings)

"""What differs inside a submitted Ray job: the working directory is a copy that Ray throws away."""

import os
from pathlib import Path

RUNS = "FACTORY_RUNS"  # environment variable: the folder or URL below which results lie that no `out` names


def in_submitted_job() -> bool:
    """This process is the driver of a `ray job submit`."""
    return "RAY_JOB_CONFIG_JSON_ENV_VAR" in os.environ  # Ray sets it for drivers of jobs alone


def runs_root() -> str:
    """FACTORY_RUNS, else `runs` in the working directory, in a submitted job ~/driving-data-factory/runs."""
    if named := os.environ.get(RUNS):
        return named
    return str(Path.home() / "driving-data-factory" / "runs") if in_submitted_job() else "runs"

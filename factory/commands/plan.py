"""`python -m factory plan ...`: what a run of these settings would take; nothing is written but cached blocks.

    python -m factory plan clips=av2 clips.root=<logs> rounds=5 out=runs/next

Clips, attempts, samples, core-hours, GPU-hours and GB, from a calibration on three clips; where `out` has samples
already, also what the rates there come to. Takes the settings of `python -m factory run`.
Exit codes: 0 told, 2 bad settings or no clip.
"""

from collections.abc import Sequence

from factory import run
from factory.config.arguments import command
from factory.config.run import RunConfig
from factory.config.words import asked_of


@command("run", RunConfig, refused=(), resumes=True)
def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    return run.run(asked_of(argv), only_plan=True)

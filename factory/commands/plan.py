"""`python -m factory plan ...`: what a run of these settings would take; nothing is written but cached blocks.

    python -m factory plan clips=av2 clips.root=<logs> rounds=5 out=runs/next

Clips, attempts, samples, core-hours, GPU-hours and GB, from a calibration on three clips; where `out` has samples
already, also what the rates there come to. Takes the settings of `python -m factory run`, whose --help lists them.
Exit codes: 0 told, 2 bad settings or no clip.
"""

from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    from factory.run import main as run

    return run(argv, only_plan=True)

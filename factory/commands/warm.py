"""`python -m factory warm [part ...]`: compile the kernels before the first run, some 60 s on a core.

    python -m factory warm                  all of them, and what the synthetic town is painted with
    python -m factory warm drive judge      parts: what a run that only drives needs, what scores need

Each is compiled once per machine, processor and version; what is there is not compiled again. Exit codes: 0 compiled,
2 no such part, or no folder to keep them in.
"""

import sys
from collections.abc import Sequence

from factory.config.arguments import BAD_ARGUMENTS


def main(argv: Sequence[str]) -> int:
    """The parts that are named, else all; the exit code."""
    if {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    from factory.graph.work import NotReady
    from factory.stages.warm import PARTS, compile_kernels, compile_town_kernels

    if unknown := sorted(set(argv) - PARTS.keys()):
        print(f"error: no part {', '.join(unknown)}; there are {', '.join(PARTS)}", file=sys.stderr)
        return BAD_ARGUMENTS
    try:
        compile_kernels(list(argv) or ["judge", "answers", "fit"])
    except NotReady as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_ARGUMENTS
    if not argv:
        compile_town_kernels()
    return 0

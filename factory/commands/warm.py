"""`python -m factory warm [part ...]`: compile the kernels before the first run, some 110 s on a core.

    python -m factory warm                  all of them, and what the synthetic town is drawn with
    python -m factory warm drive judge      parts: what a run that only drives needs, what scores need

Each is compiled once per machine, processor and version; what is there is not compiled again.
"""

from dataclasses import dataclass, field

from factory.config.arguments import POSITIONAL, Refused
from factory.config.datasets import data_sets


@dataclass(frozen=True)
class Request:
    """The command line."""

    parts: tuple[str, ...] = field(default=(), metadata=POSITIONAL)


def main(request: Request) -> None:
    """Compile the parts that are named, else all. Raises Refused."""
    from factory.graph.steps import NotReady
    from factory.stages.warm import PARTS, compile_kernels

    if unknown := sorted(set(request.parts) - PARTS.keys()):
        raise Refused(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    try:
        compile_kernels(list(request.parts) or ["judge", "plan", "answers", "fit", "rig"])
    except NotReady as error:
        raise Refused(str(error)) from error
    if not request.parts:
        for data_set in data_sets().values():
            getattr(data_set, "compile_kernels", lambda: None)()

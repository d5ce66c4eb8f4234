"""`python -m factory status out=<folder or URL>`: what a run holds, and how its newest start ended.

    python -m factory status out=runs/demo        tables, counts, acceptance funnel, the newest run

One sample: python -m factory show.
"""

from dataclasses import dataclass

from factory.views.status import open_store, status_lines


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str


def main(request: Request) -> None:
    """Print it, line by line."""
    for line in status_lines(open_store(request.out)):
        print(line, flush=True)

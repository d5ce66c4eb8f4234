"""`python -m factory report out=<folder or URL>`: a run as one HTML file, for sharing.

    python -m factory report out=runs/demo                  writes runs/demo/report.html and, beside it, README.md,
                                                            the data set's card, as a run does at its end
    python -m factory report out=s3://bucket/samples to=run.html

It is the dashboard with its answers and some pictures inside: the same page, the same numbers, nothing fetched.
"""

from dataclasses import dataclass

from factory.views.board.report import write_report
from factory.views.status import open_store


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str
    to: str | None = None  # another file; null: in the run's folder, with the card


def main(request: Request) -> None:
    """Write the file; the card too where it goes into the run's folder."""
    from factory.views.card import write_card

    store = open_store(request.out)
    print(write_report(store, request.to))
    if request.to is None:
        print(write_card(store))

"""`python -m factory lineage out=<folder or URL> sample=<id>`: where a sample, or any other attempt, comes from.

    python -m factory lineage 3fa9 out=runs/demo            an id, the beginning of one, or an ordinal
    python -m factory lineage sample=0 out=s3://bucket/samples

Run -> clip -> candidate -> attempt -> sample, with digests, versions and files.
"""

from dataclasses import dataclass, field

from factory.config.arguments import POSITIONAL
from factory.views.lineage import lineage
from factory.views.status import open_store


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str
    sample: str = field(metadata=POSITIONAL)


def main(request: Request) -> None:
    """Print the chain, part by part."""
    for title, facts in lineage(open_store(request.out), request.sample):
        print(title)
        for name, value in facts:
            if value not in (None, ""):
                print(f"  {name:<18}{value}")

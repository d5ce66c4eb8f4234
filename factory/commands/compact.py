"""`python -m factory compact out=<folder or URL>`: merge the small shards of a run into larger ones.

Of each round and expert, files below 64 MB are merged into files of up to 128 MB, one transaction a table. No sample
changes: readers, trainings and their order are the same before and after. What was merged is left for readers that are
open; `python -m factory clean` removes it. While a run writes here the command is refused.
"""

from dataclasses import dataclass

from factory.config.arguments import Refused
from factory.views.status import open_store


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str


def main(request: Request) -> None:
    """Merge and say what became of each table. Raises Refused."""
    from factory.store.location import BadLocation, DamagedFile
    from factory.store.table import AnotherWriter
    from factory.store.verify import RunInProgress, claim_for_upkeep, compact

    store = open_store(request.out)
    try:
        claim_for_upkeep(store)
        for merged in compact(store):
            print(f"{merged.table:<13}{merged.before} files, now {merged.after}")
    except (RunInProgress, AnotherWriter, BadLocation) as error:
        raise Refused(str(error)) from error
    except DamagedFile as error:
        raise Refused(f"{error}; python -m factory verify out={request.out} repair=true takes it out") from error

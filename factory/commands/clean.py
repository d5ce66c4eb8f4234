"""`python -m factory clean out=<folder or URL>`: remove what runs that died left behind.

    python -m factory clean out=runs/demo                     what was last written a day ago or earlier
    python -m factory clean out=runs/demo older_than=2h       days, hours or minutes: 7d, 12h, 30min
    python -m factory clean out=runs/demo say=true            name them and remove nothing

These are temporary files, files in the tables' folders that no commit names, and episodes of rows that were replaced.
A reader that was opened before rows were replaced or shards merged still reads what they stood in: leave it its time.
While a run writes here the command is refused.
"""

import re
import time
from dataclasses import dataclass

from factory.config.arguments import Refused
from factory.views.status import open_store

UNITS_S = {"d": 86_400.0, "h": 3600.0, "min": 60.0}


@dataclass(frozen=True)
class Request:
    """The command line."""

    out: str
    older_than: str = "1d"  # days, hours or minutes, as 7d, 12h, 30min: what is younger stays
    say: bool = False  # and remove nothing

    def __post_init__(self) -> None:
        _ = self.older_s

    @property
    def older_s(self) -> float:
        """Raises ValueError for what is no time."""
        told = re.fullmatch(r"(\d+(?:\.\d+)?)(d|h|min)", self.older_than)
        if told is None:
            raise ValueError(
                f"older_than={self.older_than}: must be a number of days, hours or minutes: 7d, 12h, 30min"
            )
        return float(told[1]) * UNITS_S[told[2]]


def main(request: Request) -> None:
    """Remove and name them. Raises Refused."""
    from factory.files import why_not_written
    from factory.store.location import BadLocation
    from factory.store.table import AnotherWriter
    from factory.store.verify import RunInProgress, claim_for_upkeep, leftovers, refuse_while_running

    store = open_store(request.out)
    try:
        (refuse_while_running if request.say else claim_for_upkeep)(store)
        found = leftovers(store, request.older_s, time.time())
    except (RunInProgress, AnotherWriter, BadLocation, OSError) as error:
        raise Refused(why_not_written(error) or str(error)) from error
    for name in found:
        if not request.say:
            store.location.remove(name)
        print(f"{'leftover' if request.say else 'removed'}  {name}")
    print(f"{len(found)} files older than {request.older_than}")

"""What workers do in tests of `each`: a module of its own, as they import it."""

import os
import time
from pathlib import Path

from factory.store.location import Location


class OddItem(ValueError):
    """Of what stands at fault."""


def squared(number: int, odd: int = -1, deadly: int = -1) -> int:
    if number == odd:
        raise OddItem(f"{number} is odd")
    if number == deadly:
        os._exit(9)
    return number * number


def noted(path: Path) -> None:
    """Says whose process it is, and stays."""
    draft = path.with_suffix(".tmp")
    draft.write_text(str(os.getpid()))
    draft.replace(path)
    time.sleep(60.0)


class Elsewhere(Location):
    """A folder as a node sees it that has another disk there."""

    def read(self, name: str) -> bytes | None:
        return None
